"""How annotations are checked at run time under test: by beartype, where an int is a float, as PEP 484 says."""

from beartype import BeartypeConf, beartype

check_annotations = beartype(conf=BeartypeConf(is_pep484_tower=True))

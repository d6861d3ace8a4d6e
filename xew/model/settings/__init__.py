"""Settings of an experiment: the sections of a config, their checks, and the parts that the rest of the package takes.

`xew.model.experiment` combines them.
"""

__all__ = ["checks", "optimizer", "parts", "settings"]

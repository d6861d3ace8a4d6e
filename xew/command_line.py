"""Commands on a config: `CONFIG [flags] [--section.field value …]`; --help lists every option.

The flags are a dataclass of the command. Every other option is a field of the config, with the config's value as its default.
"""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Generic, NamedTuple, TypeVar

import tyro

from xew.config import ConfigError, check_finite

F = TypeVar("F")
C = TypeVar("C")


class Command(NamedTuple, Generic[F, C]):
    """A parsed command line."""

    path: Path
    """Path of the config, or of another input of the command."""
    flags: F
    config: C
    """The config with its overrides; only types and the finiteness of numbers have been checked."""


def parse_command(
    flags: type[F],
    kind: type[C],
    read: Callable[[Path], C],
    arguments: Sequence[str] | None,
    *,
    prog: str,
    description: str,
    metavar: str = "CONFIG",
) -> Command[F, C]:
    """Parse a command line.

    Args:
        flags: the command's own flags, a dataclass whose fields all have defaults. They override fields of the config with
            the same name.
        kind: type of the config, a dataclass.
        read: reads the config at a path.
        arguments: default: the arguments of the process.
        prog: name of the command, for messages.
        description: one line on what it does.
        metavar: name of the first argument, for messages.

    Raises:
        ConfigError: the config is missing or cannot be read, or a number is not finite.
        SystemExit: an option is unknown or malformed (code 2), or --help was given (code 0).
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    path = find_path(words, flags)
    if path is None and not {"-h", "--help"} & set(words):
        raise ConfigError(f"name the {metavar} first, as in `{prog} {metavar}`; --help lists all options.")
    first = ("path", Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name=metavar.lower(), help=f"The {metavar}.")])
    own = [field.name for field in dataclasses.fields(flags)]  # type: ignore[arg-type]
    # Fields without a default may follow fields that have one as keywords only.
    required = [
        (field.name, field.type)
        for field in dataclasses.fields(kind)  # type: ignore[arg-type]
        if field.default is field.default_factory is dataclasses.MISSING and field.name not in own
    ]
    whole: Any = dataclasses.make_dataclass("Options", [first, *required], bases=(flags, kind), frozen=True, kw_only=True)
    others = [field.name for field in dataclasses.fields(kind) if field.name not in own]  # type: ignore[arg-type]
    config = None if path is None else read(path)
    default = None
    if config is not None:
        values = {name: getattr(flags(), name) for name in own} | {name: getattr(config, name) for name in others}
        default = whole(path=path, **values)
    style = (tyro.conf.FlagCreatePairsOff,)
    options = tyro.cli(whole, args=words, default=default, prog=prog, description=description, config=style)
    assert config is not None  # without a path, --help has ended the program
    changed: Any = dataclasses.replace(config, **{name: getattr(options, name) for name in others})  # type: ignore[type-var]
    check_finite(changed, str(path))
    return Command(options.path, flags(**{name: getattr(options, name) for name in own}), changed)


def find_path(words: Sequence[str], flags: type) -> Path | None:
    """The first argument that is neither an option nor an option's value."""
    switches = {"--" + field.name.replace("_", "-") for field in dataclasses.fields(flags) if field.default is False}
    is_value = False
    for word in words:
        if word.startswith("-"):
            is_value = "=" not in word and word.replace("_", "-") not in switches | {"-h", "--help"}
        elif not is_value:
            return Path(word)
        else:
            is_value = False
    return None

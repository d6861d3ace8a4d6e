"""Strict configs for all rooms: YAML -> frozen dataclasses, overridden from the command line, saved with the run.

Whatever a user gets wrong (a missing file, an unknown key, a wrong type, an unknown name) raises ConfigError with what
was found, what was expected and what to do; `user_errors` turns it into that message and exit code 2.

`module:NAME` imports a module, which runs its code. It is for what a user types, and for the config that the user names
(`pick`). What data, runs, rollouts and score tables say of themselves is imported only from modules that the user admits
(`pick_recorded`).
"""

import dataclasses
import difflib
import errno
import functools
import importlib
import json
import math
import os
import re
import select
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO, TypeVar, cast

import cattrs
import tyro
import yaml

from xew.files import demand_regular, write_text
from xew.names import EpisodeError

T = TypeVar("T")


CONFIGS = Path(__file__).parent / "configs"
"""Folder of the configs that come with xew; in the repository a link to the folder at its root."""
PACKAGED = "xew:"
"""Beginning of the names of configs that come with xew."""
BASE = "base"
"""Key of a config that names the config that it changes."""
LARGEST = 2**63 - 1
"""Largest whole number of a config."""
IMPORT_PATH = re.compile(r"([^\W\d]\w*(?:\.[^\W\d]\w*)*):[^\W\d]\w*")
"""Form of the name of an object of a module, `module:NAME`."""
TRUST = "XEW_TRUST"
"""Name of the environment variable that lists admitted modules, separated by commas; processes inherit it."""


PIPE_CLOSED = 141
"""Exit code of a command whose output nobody reads any longer: 128 and the number of SIGPIPE, as shells have it."""
DISK_FAULTS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)
"""Numbers of errors of the system that are no mistake of this program, also where they name no file."""


class ConfigError(Exception):
    """A user's setting cannot be used; the message says what to do."""


class UntrustedError(ConfigError):
    """A file names a module that the user has not admitted; nothing of it was imported."""


def load(cls: type[T], path: Path | str, overrides: Sequence[str] = ()) -> T:
    """Read a YAML file into the frozen dataclass `cls`, then apply overrides such as `--train.steps 100`.

    Raises:
        ConfigError: no such file, not YAML, unknown key, missing key, wrong type or a number that is not finite.
        SystemExit: an override is unknown or malformed (tyro has told so; code 2), or asks for --help (code 0).
    """
    loaded = parse(cls, read_yaml(path), str(path))
    if overrides:
        loaded = tyro.cli(cls, args=list(overrides), default=loaded, prog=f"… {path}")
    check_finite(loaded, str(path))
    return loaded


def find_config(path: Path | str) -> Path:
    """Where a config lies: `xew:NAME` is the one that comes with xew, and so is `configs/NAME.yaml` where no such file is.

    Raises:
        ConfigError: xew has no config of that name.
    """
    path = Path(path)
    if is_packaged(path):
        name = str(path).removeprefix(PACKAGED)
        known = sorted(str(file.relative_to(CONFIGS).with_suffix("")) for file in CONFIGS.rglob("*.yaml"))
        if name not in known:
            raise ConfigError(f"xew has no config {name!r};{suggestion(name, known)} known: {', '.join(known)}.")
        return CONFIGS / f"{name}.yaml"
    packaged = CONFIGS.joinpath(*path.parts[1:])
    return packaged if path.parts[:1] == ("configs",) and not path.exists() and packaged.is_file() else path


def is_packaged(path: Path) -> bool:
    """Whether a path is the name of a config that comes with xew, such as xew:fixed."""
    return str(path).startswith(PACKAGED)


def read_yaml(path: Path | str) -> Any:
    """The content of a YAML file, which may be one that comes with xew, on top of the config that its key `base` names.

    `base: fixed.yaml` is a path from the file's own folder, or `xew:NAME`. The file's keys replace those of its base, section
    by section. A base has no base itself.

    Raises:
        ConfigError: a file is missing or not YAML, or the base has a base.
    """
    path = find_config(path)
    content = _read_content(path)
    if not isinstance(content, Mapping) or BASE not in content:
        return content
    changes = dict(content)
    base = changes.pop(BASE)
    if not isinstance(base, str):
        raise ConfigError(f"{path}: {BASE} is {base!r}; expected the path of a config from this folder, or xew:NAME.")
    below = _read_content(find_config(base if is_packaged(Path(base)) else path.parent / base))
    if not isinstance(below, Mapping):
        raise ConfigError(f"{path}: its base {base} has no keys and values.")
    if BASE in below:
        raise ConfigError(f"{path}: its base {base} has the base {below[BASE]}; name that, since there is one level only.")
    return merge_settings(below, changes)


def _read_content(path: Path) -> Any:
    try:
        return yaml.safe_load(demand_regular(path).read_text())
    except OSError as error:
        siblings = sorted(str(p) for p in path.parent.glob("*.yaml"))
        known = f" There is: {', '.join(siblings)}." if siblings else ""
        raise ConfigError(f"cannot read the config {path}: {error.strerror or error}.{known}") from error
    except RecursionError as error:
        raise ConfigError(f"{path} is nested too deeply for a config.") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{path} is not YAML: {error}") from error


def merge_settings(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested settings; where both have a key, `above` wins."""
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge_settings(merged[key], value) if both else value
    return merged


def parse(cls: type[T], content: Any, source: str) -> T:
    """Structure plain YAML content as the frozen dataclass `cls`; `source` names it in errors."""
    if not isinstance(content, Mapping):
        raise ConfigError(f"{source}: expected keys and values, found {type(content).__name__}.")
    try:
        return CONVERTER.structure(content, cls)
    except (cattrs.BaseValidationError, ValueError, TypeError) as error:
        reasons = cattrs.transform_error(error, path="", format_exception=_reason)
        raise ConfigError("\n".join(f"{source}: {_put_path_first(reason)}" for reason in reasons)) from error


def save(config: Any, path: Path) -> None:
    """Write the resolved config as YAML that `load` reads back to an equal object. Raises OSError where it cannot."""
    write_text(path, yaml.safe_dump(CONVERTER.unstructure(config), sort_keys=False, allow_unicode=True))


def digest(config: Any) -> str:
    """A canonical text of a config, equal for equal configs."""
    return json.dumps(CONVERTER.unstructure(config), sort_keys=True)


def pick(registry: Mapping[str, T], name: str, kind: str, also: tuple[type, ...] = ()) -> T:
    """The entry of a registry, or for `module:NAME` an object imported from outside.

    Args:
        also: types that an object from outside may have, beside those of the registry's entries.

    Raises:
        ConfigError: neither exists (the nearest name is suggested), or what was imported is of another type.
    """
    if name in registry:
        return registry[name]
    if ":" in name:
        module, _, attribute = name.partition(":")
        try:
            found = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError, ValueError) as error:
            raise ConfigError(f"cannot import the {kind} {name!r}: {error}; expected module:NAME.") from error
        expected = tuple({type(entry) for entry in registry.values() if entry is not None})
        if not isinstance(found, (*expected, *also)):
            names = " or ".join(kind.__name__ for kind in expected)
            raise ConfigError(f"the {kind} {name!r} is a {type(found).__name__}; expected a {names}.")
        admit([module])  # its code has run by the user's own word; files may name it from now on
        return cast(T, found)
    raise ConfigError(f"unknown {kind} {name!r};{suggestion(name, registry)} known: {', '.join(registry)}, or module:NAME.")


def pick_recorded(registry: Mapping[str, T], name: str, kind: str) -> T:
    """`pick` for a name that a file gives: `module:NAME` only of a module that the user has admitted.

    Raises:
        UntrustedError: the module is not admitted; it is not imported.
        ConfigError: as `pick`.
    """
    if name not in registry:
        demand_admitted(name, f"the {kind}")
    return pick(registry, name, kind)


def admit(names: Iterable[str]) -> None:
    """Admit modules, in this process and in those that it starts.

    Args:
        names: modules, as `my_lab.tasks`, with all that lies below them; or `module:NAME`, of which the module counts.

    Raises:
        ConfigError: one is no name of a module.
    """
    modules = [name.partition(":")[0] for name in names]
    for module in modules:
        if not all(part.isidentifier() for part in module.split(".")):
            raise ConfigError(f"--trust {module!r} is no name of a module; expected one as my_lab.tasks.")
    if modules:
        os.environ[TRUST] = ",".join(sorted({*_admitted(), *modules}))


def admit_named(content: Any) -> None:
    """Admit every module that a config, or its plain content, names as `module:NAME`: the user named the config."""
    admit(find_import_paths(content))


def demand_admitted(content: Any, source: str) -> None:
    """Check what a file says of itself (a name, a config or plain content) before anything that it names is looked up.

    Raises:
        UntrustedError: it names a module that the user has not admitted.
    """
    for name in find_import_paths(content):
        module = name.partition(":")[0]
        if not any(module == admitted or module.startswith(f"{admitted}.") for admitted in _admitted()):
            raise UntrustedError(
                f"{source} names {name!r}, which would run the code of a module that you did not name yourself. If you trust "
                f"{module}, admit it: --trust {module}"
            )


def check_finite(settings: Any, source: str, name: str = "") -> None:
    """Check the numbers of a config, as given or nested: they are finite, and whole ones fit into 64 bits.

    Raises:
        ConfigError: one does not; `source` names the config and `name` where in it the settings stand.
    """
    if dataclasses.is_dataclass(settings) and not isinstance(settings, type):
        settings = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    if isinstance(settings, Mapping):
        for key, value in settings.items():
            check_finite(value, source, f"{name}.{key}".lstrip("."))
    elif isinstance(settings, (list, tuple)):
        for value in settings:
            check_finite(value, source, name)
    elif isinstance(settings, float) and not math.isfinite(settings):
        raise ConfigError(f"{source}: {name} is {settings}; expected a finite number.")
    elif isinstance(settings, int) and not -LARGEST <= settings <= LARGEST:
        raise ConfigError(f"{source}: {name} is {settings}; expected a number of at most 64 bits.")


def find_import_paths(content: Any) -> list[str]:
    """All texts of the form `module:NAME` in a config or in plain content, sorted."""
    if dataclasses.is_dataclass(content) and not isinstance(content, type):
        content = {field.name: getattr(content, field.name) for field in dataclasses.fields(content)}
    if isinstance(content, str):
        return [content] if IMPORT_PATH.fullmatch(content) else []
    if isinstance(content, Mapping):
        content = content.values()
    elif not isinstance(content, (list, tuple)):
        return []
    return sorted({name for value in content for name in find_import_paths(value)})


def _admitted() -> list[str]:
    return [name for name in os.environ.get(TRUST, "").split(",") if name]


def suggestion(name: str, known: Iterable[str]) -> str:
    """' did you mean …?' or nothing."""
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f" did you mean {close[0]!r}?" if close else ""


def user_errors(main: Callable[..., T]) -> Callable[..., T]:
    """Decorate a command: a user's mistake prints its message on stderr and exits with code 2, without a traceback.

    So does Ctrl-C, with code 130. Where the reader of a pipe goes away, as `| head` does, the command ends quietly with
    PIPE_CLOSED.
    """

    @functools.wraps(main)
    def guarded(*args: Any, **kwargs: Any) -> T:
        try:
            try:
                return main(*args, **kwargs)
            finally:
                _flush(sys.stdout)  # here, because at the end of the process nobody can catch what a closed pipe raises
        except BrokenPipeError:
            if not _silence_closed_pipes():
                raise
            raise SystemExit(PIPE_CLOSED) from None
        except (ConfigError, EpisodeError) as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        except OSError as error:
            if error.filename is None and error.errno not in DISK_FAULTS:
                raise
            where = f"{error.filename}: " if error.filename is not None else ""
            print(f"error: {where}{error.strerror}; mend that, or name another place.", file=sys.stderr)
            raise SystemExit(2) from None
        except KeyboardInterrupt:
            print("stopped; the same command goes on from what is done", file=sys.stderr)
            raise SystemExit(130) from None

    return guarded


def _flush(stream: TextIO | None) -> None:
    """Write out what a stream holds back; a process may have none, or have closed it."""
    if stream is not None and not stream.closed:
        stream.flush()


def _silence_closed_pipes() -> bool:
    """Discard what is still to be written to a pipe without a reader, and return whether there was such a pipe."""
    closed = [stream for stream in (sys.stdout, sys.stderr) if stream is not None and _has_no_reader(stream)]
    for stream in closed:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
    return bool(closed)


def _has_no_reader(stream: TextIO) -> bool:
    """Whether a stream writes into a pipe that nobody reads; a failed write may have left nothing to flush."""
    poller = select.poll()
    try:
        poller.register(stream.fileno(), 0)
    except (OSError, ValueError):  # a stream without a file, as tests and notebooks have
        return False
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poller.poll(0))


def _exact(kind: type, accepts: tuple[type, ...]) -> Callable[[Any, type], Any]:
    """A structure hook that converts nothing: YAML's own types are what a config means."""

    def structure(value: Any, _: type) -> Any:
        if kind is float and isinstance(value, str):
            value = _yaml_1_2_float(value)
        if not isinstance(value, accepts) or (isinstance(value, bool) and kind is not bool):
            raise TypeError(f"expected {kind.__name__}, found {type(value).__name__} {value!r}")
        return kind(value)

    return structure


def _yaml_1_2_float(text: str) -> float | str:
    """PyYAML reads 5e-5 as text (YAML 1.1 wants 5.0e-5); people mean the number."""
    try:
        return float(text) if "e" in text.lower() else text
    except ValueError:
        return text


def _structure_names(value: Any, kind: type) -> tuple[str, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise TypeError(f"expected a list, found {type(value).__name__} {value!r}")
    return CONVERTER_OF_TUPLES.structure(value, kind)


def _reason(error: BaseException, kind: type | None) -> str:
    """Say in words what is wrong: unknown keys with a suggestion, the rest as cattrs says it."""
    if isinstance(error, cattrs.ForbiddenExtraKeysError):
        known = [field.name for field in dataclasses.fields(error.cl)]
        return " ".join(
            f"unknown key {key!r};{suggestion(key, known)} known: {', '.join(known)}." for key in error.extra_fields
        )
    if isinstance(error, KeyError):
        return f"missing key {error.args[0]!r}."
    if dataclasses.is_dataclass(kind) and isinstance(error, TypeError):
        return "expected keys and values below it."
    return str(error)


def _put_path_first(reason: str) -> str:
    """Put the path, which cattrs appends as " @ .path", first."""
    message, _, path = reason.rpartition(" @ ")
    return f"{path.lstrip('.')}: {message}" if path.strip(".") else message or reason


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(forbid_extra_keys=True)
    for kind, accepts in ((bool, (bool,)), (int, (int,)), (float, (int, float)), (str, (str,))):
        converter.register_structure_hook(kind, _exact(kind, accepts))
    converter.register_unstructure_hook(tuple, list)
    return converter


CONVERTER_OF_TUPLES = _converter()
CONVERTER = _converter()
CONVERTER.register_structure_hook_func(lambda kind: getattr(kind, "__origin__", None) is tuple, _structure_names)

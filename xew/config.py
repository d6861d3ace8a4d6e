"""Strict configs for all packages: YAML -> frozen dataclasses, overridden from the command line, saved with the run.

A user's mistake (a missing file, an unknown key, a wrong type, an unknown name) raises ConfigError with the value found, the
value expected and the remedy. `user_errors` prints that message and exits with code 2.

`module:NAME` imports a module and so runs its code. `pick` imports names that the user types or that the user's config holds.
`pick_recorded` imports names in data, runs, rollouts and score tables only from modules that the user admits.
"""

import contextlib
import dataclasses
import difflib
import errno
import functools
import importlib
import io
import json
import math
import os
import re
import select
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO, TypeVar, cast

import cattrs
import tyro
import yaml

from xew.files import read_text, write_text
from xew.names import SHOWN_LETTERS, UserError, plain_line, shorten

T = TypeVar("T")


CONFIGS = Path(__file__).parent / "configs"
"""Folder of the packaged configs; in the repository a link to the folder at its root."""
PACKAGED = "xew:"
"""Prefix of the names of packaged configs."""
BASE = "base"
"""Key of a config that names its base config."""
LARGEST = 2**63 - 1
"""Largest integer in a config."""
MOST_VALUES = 100_000
"""Largest number of values in a YAML file; an alias counts as the values that it repeats."""
MOST_NAMED = 5
"""Largest number of unknown keys that a message names."""
IMPORT_PATH = re.compile(r"([^\W\d]\w*(?:\.[^\W\d]\w*)*):[^\W\d]\w*")
"""Pattern of `module:NAME`."""
SURROGATES = re.compile("[\ud800-\udfff]")
"""Letters that no file can hold as UTF-8 text."""
TRUST = "XEW_TRUST"
"""Environment variable with the admitted modules, separated by commas; child processes inherit it."""


PIPE_CLOSED = 141
"""Exit code of a command whose output pipe was closed: 128 + SIGPIPE, as in shells."""
DISK_FAULTS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)
"""System errors that are reported as the user's even if they name no file."""


class ConfigError(UserError):
    """A user's setting cannot be used; the message gives the remedy."""


class UntrustedError(ConfigError):
    """A file names a module that the user has not admitted; it was not imported."""


def load(cls: type[T], path: Path | str, overrides: Sequence[str] = ()) -> T:
    """Read a YAML file into the frozen dataclass `cls`, then apply overrides such as `--train.steps 100`.

    Raises:
        ConfigError: no such file, not YAML, unknown key, missing key, wrong type or a number that is not finite.
        SystemExit: an override is unknown or malformed (code 2), or asks for --help (code 0).
    """
    loaded = parse(cls, read_yaml(path), str(path))
    if overrides:
        loaded = tyro.cli(cls, args=list(overrides), default=loaded, prog=f"… {path}")
    check_finite(loaded, str(path))
    return loaded


def find_config(path: Path | str) -> Path:
    """Path of a config. `xew:NAME`, and `configs/NAME.yaml` if no such file exists, name a packaged one.

    Raises:
        ConfigError: xew has no config of that name.
    """
    path = Path(path)
    if is_packaged(path):
        name = str(path).removeprefix(PACKAGED)
        known = sorted(file.relative_to(CONFIGS).with_suffix("").as_posix() for file in CONFIGS.rglob("*.yaml"))
        if name not in known:
            raise ConfigError(f"xew has no config {name!r};{suggestion(name, known)} known: {', '.join(known)}.")
        return CONFIGS / f"{name}.yaml"
    packaged = CONFIGS.joinpath(*path.parts[1:])
    return packaged if path.parts[:1] == ("configs",) and not path.exists() and packaged.is_file() else path


def is_packaged(path: Path) -> bool:
    """Whether a path is the name of a packaged config, such as xew:fixed."""
    return str(path).startswith(PACKAGED)


def read_yaml(path: Path | str) -> Any:
    """The content of a YAML file, merged over the config that its key `base` names.

    `base` is `xew:NAME` or a path relative to the file's folder. The file's keys replace the base's keys, section by section.

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
        raise ConfigError(f"{path}: its base {base} has the base {below[BASE]}; bases cannot be nested, name {below[BASE]}.")
    return merge_settings(below, changes)


def _read_content(path: Path) -> Any:
    try:
        return parse_yaml(read_text(path))
    except OSError as error:
        siblings = sorted(str(p) for p in path.parent.glob("*.yaml"))
        known = f" The folder has {', '.join(siblings)}." if siblings else ""
        raise ConfigError(f"cannot read the config {path}: {error.strerror or error}.{known}") from error
    except RecursionError as error:
        raise ConfigError(f"{path} is nested too deeply for a config.") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{path} is not YAML: {error}") from error


class _StrictLoader(yaml.SafeLoader):
    """PyYAML's safe loader, which refuses a key that stands twice in a mapping and aliases that repeat too many values."""

    def get_single_node(self) -> yaml.Node | None:
        node: yaml.Node | None = super().get_single_node()
        if node is not None and _count_values(node, {}) > MOST_VALUES:
            raise yaml.YAMLError(f"with its aliases it has more than {MOST_VALUES:,} values")
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        keys = Counter((key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for (_, name), count in keys.items():
            if count > 1:
                raise yaml.MarkedYAMLError(problem=f"the key {shorten(name)} stands there twice", problem_mark=node.start_mark)
        return node


def _count_values(node: yaml.Node, known: dict[int, float]) -> float:
    """Number of values at and below a node, infinite for a node that holds itself; `known` has the numbers by node."""
    if id(node) not in known:
        known[id(node)] = math.inf
        children = node.value if isinstance(node, yaml.CollectionNode) else ()
        if isinstance(node, yaml.MappingNode):
            children = [child for pair in children for child in pair]
        known[id(node)] = 1 + sum(_count_values(child, known) for child in children)
    return known[id(node)]


def parse_yaml(text: str) -> Any:
    """The content of a YAML text.

    Raises:
        yaml.YAMLError: it is not YAML, has a key twice, or its aliases repeat too many values.
        ValueError, RecursionError: a value cannot be represented; it is nested too deeply.
    """
    return yaml.load(text, _StrictLoader)


def merge_settings(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested settings; where both have a key, `above` wins."""
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge_settings(merged[key], value) if both else value
    return merged


def parse(cls: type[T], content: Any, source: str) -> T:
    """Structure plain YAML content as the frozen dataclass `cls`. Raises ConfigError, which names `source`."""
    if not isinstance(content, Mapping):
        raise ConfigError(f"{source}: expected keys and values, found {type(content).__name__}.")
    try:
        return CONVERTER.structure(content, cls)
    except (cattrs.BaseValidationError, ValueError, TypeError) as error:
        reasons = cattrs.transform_error(error, path="", format_exception=_reason)
        raise ConfigError(*(f"{source}: {_put_path_first(reason)}" for reason in reasons)) from error


def save(config: Any, path: Path) -> None:
    """Write the resolved config as YAML that `load` reads back to an equal object. Raises OSError if it fails."""
    text = yaml.safe_dump(CONVERTER.unstructure(config), sort_keys=False, allow_unicode=True)
    write_text(path, text, within=path.parent)


def digest(config: Any) -> str:
    """Canonical text of a config, equal for equal configs."""
    return json.dumps(CONVERTER.unstructure(config), sort_keys=True)


def pick(registry: Mapping[str, T], name: str, kind: str, also: tuple[type, ...] = ()) -> T:
    """The entry of a registry, or for `module:NAME` the imported object.

    Args:
        also: types of imported objects that are accepted besides the types of the registry's entries.

    Raises:
        ConfigError: neither exists (the nearest name is suggested), or the imported object has another type.
    """
    if name in registry:
        return registry[name]
    if ":" in name:
        try:
            imported = import_named(name)
        except (ImportError, AttributeError, ValueError) as error:
            raise ConfigError(f"cannot import the {kind} {name!r}: {error}; expected module:NAME.") from error
        expected = tuple({type(entry) for entry in registry.values() if entry is not None})
        if not isinstance(imported, (*expected, *also)):
            names = " or ".join(kind.__name__ for kind in expected)
            raise ConfigError(f"the {kind} {name!r} is a {type(imported).__name__}; expected a {names}.")
        admit([name])  # the user named it, so files may name it from now on
        return cast(T, imported)
    raise ConfigError(f"unknown {kind} {name!r};{suggestion(name, registry)} known: {', '.join(registry)}, or module:NAME.")


def import_named(name: str) -> Any:
    """The object of `module:NAME`, which the user named; the current folder is searched last.

    Raises:
        ImportError, AttributeError, ValueError: there is none.
    """
    module, _, attribute = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # commands leave it out, see xew/__init__.py
    return getattr(importlib.import_module(module), attribute)


def pick_recorded(registry: Mapping[str, T], name: str, kind: str) -> T:
    """`pick` for a name in a file: raises UntrustedError for `module:NAME` if the user has not admitted the module."""
    if name not in registry:
        demand_admitted(name, f"the {kind}")
    return pick(registry, name, kind)


def admit(names: Iterable[str]) -> None:
    """Admit modules with their submodules, in this process and its child processes.

    Args:
        names: modules such as `my_lab.tasks`, or `module:NAME`, which admits the module.

    Raises:
        ConfigError: a name is not a module name.
    """
    modules = [name.partition(":")[0] for name in names]
    for module in modules:
        if not all(part.isidentifier() for part in module.split(".")):
            raise ConfigError(f"--trust {module!r} is not a module name; expected a name such as my_lab.tasks.")
    if modules:
        os.environ[TRUST] = ",".join(sorted({*_admitted(), *modules}))


def admit_named(content: Any) -> None:
    """Admit every module that a user's config, or its plain content, names as `module:NAME`."""
    admit(find_import_paths(content))


def demand_admitted(content: Any, source: str) -> None:
    """Raise UntrustedError if content of a file (a name, a config, plain content) names a module that is not admitted."""
    for name in find_import_paths(content):
        module = name.partition(":")[0]
        if not any(module == admitted or module.startswith(f"{admitted}.") for admitted in _admitted()):
            raise UntrustedError(
                f"{source} names {name!r}, which would run code of a module that you did not name yourself. If you trust "
                f"{module}, admit it: --trust {module}"
            )


def check_finite(settings: Any, source: str, name: str = "") -> None:
    """Raise ConfigError unless all numbers of a config are finite and its integers fit into 64 bits.

    The message names `source` and `name`, the path of the setting in the config.
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
    """All strings of the form `module:NAME` in a config or in plain content, sorted."""
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
    if len(str(name)) > SHOWN_LETTERS:
        return ""
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f" did you mean {close[0]!r}?" if close else ""


def user_errors(main: Callable[..., T]) -> Callable[..., T]:
    """Decorate a command: a user's mistake prints its message on stderr and exits with code 2, Ctrl-C with code 130.

    A closed output pipe, as with `| head`, ends the command quietly with PIPE_CLOSED.
    """

    @functools.wraps(main)
    def guarded(*args: Any, **kwargs: Any) -> T:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")  # names that are not UTF-8, terminals that are not
        try:
            try:
                return main(*args, **kwargs)
            finally:
                if sys.stdout is not None and not sys.stdout.closed:
                    sys.stdout.flush()  # here, because the error of a closed pipe cannot be caught at exit
        except BrokenPipeError:
            if not _silence_closed_pipes():
                raise
            raise SystemExit(PIPE_CLOSED) from None
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        except OSError as error:
            if error.filename is None and error.errno not in DISK_FAULTS:
                raise
            where = f"{os.fsdecode(error.filename)}: " if error.filename is not None else ""
            print(plain_line(f"error: {where}{error.strerror}; fix that, or choose another path."), file=sys.stderr)
            raise SystemExit(2) from None
        except KeyboardInterrupt:
            print("stopped; the same command continues from here", file=sys.stderr)
            raise SystemExit(130) from None

    return guarded


def _silence_closed_pipes() -> bool:
    """Redirect output to closed pipes to /dev/null, and return whether there was one."""
    closed = [stream for stream in (sys.stdout, sys.stderr) if stream is not None and _has_no_reader(stream)]
    for stream in closed:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)
    return bool(closed)


def _has_no_reader(stream: TextIO) -> bool:
    """Whether a stream writes into a pipe without a reader."""
    poller = select.poll()
    try:
        poller.register(stream.fileno(), 0)
    except (OSError, ValueError):  # a stream without a file descriptor, as in tests and notebooks
        return False
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poller.poll(0))


def _exact(kind: type, accepts: tuple[type, ...]) -> Callable[[Any, type], Any]:
    """A structure hook that accepts YAML's own types and, for floats, text such as 5e-5 (YAML 1.1 requires 5.0e-5)."""

    def structure(value: Any, _: type) -> Any:
        if kind is float and isinstance(value, str) and "e" in value.lower():
            with contextlib.suppress(ValueError):
                value = float(value)
        if not isinstance(value, accepts) or (isinstance(value, bool) and kind is not bool):
            raise TypeError(f"expected {kind.__name__}, found {type(value).__name__} {shorten(value)}")
        if isinstance(value, str) and ("\0" in value or (not value.isascii() and SURROGATES.search(value))):
            raise ValueError(f"expected text without NUL characters and surrogates, found {shorten(value)}")
        return kind(value)

    return structure


def _structure_names(value: Any, kind: type) -> tuple[str, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise TypeError(f"expected a list, found {type(value).__name__} {shorten(value)}")
    return CONVERTER_OF_TUPLES.structure(value, kind)


def _structure_path(value: Any, _: type) -> Path:
    if not isinstance(value, (str, Path)):
        raise TypeError(f"expected a path, found {type(value).__name__} {shorten(value)}")
    if b"\0" in os.fsencode(value):
        raise ValueError(f"expected a path without NUL characters, found {shorten(value)}")
    return Path(value)


def _reason(error: BaseException, kind: type | None) -> str:
    """Message of a structuring error: unknown keys with a suggestion, others as cattrs words them."""
    if isinstance(error, cattrs.ForbiddenExtraKeysError):
        known = [field.name for field in dataclasses.fields(error.cl)]
        named = sorted(error.extra_fields, key=str)[:MOST_NAMED]
        return " ".join(f"unknown key {shorten(key)};{suggestion(key, known)} known: {', '.join(known)}." for key in named)
    if isinstance(error, KeyError):
        return f"missing key {error.args[0]!r}."
    if dataclasses.is_dataclass(kind) and isinstance(error, TypeError):
        return "expected keys and values below it."
    return str(error)


def _put_path_first(reason: str) -> str:
    """Move the path, which cattrs appends as " @ .path", to the front."""
    message, _, path = reason.rpartition(" @ ")
    return f"{path.lstrip('.')}: {message}" if path.strip(".") else message or reason


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(forbid_extra_keys=True)
    for kind, accepts in ((bool, (bool,)), (int, (int,)), (float, (int, float)), (str, (str,))):
        converter.register_structure_hook(kind, _exact(kind, accepts))
    converter.register_structure_hook(Path, _structure_path)
    converter.register_unstructure_hook(tuple, list)
    return converter


CONVERTER_OF_TUPLES = _converter()
CONVERTER = _converter()
CONVERTER.register_structure_hook_func(lambda kind: getattr(kind, "__origin__", None) is tuple, _structure_names)

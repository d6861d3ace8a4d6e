"""Expansion of xacro files by xacrodoc, without ROS: encodings, packages and arguments as for URDFs."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

from xew.config import ConfigError, suggestion
from xew.sim_warp.embodiment.named_files import package_folders
from xew.sim_warp.embodiment.xml_files import decode_xml, parse_xml, read_xml

NO_XACRO = "is a xacro and needs xacrodoc: python -m pip install xacrodoc. Or pass the expanded URDF."


def expand_xacro(path: Path, packages: Mapping[str, Path], arguments: Mapping[str, str]) -> ElementTree.Element:
    """The tree of a xacro, with the folders of packages and its arguments by name; other packages are searched.

    Raises:
        ConfigError: it cannot be expanded, or has no argument of a name.
    """
    read_xml(path)
    text, given = decode_xml(path.read_bytes()), _Arguments(arguments)
    expanded = _expand(path, text, packages, given)
    if unknown := sorted(set(arguments) - given.asked):
        known = ", ".join(sorted(given.asked)) or "none"
        raise ConfigError(
            f"--argument {unknown[0]}: {path.name} has no such argument;{suggestion(unknown[0], given.asked)} It has {known}."
        )
    return parse_xml(expanded.encode())


class _Arguments(dict[str, str]):
    """Arguments by name that remember the names which a xacro asks for."""

    def __init__(self, given: Mapping[str, str]) -> None:
        super().__init__(given)
        self.asked: set[str] = set()

    def __contains__(self, name: object) -> bool:
        self.asked.add(str(name))
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.asked.add(name)
        return super().__getitem__(name)


def _expand(path: Path, text: str, packages: Mapping[str, Path], arguments: _Arguments) -> str:
    try:
        import xacro
        from xacrodoc import XacroDoc
        from xacrodoc import packages as finder
    except ImportError as error:
        raise ConfigError(f"{path} {NO_XACRO}") from error

    def find_package(name: str) -> str:
        folders = [packages[name]] if name in packages else package_folders(name, path.resolve().parent)
        return str(next(iter(folders)).resolve())

    finder.reset()  # it remembers the packages of the file before
    finder._finder.finder_funcs.insert(0, (find_package, StopIteration))
    xacro.init_stacks(str(path))  # relative includes are next to the file
    try:
        return str(XacroDoc.from_string(text, subargs=arguments, resolve_packages=False).to_urdf_string())
    except RecursionError as error:
        raise _unexpanded(path, "a file or macro includes itself", "remove the circle") from error
    except UnicodeDecodeError as error:
        raise _unexpanded(path, f"a file that it includes is not UTF-8: {error}", "save it as UTF-8") from error
    except Exception as error:  # xacro and xacrodoc raise many kinds
        reason = " ".join(str(error).split()) or type(error).__name__
        raise _unexpanded(path, reason, "check --package NAME=DIR and --argument NAME=VALUE") from error


def _unexpanded(path: Path, reason: str, advice: str) -> ConfigError:
    return ConfigError(f"{path} cannot be expanded ({reason}); {advice}.")

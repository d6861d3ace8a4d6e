"""Search for files and packages by the names that URDFs have for them, as RViz and yourdfpy do.

The command that completes a robot and all commands that read one find the same files.
"""

import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from urllib.parse import unquote

from xew.sim_warp.embodiment.xml_files import parse_xml

PACKAGE = re.compile(r"(?:package|model)://([^/]+)/(.*)")
ABSOLUTE = re.compile(r"file://|/|[A-Za-z]:/")
"""Beginning of an absolute name, of Windows too."""
NO_PACKAGES: Mapping[str, Path] = {}


def find_file(name: str, folder: Path, packages: Mapping[str, Path] = NO_PACKAGES) -> tuple[Path, str] | None:
    """A file by its name in a URDF, with a note if it lies elsewhere than the name says; None if it is nowhere.

    Names are relative, absolute, `file://` or `package://`, also with `%20` or backslashes. An absolute name of another machine
    is searched by its end in the URDF's folder and the two folders above.

    Args:
        name: the name of the file.
        folder: folder of the URDF.
        packages: folders of packages by name.
    """
    for text in dict.fromkeys((name, unquote(name).replace("\\", "/"))):
        if found := _search(text, folder, packages):
            return found
    return None


def missing_file(path: Path, who: str, name: str) -> str:
    """Message on a file that is nowhere, for the URDF at `path`; `who` begins the sentence."""
    package = PACKAGE.fullmatch(name)
    advice = (
        f"name the package's folder: python -m xew.sim_warp.robots.adopt {path} --package {package[1]}=DIR"
        if package
        else "put it there or correct the name"
    )
    return f"{path}: {who} {name[:200]}, which does not exist; {advice}."


def package_folders(name: str, folder: Path) -> Iterator[Path]:
    """Possible folders of a ROS package: folders above of its name or package.xml, folders next to these, then ROS's own."""
    for base in (folder, *folder.parents):
        if base.name == name or _declared_package(base) == name:
            yield base
        if (base / name).is_dir():
            yield base / name
    for variable, inner in (("AMENT_PREFIX_PATH", "share"), ("ROS_PACKAGE_PATH", "")):
        for place in filter(None, os.environ.get(variable, "").split(os.pathsep)):
            if (home := Path(place, inner, name)).is_dir():
                yield home


def _search(name: str, folder: Path, packages: Mapping[str, Path]) -> tuple[Path, str] | None:
    above = (folder, *folder.parents)
    inside = PACKAGE.fullmatch(name)
    if inside is not None:
        named = [packages[inside[1]]] if inside[1] in packages else list(package_folders(inside[1], folder))
        if home := next((home for home in named if _is_file(home / inside[2])), None):
            return home / inside[2], ""
        if inside[1] in packages:
            return None
    rest = inside[2] if inside else name.removeprefix("file://")
    if base := next((base for base in above if _is_file(base / rest)), None):
        return base / rest, f"there is no package {inside[1]}: its files are read from {base}" if inside else ""
    return _search_end(name, above[:3]) if ABSOLUTE.match(name) else None


def _search_end(name: str, folders: tuple[Path, ...]) -> tuple[Path, str] | None:
    """A file of another machine, by as many of the last parts of its name as are here."""
    parts = [part for part in name.removeprefix("file://").split("/") if part not in ("", ".", "..")]
    for base, skipped in product(folders, range(len(parts))):
        if _is_file(path := base.joinpath(*parts[skipped:])):
            return path, f"{name} is not on this machine: {path} is used instead"
    return None


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that no file system has
        return False


def _declared_package(folder: Path) -> str:
    """The package's name in a folder's package.xml, or nothing."""
    try:
        return (parse_xml((folder / "package.xml").read_bytes()).findtext("name") or "").strip()
    except (OSError, ElementTree.ParseError, ValueError, LookupError):
        return ""

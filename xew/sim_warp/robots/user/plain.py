"""Normalization of robot descriptions: a URDF or xacro becomes one URDF tree with absolute file names."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from xew.config import ConfigError
from xew.files import read_text
from xew.sim_warp.embodiment.urdf import Urdf

NO_XACRO = "is a xacro and needs xacrodoc: python -m pip install xacrodoc. Or pass the expanded URDF."


def read_description(path: Path, packages: Mapping[str, Path], arguments: Mapping[str, str]) -> ElementTree.Element:
    """The tree of a .urdf or .xacro with absolute file names, with the folders of packages and a xacro's arguments by name.

    Raises:
        ConfigError: it cannot be read, or a folder does not exist.
    """
    if missing := [f"{name}={folder}" for name, folder in packages.items() if not folder.is_dir()]:
        raise ConfigError(f"--package {missing[0]}: there is no such folder.")
    text = _expand(path, packages, arguments) if path.suffix == ".xacro" else read_text(path)
    try:
        tree = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConfigError(f"{path} is not a URDF that can be read ({error}); fix its XML.") from error
    for entry in [*tree.iter("mesh"), *tree.iter("texture")]:
        entry.set("filename", _absolute(entry.get("filename", ""), path.parent, packages))
    return tree


def _expand(path: Path, packages: Mapping[str, Path], arguments: Mapping[str, str]) -> str:
    """The expanded text of a xacro."""
    try:
        from xacrodoc import XacroDoc
        from xacrodoc import packages as finder
    except ImportError as error:
        raise ConfigError(f"{path} {NO_XACRO}") from error
    finder.update_package_cache({name: str(folder.resolve()) for name, folder in packages.items()})
    try:
        document = XacroDoc.from_file(str(path), subargs=dict(arguments), resolve_packages=False)
        return str(document.to_urdf_string())
    except Exception as error:  # xacro and xacrodoc raise many kinds
        reason = " ".join(str(error).split()) or type(error).__name__
        advice = "check --package NAME=DIR and --argument NAME=VALUE"
        raise ConfigError(f"{path} cannot be expanded ({reason}); {advice}.") from error


def _absolute(name: str, folder: Path, packages: Mapping[str, Path]) -> str:
    """The absolute name of a file in its package or next to the description; other names are unchanged."""
    if (inside := re.fullmatch(r"package://([^/]+)/(.*)", name)) and inside[1] in packages:
        return str((packages[inside[1]] / inside[2]).resolve())
    local = folder / name.removeprefix("file://")
    return str(local.resolve()) if local.is_file() else name


def unfold_mirrored(tree: ElementTree.Element, pairs: list[tuple[str, str]], urdf: Urdf) -> list[str]:
    """Reverse the axes of right joints in the tree whose limits mirror the left ones': both arms then have equal limits.

    `pairs` are names of left and right joints, from the base outward. Returns the names of the reversed joints.
    """
    turned = []
    for left, right in pairs:
        one, two = urdf.joints[left], urdf.joints[right]
        equal = abs(one.lower - two.lower) + abs(one.upper - two.upper)
        mirrored = abs(one.lower + two.upper) + abs(one.upper + two.lower)
        if np.isfinite([equal, mirrored]).all() and mirrored < equal - 1e-6:
            _turn_about(next(joint for joint in tree.findall("joint") if joint.get("name") == right))
            turned.append(right)
    return turned


def _turn_about(joint: ElementTree.Element) -> None:
    axis, limit = joint.find("axis"), joint.find("limit")
    if axis is None:
        axis = ElementTree.SubElement(joint, "axis", xyz="1 0 0")
    axis.set("xyz", " ".join(f"{-float(value):.9g}" for value in axis.get("xyz", "1 0 0").split()))
    if limit is not None:
        lower, upper = (float(limit.get(name, "0")) for name in ("lower", "upper"))
        limit.set("lower", f"{-upper:.9g}")
        limit.set("upper", f"{-lower:.9g}")

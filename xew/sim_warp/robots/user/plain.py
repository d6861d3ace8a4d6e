"""Normalization of robot descriptions: a URDF or xacro becomes one URDF tree with absolute file names."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from xew.config import ConfigError
from xew.sim_warp.embodiment.named_files import find_file, missing_file
from xew.sim_warp.embodiment.urdf import Urdf
from xew.sim_warp.embodiment.xml_files import UrdfError, check_elements, file_entries, problem_lines, read_xml
from xew.sim_warp.robots.user.xacro_files import expand_xacro


def read_description(
    path: Path, packages: Mapping[str, Path], arguments: Mapping[str, str], notes: list[str] | None = None
) -> ElementTree.Element:
    """The tree of a .urdf or .xacro with absolute file names, with the folders of packages and a xacro's arguments by name.

    Sentences on files that lie elsewhere than their names say are added to `notes`.

    Raises:
        ConfigError: it cannot be read, or a file or folder does not exist.
    """
    if missing := [f"{name}={folder}" for name, folder in packages.items() if not folder.is_dir()]:
        raise ConfigError(f"--package {missing[0]}: there is no such folder.")
    is_xacro = path.suffix.lower() == ".xacro"
    tree = check_elements(expand_xacro(path, packages, arguments) if is_xacro else read_xml(path), path)
    problems = []
    for who, entry in file_entries(tree):
        name = entry.get("filename", "")
        if (found := find_file(name, path.parent, packages)) is None:
            problems.append(missing_file(path, who, name))
        else:
            entry.set("filename", str(found[0].resolve()))
            if notes is not None and found[1]:
                notes.append(found[1])
    if problems:
        raise UrdfError(*problem_lines(path, problems))
    return tree


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

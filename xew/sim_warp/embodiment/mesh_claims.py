"""Statements of mesh files on units, axes and counts, read before a file is decoded.

A small file can declare gigabytes, or repeat a part of its scene without end. Such files are refused here.
"""

import json
import math
import struct
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xew.sim_warp.embodiment.xml_files import parse_xml

LARGEST_FILE = 200e6
"""Largest size of a mesh file [bytes], with all repeated parts of its scene written out; larger files are not read."""
MOST_TRIANGLES = 1_000_000
"""Largest number of triangles of a mesh file; a link of xew's robots has some hundreds."""
MOST_ROWS = 20 * MOST_TRIANGLES
"""Largest number of rows of all arrays of a glTF file: positions, normals, texture coordinates, indices."""


class MeshError(Exception):
    """A mesh file cannot be used; the message completes a sentence that begins with its name."""


@dataclass(frozen=True)
class Claims:
    """Statements of a mesh file."""

    unit: float = 1.0
    """Unit of length [m]."""
    linear_colors: bool = False
    """Whether its color factors and vertex colors are linear and not sRGB; textures are always sRGB."""
    notes: tuple[str, ...] = ()
    """Sentences on statements that are not followed."""


def read_claims(path: Path) -> Claims:
    """The statements of a mesh file. Raises MeshError if it declares more than can be read, other errors if it is broken."""
    kind = path.suffix.lower()
    if kind == ".dae":
        return _read_collada(parse_xml(path.read_bytes()), path.name)
    if kind in (".gltf", ".glb"):
        _check_gltf(_gltf_json(path.read_bytes()))
        return Claims(linear_colors=True)
    return Claims()


def _gltf_json(content: bytes) -> Any:
    if content[:4] == b"glTF":
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    return json.loads(content)


def _check_gltf(header: Any) -> None:
    """Raise MeshError if arrays of a glTF file are too large; an array without data is filled with zeros."""
    rows = sum(accessor["count"] for accessor in header.get("accessors", []))
    if rows > MOST_ROWS:
        raise MeshError(f"declares arrays of {rows} rows, at most {MOST_ROWS}; simplify it")


def _read_collada(root: ElementTree.Element, name: str) -> Claims:
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    corners = sum(int(word) for vcount in root.iter("vcount") for word in (vcount.text or "").split())
    if corners > 3 * MOST_TRIANGLES:
        raise MeshError(f"declares polygons of {corners} corners, at most {3 * MOST_TRIANGLES}; simplify it")
    _check_scene(root)
    stated = root.find("asset/unit")
    unit = float(stated.get("meter", "1")) if stated is not None else 1.0
    if not 0 < unit < math.inf:
        raise MeshError(f"states a unit of {unit:g} m; expected more than 0")
    axis = (root.findtext("asset/up_axis") or "Z_UP").strip()
    up = f"{name} states that its {axis[0]} axis points up: its axes are used as they are, as in RViz"
    return Claims(unit, notes=() if axis == "Z_UP" else (up,))


def _check_scene(root: ElementTree.Element) -> None:
    """Raise MeshError if the scene of a COLLADA file contains itself, or is too large with repeated parts written out."""
    sizes = {entry.get("id"): sum(1 + len(part.text or "") for part in entry.iter()) for entry in root.iter("geometry")}
    nodes = {entry.get("id"): entry for entry in root.iter("node") if entry.get("id")}
    known: dict[ElementTree.Element, int] = {}
    open_nodes: set[ElementTree.Element] = set()

    def size(node: ElementTree.Element) -> int:
        if node in open_nodes:
            raise MeshError(f"has a scene whose node {node.get('id')} contains itself; export it again")
        if node not in known:
            open_nodes.add(node)
            urls = [child.get("url", "").removeprefix("#") for child in node.findall("instance_node")]
            inner = [*node.findall("node"), *(nodes[url] for url in urls if url in nodes)]
            shapes = [child.get("url", "").removeprefix("#") for child in node.findall("instance_geometry")]
            known[node] = 1 + sum(sizes.get(url, 0) for url in shapes) + sum(map(size, inner))
            open_nodes.remove(node)
        return known[node]

    total = sum(size(node) for scene in root.iter("visual_scene") for node in scene.findall("node"))
    if total > LARGEST_FILE:
        raise MeshError(f"repeats parts of its scene until it has {total / 1e6:.3g} MB, at most {LARGEST_FILE / 1e6:.0f}")

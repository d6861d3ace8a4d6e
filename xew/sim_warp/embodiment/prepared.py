"""Shapes of a URDF as arrays in prepared.npz next to it: a load then reads and merges no mesh files.

The file is valid for the URDF whose digest it holds, and is for folders that never change: the cache of procedural bodies. It
is read nowhere else, because a file next to a user's robot could say anything. Its arrays are bit for bit what the mesh files
give.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xew.files import cache_folder
from xew.sim_warp.geometry.meshes import Mesh

PREPARED = "prepared.npz"
Hulls = tuple[tuple[str, np.ndarray], ...]
"""Name and corners [k 3] m of convex shapes."""
MESH_ARRAYS = ("vertices", "triangles", "colors", "normals")
"""Fields of `Mesh`, in its order."""


@dataclass(frozen=True)
class Prepared:
    """Shapes of all links of a URDF."""

    shapes: Mapping[str, tuple[Mesh | None, Hulls]]
    """Visual and collision shapes by link."""
    meshes: Mapping[str, Path]
    """File of each mesh by its name in the URDF."""


def bodies_folder() -> Path:
    """Folder of procedural bodies in the user's cache."""
    return cache_folder("bodies")


def write_prepared(path: Path, prepared: Prepared) -> None:
    """Write the shapes of the URDF at `path` next to it."""
    index: dict[str, tuple[bool, list[str]]] = {}
    arrays: dict[str, np.ndarray] = {}
    for link, (visual, hulls) in prepared.shapes.items():
        index[link] = (visual is not None, [name for name, _ in hulls])
        arrays |= {f"{link}/{name}": getattr(visual, name) for name in MESH_ARRAYS if visual is not None}
        arrays |= {f"{link}/{number}": points for number, (_, points) in enumerate(hulls)}
    names = {name: file.relative_to(path.parent).as_posix() for name, file in prepared.meshes.items()}
    text = json.dumps({"urdf": hashlib.sha256(path.read_bytes()).hexdigest(), "links": index, "meshes": names})
    np.savez(path.with_name(PREPARED), allow_pickle=False, index=np.frombuffer(text.encode(), np.uint8), **arrays)


def read_prepared(path: Path) -> Prepared | None:
    """The stored shapes of the URDF at `path`; None if there are none, they are damaged, or they belong to another URDF."""
    file = path.with_name(PREPARED)
    if not path.resolve().is_relative_to(bodies_folder().resolve()) or not file.is_file():
        return None
    try:
        with file.open("rb") as content, np.load(content, allow_pickle=False) as arrays:
            return _unpack(arrays, path)
    except Exception:  # each kind of damage has its own; the mesh files say the same
        return None


def _unpack(arrays: Mapping[str, np.ndarray], path: Path) -> Prepared | None:
    index = json.loads(arrays["index"].tobytes())
    if index["urdf"] != hashlib.sha256(path.read_bytes()).hexdigest():
        return None
    shapes = {
        link: (
            Mesh(*(arrays[f"{link}/{name}"] for name in MESH_ARRAYS)) if has_visual else None,
            tuple((name, arrays[f"{link}/{number}"]) for number, name in enumerate(hulls)),
        )
        for link, (has_visual, hulls) in index["links"].items()
    }
    return Prepared(shapes, {name: path.parent / file for name, file in index["meshes"].items()})

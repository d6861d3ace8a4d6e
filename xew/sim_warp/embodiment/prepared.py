"""Shapes of a URDF as arrays beside it, so that who loads it again need not read and merge its mesh files.

Reads  prepared.npz beside a URDF; it counts only while the URDF has the bytes that it was made of
Writes the same, for folders that are written whole and never changed (the cache of procedural bodies)

Plain arrays with an index in JSON, no pickles; what is read is bit for bit what the mesh files give.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xew.sim_warp.geometry.meshes import Mesh

PREPARED = "prepared.npz"
Hulls = tuple[tuple[str, np.ndarray], ...]
"""Name and corners [k 3] m of convex shapes."""


@dataclass(frozen=True)
class Prepared:
    """Shapes of all links of a URDF."""

    shapes: Mapping[str, tuple[Mesh | None, Hulls]]
    """Visual and collision shapes by link."""
    meshes: Mapping[str, Path]
    """File of each mesh by the name that the URDF gives it."""


def write_prepared(path: Path, prepared: Prepared) -> None:
    """Write the shapes of the URDF at `path` beside it."""
    index, visuals, hulls = [], [], []
    for link, (visual, collisions) in prepared.shapes.items():
        sizes = None if visual is None else (len(visual.vertices), len(visual.triangles))
        index.append((link, sizes, [(name, len(points)) for name, points in collisions]))
        visuals += [] if visual is None else [visual]
        hulls += [points for _, points in collisions]
    names = {name: file.relative_to(path.parent).as_posix() for name, file in prepared.meshes.items()}
    text = json.dumps({"urdf": hashlib.sha256(path.read_bytes()).hexdigest(), "links": index, "meshes": names})
    np.savez(
        path.with_name(PREPARED),
        index=np.frombuffer(text.encode(), np.uint8),
        vertices=np.concatenate([mesh.vertices for mesh in visuals]),
        triangles=np.concatenate([mesh.triangles for mesh in visuals]),
        colors=np.concatenate([mesh.colors for mesh in visuals]),
        normals=np.concatenate([mesh.normals for mesh in visuals]),
        hulls=np.concatenate(hulls),
    )


def read_prepared(path: Path) -> Prepared | None:
    """The shapes beside the URDF at `path`; None if there are none, or they were made of another URDF."""
    file = path.with_name(PREPARED)
    if not file.is_file():
        return None
    with np.load(file, allow_pickle=False) as content:
        arrays = {name: content[name] for name in content.files}
    index = json.loads(arrays["index"].tobytes())
    if index["urdf"] != hashlib.sha256(path.read_bytes()).hexdigest():
        return None
    shapes: dict[str, tuple[Mesh | None, Hulls]] = {}
    vertex = triangle = point = 0
    for link, sizes, collisions in index["links"]:
        visual = None
        if sizes is not None:
            vertices, triangles = slice(vertex, vertex + sizes[0]), slice(triangle, triangle + sizes[1])
            visual = Mesh(
                arrays["vertices"][vertices], *(arrays[name][triangles] for name in ("triangles", "colors", "normals"))
            )
            vertex, triangle = vertices.stop, triangles.stop
        hulls = []
        for name, count in collisions:
            hulls.append((name, arrays["hulls"][point : point + count]))
            point += count
        shapes[link] = (visual, tuple(hulls))
    return Prepared(shapes, {name: path.parent / file for name, file in index["meshes"].items()})

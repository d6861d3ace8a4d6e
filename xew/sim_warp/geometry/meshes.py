"""Triangle meshes of robots and objects.

Units are meters, in the frame of the body. Triangles are counter-clockwise seen from outside. Shapes come from trimesh.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

Color = tuple[int, int, int]
"""sRGB values, 0 to 255."""


@dataclass(frozen=True)
class Mesh:
    """A colored triangle mesh in the frame of its body."""

    vertices: np.ndarray
    """[v 3] float32, m."""
    triangles: np.ndarray
    """[f 3] int32, vertex indices, counter-clockwise seen from outside."""
    colors: np.ndarray
    """[f 3] uint8, sRGB."""
    normals: np.ndarray
    """[f 3 3] float32, unit outward normal at each corner of each triangle."""

    def transformed(self, xyz: Sequence[float] = (0, 0, 0), rpy: Sequence[float] = (0, 0, 0)) -> "Mesh":
        """This mesh turned by fixed-axis roll, pitch, yaw [rad], then moved by xyz [m] (URDF's order)."""
        rotation = Rotation.from_euler("xyz", rpy).as_matrix()
        vertices = self.vertices @ rotation.T + np.asarray(xyz)
        return Mesh(vertices.astype(np.float32), self.triangles, self.colors, (self.normals @ rotation.T).astype(np.float32))


def from_trimesh(shape: trimesh.Trimesh, color: Color, crease_angle: float = np.radians(40)) -> Mesh:
    """A `Mesh` of one color; edges sharper than `crease_angle` [rad] stay sharp, the others are shaded smooth."""
    triangles = np.asarray(shape.faces, np.int32)
    face_normals = np.asarray(shape.face_normals)
    return Mesh(
        np.asarray(shape.vertices, np.float32),
        triangles,
        np.tile(np.asarray(color, np.uint8), (len(triangles), 1)),
        _corner_normals(shape, face_normals, crease_angle),
    )


def _corner_normals(shape: trimesh.Trimesh, face_normals: np.ndarray, crease_angle: float) -> np.ndarray:
    """[f 3 3] area-weighted mean normals over the faces round each vertex that bend less than the crease angle."""
    weighted = face_normals * shape.area_faces[:, None]
    around = shape.vertex_faces[shape.faces]  # [f 3 k], -1 where there is no further face
    aligned = np.einsum("fi,fcki->fck", face_normals, face_normals[around]) > np.cos(crease_angle)
    normals = np.einsum("fck,fcki->fci", aligned & (around >= 0), weighted[around])
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(length > 1e-12, normals / np.maximum(length, 1e-12), face_normals[:, None]).astype(np.float32)


def box(size: Sequence[float], color: Color) -> Mesh:
    """A box of full edge lengths `size` [m], centered."""
    corners, triangles, normals = _unit_box()  # cached: a scene can have hundreds
    colors = np.tile(np.asarray(color, np.uint8), (len(triangles), 1))
    return Mesh((corners * np.asarray(size, float)).astype(np.float32), triangles.copy(), colors, normals.copy())


@functools.cache
def _unit_box() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners [8 3] float64 of the cube of edge 1 about the origin, its triangles [12 3] and their normals [12 3 3]."""
    shape = trimesh.creation.box((1, 1, 1))
    mesh = from_trimesh(shape, (0, 0, 0))
    return np.asarray(shape.vertices), mesh.triangles, mesh.normals


def cylinder(radius: float, length: float, color: Color, sections: int = 24) -> Mesh:
    """A cylinder along z, centered."""
    return from_trimesh(trimesh.creation.cylinder(radius, length, sections=sections), color)


def capsule(radius: float, length: float, color: Color, sections: int = 16) -> Mesh:
    """A capsule along z, centered; `length` [m] is the length of its cylinder."""
    shape = trimesh.creation.capsule(length, radius, count=(sections // 2, sections))
    shape.apply_translation(-shape.bounds.mean(0))
    return from_trimesh(shape, color)


def sphere(radius: float, color: Color, subdivisions: int = 2) -> Mesh:
    """A sphere, centered."""
    return from_trimesh(trimesh.creation.icosphere(subdivisions, radius), color)


def revolve(profile: Sequence[Sequence[float]], color: Color, sections: int = 32) -> Mesh:
    """A body of revolution about z from a profile of (radius, height) pairs [m], upward along the outside and back along the
    inside."""
    return from_trimesh(trimesh.creation.revolve(np.asarray(profile, float), sections=sections), color)


def hull(points: np.ndarray, color: Color) -> Mesh:
    """The convex hull of points [k 3]."""
    return from_trimesh(trimesh.convex.convex_hull(np.asarray(points, float)), color)


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh out of several in the same frame."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=True)]).astype(np.int32),
        np.concatenate([mesh.colors for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
    )

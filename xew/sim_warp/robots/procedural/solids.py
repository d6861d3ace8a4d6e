"""Basic solids of robot shapes, in meters and the frame of the link."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

Vector = tuple[float, float, float]
Part = tuple[str, trimesh.Trimesh]
"""Name of a material, and a solid in the frame of its link."""

PAD_HALF_WIDTH, PAD_THICKNESS = 0.011, 0.008
"""Reach of a gripping face to either side of the tool center point, and outward [m]."""


@dataclass(frozen=True)
class Box:
    """A collision box between two corners, in a frame turned by fixed-axis roll, pitch, yaw [rad]."""

    low: Vector
    high: Vector
    rpy: Vector = (0, 0, 0)
    name: str = ""

    @property
    def size(self) -> np.ndarray:
        """[3] edge lengths [m]."""
        return np.subtract(self.high, self.low)

    @property
    def center(self) -> np.ndarray:
        """[3] in the link frame."""
        return Rotation.from_euler("xyz", self.rpy).apply(np.add(self.low, self.high) / 2)


def transform(xyz: Sequence[float] | np.ndarray = (0, 0, 0), rpy: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    """[4 4], URDF's order: turn by roll, pitch, yaw, then move."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    matrix[:3, 3] = xyz
    return matrix


def box_solid(box: Box) -> trimesh.Trimesh:
    return trimesh.creation.box(box.size, transform(box.center, box.rpy))


def cylinder(
    start: Vector, end: Vector, radius: float, end_radius: float | None = None, bevel: float = 0.0, sections: int = 16
) -> trimesh.Trimesh:
    """A cylinder, or a cone to `end_radius`, between two points; `bevel` cuts its rims."""
    axis = np.subtract(end, start)
    length, last = float(np.linalg.norm(axis)), radius if end_radius is None else end_radius
    profile = [(0, 0), (radius - bevel, 0), (radius, bevel), (last, length - bevel), (last - bevel, length), (0, length)]
    if not bevel:
        profile = [(0, 0), (radius, 0), (last, length), (0, length)]
    solid = trimesh.creation.revolve(np.array(profile), sections=sections)
    return _move(solid, trimesh.geometry.align_vectors([0, 0, 1], axis / length), start)


def dome(start: Vector, end: Vector, radius: float, sections: int = 16) -> trimesh.Trimesh:
    """A cylinder whose end is rounded off."""
    axis = np.subtract(end, start)
    length = float(np.linalg.norm(axis))
    rise = min(0.6 * radius, length)
    turn = np.radians([0, 30, 60])
    rim = np.stack([radius * np.cos(turn), length - rise + rise * np.sin(turn)], 1)
    solid = trimesh.creation.revolve(np.vstack([[0, 0], [radius, 0], rim, [0, length]]), sections=sections)
    return _move(solid, trimesh.geometry.align_vectors([0, 0, 1], axis / length), start)


def rounded_box(low: Vector, high: Vector, chamfer: float = 0.004, rpy: Vector = (0, 0, 0)) -> trimesh.Trimesh:
    """A box between two corners, its edges cut, in a frame turned by roll, pitch, yaw [rad]."""
    corners = []
    for axis in range(3):
        inset = np.full(3, chamfer)
        inset[axis] = 0
        corners.append(trimesh.creation.box(bounds=[np.add(low, inset), np.subtract(high, inset)]).vertices)
    return _move(trimesh.convex.convex_hull(np.vstack(corners)), transform(rpy=rpy), (0, 0, 0))


def hull(*solids: trimesh.Trimesh) -> trimesh.Trimesh:
    """The convex hull round several solids: one smooth shell."""
    return trimesh.convex.convex_hull(np.vstack([solid.vertices for solid in solids]))


def loft(axis: str, stations: Sequence[Sequence[float]], rpy: Vector = (0, 0, 0), corner: float = 0.35) -> trimesh.Trimesh:
    """A skin over rounded rectangles along an axis.

    Args:
        axis: "x", "y" or "z".
        stations: (position, low, high, low, high) of each, with the extents along the other two axes in order [m].
        rpy: turn of the whole [rad].
        corner: share of a half side that is rounded off.
    """
    along = "xyz".index(axis)
    across = [index for index in range(3) if index != along]
    cut = 1 - corner
    ring = np.array([(1, cut), (cut, 1), (-cut, 1), (-1, cut), (-1, -cut), (-cut, -1), (cut, -1), (1, -cut)])
    points = np.empty((len(stations), 8, 3))
    for index, (position, low_a, high_a, low_b, high_b) in enumerate(stations):
        points[index, :, along] = position
        points[index, :, across[0]] = (low_a + high_a) / 2 + ring[:, 0] * (high_a - low_a) / 2
        points[index, :, across[1]] = (low_b + high_b) / 2 + ring[:, 1] * (high_b - low_b) / 2
    solid = trimesh.Trimesh(points.reshape(-1, 3), _skin(len(stations)), process=False)
    if solid.volume < 0:
        solid.invert()
    return _move(solid, transform(rpy=rpy), (0, 0, 0))


def _skin(rings: int) -> np.ndarray:
    """Triangles between rings of eight points, and over both ends."""
    faces = []
    for ring in range(rings - 1):
        for index in range(8):
            a, b = 8 * ring + index, 8 * ring + (index + 1) % 8
            faces += [(a, b, b + 8), (a, b + 8, a + 8)]
    last = 8 * (rings - 1)
    for index in range(1, 7):
        faces += [(0, index + 1, index), (last, last + index, last + index + 1)]
    return np.array(faces)


def _move(solid: trimesh.Trimesh, rotation: np.ndarray, xyz: Sequence[float]) -> trimesh.Trimesh:
    matrix = rotation.copy()
    matrix[:3, 3] = xyz
    solid.apply_transform(matrix)
    return solid

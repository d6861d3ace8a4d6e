"""Basic shapes of objects: visible meshes and convex collision pieces.

Each function returns a `Shape` in the object's frame: z up, origin at the center of the bottom face.
"""

from dataclasses import dataclass

import numpy as np

from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.meshes import Color, Mesh

WALL_SEGMENTS = 6
"""Number of convex wedges round the wall of a hollow object; each is flat and wide enough for a finger pad."""
FOOT = 0.0005
"""Gap between the wall's wedges and the table [m]: a vessel stands on its floor alone."""

PALETTE: dict[str, Color] = {
    "red": (200, 45, 40),
    "green": (60, 150, 70),
    "blue": (50, 90, 190),
    "yellow": (225, 185, 50),
    "orange": (225, 120, 45),
    "purple": (120, 75, 160),
    "teal": (40, 140, 145),
    "pink": (215, 120, 150),
}


@dataclass(frozen=True)
class Shape:
    """A rigid piece: a visible mesh and collision hulls."""

    mesh: Mesh
    hulls: tuple[np.ndarray, ...] = ()
    """Convex pieces, each [k 3] float32 points in the same frame; none for decorations."""


def merge(*shapes: Shape) -> Shape:
    """One rigid piece out of several in the same frame."""
    return Shape(meshes.merge([s.mesh for s in shapes]), tuple(h for s in shapes for h in s.hulls))


def move(shape: Shape, xyz: tuple[float, float, float]) -> Shape:
    """The shape moved by `xyz` [m]."""
    return Shape(shape.mesh.transformed(xyz), tuple(h + np.array(xyz, np.float32) for h in shape.hulls))


def darken(color: Color, share: float) -> Color:
    """The color at `share` of its brightness."""
    red, green, blue = color
    return int(share * red), int(share * green), int(share * blue)


def block(size: tuple[float, float, float], color: Color) -> Shape:
    """A box of full edge lengths `size` [m]."""
    mesh = meshes.box(size, color).transformed((0, 0, size[2] / 2))
    return Shape(mesh, (mesh.vertices,))


def prism(radius: float, length: float, color: Color, end_color: Color | None = None, sides: int = 12) -> Shape:
    """A rod along x on one of its flat sides; `radius` [m] is the radius of its inscribed circle."""
    angle = (np.arange(sides) + 0.5) * 2 * np.pi / sides - np.pi / 2
    ring = radius / np.cos(np.pi / sides) * np.stack([np.cos(angle), np.sin(angle)], -1)
    points = np.concatenate([np.column_stack([np.full(sides, x), ring]) for x in (-length / 2, length / 2)])
    points[:, 2] += radius
    body = meshes.hull(points, color)
    caps = [
        meshes.cylinder(radius * 1.04, 0.02, end_color or color).transformed((x, 0, radius), (0, np.pi / 2, 0))
        for x in (-length / 2 + 0.005, length / 2 - 0.005)
    ]
    return Shape(meshes.merge([body, *caps]) if end_color else body, (points.astype(np.float32),))


def disc(radius: float, height: float, color: Color, sides: int = 24) -> Shape:
    """A flat round plate."""
    mesh = meshes.cylinder(radius, height, color, sections=sides).transformed((0, 0, height / 2))
    return Shape(mesh, (mesh.vertices,))


def vessel(outline: list[tuple[float, float]], wall: float, color: Color, inside: Color | None = None) -> Shape:
    """A hollow body of revolution: cup or bowl.

    Args:
        outline: (outer radius, height) pairs [m] from the bottom to the rim.
        wall: thickness [m] of wall and floor.
        color, inside: outer and inner sRGB color.
    """
    outer = np.asarray(outline, float)
    inner = np.stack([outer[:, 0] - wall, np.maximum(outer[:, 1], wall)], -1)
    shell = meshes.revolve([(0, 0), *outer, *inner[::-1], (0, wall)], color)
    centers = shell.vertices[shell.triangles].mean(1)
    outward = (shell.normals.mean(1)[:, :2] * centers[:, :2]).sum(-1) >= 0
    colors = np.where(outward[:, None], np.array(color, np.uint8), np.array(inside or color, np.uint8))
    mesh = Mesh(shell.vertices, shell.triangles, colors, shell.normals)
    return Shape(mesh, (*_wall_hulls(outer, inner), _ring(outer[0, 0], 0, wall)))


def _wall_hulls(outer: np.ndarray, inner: np.ndarray) -> list[np.ndarray]:
    """One convex wedge for each band of the outline and each segment round the axis."""
    hulls = []
    for angle in np.arange(WALL_SEGMENTS) * 2 * np.pi / WALL_SEGMENTS:
        half = np.pi / WALL_SEGMENTS
        turns = [np.array([np.cos(a), np.sin(a)]) for a in (angle - half, angle + half)]
        for low in range(len(outer) - 1):
            corners = [outer[low], outer[low + 1], inner[low], inner[low + 1]]
            # The middle of a wedge's chord has the outline's radius.
            points = [[*(radius / np.cos(half) * turn), max(z, FOOT)] for radius, z in corners for turn in turns]
            hulls.append(np.array(points, np.float32))
    return hulls


def _ring(radius: float, low: float, high: float) -> np.ndarray:
    """[k 3] m, corners of an upright prism about z between two heights [m]."""
    angle = np.arange(WALL_SEGMENTS) * 2 * np.pi / WALL_SEGMENTS
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([np.column_stack([circle, np.full(WALL_SEGMENTS, z)]) for z in (low, high)]).astype(np.float32)

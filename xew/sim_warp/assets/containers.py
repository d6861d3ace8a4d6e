"""Bottles, cans, pill bottles and pots: closed containers, drawn from a random stream.

Each function returns a `Shape` in the object's frame: z up, origin at the center of the bottom face, round about z. The
collision shape is a column of few flat sides that face along x and y: a finger pad lies flat on one, and a lying bottle does
not roll. The visible surface is at most 8 % of the radius inside. Sizes follow RoboTwin 2.0, reduced for a gripper of 80 mm.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from xew.sim_warp import objects
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.meshes import Color, Mesh
from xew.sim_warp.objects import Shape
from xew.sim_warp.scene import Grasp, Point, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP

METAL: Color = (190, 192, 196)
PAPER: Color = (240, 238, 230)
WHITE: Color = (238, 240, 242)
DARK: Color = (48, 48, 52)
PILL_COLORS: tuple[tuple[str, Color], ...] = (
    ("orange", (214, 120, 30)),
    ("white", WHITE),
    ("brown", (110, 66, 38)),
    ("green", (70, 130, 90)),
    ("blue", (70, 110, 180)),
)

SECTIONS = 32
"""Number of facets round a body of revolution."""
SIDES = 12
"""Number of flat sides of a container that stands."""
GRASP_BELOW_TOP = 0.014
"""Depth of the tool below the top of a standing container grasped from above [m]; any deeper, a leaning palm meets the edge."""

Outline = Sequence[tuple[float, float]]
"""Pairs (radius, height) [m] from the bottom to the top."""


@dataclass(frozen=True)
class Band:
    """A painted range of a container's height."""

    low: float
    """Lower end [m]."""
    high: float
    color: Color
    front: Color | None = None
    """Color of the label's front, a third of the way round."""


def revolve_painted(outline: Outline, color: Color, bands: Sequence[Band] = (), facing: float = 0.0) -> Mesh:
    """A body of revolution with painted bands.

    Args:
        outline: its side; every band should begin and end at one of its heights.
        color: color outside bands.
        facing: the direction of the labels' fronts about z [rad].
    """
    mesh = meshes.revolve([(0.0, outline[0][1]), *outline, (0.0, outline[-1][1])], color, SECTIONS)
    centers = mesh.vertices[mesh.triangles].mean(1)
    sector = 2 * np.pi / SECTIONS
    around = (np.floor(np.arctan2(centers[:, 1], centers[:, 0]) / sector) + 0.5) * sector
    away = np.abs((around - facing + np.pi) % (2 * np.pi) - np.pi)
    colors = mesh.colors.copy()
    for band in bands:
        inside = (centers[:, 2] > band.low) & (centers[:, 2] < band.high)
        colors[inside] = band.color
        colors[inside & (away < np.pi / 3)] = band.front or band.color
    return Mesh(mesh.vertices, mesh.triangles, colors, mesh.normals)


def column(radii: tuple[float, float], low: float, high: float, sides: int) -> np.ndarray:
    """[2 sides, 3] points of a straight or tapering column about z with one flat side facing along x.

    Args:
        radii: of the inscribed circles at the bottom and at the top [m].
        low, high: heights [m].
        sides: a multiple of four, for flat sides along y too.
    """
    angle = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], -1) / np.cos(np.pi / sides)
    ends = [np.column_stack([radius * ring, np.full(sides, z)]) for radius, z in zip(radii, (low, high), strict=True)]
    return np.concatenate(ends).astype(np.float32)


def ring(radius: float, sides: int, z: float) -> np.ndarray:
    """[sides 3] corners of a polygon about z whose inscribed circle has `radius` [m]; a flat side faces +x."""
    angle = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    outer = radius / np.cos(np.pi / sides)
    return np.column_stack([outer * np.cos(angle), outer * np.sin(angle), np.full(sides, z)])


def walls(size: tuple[float, float], thickness: float, height: float, color: Color, z: float = 0.0) -> list[Shape]:
    """Four upright walls along the edges of a rectangle of outer `size` x y [m], standing at height `z`."""
    width, depth = size
    front = objects.block((width, thickness, height), color)
    side = objects.block((thickness, depth - 2 * thickness, height), color)
    return [
        *(objects.move(front, (0, sign * (depth - thickness) / 2, z)) for sign in (-1, 1)),
        *(objects.move(side, (sign * (width - thickness) / 2, 0, z)) for sign in (-1, 1)),
    ]


def center_of_mass(shape: Shape) -> np.ndarray:
    """[3] center of mass [m] of a shape's convex pieces, all of one density."""
    pieces = [trimesh.convex.convex_hull(np.asarray(points, float)) for points in shape.hulls]
    volumes = np.array([piece.volume for piece in pieces])
    return np.array(volumes @ [piece.center_mass for piece in pieces] / volumes.sum())


def height(shape: Shape) -> float:
    """Height of the top above the bottom face [m]."""
    return float(shape.mesh.vertices[:, 2].max())


def draw_color_names(rng: np.random.Generator, count: int) -> list[str]:
    """Names of different colors of `objects.PALETTE`."""
    return [str(name) for name in rng.permutation(sorted(objects.PALETTE))[:count]]


# --- Standing objects, grasped from above.


def can(rng: np.random.Generator) -> tuple[Shape, str]:
    """A tin can with a paper label, and its color's name: radius 25 to 29 mm, 88 to 108 mm high."""
    radius, top = rng.uniform([0.025, 0.088], [0.029, 0.108])
    label, stripe = draw_color_names(rng, 2)
    middle = rng.uniform(0.35, 0.65) * top
    facing = rng.uniform(-np.pi, np.pi)
    bands = [
        Band(0.008, top - 0.008, objects.PALETTE[label]),
        Band(middle - 0.014, middle + 0.014, objects.PALETTE[stripe], PAPER),
    ]
    outline = [
        (radius - 0.002, 0.0),
        (radius, 0.003),
        (radius - 0.001, 0.008),
        (radius - 0.001, middle - 0.014),
        (radius - 0.001, middle + 0.014),
        (radius - 0.001, top - 0.008),
        (radius, top - 0.003),
        (radius - 0.002, top),
        (radius - 0.005, top - 0.002),
    ]
    return Shape(revolve_painted(outline, METAL, bands, facing), (column((radius, radius), 0.0, top, SIDES),)), label


def pill_bottle(rng: np.random.Generator) -> tuple[Shape, str]:
    """A short bottle with a wide screw cap, and the name of its body's color: radius 23 to 27 mm, 80 to 100 mm high."""
    radius, top = rng.uniform([0.023, 0.080], [0.027, 0.100])
    cap = rng.uniform(0.018, 0.023)
    name, color = PILL_COLORS[rng.integers(len(PILL_COLORS))]
    lid = [WHITE, WHITE, objects.PALETTE["red"], objects.PALETTE["blue"], DARK][rng.integers(5)]
    stripe = objects.PALETTE[draw_color_names(rng, 1)[0]]
    low, high = 0.012, top - cap - 0.014
    bands = [Band(low, high, PAPER), Band(high - 0.010, high, stripe), Band(top - cap, top + 0.001, lid)]
    outline = [
        (radius - 0.002, 0.0),
        (radius, 0.003),
        (radius, low),
        (radius, high - 0.010),
        (radius, high),
        (radius, top - cap - 0.008),
        (radius - 0.004, top - cap - 0.002),
        (radius - 0.004, top - cap),
        (radius, top - cap),
        (radius, top - 0.003),
        (radius - 0.003, top),
    ]
    body = revolve_painted(outline, color, bands, rng.uniform(-np.pi, np.pi))
    ribs = [_rib(radius, angle, top - cap + 0.003, top - 0.004, lid) for angle in np.arange(24) * np.pi / 12]
    return Shape(meshes.merge([body, *ribs]), (column((radius, radius), 0.0, top, SIDES),)), name


def _rib(radius: float, angle: float, low: float, high: float, color: Color) -> Mesh:
    """An upright ridge of a screw cap."""
    rib = meshes.box((0.0016, 0.0026, high - low), color).transformed((radius, 0, (low + high) / 2))
    return rib.transformed(rpy=(0, 0, angle))


def place_standing(name: str, shape: Shape, xy: Point, yaw: float, mass: float) -> SceneObject:
    """A can or pill bottle on the table at `xy` [2] m, turned by `yaw` [rad], with a grasp at its upper end."""
    width = 2 * float(shape.hulls[0][:, 0].max())
    grasp = Grasp(height(shape) - GRASP_BELOW_TOP, width, 2 * np.pi / SIDES)
    return SceneObject(name, shape, upright(xy, TABLE_TOP, yaw), mass, grasp=grasp)


# --- Bottles lying on the table.


def place_lying(name: str, shape: Shape, xy: Point, yaw: float, mass: float) -> SceneObject:
    """A bottle on its side with its center of mass over `xy` [2] m, its neck along +y turned by `yaw` [rad].

    A hand grasps it across at the center of mass. In its frame it lies on z = 0, the origin under the center of mass.
    """
    turn = Rotation.from_euler("x", -np.pi / 2)
    thickness = 2 * float(shape.hulls[0][:, 1].max())  # of the flat side that faces down
    shift = np.array([0.0, 0.0, thickness / 2]) - turn.apply(center_of_mass(shape))
    hulls = tuple((turn.apply(hull) + shift).astype(np.float32) for hull in shape.hulls)
    mesh = shape.mesh.transformed(shift, (-np.pi / 2, 0, 0))
    grasp = Grasp(thickness / 2, 2 * float(shape.hulls[0][:, 0].max()), 2 * np.pi)
    return SceneObject(name, Shape(mesh, hulls), upright(xy, TABLE_TOP, yaw), mass, grasp=grasp)


def bottle(rng: np.random.Generator) -> tuple[Shape, str]:
    """A bottle of one of four kinds, and its color's name: 165 to 205 mm long, 50 to 60 mm wide."""
    kinds = (_drink_bottle, _sauce_bottle, _flask, _shampoo)
    return kinds[rng.integers(len(kinds))](rng)


def _drink_bottle(rng: np.random.Generator) -> tuple[Shape, str]:
    """Long shoulders, a neck and a screw cap, a paper label round the belly."""
    radius, shoulder, neck = rng.uniform([0.026, 0.105, 0.045], [0.030, 0.120, 0.060])
    drink, label = draw_color_names(rng, 2)
    top = shoulder + neck + 0.020
    outline = [
        (radius - 0.004, 0.0),
        (radius, 0.006),
        (radius, 0.030),
        (radius, shoulder - 0.025),
        (radius, shoulder),
        (0.75 * radius, shoulder + 0.4 * neck),
        (0.012, shoulder + neck),
        (0.012, top - 0.017),
        (0.015, top - 0.017),
        (0.015, top),
    ]
    bands = [Band(0.030, shoulder - 0.025, objects.PALETTE[label], PAPER), Band(top - 0.017, top + 0.001, WHITE)]
    hulls = (column((radius, radius), 0.0, shoulder, 8), column((radius * 0.95, 0.014), shoulder, top, 8))
    return Shape(revolve_painted(outline, objects.PALETTE[drink], bands, rng.uniform(-np.pi, np.pi)), hulls), drink


def _sauce_bottle(rng: np.random.Generator) -> tuple[Shape, str]:
    """A squeeze bottle with a pointed nozzle."""
    radius, shoulder = rng.uniform([0.026, 0.115], [0.029, 0.130])
    sauce = ("red", "yellow", "orange", "green")[rng.integers(4)]
    top = shoulder + 0.058
    outline = [
        (radius - 0.003, 0.0),
        (radius, 0.005),
        (radius, 0.035),
        (radius, shoulder - 0.030),
        (radius, shoulder - 0.008),
        (radius - 0.006, shoulder),
        (0.019, shoulder),
        (0.019, shoulder + 0.018),
        (0.010, shoulder + 0.026),
        (0.004, top),
    ]
    bands = [Band(0.035, shoulder - 0.030, PAPER, objects.PALETTE[sauce]), Band(shoulder, top + 0.001, WHITE)]
    hulls = (column((radius, radius), 0.0, shoulder, 8), column((0.019, 0.004), shoulder, top, 8))
    return Shape(revolve_painted(outline, objects.PALETTE[sauce], bands, rng.uniform(-np.pi, np.pi)), hulls), sauce


def _flask(rng: np.random.Generator) -> tuple[Shape, str]:
    """An insulated flask with a wide cap."""
    radius, shoulder = rng.uniform([0.027, 0.140], [0.030, 0.155])
    paint = draw_color_names(rng, 1)[0]
    cap = [DARK, METAL, WHITE][rng.integers(3)]
    top = shoulder + 0.038
    outline = [
        (radius - 0.002, 0.0),
        (radius, 0.002),
        (radius, 0.014),
        (radius, shoulder - 0.012),
        (0.022, shoulder),
        (0.022, shoulder + 0.006),
        (0.024, shoulder + 0.006),
        (0.024, top - 0.004),
        (0.021, top),
    ]
    bands = [Band(0.0, 0.014, METAL), Band(shoulder, shoulder + 0.006, METAL), Band(shoulder + 0.006, top + 0.001, cap)]
    hulls = (column((radius, radius), 0.0, shoulder, 8), column((0.024, 0.024), shoulder, top, 8))
    return Shape(revolve_painted(outline, objects.PALETTE[paint], bands, 0.0), hulls), paint


def _shampoo(rng: np.random.Generator) -> tuple[Shape, str]:
    """A flat bottle with rounded edges and a flip cap; it lies on its broad side."""
    width, depth, shoulder = rng.uniform([0.050, 0.038, 0.125], [0.058, 0.044, 0.145])
    paint, label = draw_color_names(rng, 2)
    top = shoulder + 0.036
    body = _rounded_box_points(width, depth, 0.0, shoulder - 0.010)
    tapered = np.concatenate([body, _rounded_box_points(0.6 * width, 0.7 * depth, shoulder, shoulder + 0.002)])
    sticker = meshes.hull(_rounded_box_points(width * 0.7, depth + 0.001, 0.035, shoulder - 0.035), PAPER)
    stripe = meshes.hull(_rounded_box_points(width * 0.7, depth + 0.002, 0.060, 0.075), objects.PALETTE[label])
    cap = meshes.cylinder(0.016, 0.034, WHITE).transformed((0, 0, shoulder + 0.019))
    mesh = meshes.merge([meshes.hull(tapered, objects.PALETTE[paint]), sticker, stripe, cap])
    half = np.array([width, depth, 0.0]) / 2
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0.0, shoulder)])
    return Shape(mesh, ((corners * [*half[:2], 1]).astype(np.float32), column((0.016, 0.016), shoulder, top, 8))), paint


def _rounded_box_points(width: float, depth: float, low: float, high: float, edge: float = 0.012) -> np.ndarray:
    """Points [k 3] m of a box about z whose upright edges are rounded."""
    angle = np.linspace(0, np.pi / 2, 4)
    quarter = np.stack([width / 2 - edge + edge * np.cos(angle), depth / 2 - edge + edge * np.sin(angle)], -1)
    ring = np.concatenate([quarter * [sx, sy] for sx in (-1, 1) for sy in (-1, 1)])
    return np.concatenate([np.column_stack([ring, np.full(len(ring), z)]) for z in (low, high)])


# --- Pots.


def pot(rng: np.random.Generator, radius: tuple[float, float], height: tuple[float, float], reach: float) -> tuple[Shape, str]:
    """A cooking pot with a loop handle at either end of its x axis, lidded or open, and its color's name.

    Args:
        rng: random stream for size, colors and lid.
        radius, height: ranges for the body [m].
        reach: reach of the handles' bars beyond the body [m].
    """
    body, top = (float(rng.uniform(*span)) for span in (radius, height))
    paint = draw_color_names(rng, 1)[0]
    steel = rng.random() < 0.4
    color = METAL if steel else objects.PALETTE[paint]
    outline = [(body - 0.010, 0.0), (body, 0.010), (body, top - 0.012), (body, top - 0.004), (body + 0.003, top)]
    rim = [Band(top - 0.012, top + 0.001, METAL)]
    if rng.random() < 0.3:
        parts = [revolve_painted([*outline, (body - 0.004, top), (body - 0.006, 0.006)], color, rim)]
    else:
        parts = [revolve_painted([*outline, (body - 0.004, top)], color, rim), _lid(rng, body, top, color)]
    shape = Shape(meshes.merge(parts), (column((body, body), 0.0, top, SIDES),))
    grip = DARK if rng.random() < 0.5 else METAL
    loops = [_loop(side, body, body + reach, top + 0.004, grip) for side in (-1, 1)]
    return objects.merge(shape, *loops), "steel" if steel else paint


def handles(pot: Shape) -> np.ndarray:
    """[2 3] centers of a pot's handle bars, at -x and at +x [m]; the bars run along y."""
    _, left, _, _, right, _, _ = pot.hulls
    return np.stack([left.mean(0), right.mean(0)])


def _lid(rng: np.random.Generator, radius: float, top: float, color: Color) -> Mesh:
    """A shallow dome with a knob, low enough for the palms of hands at the handles."""
    paint = [METAL, color, (150, 165, 170)][rng.integers(3)]
    dome = revolve_painted(
        [(radius - 0.001, top), (radius - 0.004, top + 0.003), (0.5 * radius, top + 0.006), (0.012, top + 0.008)], paint
    )
    knob = revolve_painted([(0.006, top + 0.008), (0.006, top + 0.012), (0.011, top + 0.014), (0.010, top + 0.019)], DARK)
    return meshes.merge([dome, knob])


BAR = (0.014, 0.060, 0.012)
"""Size of a handle's bar [m]."""


def _loop(side: int, body: float, reach: float, height: float, color: Color) -> Shape:
    """A bar along y on two rising struts, far enough from the body's wall for a finger."""
    bar = meshes.box(BAR, color).transformed((side * reach, 0, height))
    ends = ((body - 0.003, height - 0.018), (reach, height))
    struts = [
        meshes.hull(
            np.array([[side * x, y + w, z + h] for x, z in ends for w in (-0.004, 0.004) for h in (-0.005, 0.005)]), color
        )
        for y in (-BAR[1] / 2 + 0.004, BAR[1] / 2 - 0.004)
    ]
    return Shape(meshes.merge([bar, *struts]), tuple(mesh.vertices for mesh in (bar, *struts)))

"""Task: put a pair of shoes into their box side by side, tips to the left; both are grasped at once.

Randomization: box (fixed) at (0, -.14); left shoe at x in [-.29, -.22], right shoe at x in [.22, .29], both at y in
    [-.15, -.07]; tips up to 75 degrees from the left, of the left shoe toward the robot, of the right shoe away from it
    (and 12 degrees the other way); size, kind and colors of the shoes, color of the box.
Success: the left shoe within 50 mm in x and y of the box's nearer place, the right one of the farther, tips to the left
    (within 15 degrees), on the box's floor (15 mm), both grippers open.
After RoboTwin 2.0's place_dual_shoes, which lowers the table by .1 m for a box 106 mm high. Our table stays: the box is the
    open, low lower part of one, and the shoes are children's, to fit a hand that opens 80 mm. There tips point anywhere; ours
    as far as all wrists can turn from there to the left.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from xew.sim_warp import objects
from xew.sim_warp.assets import containers
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.meshes import Color, Mesh
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import LEFT, RIGHT, Timeline, Tool, tool
from xew.sim_warp.scene import Grasp, Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import (
    HOVER,
    Moment,
    Task,
    aside_poses,
    grasp_of,
    object_axis,
    opening_for,
    pick,
    place,
    point_above,
    share_carried,
    side_sign,
)

BOX = (0.0, -0.14)
BOX_SIZE = (0.236, 0.214)
"""Outer size of the box [m]."""
WALL, FLOOR, RIM = 0.005, 0.004, 0.034
"""Thickness of the walls and of the floor, height of the rim [m]."""
SLOT = 0.044
"""Distance of each shoe's place from the box's middle, in y [m]."""
LIFT = 0.05
"""Height to which the shoes are lifted [m]: enough to pass over the rim, little enough for short wrists that point straight
down."""
TURNS = np.radians([-12, 75])
"""Range of a shoe's turn from its place in the box [rad]: of the left one counterclockwise, of the right one clockwise."""
TIP_LEFT = np.pi / 2
"""Yaw at which a shoe's tip, its y axis, points to the left [rad]."""
SOLE = 0.012
WITHIN = (0.05, 0.05, 0.015)
"""Largest offset from the goal in x, y and z [m]."""
GRASP_HEIGHT = 0.036
"""Height of the tool above the sole's bottom [m]: the pads end above the rim of the sole."""
GRASP_AT = -0.010
"""Place of the grasp along y in a shoe's frame [m]: its center of mass is there."""
LEATHERS: dict[str, Color] = objects.PALETTE | {"black": (52, 53, 58), "white": (236, 236, 232), "brown": (122, 78, 46)}


def shoe(kind: str, length: float, color: Color, trim: Color) -> tuple[Shape, float]:
    """A sneaker or a loafer with its tip at +y, and its width where a hand takes it [m].

    Its upper has upright flat sides from the heel to the instep, on which pads lie.
    """
    half, width = length / 2, 0.16 * length
    grip, top = 0.92 * width, 0.064 if kind == "sneaker" else 0.056
    sides = [(0.72, -1.0), (0.98, -0.82), (0.90, -0.1), (1.10, 0.45), (0.98, 0.75), (0.6, 0.95), (0.2, 1.0)]
    outline = [(x * width, y * half) for x, y in sides]
    sole = _plate(outline, lambda y: 0.0, lambda y: SOLE, (242, 240, 234) if kind == "sneaker" else (58, 42, 32))
    quarter = _arches([(-0.95, 0.74, 0.99), (-0.80, 1.0, 1.0), (-0.1, 1.0, 0.93), (0.2, 1.0, 0.83)], grip, half, top, color)
    vamp = _arches(
        [(0.14, 1.0, 0.85), (0.36, 1.08, 0.73), (0.62, 1.05, 0.58), (0.84, 0.8, 0.48), (0.96, 0.42, 0.38)],
        grip,
        half,
        top,
        color,
    )
    seen = [sole, quarter, vamp, *_collar(grip, half, top, trim), *_details(kind, grip, half, top, trim)]
    return Shape(meshes.merge(seen), (sole.vertices, quarter.vertices, vamp.vertices)), 2 * grip


def _plate(
    outline: Sequence[tuple[float, float]], low: Callable[[float], float], high: Callable[[float], float], color: Color
) -> Mesh:
    """The convex body over a half outline (x, y) [m] and its mirror image, from a height to another [m], functions of y."""
    points = [(side * x, y, z(y)) for x, y in outline for side in (-1, 1) for z in (low, high)]
    return meshes.hull(np.array(points), color)


def _arches(stations: Sequence[tuple[float, float, float]], grip: float, half: float, top: float, color: Color) -> Mesh:
    """The convex hull of arches, each at (share of y, of the half width, of the height): upright sides, a rounded top."""
    arch = np.array([(1, 0, SOLE), (1, 0.74, 0), (0.84, 0.92, 0), (0.6, 1, 0)])
    points = [
        (side * x * wide * grip, y * half, z * high * top + low)
        for y, wide, high in stations
        for x, z, low in arch
        for side in (-1, 1)
    ]
    return meshes.hull(np.array(points), color)


def _collar(grip: float, half: float, top: float, trim: Color) -> list[Mesh]:
    """The padded rim and the dark opening for the foot, on the slope from heel to instep; they are only seen."""

    def slope(y: float) -> float:
        return top * (1.0 - 0.1 * (y / half + 0.8))

    def ring(inside: float, proud: float, color: Color) -> Mesh:
        sides = [(0.3, -0.86), (0.58, -0.76), (0.6, -0.45), (0.56, -0.14), (0.3, -0.06)]
        outline = [(x * grip * inside, (y + 0.46) * half * inside - 0.46 * half) for x, y in sides]
        return _plate(outline, lambda y: slope(y) - 0.002, lambda y: slope(y) + proud, color)

    return [ring(1.0, 0.0012, objects.darken(trim, 0.85)), ring(0.84, 0.0020, (34, 31, 31))]


def _details(kind: str, grip: float, half: float, top: float, trim: Color) -> list[Mesh]:
    """Details of a sneaker (laces, tongue, stripes, toe cap) or a loafer (strap, heel); all only seen."""
    fall = 0.27 * top / (0.48 * half)
    lean = -float(np.arctan(fall))

    def on_vamp(y: float) -> tuple[float, float, float]:
        return 0.0, y * half, top * 0.85 - fall * (y - 0.14) * half

    if kind == "loafer":
        strap = meshes.box((grip * 1.35, 0.015, 0.004), trim).transformed(on_vamp(0.34), (lean, 0, 0))
        buckle = meshes.box((grip * 0.4, 0.008, 0.006), (212, 182, 92)).transformed(on_vamp(0.34), (lean, 0, 0))
        heel = meshes.box((grip * 1.5, 0.25 * half, SOLE), (30, 24, 20)).transformed((0, -0.86 * half, SOLE / 2))
        return [strap, buckle, heel]
    laces = [
        meshes.box((grip * 1.1, 0.0045, 0.0045), (250, 250, 248)).transformed(on_vamp(y), (lean, 0, 0.16 * (-1) ** number))
        for number, y in enumerate((0.20, 0.32, 0.44, 0.56))
    ]
    tongue = meshes.box((grip * 0.95, 0.004, 0.020), trim).transformed((0, 0.06 * half, 0.92 * top), (0.5, 0, 0))
    cap = _arches([(0.76, 0.95, 0.535), (0.86, 0.8, 0.49), (0.975, 0.45, 0.40)], grip, half, top, (242, 240, 234))
    stripes = [
        meshes.box((0.0012, 0.007, 0.030), trim).transformed((side * grip, y * half, 0.031), (-0.5, 0, 0))
        for side in (-1, 1)
        for y in (-0.42, -0.22, -0.02)
    ]
    return [*laces, tongue, cap, *stripes]


def shoe_box(color: Color) -> Shape:
    """The lower part of a shoe box, with tissue paper on its floor."""
    width, depth = BOX_SIZE
    floor = objects.block((width - WALL, depth - WALL, FLOOR), objects.darken(color, 0.9))
    paper = meshes.box((width - 0.02, depth - 0.02, 0.0008), (246, 244, 240)).transformed((0, 0, FLOOR))
    label = meshes.box((0.07, 0.0012, 0.018), (246, 244, 240)).transformed((0, -depth / 2, RIM / 2))
    return objects.merge(floor, *containers.walls(BOX_SIZE, WALL, RIM, color), Shape(meshes.merge([paper, label])))


def sample(rng: np.random.Generator, seed: int) -> Scene:
    kind = str(rng.choice(["sneaker", "loafer"]))
    colors = [str(color) for color in rng.permutation(sorted(LEATHERS))]
    shape, width = shoe(kind, rng.uniform(0.158, 0.176), LEATHERS[colors[0]], LEATHERS[colors[1]])
    card = [(196, 160, 116), (186, 70, 60), (72, 96, 140), (70, 74, 82)][rng.integers(4)]
    shoes = []
    for name, side in (("left_shoe", -1), ("right_shoe", 1)):
        x, y = rng.uniform([0.22, -0.15], [0.29, -0.07])
        pose = upright((side * x, y), TABLE_TOP, TIP_LEFT - side * rng.uniform(*TURNS))
        shoes.append(SceneObject(name, shape, pose, mass=0.10, grasp=Grasp(GRASP_HEIGHT, width, np.pi)))
    fixed = SceneObject("box", shoe_box(card), upright(BOX, TABLE_TOP))
    return Scene("place_dual_shoes", seed, (*shoes, fixed), words={"color": colors[0], "kind": kind})


def slots(scene: Scene) -> dict[str, np.ndarray]:
    """Where the shoes stand in the box, [3] world."""
    middle = point_above(scene.object("box"), FLOOR)
    return {"left_shoe": middle - [0, SLOT, 0], "right_shoe": middle + [0, SLOT, 0]}


def _grasp(thing: SceneObject, arm: int) -> tuple[Tool, float]:
    """The hand straight down across a shoe, and the turn [rad] that brings the tip to the left and ends a quarter outward."""
    turn = TIP_LEFT - thing.yaw
    middle = np.array(thing.pose[:3]) + Rotation.from_euler("z", thing.yaw).apply([0, GRASP_AT, GRASP_HEIGHT])
    return tool(middle, side_sign(arm) * np.pi / 2 - turn), turn


def plan(scene: Scene) -> Timeline:
    """Both are lifted and turned; the left one goes into the box first, while the other waits."""
    names = {LEFT: "left_shoe", RIGHT: "right_shoe"}
    grasps, goals = {}, {}
    for arm, name in names.items():
        thing, goal = scene.object(name), slots(scene)[name] + [0, 0, HOVER]
        grasps[arm], turn = _grasp(thing, arm)
        goals[arm] = grasps[arm].carried(thing.pose[:3], goal, turn)
    release = opening_for(grasp_of(scene.object("left_shoe")).width)
    timeline = Timeline()
    pick(timeline, grasps, LIFT)
    place(timeline, LEFT, names[LEFT], goals[LEFT], above=LIFT, retreat=LIFT, release=release)
    timeline.move(aside_poses([RIGHT]) | {RIGHT: goals[RIGHT].moved(z=LIFT)})
    place(timeline, RIGHT, names[RIGHT], goals[RIGHT], above=0.03, retreat=LIFT, release=release)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    for name, goal in slots(scene).items():
        pose = now.object_pose[scene.index(name)]
        offset = np.abs(pose[:3] - goal)
        if (offset >= WITHIN).any() or -object_axis(pose, [0, 1, 0])[0] < np.cos(np.radians(15)):
            return False
    return now.both_open


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_carried(scene, first, now, slots(scene), WITHIN)


TASK = Task(
    "place_dual_shoes", "put the pair of {color} {kind}s into the shoe box, tips to the left", sample, plan, success, approach
)

"""Task: stamp a seal on a colored square, with one hand.

Randomization: the seal upright at |x| in [.05, .25], |y| at most .05, one of eight turns; the square (only seen, 70 mm wide)
    on the same side at |x| in [.05, .25], |y| at most .05, at least .10 away; round, square or eight-sided foot, sizes,
    kind of wood, color of the square.
Success: the seal's middle within 10 mm of the square's in x and y, standing on the table (5 mm, upright within 8 degrees),
    both grippers open. (RoboTwin 2.0 tests x, y and the grippers.)
After RoboTwin 2.0's stamp_seal.
"""

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.assets import containers
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.meshes import Color
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import Timeline, tool
from xew.sim_warp.scene import Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import (
    GRASP_TILT,
    Moment,
    Task,
    arm_for,
    is_upright,
    pick,
    place,
    radial_turn,
    radial_yaw,
    share_carried,
)

FACETS = 8
"""Number of flat sides of the knob, for the pads."""
TURN = 2 * np.pi / FACETS
GRASP_BELOW_TOP = 0.022
TARGET = 0.07
"""Edge of the square [m]."""
WITHIN = (0.01, 0.01, 0.005)
"""Largest offset from the goal in x, y and z [m]."""
WOODS: tuple[Color, ...] = ((168, 104, 58), (206, 160, 106), (122, 76, 52))
BRASS: Color = (205, 165, 75)


def seal(rng: np.random.Generator, ink: Color) -> Shape:
    """A stamp whose foot carries `ink`, with a waist and a knob of `FACETS` flat sides."""
    foot, handle, height = rng.uniform([0.017, 0.012, 0.072], [0.021, 0.015, 0.084])
    sides, wood = int(rng.choice([4, FACETS, 24])), WOODS[rng.integers(len(WOODS))]
    pad = _prism(foot * 0.97, sides, 0.0, 0.005)
    base = _prism(foot, sides, 0.004, 0.016)
    neck = _prism(handle * 0.55, FACETS, 0.015, 0.036)
    band = _prism(handle * 0.7, 24, 0.016, 0.020)
    outline = [(0.55, 0.034), (1.0, 0.044), (1.0, height - 0.010), (0.72, height)]
    knob = np.concatenate([containers.ring(share * handle, FACETS, z) for share, z in outline]).astype(np.float32)
    pieces = [(pad, ink), (base, wood), (band, BRASS), (neck, wood), (knob, wood)]
    mesh = meshes.merge([meshes.hull(points, color) for points, color in pieces])
    return Shape(mesh, (np.concatenate([pad, base]), neck, knob))


def _prism(radius: float, sides: int, low: float, high: float) -> np.ndarray:
    """[k 3] corners of an upright prism; `radius` [m] is the radius of its inscribed circle, a flat side faces +x."""
    return np.concatenate([containers.ring(radius, sides, low), containers.ring(radius, sides, high)]).astype(np.float32)


def square(color: Color) -> Shape:
    """Where the seal goes: paint on the table, with a paler frame."""
    paint = meshes.box((TARGET, TARGET, 0.0008), color)
    frame = meshes.box((TARGET + 0.008, TARGET + 0.008, 0.0004), (250, 250, 250))
    return Shape(meshes.merge([paint, frame]))


def sample(rng: np.random.Generator, seed: int) -> Scene:
    side = np.array([rng.choice([-1.0, 1.0]), 1.0])
    start = rng.uniform([0.05, -0.05], [0.25, 0.05]) * side
    target = draw(rng, [0.05, -0.05], [0.25, 0.05], lambda p: np.hypot(*(p * side - start)) >= 0.1) * side
    color = str(rng.choice(sorted(objects.PALETTE)))
    yaw = radial_yaw(arm_for(start[0]), start) + TURN * rng.integers(FACETS)
    return Scene(
        "stamp_seal",
        seed,
        (
            SceneObject("seal", seal(rng, objects.PALETTE[color]), upright(start, TABLE_TOP, yaw), mass=0.05),
            SceneObject("square", square(objects.PALETTE[color]), upright(target, TABLE_TOP)),
        ),
        words={"color": color},
    )


def plan(scene: Scene) -> Timeline:
    thing, target = scene.object("seal"), np.array(scene.object("square").pose[:3])
    start = np.array(thing.pose[:3])
    arm = arm_for(start[0])
    height = float(thing.shape.mesh.vertices[:, 2].max()) - GRASP_BELOW_TOP
    grasp = tool(start + [0, 0, height], radial_yaw(arm, start), GRASP_TILT)
    turn = radial_turn(arm, start, target)
    timeline = Timeline()
    pick(timeline, {arm: grasp}, lift=0.05, opening=0.7)
    place(timeline, arm, "seal", grasp.carried(start, target + [0, 0, 0.001], turn), above=0.05, retreat=0.09, release=0.7)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    pose = now.object_pose[scene.index("seal")]
    offset = np.abs(pose[:3] - scene.object("square").pose[:3])
    return bool((offset < WITHIN).all() and is_upright(pose, 8) and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    goal = scene.object("square").pose[:3]
    return share_carried(scene, first, now, {"seal": goal}, WITHIN)


TASK = Task("stamp_seal", "stamp the seal on the {color} square", sample, plan, success, approach)

"""Task: put an everyday thing on a display stand.

Randomization: one of mouse, stapler, bell, magic cube, toy car, remote control at |x| in [.20, .28], y in [-.05, .05], its
    long side within 45 degrees of the direction from its arm's shoulder, either way round; stand at |x| at most .05 on the
    same side, y in [-.15, -.10], its yaw within 30 degrees, free of the thing; variant of the thing, form (round, square,
    long), size and color of the stand.
Success: thing within 30 mm of the stand's center in x and y, on top of it (10 mm), both grippers open.
After RoboTwin 2.0's place_object_stand, whose thing lies within 60 degrees and whose test asks for no height.
"""

import numpy as np

from xew.sim_warp.assets import household
from xew.sim_warp.assets.household import slab
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.meshes import Color, Mesh
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import Moment, Task, carry, draw_pair, easy_turn, graspable_yaw, point_above, share_of_way

KINDS = ("bell", "mouse", "remote", "rubik_cube", "stapler", "toy_car")
COLORS = ("black", "gray", "teal", "purple", "blue", "green")
PLATE, INLAY = 0.008, 0.002
"""Thickness of the upper plate and of the pale inlay on it [m]."""
STAND_MASS = 0.3
GAP = 0.01
"""Free space between the two at first [m]."""
WITHIN = (0.03, 0.03, 0.01)
"""Largest offset of a thing from the middle of the stand's upper face [m]."""


def stand(rng: np.random.Generator) -> tuple[str, Shape]:
    """The color and the shape of a stand: a foot, a column, and a plate whose upper face is the place for a thing."""
    name, form = str(rng.choice(COLORS)), str(rng.choice(["round", "square", "long"]))
    height, span = rng.uniform([0.040, 0.104], [0.060, 0.124])
    width = 1.35 * span if form == "long" else span
    color, is_round = household.COLORS[name], form == "round"
    foot = _plate(0.78 * width, 0.78 * span, 0.010, color, is_round)
    plate = _plate(width, span, PLATE, color, is_round).transformed((0, 0, height - PLATE))
    column = meshes.cylinder(0.022, height - 0.012, household.STEEL, sections=12).transformed((0, 0, height / 2))
    # The rim is seen a little lower than it collides: a thing lies on the inlay.
    rim = plate.transformed((0, 0, -INLAY))
    inlay = _plate(width - 0.012, span - 0.012, INLAY, household.CREAM, is_round).transformed((0, 0, height - INLAY))
    return name, Shape(meshes.merge([foot, column, rim, inlay]), tuple(mesh.vertices for mesh in (foot, column, plate)))


def _plate(width: float, depth: float, thickness: float, color: Color, is_round: bool) -> Mesh:
    """A plate that lies on z = 0: a slab, or a disc as wide as that."""
    if is_round:
        return meshes.cylinder(width / 2, thickness, color, sections=20).transformed((0, 0, thickness / 2))
    return slab((width, depth, thickness), min(0.002, thickness / 3), color)


def sample(rng: np.random.Generator, seed: int) -> Scene:
    side = rng.choice([-1.0, 1.0])
    thing = household.draw_thing(rng, KINDS)
    color, shape = stand(rng)
    apart = thing.radius + household.footprint_radius(shape) + GAP
    at, beneath = draw_pair(rng, [0.20, -0.05, 0.0, -0.15], [0.28, 0.05, 0.05, -0.10], apart, side)
    turn = rng.uniform(-1, 1) * np.radians(30)
    return Scene(
        "place_object_stand",
        seed,
        (
            thing.place_at("thing", at, graspable_yaw(rng, at, np.radians(45))),
            SceneObject("stand", shape, upright(beneath, TABLE_TOP, turn), mass=STAND_MASS),
        ),
        words={"thing": thing.words, "color": color},
    )


def top_height(scene: Scene) -> float:
    """Height of the stand's upper face over its origin [m]."""
    return float(max(hull[:, 2].max() for hull in scene.object("stand").shape.hulls))


def plan(scene: Scene) -> Timeline:
    thing, goal = scene.object("thing"), point_above(scene.object("stand"), top_height(scene))
    timeline = Timeline()
    carry(timeline, thing, goal, easy_turn(thing, goal))
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    thing, beneath = (now.object_pose[scene.index(name), :3] for name in ("thing", "stand"))
    offset = np.abs(thing - beneath - [0, 0, top_height(scene)])
    return bool((offset < WITHIN).all() and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    """The share of the thing's way to the top of the stand, where that is now."""
    start, end = (
        moment.object_pose[scene.index("thing"), :3] - moment.object_pose[scene.index("stand"), :3] for moment in (first, now)
    )
    return share_of_way(start, end, (0.0, 0.0, top_height(scene)), WITHIN)


TASK = Task("place_object_stand", "place the {thing} on the {color} stand", sample, plan, success, approach)

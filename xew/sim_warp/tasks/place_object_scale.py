"""Task: put an everyday thing on a kitchen scale.

Randomization: one of mouse, stapler, bell at |x| in [.04, .25], y in [-.20, 0], its long side within 55 degrees of the
    direction from its arm's shoulder, either way round; scale on the same side at |x| in [.04, .25], y in [-.18, .02], its
    display turned at most 40 degrees off the robot, 20 mm free of it; variant of the thing, form (round or square pan),
    size and color of the scale, which is fixed to the table.
Success: thing within 35 mm of the pan's center in the plane and not below the pan (10 mm), both grippers open.
After RoboTwin 2.0's place_object_scale, whose scale is free and stands at any yaw, and whose thing and scale reach y = .05.
"""

import numpy as np

from xew.sim_warp.assets import household
from xew.sim_warp.assets.household import print_on, slab
from xew.sim_warp.geometry import meshes
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import Moment, Task, carry, draw_pair, easy_turn, graspable_yaw, point_above, share_carried

KINDS = ("mouse", "stapler", "bell")
GAP = 0.02
"""Free space between thing and scale at first, for a finger [m]."""
COLORS = ("black", "red", "blue", "green", "teal", "orange")
PLATE = 0.006


def scale(rng: np.random.Generator) -> tuple[str, Shape]:
    """The color and the shape of a kitchen scale: a pan over the frame's origin, a body under it that reaches out in front
    (-y), where the display lies."""
    name = str(rng.choice(COLORS))
    width, depth, height = rng.uniform([0.112, 0.140, 0.034], [0.128, 0.156, 0.044])
    low, half = 0.6 * height, 0.46 * width
    body = slab((width, depth, low), 0.004, household.COLORS[name]).transformed((0, half + 0.004 - depth / 2, 0))
    neck = meshes.cylinder(0.018, height - low, household.DARK, sections=16).transformed((0, 0, (height + low) / 2 - 0.001))
    if rng.random() < 0.5:
        pan = meshes.cylinder(half, PLATE, household.STEEL, sections=20).transformed((0, 0, height - PLATE / 2))
    else:
        pan = slab((2 * half, 2 * half, PLATE), 0.002, household.STEEL, height - PLATE)
    front = half + 0.004 - depth + 0.016
    window = print_on((0.040, 0.018), (0, front, low), (60, 66, 62))
    digits = [print_on((0.004, 0.010), (x, front, low + household.SKIN), (190, 230, 150)) for x in (-0.010, 0.001, 0.012)]
    keys = [print_on((0.010, 0.010), (side * 0.034, front, low), (205, 205, 200)) for side in (-1, 1)]
    seen = meshes.merge([body, neck, pan, window, *digits, *keys])
    return name, Shape(seen, (body.vertices, pan.vertices))


def sample(rng: np.random.Generator, seed: int) -> Scene:
    side = rng.choice([-1.0, 1.0])
    thing = household.draw_thing(rng, KINDS)
    color, shape = scale(rng)
    apart = thing.radius + household.footprint_radius(shape) + GAP
    at, beneath = draw_pair(rng, [0.04, -0.20, 0.04, -0.18], [0.25, 0.0, 0.25, 0.02], apart, side)
    turn = rng.uniform(-1, 1) * np.radians(40)
    return Scene(
        "place_object_scale",
        seed,
        (
            thing.place_at("thing", at, graspable_yaw(rng, at)),
            SceneObject("scale", shape, upright(beneath, TABLE_TOP, turn)),
        ),
        words={"thing": thing.words, "color": color},
    )


def pan_center(scene: Scene) -> np.ndarray:
    """[3] the middle of the pan's upper face, world [m]."""
    scale = scene.object("scale")
    return point_above(scale, scale.shape.mesh.vertices[:, 2].max())


def plan(scene: Scene) -> Timeline:
    thing, goal = scene.object("thing"), pan_center(scene)
    timeline = Timeline()
    carry(timeline, thing, goal, easy_turn(thing, goal))
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    offset = now.object_pose[scene.index("thing"), :3] - pan_center(scene)
    return bool(np.hypot(*offset[:2]) < 0.035 and offset[2] > -0.01 and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_carried(scene, first, now, {"thing": pan_center(scene)}, (0.025, 0.025, 0.01))


TASK = Task("place_object_scale", "put the {thing} on the {color} scale", sample, plan, success, approach)

"""Task: put a pill bottle on a square pad.

Randomization: bottle at |x| in [.05, .25], y in [-.10, .10], any yaw; its size and colors. The pad (fixed to
    the table) on the same side, |x| in [.05, .25], y in [-.20, .10], at least .10 away; its color.
Success: bottle within 30 mm of the pad's center in x and y, standing on it (5 mm), both grippers open.
After RoboTwin 2.0's move_pillbottle_pad, whose pads are all blue.
"""

import numpy as np

from xew.sim_warp.assets import containers, household
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import (
    GRASP_TILT,
    Moment,
    Task,
    arm_for,
    carry,
    is_upright,
    point_above,
    radial_turn,
    share_carried,
)

PAD = 0.08
"""Side of the pad [m]."""
WITHIN = (0.03, 0.03, 0.005)
"""Largest offset from the goal in x, y and z [m]."""


def sample(rng: np.random.Generator, seed: int) -> Scene:
    side = rng.choice([-1.0, 1.0])
    bottle = rng.uniform([0.05, -0.10], [0.25, 0.10])
    pad = draw(rng, [0.05, -0.20], [0.25, 0.10], lambda p: np.hypot(*(p - bottle)) >= 0.10)
    shape, _ = containers.pill_bottle(rng)
    color = str(rng.choice(sorted(household.MATS)))
    return Scene(
        "move_pillbottle_pad",
        seed,
        (
            containers.place_standing("bottle", shape, bottle * [side, 1], rng.uniform(-np.pi, np.pi), mass=0.08),
            SceneObject("pad", household.mat((PAD, PAD), household.MATS[color]), upright(pad * [side, 1], TABLE_TOP)),
        ),
        words={"color": color},
    )


def plan(scene: Scene) -> Timeline:
    bottle, pad = scene.object("bottle"), scene.object("pad")
    goal = point_above(pad, household.MAT_THICKNESS)
    timeline = Timeline()
    carry(timeline, bottle, goal, radial_turn(arm_for(bottle.pose[0]), bottle.pose, goal), lift=0.06, tilt=GRASP_TILT)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    bottle = now.object_pose[scene.index("bottle")]
    offset = np.abs(bottle[:3] - scene.object("pad").pose[:3] - [0, 0, household.MAT_THICKNESS])
    return bool((offset < WITHIN).all() and is_upright(bottle, 15) and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    goal = point_above(scene.object("pad"), household.MAT_THICKNESS)
    return share_carried(scene, first, now, {"bottle": goal}, WITHIN)


TASK = Task("move_pillbottle_pad", "place the pill bottle on the {color} pad", sample, plan, success, approach)

"""Task: move a stapler onto a mat, its long side along the mat's.

Randomization: stapler at |x| in [.05, .25], y in [-.20, -.03], its long side within 50 degrees of the direction from its
    arm's shoulder, either way round; mat (110 x 60 mm, its long side along x) on the same side at |x| in [.05, .16], y in
    [-.20, -.10], at least .12 away; size and color of the stapler, one of eight colors of the mat, not its own.
Success: stapler within 20 mm of the mat's center in x and y and standing on it (10 mm), its long side within 10 degrees of x,
    both grippers open.
After RoboTwin 2.0's move_stapler_pad, whose stapler lies at any yaw; here both lie where a Piper turns its hand crosswise.
"""

import numpy as np

from xew.sim_warp.assets import household
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import (
    STEEP_TILT,
    Moment,
    Task,
    aligning_turn,
    carry,
    graspable_yaw,
    object_axis,
    point_above,
    share_carried,
)

MAT = (0.11, 0.06)
WITHIN = (0.02, 0.02, 0.01)
"""Largest offset from the goal in x, y and z [m]."""


def sample(rng: np.random.Generator, seed: int) -> Scene:
    side = rng.choice([-1.0, 1.0])
    stapler = household.stapler(rng)
    goal = rng.uniform([0.05, -0.20], [0.16, -0.10])
    at = draw(rng, [0.05, -0.20], [0.25, -0.03], lambda p: np.hypot(*(p - goal)) >= 0.12) * [side, 1]
    color = household.mat_color(rng, stapler.words)
    return Scene(
        "move_stapler_pad",
        seed,
        (
            stapler.place_at("stapler", at, graspable_yaw(rng, at, np.radians(50))),
            SceneObject("mat", household.mat(MAT, household.MATS[color]), upright(goal * [side, 1], TABLE_TOP)),
        ),
        words={"stapler": stapler.words, "color": color},
    )


def plan(scene: Scene) -> Timeline:
    stapler, mat = scene.object("stapler"), scene.object("mat")
    goal = point_above(mat, household.MAT_THICKNESS)
    timeline = Timeline()
    carry(timeline, stapler, goal, aligning_turn(stapler, goal, np.pi / 2), tilt=STEEP_TILT)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    pose = now.object_pose[scene.index("stapler")]
    offset = np.abs(pose[:3] - np.array(scene.object("mat").pose[:3]) - [0, 0, household.MAT_THICKNESS])
    along = np.abs(object_axis(pose, [0, 1, 0])[0]) > np.cos(np.radians(10))
    return bool((offset < WITHIN).all() and along and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    goal = point_above(scene.object("mat"), household.MAT_THICKNESS)
    return share_carried(scene, first, now, {"stapler": goal}, WITHIN)


TASK = Task("move_stapler_pad", "move the {stapler} to the {color} mat", sample, plan, success, approach)

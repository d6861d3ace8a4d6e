"""Task: put a computer mouse on a mat, lengthwise.

Randomization: mouse at |x| in [.05, .25], y in [-.20, 0], its long side within 55 degrees of the direction from its arm's
    shoulder, either way round; mat (70 x 130 mm, its long side along y) on the same side in the same range, at least .13
    away; size and color of the mouse, one of eight colors of the mat, not its own.
Success: mouse within 15 mm in x and 12 mm in y of the mat's center, its long side within 15 degrees of y, both grippers open.
After RoboTwin 2.0's place_mouse_pad, whose mouse lies at any yaw and at least .10 from the mat.
"""

import numpy as np

from xew.sim_warp.assets import household
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import Moment, Task, aligning_turn, carry, graspable_yaw, object_axis, point_above, share_carried

MAT = (0.07, 0.13)
WITHIN = (0.015, 0.012)
"""Largest offset from the mat's center in x and y [m]."""


def sample(rng: np.random.Generator, seed: int) -> Scene:
    side = rng.choice([-1.0, 1.0])
    mouse = household.mouse(rng)
    at = rng.uniform([0.05, -0.20], [0.25, 0.0])
    goal = draw(rng, [0.05, -0.20], [0.25, 0.0], lambda p: np.hypot(*(p - at)) >= 0.13) * [side, 1]
    at = at * [side, 1]
    color = household.mat_color(rng, mouse.words)
    return Scene(
        "place_mouse_pad",
        seed,
        (
            mouse.place_at("mouse", at, graspable_yaw(rng, at)),
            SceneObject("mat", household.mat(MAT, household.MATS[color]), upright(goal, TABLE_TOP)),
        ),
        words={"mouse": mouse.words, "color": color},
    )


def plan(scene: Scene) -> Timeline:
    mouse, mat = scene.object("mouse"), scene.object("mat")
    goal = point_above(mat, household.MAT_THICKNESS)
    timeline = Timeline()
    carry(timeline, mouse, goal, aligning_turn(mouse, goal, 0.0))
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    pose = now.object_pose[scene.index("mouse")]
    offset = np.abs(pose[:2] - scene.object("mat").pose[:2])
    along = np.abs(object_axis(pose, [0, 1, 0])[1]) > np.cos(np.radians(15))
    return bool((offset < WITHIN).all() and along and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_carried(scene, first, now, {"mouse": scene.object("mat").pose[:2]}, WITHIN)


TASK = Task("place_mouse_pad", "place the {mouse} on the {color} mat", sample, plan, success, approach)

"""Task: take a lying bottle, hold it level across and shake it.

Randomization: a bottle of one of four kinds, on its side, |x| in [.10, .15], y in [-.15, -.05], its neck away from the
    robot and within 45 degrees of the direction in which its side's arm reaches; sizes and colors.
Success: the bottle above .80.
After RoboTwin 2.0's shake_bottle_horizontally, whose bottles all point to the left: here to the side of the other
arm.
"""

import numpy as np

from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene
from xew.sim_warp.tasks.shake_bottle import (
    STROKE,
    SWING,
    approach,
    front_pose,
    lying_bottle,
    raise_bottle,
    roll_hand,
    shake,
    success,
)
from xew.sim_warp.tasks.task import Task, side_sign

TURNING = 2.0
"""Time to turn the bottle level [s]."""


def sample(rng: np.random.Generator, seed: int) -> Scene:
    return lying_bottle("shake_bottle_horizontally", rng, seed)


def plan(scene: Scene) -> Timeline:
    timeline = Timeline()
    arm = raise_bottle(timeline, scene.object("bottle"))
    level = roll_hand(front_pose(arm), -side_sign(arm) * np.pi / 2)
    timeline.follow(arm, [level], TURNING)
    shake(timeline, arm, level, [(STROKE, -SWING), (0, SWING)] * 3)
    return timeline


TASK = Task("shake_bottle_horizontally", "shake the {color} bottle horizontally", sample, plan, success, approach)

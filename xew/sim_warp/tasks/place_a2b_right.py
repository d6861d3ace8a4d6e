"""Task: put one everyday thing to the right of another.

Randomization: that of place_a2b_left, mirrored: B at x in [-.23, -.18] if A is on the left, else in [-.10, .10].
Success: A right of B, between .08 and .20 away, within 50 mm of it in y, both grippers open.
After RoboTwin 2.0's place_a2b_right, with the departures of place_a2b_left.
"""

import numpy as np

from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene
from xew.sim_warp.tasks.place_a2b_left import RIGHT_OF, is_beside, plan_beside, sample_beside, share_beside
from xew.sim_warp.tasks.task import Moment, Task


def sample(rng: np.random.Generator, seed: int) -> Scene:
    return sample_beside(rng, "place_a2b_right", seed, RIGHT_OF)


def plan(scene: Scene) -> Timeline:
    return plan_beside(scene, RIGHT_OF)


def success(scene: Scene, now: Moment) -> bool:
    return is_beside(scene, now, RIGHT_OF)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_beside(scene, first, now, RIGHT_OF)


TASK = Task("place_a2b_right", "place the {a} to the right of the {b}", sample, plan, success, approach)

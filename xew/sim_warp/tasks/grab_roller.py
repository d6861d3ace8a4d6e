"""Task: lift a roller with both hands at once, one at each end.

Randomization: center at |x| at most .15, y in [-.25, -.05], yaw within 46 degrees; length, thickness and color.
Success: roller higher than .80, both grippers closed on it.
After RoboTwin 2.0's grab_roller.
"""

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.plan import LEFT, RIGHT, Timeline
from xew.sim_warp.scene import Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import GRIPPER_CLOSED, Moment, Task, across, pick, share_raised

GRASP_FROM_END = 0.03
GRASP_ABOVE_AXIS = 0.006
"""Height of the tool above the roller's axis [m], for clearance of the lower finger from the table."""
LIFT = 0.12
HIGH_ENOUGH = 0.80


def sample(rng: np.random.Generator, seed: int) -> Scene:
    x, y, yaw = rng.uniform([-0.15, -0.25, -0.8], [0.15, -0.05, 0.8])
    length, radius = rng.uniform([0.23, 0.017], [0.25, 0.019])
    wood, ends = (205, 160, 105), objects.PALETTE[rng.choice(sorted(objects.PALETTE))]
    roller = SceneObject("roller", objects.prism(radius, length, wood, ends), upright((x, y), TABLE_TOP, yaw), mass=0.2)
    return Scene("grab_roller", seed, (roller,))


def plan(scene: Scene) -> Timeline:
    roller = scene.object("roller")
    x, y = roller.pose[:2]
    yaw = roller.yaw
    points = roller.shape.hulls[0]
    reach, height = points[:, 0].max() - GRASP_FROM_END, points[:, 2].mean()
    along = np.array([np.cos(yaw), np.sin(yaw)])
    grasps = {
        arm: across((*(np.array([x, y]) + side * reach * along), TABLE_TOP + height + GRASP_ABOVE_AXIS), yaw, arm)
        for arm, side in ((LEFT, -1), (RIGHT, 1))
    }
    timeline = Timeline()
    pick(timeline, grasps, lift=LIFT, opening=0.6)
    timeline.wait(0.3)
    for arm in grasps:
        timeline.hold(arm, "roller")
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    index = scene.index("roller")
    return bool(now.object_pose[index, 2] > HIGH_ENOUGH and (now.gripper < GRIPPER_CLOSED).all())


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_raised(scene, first, now, "roller", HIGH_ENOUGH)


TASK = Task("grab_roller", "use both arms to grab the roller and lift it", sample, plan, success, approach)

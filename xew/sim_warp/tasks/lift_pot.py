"""Task: lift a cooking pot level with both hands, one at each handle.

Randomization: the pot at |x| at most .05, y in [-.05, .05], its handles within 22 degrees of x; its size, colors and lid.
Success: pot higher than .82 and upright within 37 degrees, each tool within 30 mm of its handle.
After RoboTwin 2.0's lift_pot.
"""

import numpy as np

from xew.sim_warp.assets import containers
from xew.sim_warp.plan import LEFT, RIGHT, Timeline, tool
from xew.sim_warp.scene import Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import GRASP_TILT, Moment, Task, object_axis, pick, share_raised

WIDEST_TURN = np.radians(22.5)
LIFT = 0.14
OPENING = 0.4
"""Opening of the grippers on their way to the handles: a finger has to go between each and the pot."""
HIGH_ENOUGH, UPRIGHT, NEAR = 0.82, 0.8, 0.03
"""Limits of success: height of the pot [m], cosine of its lean, distance of a tool from its handle [m]."""


def sample(rng: np.random.Generator, seed: int) -> Scene:
    x, y = rng.uniform([-0.05, -0.05], [0.05, 0.05])
    yaw = rng.uniform(-WIDEST_TURN, WIDEST_TURN)
    shape, color = containers.pot(rng, radius=(0.068, 0.078), height=(0.075, 0.095), reach=0.036)
    pot = SceneObject("pot", shape, upright((x, y), TABLE_TOP, yaw), mass=0.3)
    return Scene("lift_pot", seed, (pot,), words={"color": color})


def handles(scene: Scene, pose: np.ndarray) -> np.ndarray:
    """[2 3] the middles of the left and the right handle of the pot at `pose` [7], world [m]."""
    return np.asarray(pose[:3]) + object_axis(pose, containers.handles(scene.object("pot").shape))


def plan(scene: Scene) -> Timeline:
    pot = scene.object("pot")
    middles = handles(scene, np.array(pot.pose))
    grasps = {arm: tool(middles[arm], pot.yaw, GRASP_TILT) for arm in (LEFT, RIGHT)}
    timeline = Timeline()
    pick(timeline, grasps, lift=LIFT, opening=OPENING)
    timeline.wait(0.6)
    for arm in grasps:
        timeline.hold(arm, "pot")
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    pose = now.object_pose[scene.index("pot")]
    apart = np.linalg.norm(now.tool_pose[:, :3] - handles(scene, pose), axis=-1)
    return bool(pose[2] > HIGH_ENOUGH and object_axis(pose, [0, 0, 1])[2] > UPRIGHT and (apart < NEAR).all())


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_raised(scene, first, now, "pot", HIGH_ENOUGH)


TASK = Task("lift_pot", "lift the {color} pot with both arms", sample, plan, success, approach)

"""Task: pick up a can and put it beside a cooking pot.

Randomization: the pot (fixed to the table) in the middle, its handles within 22 degrees of x; its size, colors and lid.
    The can at |x| in [.20, .30], y in [.05, .15], yaw within 43 degrees; size and colors. The arm is that of the can's side.
Success: the can on the arm's side of the pot, at most 200 mm from it in x and 35 mm in y, upright within 15 degrees and on
    the table (5 mm), both grippers open.
After RoboTwin 2.0's move_can_pot, whose pot may be pushed. Here it is lower than the can: a wide hand at the can
passes over its handle.
"""

import numpy as np

from xew.sim_warp.assets import containers
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import GRASP_TILT, Moment, Task, arm_for, carry, is_upright, radial_turn, share_carried, side_sign

BESIDE = 0.18
"""Distance of the can from the pot's axis [m]."""


def sample(rng: np.random.Generator, seed: int) -> Scene:
    side = rng.choice([-1.0, 1.0])
    at = rng.uniform([0.20, 0.05], [0.30, 0.15]) * [side, 1]
    pot, metal = containers.pot(rng, radius=(0.056, 0.064), height=(0.062, 0.074), reach=0.022)
    can, label = containers.can(rng)
    return Scene(
        "move_can_pot",
        seed,
        (
            containers.place_standing("can", can, at, rng.uniform(-0.75, 0.75), mass=0.1),
            SceneObject("pot", pot, upright((0, 0), TABLE_TOP, rng.uniform(-0.39, 0.39))),
        ),
        words={"can": label, "pot": metal},
    )


def beside_pot(scene: Scene) -> np.ndarray:
    """[3] the place of the can on its side of the pot, world [m]."""
    side = side_sign(arm_for(scene.object("can").pose[0]))
    return np.array(scene.object("pot").pose[:3]) + [side * BESIDE, 0, 0]


def plan(scene: Scene) -> Timeline:
    can, goal = scene.object("can"), beside_pot(scene)
    arm = arm_for(can.pose[0])
    timeline = Timeline()
    carry(timeline, can, goal, radial_turn(arm, can.pose, goal), tilt=GRASP_TILT)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    can, pot = now.object_pose[scene.index("can")], np.array(scene.object("pot").pose[:3])
    side = np.sign(scene.object("can").pose[0])
    x, y, z = (can[:3] - pot) * [side, 1, 1]
    return bool(0 < x < 0.2 and abs(y) < 0.035 and abs(z) < 0.005 and is_upright(can, 15) and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    goal = beside_pot(scene)
    return share_carried(scene, first, now, {"can": goal}, (0.02, 0.035, 0.005))


TASK = Task("move_can_pot", "pick up the {can} can and put it beside the {pot} pot", sample, plan, success, approach)

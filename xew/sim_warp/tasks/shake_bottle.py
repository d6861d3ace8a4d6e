"""Task: take a lying bottle, turn it upright and shake it.

Randomization: a bottle of one of four kinds, on its side, |x| in [.10, .15], y in [-.15, -.05], its neck away from the
    robot and within 45 degrees of the direction in which its side's arm reaches; sizes and colors.
Success: the bottle above .80.
After RoboTwin 2.0's shake_bottle, whose bottles stand upright in the hand: here they lean 20 degrees forward, as far up as all
five robots can turn them in the head camera's view. The hand shakes at one place for each arm.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from xew.sim_warp.assets import containers
from xew.sim_warp.plan import Timeline, Tool, tool
from xew.sim_warp.scene import Scene, SceneObject
from xew.sim_warp.tasks.task import Moment, Task, arm_for, grasp_across, pick, radial_yaw, share_raised, side_sign

WIDEST_TURN = np.radians(45)
"""Largest turn of the bottle from the radial direction [rad]."""
FRONT = (0.07, -0.17, 0.985)
"""Place where the right hand shakes [m], its x mirrored for the left: before the head camera, and where all wrists can roll."""
FRONT_TILT, FRONT_YAW = np.radians(70), np.radians(18)
"""Lean of the shaking hand, and its turn inward [rad]."""
LIFT = 0.07
"""Way straight up, before the bottle is turned [m]."""
RAISING = 3.2
"""Time to bring the bottle up [s]."""
STROKE, SWING, STROKE_TIME = 0.05, np.radians(22.5), 0.9
"""Size of a shake: way up [m], turn about the hand's approach direction to either side [rad], time for one way [s]."""
HIGH_ENOUGH = 0.80


def sample(rng: np.random.Generator, seed: int) -> Scene:
    return lying_bottle("shake_bottle", rng, seed)


def lying_bottle(task: str, rng: np.random.Generator, seed: int) -> Scene:
    """A bottle on its side, to be taken where it balances by the arm on its side."""
    side = rng.choice([-1.0, 1.0])
    at = rng.uniform([0.10, -0.15], [0.15, -0.05]) * [side, 1]
    yaw = radial_yaw(arm_for(side), at) + rng.uniform(-WIDEST_TURN, WIDEST_TURN)
    shape, color = containers.bottle(rng)
    return Scene(task, seed, (containers.place_lying("bottle", shape, at, yaw, mass=0.12),), words={"color": color})


def front_pose(arm: int) -> Tool:
    """The shaking pose of a hand: nearly level, with the bottle nearly upright."""
    x, y, z = FRONT
    return tool((side_sign(arm) * x, y, z), side_sign(arm) * FRONT_YAW, FRONT_TILT)


def roll_hand(hand: Tool, angle: float) -> Tool:
    """The hand turned about its approach direction [rad]."""
    return Tool(hand.position, hand.rotation * Rotation.from_euler("x", angle))


def raise_bottle(timeline: Timeline, bottle: SceneObject) -> int:
    """Take a lying bottle from straight above and bring it to `front_pose`; the arm on its side does it."""
    arm = arm_for(bottle.pose[0])
    pick(timeline, {arm: grasp_across(bottle, tilt=0.0)}, lift=LIFT)
    timeline.follow(arm, [front_pose(arm)], RAISING)
    return arm


def shake(timeline: Timeline, arm: int, start: Tool, strokes: Sequence[tuple[float, float]]) -> None:
    """From `start` through (height above it [m], roll [rad]) one after the other, and back."""
    for up, angle in strokes:
        timeline.follow(arm, [roll_hand(start.moved(z=up), angle)], STROKE_TIME)
    timeline.follow(arm, [start], STROKE_TIME)
    timeline.hold(arm, "bottle")


def plan(scene: Scene) -> Timeline:
    timeline = Timeline()
    arm = raise_bottle(timeline, scene.object("bottle"))
    shake(timeline, arm, front_pose(arm), [(STROKE, -SWING), (0, SWING)] * 3)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    return bool(now.object_pose[scene.index("bottle"), 2] > HIGH_ENOUGH)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_raised(scene, first, now, "bottle", HIGH_ENOUGH)


TASK = Task("shake_bottle", "shake the {color} bottle", sample, plan, success, approach)

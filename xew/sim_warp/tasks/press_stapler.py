"""Task: press a stapler shut twice with the closed fingers of one hand, and hold it down.

Randomization: stapler at |x| at most .20, y in [-.10, .05], any yaw (the arm on its side works); its size and color. Its
    foot is fixed to the table, its arm stands on a sprung hinge.
Success: arm of the stapler pressed down beyond 60 % of its way, closed fingers on it, the tool within 40 mm of the place to
    press.
After RoboTwin 2.0's press_stapler, whose stapler has no hinge and whose test asks for a touch.
"""

import numpy as np

from xew.sim_warp.assets import household
from xew.sim_warp.assets.household import StaplerParts
from xew.sim_warp.plan import ASIDE_TIME, Timeline, Tool, tool
from xew.sim_warp.scene import Hinge, Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import (
    GRIPPER_CLOSED,
    TURN_TILT,
    Moment,
    Task,
    arm_for,
    aside_poses,
    hinge_of,
    lid_point,
    radial_yaw,
    share_turned,
)

PRESS_AT = 0.28
"""Place to press along y, as a share of the stapler's length."""
PRESSED, DONE = 1.3, 0.6
"""Shares of the arm's way: to which the expert means to press it, past the stop since a robot gives way by a millimeter or two
under the spring, and from which it counts as pressed."""
STIFFNESS, PRELOAD = 1.0, 0.15
"""Stiffness of the spring [N m/rad], and the angle [rad] by which it is wound when the arm stands open: 2 N at the fingers, 4
N shut."""
BEYOND_TOOL, HALF_WIDTH = 0.015, 0.011
"""Reach of every robot's pads ahead of the tool, and to its sides [m]."""
NEAR = 0.04
"""Largest distance of the tool from the place to press [m]."""
STROKES = 2
"""Number of strokes: in between the spring lifts the arm again, at the end it is held down."""
STROKE_TIME = 0.72
"""Time of each way down [s]."""
CLEAR, APPROACH = 0.01, 0.06
"""Heights over the place to press between strokes, and from which the way down is straight [m]."""


def stapler_hinge(parts: StaplerParts) -> Hinge:
    """The stapler's arm on its hinge: at 0 as it stands open, pressed down at `upper`."""
    return Hinge(
        lid=parts.arm,
        mass=0.06,
        anchor=parts.hinge,
        axis=(-1.0, 0.0, 0.0),
        lower=0.0,
        upper=parts.opening,
        start=0.0,
        friction=0.01,
        damping=0.05,
        stiffness=STIFFNESS,
        rest=-PRELOAD,
    )


def sample(rng: np.random.Generator, seed: int) -> Scene:
    at = rng.uniform([-0.20, -0.10], [0.20, 0.05])
    parts = household.stapler_parts(rng)
    pose = upright(at, TABLE_TOP, rng.uniform(-np.pi, np.pi))
    return Scene(
        "press_stapler",
        seed,
        (SceneObject("stapler", parts.base, pose, hinge=stapler_hinge(parts)),),
        words={"stapler": parts.words},
    )


def press_point(scene: Scene, fraction: float) -> np.ndarray:
    """[3] the place to press on the upper face of the stapler's arm, at a fraction of its way down, world [m]."""
    thing = scene.object("stapler")
    hinge = hinge_of(thing)
    top = hinge.lid.hulls[0][:, 2].max()
    open_at = np.array([0.0, PRESS_AT * float(np.ptp(thing.shape.hulls[0][:, 1])), top - 0.002])
    return lid_point(thing, open_at - hinge.anchor, fraction)


def _pressing_pose(scene: Scene, arm: int, fraction: float) -> Tool:
    """The closed hand whose lower edge touches the place to press."""
    at = press_point(scene, fraction)
    hand = tool(at, radial_yaw(arm, at), TURN_TILT)
    return Tool(at + hand.rotation.apply([-BEYOND_TOOL, 0, HALF_WIDTH]), hand.rotation)


def plan(scene: Scene) -> Timeline:
    arm = arm_for(scene.object("stapler").pose[0])
    touch = _pressing_pose(scene, arm, 0.0)
    timeline = Timeline()
    timeline.grip({arm: 0.0})
    timeline.move(aside_poses([arm]) | {arm: touch.moved(z=APPROACH)}, at_least=ASIDE_TIME)
    for _ in range(STROKES):
        timeline.move({arm: touch.moved(z=CLEAR)})
        timeline.follow(arm, [_pressing_pose(scene, arm, PRESSED)], seconds=STROKE_TIME)
        timeline.wait(0.3)
    timeline.hold(arm, "stapler")
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    index = scene.index("stapler")
    fraction = hinge_of(scene.object("stapler")).fraction(now.object_joint[index])
    near = np.linalg.norm(now.tool_pose[:, :3] - press_point(scene, fraction), axis=-1) < NEAR
    pressing = now.contact[:, index] & near & (now.gripper < GRIPPER_CLOSED)
    return bool(fraction > DONE and pressing.any())


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_turned(scene, first, now, "stapler", DONE)


TASK = Task("press_stapler", "press the {stapler}", sample, plan, success, approach)

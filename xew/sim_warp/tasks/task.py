"""Tasks and the moves that they share: a task is a scene to sample, a plan that solves it, and a test of success."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from xew.sim_warp.geometry.poses import Pose
from xew.sim_warp.plan import ASIDE, ASIDE_TIME, LEFT, RIGHT, Timeline, Tool, tool
from xew.sim_warp.scene import Point, Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP

GRASP_TILT = np.radians(30)
"""Lean of the hand in a grasp from above [rad]: all five robots reach the work area with it (docs/robots.md)."""
STEEP_TILT = np.radians(10)
"""Lean for grasps low over the near part of the table, where a wrist of small range has it easier [rad]."""
TURN_TILT = np.radians(20)
"""Lean for grasps across things that may lie turned: the one with which all robots turn a hand up to `WIDEST_TURN`."""
WIDEST_TURN = np.radians(55)
"""Largest turn of a hand from its radial yaw, over the near part of the table (y below .02) [rad]."""
EASY_TURN = np.radians(35)
"""Turn of a hand from its radial yaw where it need not be more [rad]: reached higher and farther than `WIDEST_TURN`."""
PRE_GRASP = 0.09
"""Distance before a grasp from which the approach is straight [m]."""
HOVER = 0.001
"""Height above its place at which a thing is let go [m]."""
LET_GO = 0.016
"""Distance by which a hand opens wider than the thing in it, to be clear of it [m]."""
NARROWEST_HAND = 0.08
"""Distance between the open pads of the narrowest gripper [m]."""
GRIPPER_OPEN = 0.8
"""Command beyond which a gripper counts as open (RoboTwin 2.0)."""
GRIPPER_CLOSED = 0.2


@dataclass(frozen=True)
class Moment:
    """One frame of an episode, as success tests see it."""

    object_pose: np.ndarray
    """[o 7] m and quaternion x y z w, world."""
    object_joint: np.ndarray
    """[o] rad."""
    tool_pose: np.ndarray
    """[2 7] measured tool poses, m and quaternion x y z w, world."""
    gripper: np.ndarray
    """[2] commanded, 0 closed, 1 open."""
    contact: np.ndarray
    """[2 o] bool, fingers of each arm against each object."""

    @property
    def both_open(self) -> bool:
        """Are both grippers open?"""
        return bool((self.gripper > GRIPPER_OPEN).all())


@dataclass(frozen=True)
class Task:
    """One manipulation task."""

    name: str
    instruction: str
    """Sentence in English, with {slots} that the words of the scene fill."""
    sample: Callable[[np.random.Generator, int], Scene]
    """Function (random stream, seed) -> scene; it knows no robot."""
    plan: Callable[[Scene], Timeline]
    """Function scene -> waypoints of both tools; it knows no robot."""
    success: Callable[[Scene, Moment], bool]
    """Function (scene, moment) -> is the task done?"""


def arm_for(x: float) -> int:
    """The arm on whose side x [m] lies."""
    return RIGHT if x > 0 else LEFT


def side_sign(arm: int) -> float:
    """+1 for the right arm, -1 for the left: the sign of x on its side."""
    return 1.0 if arm == RIGHT else -1.0


def pick(timeline: Timeline, grasps: dict[int, Tool], lift: float, opening: float = 1.0) -> None:
    """Approach, grasp and lift with one or both arms; `opening` is the gripper's before the grasp.

    An arm that has no part in it goes aside during the approach.
    """
    if opening < 1.0:
        timeline.grip(dict.fromkeys(grasps, opening), seconds=0.24)
    idle = aside_poses(grasps)
    seconds = ASIDE_TIME if any(timeline.at[arm] is not goal for arm, goal in idle.items()) else 0.0
    timeline.move(idle | {arm: grasp.backed(PRE_GRASP) for arm, grasp in grasps.items()}, at_least=seconds)
    timeline.move(grasps)
    timeline.grip(dict.fromkeys(grasps, 0.0))
    timeline.move({arm: grasp.moved(z=lift) for arm, grasp in grasps.items()})


def radial_yaw(arm: int, position: Point) -> float:
    """The hand's yaw [rad] at which its lean points away from the arm's shoulder: the one that all robots reach best."""
    x, y = position[:2]
    return side_sign(arm) * float(np.arctan2(0.25 - side_sign(arm) * x, y + 0.45))


def symmetric_yaw(arm: int, position: Point, yaw: float, symmetry: float) -> float:
    """The yaw nearest to the radial one, out of `yaw` plus multiples of `symmetry` [rad]."""
    return float(yaw + symmetry * np.round((radial_yaw(arm, position) - yaw) / symmetry))


def graspable_yaw(rng: np.random.Generator, position: Point, widest: float = WIDEST_TURN) -> float:
    """A yaw for a thing at `position`, either way round, at which the hand on its side takes it across its x axis [rad]."""
    return radial_yaw(arm_for(position[0]), position) + rng.uniform(-widest, widest) + np.pi * float(rng.integers(2))


def grasp_across(thing: SceneObject, arm: int, tilt: float = TURN_TILT) -> Tool:
    """The grasp from above that a thing asks for, with the hand turned as little as its symmetry allows."""
    assert thing.grasp is not None, f"the {thing.name} has no grasp"
    yaw = symmetric_yaw(arm, thing.pose, thing.yaw, thing.grasp.symmetry)
    return tool(np.array(thing.pose[:3]) + [0, 0, thing.grasp.height], yaw, tilt)


def easy_turn(thing: SceneObject, goal: Point) -> float:
    """Turn of a thing on its way to a `goal` [2] or [3] m at which any yaw will do [rad]: the hand keeps its angle to the
    radial yaw, or comes back to `EASY_TURN` where that is more."""
    assert thing.grasp is not None, f"the {thing.name} has no grasp"
    arm = arm_for(thing.pose[0])
    start = symmetric_yaw(arm, thing.pose, thing.yaw, thing.grasp.symmetry)
    offset = np.clip(start - radial_yaw(arm, thing.pose), -EASY_TURN, EASY_TURN)
    return float(radial_yaw(arm, goal) + offset - start)


def carry(
    timeline: Timeline,
    thing: SceneObject,
    goal: Point,
    turn: float,
    *,
    lift: float = 0.09,
    above: float = 0.05,
    tilt: float = TURN_TILT,
) -> None:
    """Take a thing from above with the arm on its side, set it down with its origin at `goal` [3] m, and draw back.

    `turn` is the thing's about z on its way [rad]; `lift` and `above` are its heights over its old and its new place [m].
    """
    arm = arm_for(thing.pose[0])
    grasp = grasp_across(thing, arm, tilt)
    assert thing.grasp is not None
    release = min(1.0, (thing.grasp.width + LET_GO) / NARROWEST_HAND)
    pick(timeline, {arm: grasp}, lift)
    end = grasp.carried(thing.pose[:3], np.asarray(goal) + [0, 0, HOVER], turn)
    place(timeline, arm, thing.name, end, above=above, retreat=PRE_GRASP, release=release)


def across(position: Point, direction: float, arm: int) -> Tool:
    """A grasp from above across a rod that lies along the horizontal `direction` [rad], leaning inward."""
    yaw = radial_yaw(arm, position)
    approach, opening = tool(position, yaw, STEEP_TILT).rotation.apply([[1.0, 0, 0], [0, 1.0, 0]])
    wanted = np.cross(approach, [np.cos(direction), np.sin(direction), 0.0])
    roll = np.arctan2(np.dot(np.cross(opening, wanted), approach), np.dot(opening, wanted))
    roll -= np.pi * np.round(roll / np.pi)  # fingers have no front
    return tool(position, yaw, STEEP_TILT, roll)


def vessel_pose(position: Point) -> Pose:
    """A pose upright on the table at (x, y), turned so that a wall segment faces the hand that will take it."""
    return upright(position[:2], TABLE_TOP, radial_yaw(arm_for(position[0]), position))


def rim_grasp(vessel: SceneObject, wall: float, depth: float) -> tuple[int, Tool]:
    """The arm on whose side a vessel stands, and its grasp from above of the wall on that side.

    Args:
        vessel: round, standing at `vessel_pose`, so that the hand meets the flat of a wall segment.
        wall: thickness [m].
        depth: of the grasp below the rim [m].
    """
    position = np.array(vessel.pose[:3])
    arm = arm_for(position[0])
    vertices = vessel.shape.mesh.vertices
    radius = float(np.hypot(*vertices[:, :2].T).max()) - wall / 2
    yaw = radial_yaw(arm, position)
    radial = side_sign(arm) * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return arm, tool(position + radius * radial + [0, 0, vertices[:, 2].max() - depth], yaw, GRASP_TILT)


def aside_poses(working: Collection[int]) -> dict[int, Tool]:
    """Poses where the arms that are not working wait."""
    return {arm: ASIDE[arm] for arm in (LEFT, RIGHT) if arm not in working}


def place(timeline: Timeline, arm: int, name: str, goal: Tool, *, above: float, retreat: float, release: float) -> None:
    """Bring what `arm` has held since its last grip to `goal` from `above` [m], let go, draw back upward and open.

    `release` is the gripper's opening between letting go and being clear of the object and its neighbors.
    """
    timeline.move({arm: goal.moved(z=above)})
    timeline.move({arm: goal})
    timeline.hold(arm, name)
    timeline.grip({arm: release})
    timeline.move({arm: goal.moved(z=retreat)})
    timeline.grip({arm: 1.0}, seconds=0.24)

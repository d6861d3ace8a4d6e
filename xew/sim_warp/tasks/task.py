"""Tasks and their common moves: a task samples a scene, plans its solution and tests success."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from xew.sim_warp.geometry.poses import Pose
from xew.sim_warp.plan import ASIDE, ASIDE_TIME, LEFT, RIGHT, Timeline, Tool, tool
from xew.sim_warp.scene import Grasp, Hinge, Point, Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP

GRASP_TILT = np.radians(30)
"""Lean of the hand in a grasp from above [rad]: all five robots reach the work area with it (docs/robots.md)."""
STEEP_TILT = np.radians(10)
"""Lean for low grasps over the near part of the table, for wrists of small range [rad]."""
TURN_TILT = np.radians(20)
"""Lean for grasps across turned objects; all robots turn a hand up to `WIDEST_TURN` with it."""
WIDEST_TURN = np.radians(55)
"""Largest turn of a hand from its radial yaw, over the near part of the table (y below .02) [rad]."""
EASY_TURN = np.radians(35)
"""Preferred largest turn of a hand from its radial yaw [rad], with a larger reach than `WIDEST_TURN`."""
PRE_GRASP = 0.09
"""Length of the straight approach before a grasp [m]."""
HOVER = 0.001
"""Height above its place at which an object is released [m]."""
LET_GO = 0.016
"""Clearance of an opened hand around the released object [m]."""
NARROWEST_HAND = 0.08
"""Distance between the open pads of the narrowest gripper [m]."""
GRIPPER_OPEN = 0.8
"""Command beyond which a gripper counts as open (RoboTwin 2.0)."""
GRIPPER_CLOSED = 0.2
MOST_UNSOLVED = 0.9
"""Progress where objects are at their goals, and something else is missing for success, such as an open gripper."""


@dataclass(frozen=True)
class Moment:
    """One frame of an episode for success tests."""

    object_pose: np.ndarray
    """[o 7] m and quaternion x y z w, world."""
    object_joint: np.ndarray
    """[o] rad."""
    tool_pose: np.ndarray
    """[2 7] measured tool poses, m and quaternion x y z w, world."""
    gripper: np.ndarray
    """[2] commanded, 0 closed, 1 open."""
    contact: np.ndarray
    """[2 o] bool, contacts of each arm's fingers and each object."""

    @property
    def both_open(self) -> bool:
        """Whether both grippers are open."""
        return bool((self.gripper > GRIPPER_OPEN).all())


@dataclass(frozen=True)
class Task:
    """One manipulation task."""

    name: str
    instruction: str
    """Sentence in English, with {slots} that the words of the scene fill."""
    sample: Callable[[np.random.Generator, int], Scene]
    """Function (random stream, seed) -> scene, independent of the robot."""
    plan: Callable[[Scene], Timeline]
    """Function scene -> waypoints of both tools, independent of the robot."""
    success: Callable[[Scene, Moment], bool]
    """Function (scene, moment) -> whether the task is solved."""
    approach: Callable[[Scene, Moment, Moment], float] = lambda scene, first, now: 0.0
    """Function (scene, first moment, moment) -> share of the objects' way to their goals, 0 to 1."""

    def progress(self, scene: Scene, first: Moment, now: Moment) -> float:
        """Progress from 0, as at the first moment, to 1, which it is exactly where the task is solved."""
        return 1.0 if self.success(scene, now) else MOST_UNSOLVED * self.approach(scene, first, now)


def point_above(thing: SceneObject, height: float) -> np.ndarray:
    """The point [3] m at `height` [m] over an object's origin."""
    return np.array(thing.pose[:3]) + [0, 0, height]


def object_axis(pose: np.ndarray | Pose, axis: Point) -> np.ndarray:
    """An axis [3] of an object at a pose [7] in the world's frame [3]."""
    return Rotation.from_quat(pose[3:]).apply(axis)


def is_upright(pose: np.ndarray, lean: float) -> bool:
    """Whether the z axis of an object at a pose [7] leans by less than `lean` [deg]."""
    return bool(object_axis(pose, [0, 0, 1])[2] > np.cos(np.radians(lean)))


def arm_for(x: float) -> int:
    """The arm on whose side x [m] lies."""
    return RIGHT if x > 0 else LEFT


def share_of_way(start: Point, now: Point, goal: Point, within: Point) -> float:
    """The share, 0 to 1, of the way [d] m from `start` to the box around `goal` that reaches `within` along each axis."""
    whole, left = (
        float(np.linalg.norm(np.maximum(np.abs(np.asarray(point) - np.asarray(goal)) - within, 0))) for point in (start, now)
    )
    return max(0.0, 1 - left / whole) if whole else float(not left)


def share_carried(scene: Scene, first: Moment, now: Moment, goals: Mapping[str, Point], within: Point) -> float:
    """The mean `share_of_way` of objects to their goals [d], x y or x y z, world."""
    shares = []
    for name, goal in goals.items():
        start, end = (moment.object_pose[scene.index(name), : len(goal)] for moment in (first, now))
        shares.append(share_of_way(start, end, goal, within))
    return float(np.mean(shares))


def share_raised(scene: Scene, first: Moment, now: Moment, name: str, height: float) -> float:
    """The share, 0 to 1, of an object's way up to a height [m], world."""
    start, end = (moment.object_pose[scene.index(name), 2] for moment in (first, now))
    return float(np.clip((end - start) / (height - start), 0, 1))


def share_turned(scene: Scene, first: Moment, now: Moment, name: str, fraction: float) -> float:
    """The share, 0 to 1, of the way of an object's hinge to a fraction of its range."""
    hinge, index = hinge_of(scene.object(name)), scene.index(name)
    start, end = (hinge.fraction(moment.object_joint[index]) for moment in (first, now))
    return float(np.clip((end - start) / (fraction - start), 0, 1))


def side_sign(arm: int) -> float:
    """+1 for the right arm, -1 for the left: the sign of x on its side."""
    return 1.0 if arm == RIGHT else -1.0


def pick(timeline: Timeline, grasps: dict[int, Tool], lift: float, opening: float = 1.0) -> None:
    """Approach, grasp and lift with one or both arms, which open to `opening` before; an idle arm moves aside."""
    if opening < 1.0:
        timeline.grip(dict.fromkeys(grasps, opening), seconds=0.24)
    idle = aside_poses(grasps)
    seconds = ASIDE_TIME if any(timeline.at[arm] is not goal for arm, goal in idle.items()) else 0.0
    timeline.move(idle | {arm: grasp.backed(PRE_GRASP) for arm, grasp in grasps.items()}, at_least=seconds)
    timeline.move(grasps)
    timeline.grip(dict.fromkeys(grasps, 0.0))
    timeline.move({arm: grasp.moved(z=lift) for arm, grasp in grasps.items()})


def radial_yaw(arm: int, position: Point) -> float:
    """The hand's yaw [rad] at which its lean points away from the arm's shoulder; all robots reach it best."""
    x, y = position[:2]
    return side_sign(arm) * float(np.arctan2(0.25 - side_sign(arm) * x, y + 0.45))


def symmetric_yaw(arm: int, position: Point, yaw: float, symmetry: float) -> float:
    """The yaw nearest to the radial one, out of `yaw` plus multiples of `symmetry` [rad]."""
    return float(yaw + symmetry * np.round((radial_yaw(arm, position) - yaw) / symmetry))


def draw_pair(
    rng: np.random.Generator, low: Sequence[float], high: Sequence[float], apart: float, side: float
) -> tuple[np.ndarray, np.ndarray]:
    """Two points [2] m at least `apart` [m], between bounds [4] x y x y [m], mirrored to the left for a `side` of -1.0."""
    points = draw(rng, low, high, lambda p: np.hypot(*(p[2:] - p[:2])) >= apart) * [side, 1, side, 1]
    return points[:2], points[2:]


def graspable_yaw(rng: np.random.Generator, position: Point, widest: float = WIDEST_TURN) -> float:
    """A yaw [rad] for an object at `position` at which the hand on its side grasps it across its x axis."""
    return radial_yaw(arm_for(position[0]), position) + rng.uniform(-widest, widest) + np.pi * float(rng.integers(2))


def grasp_of(thing: SceneObject) -> Grasp:
    """The grasp from above of an object that has one."""
    assert thing.grasp is not None, f"the {thing.name} has no grasp"
    return thing.grasp


def hinge_of(thing: SceneObject) -> Hinge:
    """The hinge of an object that has one."""
    assert thing.hinge is not None, f"the {thing.name} has no hinge"
    return thing.hinge


def lid_point(thing: SceneObject, offset: Point, fraction: float) -> np.ndarray:
    """World position [3] m of a point of a lid hinged about an upright object's -x, opened by a fraction of 0 to 1.

    `offset` [3] m is from the hinge's anchor to the point at angle 0, in the object's frame.
    """
    hinge = hinge_of(thing)
    angle = hinge.lower + fraction * (hinge.upper - hinge.lower)
    local = np.array(hinge.anchor) + Rotation.from_euler("x", -angle).apply(offset)
    return np.array(thing.pose[:3]) + Rotation.from_euler("z", thing.yaw).apply(local)


def opening_for(width: float, clearance: float = LET_GO) -> float:
    """The gripper command, 0 to 1, at which every hand clears an object of `width` [m] by `clearance` [m]."""
    return min(1.0, (width + clearance) / NARROWEST_HAND)


def hand_yaw(thing: SceneObject) -> float:
    """Yaw of the hand in the grasp from above by the arm on the object's side [rad], nearest to the radial yaw."""
    return symmetric_yaw(arm_for(thing.pose[0]), thing.pose, thing.yaw, grasp_of(thing).symmetry)


def grasp_across(thing: SceneObject, tilt: float = TURN_TILT) -> Tool:
    """The grasp from above of an object by the arm on its side."""
    return tool(point_above(thing, grasp_of(thing).height), hand_yaw(thing), tilt)


def radial_turn(arm: int, start: Point, goal: Point) -> float:
    """Turn of an object on its way from `start` to `goal` [2] or [3] m with a constant angle of the hand to radial [rad]."""
    return radial_yaw(arm, goal) - radial_yaw(arm, start)


def easy_turn(thing: SceneObject, goal: Point) -> float:
    """Turn of an object on its way to a `goal` [2] or [3] m of any yaw [rad]; its hand is at most EASY_TURN off radial."""
    arm, start = arm_for(thing.pose[0]), hand_yaw(thing)
    offset = np.clip(start - radial_yaw(arm, thing.pose), -EASY_TURN, EASY_TURN)
    return float(radial_yaw(arm, goal) + offset - start)


def aligning_turn(thing: SceneObject, goal: Point, yaw: float) -> float:
    """Turn of an object on its way to `goal` [2] or [3] m that brings the hand to `yaw`, up to the object's symmetry [rad]."""
    return symmetric_yaw(arm_for(thing.pose[0]), goal, yaw, grasp_of(thing).symmetry) - hand_yaw(thing)


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
    """Grasp an object from above with the arm on its side, set it down with its origin at `goal` [3] m, and move back.

    `turn` is its rotation about z on its way [rad]; `lift` and `above` are its heights over its old and its new place [m].
    """
    arm, grasp = arm_for(thing.pose[0]), grasp_across(thing, tilt)
    pick(timeline, {arm: grasp}, lift)
    end = grasp.carried(thing.pose[:3], np.asarray(goal) + [0, 0, HOVER], turn)
    place(timeline, arm, thing.name, end, above=above, retreat=PRE_GRASP, release=opening_for(grasp_of(thing).width))


def across(position: Point, direction: float, arm: int) -> Tool:
    """A grasp from above across a rod that lies along the horizontal `direction` [rad], leaning inward."""
    yaw = radial_yaw(arm, position)
    approach, opening = tool(position, yaw, STEEP_TILT).rotation.apply([[1.0, 0, 0], [0, 1.0, 0]])
    wanted = np.cross(approach, [np.cos(direction), np.sin(direction), 0.0])
    roll = np.arctan2(np.dot(np.cross(opening, wanted), approach), np.dot(opening, wanted))
    roll -= np.pi * np.round(roll / np.pi)  # fingers have no front
    return tool(position, yaw, STEEP_TILT, roll)


def vessel_pose(position: Point) -> Pose:
    """A pose upright on the table at (x, y), with a wall segment facing the hand on its side."""
    return upright(position[:2], TABLE_TOP, radial_yaw(arm_for(position[0]), position))


def carry_by_rim(
    timeline: Timeline,
    vessel: SceneObject,
    goal: np.ndarray,
    wall: float,
    depth: float,
    *,
    lift: float = 0.08,
    above: float = 0.05,
    retreat: float = 0.08,
) -> None:
    """Take a vessel by its rim with the arm on its side and set it down with its origin at `goal` [3] m.

    Args:
        timeline: is extended.
        vessel: round, standing at `vessel_pose`: the hand meets the flat of a wall segment.
        goal: of its origin, world.
        wall: thickness [m].
        depth: of the grasp below the rim [m].
        lift, above: heights of the vessel over its old and its new place [m].
        retreat: height by which the hand draws back [m].
    """
    start = np.array(vessel.pose[:3])
    arm, vertices = arm_for(start[0]), vessel.shape.mesh.vertices
    radius = float(np.hypot(*vertices[:, :2].T).max()) - wall / 2
    yaw = radial_yaw(arm, start)
    radial = side_sign(arm) * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    grasp = tool(start + radius * radial + [0, 0, vertices[:, 2].max() - depth], yaw, GRASP_TILT)
    pick(timeline, {arm: grasp}, lift, opening=0.5)
    end = grasp.carried(start, goal, radial_turn(arm, start, goal))
    place(timeline, arm, vessel.name, end, above=above, retreat=retreat, release=0.4)


def aside_poses(working: Collection[int]) -> dict[int, Tool]:
    """Waiting poses of the idle arms."""
    return {arm: ASIDE[arm] for arm in (LEFT, RIGHT) if arm not in working}


def place(timeline: Timeline, arm: int, name: str, goal: Tool, *, above: float, retreat: float, release: float) -> None:
    """Lower the held object to `goal` from `above` [m], open to `release`, move up by `retreat` [m] and open completely."""
    timeline.move({arm: goal.moved(z=above)})
    timeline.move({arm: goal})
    timeline.hold(arm, name)
    timeline.grip({arm: release})
    timeline.move({arm: goal.moved(z=retreat)})
    timeline.grip({arm: 1.0}, seconds=0.24)

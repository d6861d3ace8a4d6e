"""Placement of users' robots: where they stand and how they hold their arms at rest, found by inverse kinematics.

Reads  a RobotSpec whose bases or homes are not decided yet
Writes the same robot with both tools at `plan.HOME`, so that every task's plan begins where the robot is

Searched on the CPU with a fixed seed: the same robot gets the same place and posture every time.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from xew.config import ConfigError
from xew.protocol import ACTION_DIM, ARMS
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.kinematics.forward import link_poses
from xew.sim_warp.kinematics.inverse import ArmSolver
from xew.sim_warp.kinematics.reachability import GRASP_TILT, WORK_X, WORK_Y, WORK_Z, radial_yaw, reaches
from xew.sim_warp.plan import ASIDE, HOME
from xew.sim_warp.stage import TABLE_SIZE, TABLE_TOP

DISTANCES = (0.6, 0.7, 0.8, 0.5, 0.4)
"""Distances between the bases of two equal arms [m], in the order in which they are tried; RoboTwin calls 0.6 to 0.8
typical."""
PLACE_DISTANCES, BASE_Y, BASE_Z = (0.4, 0.6, 0.7), (-0.65, -0.55, -0.45, -0.37), (0.55, 0.75)
ROOT_Z = (0.0, 0.25, 0.5, 0.75)
"""Places that are tried where a robot names none [m]: the four before for two equal arms, this height for one root of both
arms."""
YAW_90 = (0.0, 0.0, 0.5**0.5, 0.5**0.5)
"""Quaternion x y z w of a root that looks to +y, for robots that look along their x."""
SEEDS = 64
"""Number of postures from which the search begins."""
BEST, FEW = 12, 3
"""Numbers of postures that are tried out, of those found: for good, and to compare places."""
OFFSETS = (-45, 0, 45)
"""Turns of a grasp's yaw from the radial one [deg]."""
ENOUGH = 0.9
"""Share of the work area that makes the other turn of the tool frame not worth a try."""
POSITION_TOLERANCE, ROTATION_TOLERANCE = 1e-3, 0.01
LIMIT_ROOM = 0.15
"""Least distance of a home from the joint limits, unless there is no other home [rad]."""
CLEARANCE = 0.02
"""Least height of all moving links above the table, with the arms at home [m]."""


def find_homes(robot: RobotSpec, near: tuple[np.ndarray | None, np.ndarray | None]) -> RobotSpec:
    """The robot with homes from which its arms reach most of the work area.

    Args:
        near: posture [d] rad that each arm would like to be near, or None.

    Raises:
        ConfigError: an arm cannot bring its tool home, or only with a link in the table.
    """
    solver = ArmSolver(robot, "cpu")
    for arm, wanted in enumerate(near):
        home, miss = _find_home(solver, arm, wanted)
        if home is None:
            raise ConfigError(
                f"{robot.urdf}: the {('left', 'right')[arm]} arm cannot bring its tool home, to "
                f"{_format_position(HOME[arm].position)} m over the table: {miss}. Move its base (root_pose), or check "
                "tool_pose and the limits."
            )
        robot = _set_home(robot, arm, home)
        solver.robot = robot
    return robot


def find_place(robot: RobotSpec, near: tuple[np.ndarray | None, np.ndarray | None]) -> RobotSpec:
    """The robot where its left arm reaches most, of the places that are tried, with homes near postures [d] rad."""
    found: list[tuple[float, RobotSpec]] = []
    for candidate in _places(robot):
        solver = ArmSolver(candidate, "cpu")
        home, _ = _find_home(solver, 0, near[0], FEW)
        if home is not None:
            solver.robot = _set_home(candidate, 0, home)
            found.append((_reached_share(solver, 0), candidate))
    if not found:
        raise ConfigError(
            f"{robot.urdf}: no place was found from which the left arm brings its tool home; give root_pose in a robot.yaml."
        )
    return find_homes(max(found, key=lambda pair: pair[0])[1], near)


def find_distance(robot: RobotSpec, near: tuple[np.ndarray | None, np.ndarray | None], distance: float | None) -> RobotSpec:
    """The robot with its bases moved to either side by half a distance [m], the first of `DISTANCES` that works, and homes near
    postures [d] rad."""
    problem: ConfigError | None = None
    for gap in DISTANCES if distance is None else (distance,):
        try:
            return find_homes(_move_apart(robot, gap), near)
        except ConfigError as error:
            problem = problem or error
    assert problem is not None
    raise problem


def try_turned_tools(robot: RobotSpec, settle: Callable[[RobotSpec], RobotSpec]) -> RobotSpec:
    """The robot after `settle`, one of the functions above, with its tool frames as they are or turned by half about the
    approach, which is the same to its fingers. They are turned where the arms reach more of the work area so, and tried only
    where the arms reach less than `ENOUGH` of it."""
    settled = settle(robot)
    if _least_share(settled) >= ENOUGH:
        return settled
    half = Rotation.from_euler("x", np.pi)
    arms = tuple(
        replace(arm, tool_pose=(*arm.tool_pose[:3], *(Rotation.from_quat(arm.tool_pose[3:]) * half).as_quat().tolist()))
        for arm in robot.arms
    )
    try:
        turned = settle(replace(robot, arms=(arms[0], arms[1])))
    except ConfigError:
        return settled
    return max(settled, turned, key=_least_share)


def _least_share(robot: RobotSpec) -> float:
    """Share of the work area that the worse of the two arms reaches."""
    solver = ArmSolver(robot, "cpu")
    return min(_reached_share(solver, arm) for arm in (0, 1))


def _places(robot: RobotSpec) -> Iterator[RobotSpec]:
    """The robot at every place that is tried."""
    if robot.one_urdf_holds_both_arms:
        for y, z in product(BASE_Y, ROOT_Z):
            arms = tuple(replace(arm, root_pose=(0.0, y, z, *YAW_90)) for arm in robot.arms)
            yield replace(robot, arms=(arms[0], arms[1]))
        return
    for gap, y, z in product(PLACE_DISTANCES, BASE_Y, BASE_Z):
        arms = tuple(replace(arm, root_pose=(0.0, y, z, *YAW_90)) for arm in robot.arms)
        yield _move_apart(replace(robot, arms=(arms[0], arms[1])), gap)


def _move_apart(robot: RobotSpec, gap: float) -> RobotSpec:
    """The robot with each base moved outward by half a gap [m]."""
    left, right = (
        replace(arm, root_pose=(arm.root_pose[0] + side * gap / 2, *arm.root_pose[1:]))
        for side, arm in zip((-1, 1), robot.arms, strict=True)
    )
    return replace(robot, arms=(left, right))


def _find_home(solver: ArmSolver, arm: int, near: np.ndarray | None, tried: int = BEST) -> tuple[np.ndarray | None, str]:
    """The posture [d] with the tool at home that reaches most of the work area; None and why not.

    Of those that reach the same, the one nearest to `near`, or to the joints' zero.
    """
    robot = solver.robot
    start = _start_postures(robot, near)
    goal = np.concatenate([HOME[arm].position, HOME[arm].rotation.as_quat()])
    solution = solver.solve(arm, np.tile(goal, (len(start), 1)), start)
    solved = (solution.position_error < POSITION_TOLERANCE) & (solution.rotation_error < ROTATION_TOLERANCE)
    if not solved.any():
        nearest = int(np.argmin(solution.position_error + 0.25 * solution.rotation_error))
        off = f"{1000 * solution.position_error[nearest]:.0f} mm and {np.degrees(solution.rotation_error[nearest]):.0f} deg off"
        return None, f"the nearest is {off}"
    wanted = np.zeros(robot.arm_joint_count) if near is None else near
    postures = sorted(
        _distinct_postures(solution.joint_pos[solved]), key=lambda posture: float(np.linalg.norm(posture - wanted))
    )
    clear = [posture for posture in postures if _is_clear(_set_home(robot, arm, posture), arm)]
    if not clear:
        return None, "a link would stand in the table or on the other arm's side"
    free = [posture for posture in clear if _limit_room(robot, posture) > LIMIT_ROOM] or clear
    shares = []
    for posture in free[:tried]:
        solver.robot = _set_home(robot, arm, posture)
        shares.append(_reached_share(solver, arm))
    solver.robot = robot
    return free[int(np.argmax(shares))], ""


def _start_postures(robot: RobotSpec, near: np.ndarray | None) -> np.ndarray:
    """[SEEDS d] postures: the wanted one, the middle of the limits, zero, and others spread over half a turn each way."""
    lower, upper = np.array(robot.joint_lower), np.array(robot.joint_upper)
    low, high = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    spread = np.random.default_rng(0).uniform(low, high, (SEEDS, len(lower)))
    first = [(low + high) / 2, np.clip(np.zeros(len(lower)), lower, upper)]
    if near is not None:
        first.insert(0, np.clip(near, lower, upper))
    spread[: len(first)] = first
    return spread


def _distinct_postures(postures: np.ndarray) -> list[np.ndarray]:
    """Postures that differ by more than 0.1 rad in a joint, in order."""
    kept: list[np.ndarray] = []
    for posture in postures:
        if all(np.abs(posture - other).max() > 0.1 for other in kept):
            kept.append(posture)
    return kept


def _limit_room(robot: RobotSpec, posture: np.ndarray) -> float:
    """Least distance of a joint of a posture [d] from its limits [rad]."""
    return float(np.minimum(posture - robot.joint_lower, robot.joint_upper - posture).min())


def _reached_share(solver: ArmSolver, arm: int) -> float:
    """Share of the work area that the arm reaches from its home, of 54 grasps that are turned as tasks turn them.

    The share counts a quarter where the arm cannot go aside, as every plan asks of an arm that has nothing to do.
    """
    cells = list(product(OFFSETS, product(WORK_X[::2], WORK_Y[::2], WORK_Z[::2])))
    positions = np.array([ASIDE[0].position, *(position for _, position in cells)])
    yaws = np.array([0.0, *(radial_yaw(np.array(position)) + offset for offset, position in cells)])
    found = reaches(solver, arm, positions, np.full(len(positions), float(GRASP_TILT)), yaws)
    return float(found[1:].mean()) * (1.0 if found[0] else 0.25)


def _is_clear(robot: RobotSpec, arm: int) -> bool:
    """Do all links that an arm's second joint and those after it move stay off the table and on their own side?"""
    urdf = load_urdf(robot.urdf)
    joints, _ = ARMS[arm]
    row = np.zeros((1, ACTION_DIM))
    row[0, joints][: robot.arm_joint_count] = robot.arms[arm].home
    frames = link_poses(robot, row)[0 if robot.one_urdf_holds_both_arms else arm]
    moved = [name for name in urdf.links if urdf.joints[robot.arms[arm].joints[1]] in urdf.chain(name)]
    for name in moved:
        mesh = urdf.links[name].visual
        if mesh is None:
            continue
        pose = matrix_from_pose(frames[name])[0]
        points = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        over = (np.abs(points[:, :2]) < np.array(TABLE_SIZE[:2]) / 2).all(1)
        if (points[over, 2] < TABLE_TOP + CLEARANCE).any() or (points[over, 0] * (2 * arm - 1) < 0).any():
            return False
    return True


def _set_home(robot: RobotSpec, arm: int, home: np.ndarray) -> RobotSpec:
    """The robot with the home [d] rad of one arm, rounded."""
    arms = list(robot.arms)
    arms[arm] = replace(arms[arm], home=tuple(round(float(value), 4) for value in home))
    return replace(robot, arms=(arms[0], arms[1]))


def _format_position(position: np.ndarray) -> str:
    return ", ".join(f"{value:g}" for value in position)

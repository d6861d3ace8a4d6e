"""Own motion: a robot moves between a plan's waypoints as its own planner would, in its own time.

Unless the task needs a straight tool line, an arm moves straight in joint space, from its own rest. Each move takes the time
that the slowest joint of either arm needs at a share of its speed and acceleration limits. A move along a tool line takes at
least the plan's time. Both arms begin and end a move together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.kinematics.expert import Commands, canonical_commands, find_too_fast, find_unreached
from xew.sim_warp.kinematics.forward import tool_poses
from xew.sim_warp.kinematics.inverse import ANCHOR_STRIDE, arm_solver
from xew.sim_warp.plan import HOME, LEFT, RIGHT, SHORTEST_MOVE, Segment, Timeline, ToolPath, frame_times, minimum_jerk

SPEED_SHARE = 0.3
"""Share of a robot's speed and acceleration limits; drivers of real arms start with 0.1 to 0.3."""
SAMPLES = 4 * ANCHOR_STRIDE
"""Number of intervals of a move for inverse kinematics. A multiple of the solver's stride: a plan has the same anchors, and the
same joints to the last bit, in a batch with longer plans."""
_SHARES = np.linspace(0, 1, 129)
"""Instants of a move, as shares of its time, at which speeds and accelerations are evaluated."""

Step = dict[int, Segment]
"""One move: the segments of the moving arms."""


@dataclass(frozen=True)
class _Move:
    """One move of a robot: joint courses and times on its own clock."""

    start: float
    """Begin [s]."""
    seconds: float
    courses: dict[int, CubicSpline]
    """Joints [d] rad over progress from 0 to 1, by arm."""


def own_commands(robot: RobotSpec, timelines: Sequence[Timeline], device: str | None = None) -> list[tuple[ToolPath, Commands]]:
    """A robot's own paths and joint commands [t 16] for many plans, solved together; bits do not depend on the batch."""
    longest = max(len(timeline.steps) for timeline in timelines) * SAMPLES + 1
    targets = np.stack([_lines(timeline.steps, longest) for timeline in timelines], 1).reshape(longest, -1, 7)
    arms = np.tile([LEFT, RIGHT], len(timelines))
    solution = arm_solver(robot, device).solve_path(arms, targets, np.array([robot.arms[arm].home for arm in arms]))
    motions = []
    for index, timeline in enumerate(timelines):
        columns = slice(2 * index, 2 * index + 2)
        asked = _asked_rows(timeline.steps, longest)
        path, action = _follow(robot, timeline, solution.joint_pos[:, columns])
        far = (np.where(asked, error[:, columns], 0.0) for error in (solution.position_error, solution.rotation_error))
        problem = find_unreached(*far) or find_too_fast(robot, action)
        motions.append((path, Commands(action.astype(np.float32), problem)))
    return motions


def _follow(robot: RobotSpec, timeline: Timeline, joint_pos: np.ndarray) -> tuple[ToolPath, np.ndarray]:
    """The path and the commands [t 16] of one plan; `joint_pos` [rows 2 d] rad solves `_lines`."""
    begin = [_begin(robot, arm, timeline.steps, joint_pos) for arm in (LEFT, RIGHT)]
    moves, clock = _plan_moves(robot, timeline, begin, joint_pos)
    planned, own = np.array(clock).T

    def in_own_time(instants: ArrayLike) -> np.ndarray:
        """Instants of the plan on the robot's own clock [s]."""
        return np.interp(np.asarray(instants, float), planned, own)

    times = frame_times(clock[-1][1])
    joints = np.stack([_sample(begin[arm], arm, moves, times) for arm in (LEFT, RIGHT)], 1)
    knots = [np.array(grips).T for grips in timeline.grips]
    gripper = np.stack([np.interp(times, in_own_time(at), value) for at, value in knots], 1)
    action = canonical_commands(np.clip(joints, robot.joint_lower, robot.joint_upper), gripper)
    holds = tuple(
        replace(hold, start=float(in_own_time(hold.start)), end=float(in_own_time(hold.end))) for hold in timeline.holds
    )
    return ToolPath(tool_poses(robot, action), gripper, holds, clock=tuple(clock)), action


def _lines(steps: Sequence[Step], rows: int) -> np.ndarray:
    """[rows 2 7] poses of both tools along the straight lines of all moves, `SAMPLES` rows each, then at rest."""
    poses = np.tile([home.pose for home in HOME], (rows, 1, 1))
    progress = np.linspace(0, 1, SAMPLES + 1)
    for number, step in enumerate(steps):
        for arm, segment in step.items():
            line = segment.sample(progress)
            poses[number * SAMPLES : (number + 1) * SAMPLES + 1, arm] = line
            poses[(number + 1) * SAMPLES :, arm] = line[-1]
    return poses


def _asked_rows(steps: Sequence[Step], rows: int) -> np.ndarray:
    """[rows 2] bool, whether a tool must reach its row of `_lines`: all along a line, else at the end of each move."""
    asked = np.zeros((rows, 2), bool)
    for number, step in enumerate(steps):
        first, last = number * SAMPLES, (number + 1) * SAMPLES
        for arm in step:
            asked[first if _keeps_line(steps, number, arm) else last : last + 1, arm] = True
    return asked


def _keeps_line(steps: Sequence[Step], number: int, arm: int) -> bool:
    """Whether an arm's tool follows its line in a move: not on its way from rest, unless that is a curve."""
    comes_from_rest = not any(arm in step for step in steps[:number])
    segment = steps[number][arm]
    return segment.is_curve or (segment.is_straight and not comes_from_rest)


def _plan_moves(
    robot: RobotSpec, timeline: Timeline, begin: Sequence[np.ndarray], joint_pos: np.ndarray
) -> tuple[list[_Move], list[tuple[float, float]]]:
    """The moves of one plan from joints `begin`, and pairs of instants on its and the robot's clock; `joint_pos` [rows 2 d]."""
    steps, at, moves, clock = timeline.steps, list(begin), list[_Move](), [(0.0, 0.0)]
    for number, step in enumerate(steps):
        rows = joint_pos[number * SAMPLES : (number + 1) * SAMPLES + 1]
        on_line = [arm for arm in step if _keeps_line(steps, number, arm)]
        courses = {}
        for arm in step:
            way = rows[:, arm] if arm in on_line else np.linspace(at[arm], rows[-1, arm], SAMPLES + 1)
            courses[arm], at[arm] = CubicSpline(np.linspace(0, 1, SAMPLES + 1), way), way[-1]
        planned = next(iter(step.values()))
        least = planned.end_time - planned.start_time if on_line else SHORTEST_MOVE
        seconds = max(least, *(_shortest_time(robot, course) for course in courses.values()))
        start = clock[-1][1] + planned.start_time - clock[-1][0]
        moves.append(_Move(start, seconds, courses))
        clock += [(planned.start_time, start), (planned.end_time, start + seconds)]
    clock.append((timeline.time, clock[-1][1] + timeline.time - clock[-1][0]))
    return moves, list(dict.fromkeys(clock))


def _begin(robot: RobotSpec, arm: int, steps: Sequence[Step], joint_pos: np.ndarray) -> np.ndarray:
    """[d] initial joints of an arm: at rest, or at the begin of its first move if that is a curve."""
    first = next((step[arm] for step in steps if arm in step), None)
    return joint_pos[0, arm] if first is not None and first.is_curve else np.array(robot.arms[arm].rest or robot.arms[arm].home)


def _shortest_time(robot: RobotSpec, course: CubicSpline) -> float:
    """Least time of a minimum-jerk move along a joint course within the share of all limits [s]."""
    share = _SHARES[:, None]
    progress = minimum_jerk(share)
    slope = 30 * share**2 * (1 - share) ** 2
    bend = 60 * share * (1 - share) * (1 - 2 * share)
    along, across = course(progress[:, 0], 1), course(progress[:, 0], 2)
    speed = np.abs(along * slope).max(0) / (SPEED_SHARE * np.array(robot.joint_velocity))
    acceleration = np.abs(across * slope**2 + along * bend).max(0) / (SPEED_SHARE * np.array(robot.joint_acceleration))
    return float(max(speed.max(), np.sqrt(acceleration.max())))


def _sample(begin: np.ndarray, arm: int, moves: Sequence[_Move], times: np.ndarray) -> np.ndarray:
    """[t d] joints of an arm at instants [t] s of its own time; it stands still between moves."""
    joints = np.tile(begin, (len(times), 1))
    for move in moves:
        if arm in move.courses:
            now = times >= move.start
            joints[now] = move.courses[arm](minimum_jerk((times[now] - move.start) / move.seconds))
    return joints

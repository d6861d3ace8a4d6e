"""Stage 2b: a plan's tool path to joint commands, by inverse kinematics, for any robot.

Reads  ToolPath, RobotSpec
Writes `Commands`: canonical joint targets at every stored frame, or the finding that this robot cannot follow
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from xew.protocol import ACTION_DIM, ARMS, FRAME_RATE
from xew.sim_warp.inverse_kinematics import ArmSolver, Solution
from xew.sim_warp.plan import ToolPath
from xew.sim_warp.robots import RobotSpec

POSITION_TOLERANCE = 0.003
"""Largest distance between commanded and planned tool [m]."""
ROTATION_TOLERANCE = 0.03
"""Largest angle between them [rad]."""


@dataclass(frozen=True)
class Commands:
    """What a robot is told to do."""

    action: np.ndarray
    """[t 16] float32, canonical."""
    problem: str | None
    """Why this robot cannot follow the plan, in words; None if it can."""


@dataclass(frozen=True)
class _Run:
    """Frames of one arm between leaving its rest posture and coming back."""

    path: int
    arm: int
    frames: np.ndarray


def joint_commands(robot: RobotSpec, paths: list[ToolPath]) -> list[Commands]:
    """Joint commands of one robot for many plans, solved together.

    Where an arm goes from or to its rest posture it moves in joint space, elsewhere along the planned tool path.
    """
    runs = [run for index, path in enumerate(paths) for arm in (0, 1) for run in _runs(index, arm, path)]
    actions = [_resting(robot, path) for path in paths]
    problems: list[str | None] = [None] * len(paths)
    if runs:
        solution = _solve(robot, paths, runs)
        for column, run in enumerate(runs):
            count = len(run.frames)
            joints = solution.joint_pos[:count, column]
            errors = solution.position_error[:count, column], solution.rotation_error[:count, column]
            home_share = paths[run.path].home_share[run.frames, run.arm]
            home = np.array(robot.arms[run.arm].home)
            columns = ARMS[run.arm][0].start + np.arange(robot.arm_joint_count)
            actions[run.path][np.ix_(run.frames, columns)] = home_share[:, None] * home + (1 - home_share[:, None]) * joints
            problems[run.path] = problems[run.path] or _out_of_reach(run, home_share, *errors)
    problems = [problem or _too_fast(robot, action) for problem, action in zip(problems, actions, strict=True)]
    return [Commands(action.astype(np.float32), problem) for action, problem in zip(actions, problems, strict=True)]


@lru_cache(maxsize=16)
def _solver(robot: RobotSpec) -> ArmSolver:
    return ArmSolver(robot)


def _runs(index: int, arm: int, path: ToolPath) -> list[_Run]:
    away = path.home_share[:, arm] < 1
    edges = np.flatnonzero(np.diff(np.concatenate([[False], away, [False]]).astype(int)))
    return [_Run(index, arm, np.arange(start, end)) for start, end in edges.reshape(-1, 2)]


def _resting(robot: RobotSpec, path: ToolPath) -> np.ndarray:
    """[t 16] both arms at rest, grippers as planned."""
    action = np.zeros((path.frame_count, ACTION_DIM))
    for arm, (joints, gripper) in enumerate(ARMS):
        action[:, joints.start : joints.start + robot.arm_joint_count] = robot.arms[arm].home
        action[:, gripper] = path.gripper[:, arm]
    return action


def _solve(robot: RobotSpec, paths: list[ToolPath], runs: list[_Run]) -> Solution:
    """All runs as one batch; shorter ones stand at their last pose until the longest ends."""
    longest = max(len(run.frames) for run in runs)
    targets = np.empty((longest, len(runs), 7))
    for column, run in enumerate(runs):
        path, count = paths[run.path], len(run.frames)
        pose = np.concatenate([path.position[run.frames, run.arm], path.quaternion[run.frames, run.arm]], -1)
        targets[:count, column], targets[count:, column] = pose, pose[-1]
    arms = np.array([run.arm for run in runs])
    start = np.array([robot.arms[run.arm].home for run in runs])
    return _solver(robot).solve_path(arms, targets, start)


def _out_of_reach(run: _Run, home_share: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> str | None:
    on_path = home_share == 0
    far, turned = position[on_path].max(initial=0), rotation[on_path].max(initial=0)
    if far <= POSITION_TOLERANCE and turned <= ROTATION_TOLERANCE:
        return None
    side = ("left", "right")[run.arm]
    return f"{side} arm cannot reach: off by {1000 * far:.0f} mm, {np.degrees(turned):.0f} deg"


def _too_fast(robot: RobotSpec, action: np.ndarray) -> str | None:
    speed = np.abs(np.diff(action, axis=0)) * FRAME_RATE
    limit = np.array(robot.joint_velocity)
    for side, (joints, _) in zip(("left", "right"), ARMS, strict=True):
        fastest = speed[:, joints.start : joints.start + len(limit)].max(0, initial=0)
        if (fastest > limit).any():
            joint = int(np.argmax(fastest / limit))
            return f"{side} joint {joint + 1} would turn at {fastest[joint]:.1f} rad/s, its limit is {limit[joint]:.1f}"
    return None

"""The expert: joint commands that follow a plan's tool path, by inverse kinematics, for any robot."""

from dataclasses import dataclass

import numpy as np

from xew.protocol import ACTION_DIM, ARMS, FRAME_RATE
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.kinematics.inverse import arm_solver
from xew.sim_warp.plan import LEFT, RIGHT, ToolPath

POSITION_TOLERANCE = 0.003
"""Largest distance between commanded and planned tool [m]."""
ROTATION_TOLERANCE = 0.03
"""Largest angle between commanded and planned tool [rad]."""


@dataclass(frozen=True)
class Commands:
    """Joint commands of a robot for one plan."""

    action: np.ndarray
    """[t 16] float32 canonical joint targets [rad] and grippers [0 closed, 1 open] at every stored frame."""
    problem: str | None
    """Reason why this robot cannot follow the plan, in words; None if it can."""


def joint_commands(robot: RobotSpec, paths: list[ToolPath], device: str | None = None) -> list[Commands]:
    """Joint commands [t 16] of a robot for many tool paths, solved together on a device; each frame near the previous one.

    The bits of a path's commands do not depend on the other paths.
    """
    longest = max(path.frame_count for path in paths)
    targets = np.stack([_extend_path(path.pose, longest) for path in paths], 1).reshape(longest, -1, 7)
    arms = np.tile([LEFT, RIGHT], len(paths))
    lengths = np.repeat([path.frame_count for path in paths], 2)
    solution = arm_solver(robot, device).solve_path(arms, targets, np.array([robot.arms[arm].home for arm in arms]), lengths)
    commands = []
    for index, path in enumerate(paths):
        columns, frames = slice(2 * index, 2 * index + 2), slice(path.frame_count)
        action = canonical_commands(solution.joint_pos[frames, columns], path.gripper)
        errors = solution.position_error[frames, columns], solution.rotation_error[frames, columns]
        problem = find_unreached(*errors, np.arange(path.frame_count) / FRAME_RATE)
        commands.append(Commands(action.astype(np.float32), problem or find_too_fast(robot, action)))
    return commands


def _extend_path(pose: np.ndarray, frames: int) -> np.ndarray:
    """A path [t 2 7] extended to `frames` frames at its last pose."""
    return np.concatenate([pose, np.repeat(pose[-1:], frames - len(pose), 0)])


def canonical_commands(joint_pos: np.ndarray, gripper: np.ndarray) -> np.ndarray:
    """[t 2 d] joints and [t 2] grippers -> [t 16] canonical."""
    action = np.zeros((len(gripper), ACTION_DIM))
    for arm, (joints, column) in enumerate(ARMS):
        action[:, joints.start : joints.start + joint_pos.shape[-1]] = joint_pos[:, arm]
        action[:, column] = gripper[:, arm]
    return action


def find_unreached(position: np.ndarray, rotation: np.ndarray, times: np.ndarray | None = None) -> str | None:
    """Description of tool errors [t 2] m and rad beyond the tolerance, with their first time if times [t] s are given."""
    for arm, side in enumerate(("left", "right")):
        beyond = (position[:, arm] > POSITION_TOLERANCE) | (rotation[:, arm] > ROTATION_TOLERANCE)
        if beyond.any():
            far, turned = position[:, arm].max(), rotation[:, arm].max()
            since = "" if times is None else f", from {times[np.argmax(beyond)]:.1f} s on"
            return f"{side} arm cannot reach: off by {1000 * far:.0f} mm, {np.degrees(turned):.0f} deg{since}"
    return None


def find_too_fast(robot: RobotSpec, action: np.ndarray) -> str | None:
    """Description of commands [t 16] that turn a joint faster than its limit."""
    speed = np.abs(np.diff(action, axis=0)) * FRAME_RATE
    limit = np.array(robot.joint_velocity)
    for side, (joints, _) in zip(("left", "right"), ARMS, strict=True):
        fastest = speed[:, joints.start : joints.start + len(limit)].max(0, initial=0)
        if (fastest > limit).any():
            joint = int(np.argmax(fastest / limit))
            when = np.argmax(speed[:, joints.start + joint]) / FRAME_RATE
            too_fast = f"would turn at {fastest[joint]:.1f} rad/s, its limit is {limit[joint]:.1f}"
            return f"{side} joint {joint + 1} {too_fast}, at {when:.1f} s"
    return None

"""Reachability of tool poses from home along straight tool paths, within the experts' joint limits."""

from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.kinematics.forward import tool_pose
from xew.sim_warp.kinematics.inverse import ArmSolver
from xew.sim_warp.plan import tool

WORK_X, WORK_Y, WORK_Z = np.linspace(-0.30, 0.10, 5), np.linspace(-0.20, 0.12, 5), np.array([0.765, 0.80, 0.88])
"""Grid over the left arm's work volume in tasks [m]; the right arm's is its mirror image."""
GRASP_TILT = 30
"""Lean of the hand in the grasps of that grid [deg]."""
RADIAL_OFFSETS = (-45, -22.5, 0, 22.5, 45)
"""Turns of the hand from the radial yaw in the grasps of that grid [deg]."""
PATH_STEPS = 8
"""Number of poses along the straight path from home that are solved one after the other."""
POSITION_TOLERANCE, ROTATION_TOLERANCE = 2e-3, 0.02
"""Largest error of a pose that counts as reached [m], [rad]."""


def reaches(solver: ArmSolver, arm: int, positions: np.ndarray, tilts: np.ndarray, yaws: np.ndarray) -> np.ndarray:
    """[n] bool, whether an arm reaches tool poses from home.

    Args:
        solver: the robot's solver.
        arm: 0 (left) or 1 (right); positions and yaws are mirrored for the right arm.
        positions: [n 3] m, world frame, for the left arm.
        tilts, yaws: [n] deg.
    """
    mirror = 1 - 2 * arm
    goals = [
        tool(p * [mirror, 1, 1], np.radians(mirror * yaw), np.radians(tilt))
        for p, tilt, yaw in zip(positions, tilts, yaws, strict=True)
    ]
    joint_pos = np.tile(solver.robot.arms[arm].home, (len(goals), 1))
    home = tool_pose(solver.robot, arm, joint_pos[:1])[0]
    turns = [Slerp([0, 1], Rotation.concatenate([Rotation.from_quat(home[3:]), goal.rotation])) for goal in goals]
    ends = np.array([goal.position for goal in goals])
    for share in np.linspace(1 / PATH_STEPS, 1, PATH_STEPS):
        rotation = np.array([turn(share).as_quat() for turn in turns])
        pose = np.concatenate([home[:3] + share * (ends - home[:3]), rotation], 1)
        solution = solver.solve(arm, pose, joint_pos)
        joint_pos = solution.joint_pos
    return (solution.position_error < POSITION_TOLERANCE) & (solution.rotation_error < ROTATION_TOLERANCE)


def work_reach(robot: RobotSpec, arm: int) -> np.ndarray:
    """[offsets x y z] bool over `RADIAL_OFFSETS`, `WORK_X`, `WORK_Y` and `WORK_Z`, whether an arm reaches the tasks' grasps."""
    cells = list(product(RADIAL_OFFSETS, product(WORK_X, WORK_Y, WORK_Z)))
    positions = np.array([position for _, position in cells])
    yaws = np.array([radial_yaw(np.array(position)) + offset for offset, position in cells])
    reached = reaches(ArmSolver(robot), arm, positions, np.full(len(cells), GRASP_TILT), yaws)
    return reached.reshape(len(RADIAL_OFFSETS), len(WORK_X), len(WORK_Y), len(WORK_Z))


def radial_yaw(position: np.ndarray) -> float:
    """The yaw [deg] at which the left hand at `position` [3] m points away from its shoulder, a spot common to all robots."""
    return -float(np.degrees(np.arctan2(position[0] + 0.25, position[1] + 0.45)))

"""Forward kinematics of a robot's links and tools, pure functions of joint positions.

Poses are x y z [m] and quaternion x y z w. `forward_kinematics` runs the kernel of batched.py. All other functions are NumPy:
the renderer gets the same bits on every device.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from xew.protocol import ARMS
from xew.sim_warp.embodiment.spec import Arm, RobotSpec
from xew.sim_warp.embodiment.urdf import Joint, Urdf, load_urdf
from xew.sim_warp.geometry.poses import matrix_from_pose, pose_from_matrix


def forward_kinematics(robot: RobotSpec | Urdf, joint_pos: np.ndarray) -> dict[str, np.ndarray]:
    """Poses of all links, by a kernel on Warp's default device in double precision.

    Args:
        robot: a robot of the registry, or what `load_urdf` returns.
        joint_pos: [n j], position [rad or m] of every joint that moves, in the order of the URDF (`Urdf.joint_names`).

    Returns:
        For every link, its pose [n 7] float64 in the frame of the URDF's root link.

    Raises:
        ValueError: `joint_pos` does not have one column per moving joint.
    """
    # Imported here: packages that need a robot's geometry without simulation work without Warp.
    import warp as wp

    from xew.sim_warp.kinematics.batched import BatchedKinematics

    urdf = robot if isinstance(robot, Urdf) else load_urdf(robot.urdf)
    rows = _check_rows(urdf, joint_pos)
    batched = BatchedKinematics(urdf, dtype=wp.float64)
    poses = batched.poses(wp.array(rows, dtype=wp.float64, device=batched.device)).numpy()
    return {name: np.ascontiguousarray(poses[:, batched.links.index(name)]) for name in urdf.links}


def _check_rows(urdf: Urdf, joint_pos: np.ndarray) -> np.ndarray:
    """`joint_pos` as float64 [n j]."""
    joint_pos = np.asarray(joint_pos, float)
    if joint_pos.ndim != 2 or joint_pos.shape[1] != len(urdf.joint_names):
        raise ValueError(
            f"joint_pos has shape {joint_pos.shape}; {urdf.name} needs [n {len(urdf.joint_names)}], "
            f"one column for each of {', '.join(urdf.joint_names)}"
        )
    return joint_pos


def link_matrices(urdf: Urdf, joint_pos: np.ndarray) -> dict[str, np.ndarray]:
    """As `forward_kinematics`, in NumPy and as homogeneous transforms [n 4 4]."""
    joint_pos = _check_rows(urdf, joint_pos)
    column = {name: index for index, name in enumerate(urdf.joint_names)}
    frames = {urdf.root: np.tile(np.eye(4), (len(joint_pos), 1, 1))}
    for joint in urdf.tree:
        frame = frames[joint.parent] @ joint.origin
        if joint.name in column:
            frame = frame @ joint_motion(joint, joint_pos[:, column[joint.name]])
        frames[joint.child] = frame
    return {name: frames[name] for name in urdf.links}


def joint_motion(joint: Joint, position: np.ndarray) -> np.ndarray:
    """[n 4 4] motion of a joint's child frame at positions [n] rad or m."""
    motion = np.tile(np.eye(4), (len(position), 1, 1))
    if joint.kind == "prismatic":
        motion[:, :3, 3] = position[:, None] * joint.axis
    else:
        motion[:, :3, :3] = Rotation.from_rotvec(position[:, None] * joint.axis).as_matrix()
    return motion


def tool_pose(robot: RobotSpec, arm: int, arm_pos: np.ndarray) -> np.ndarray:
    """World poses [n 7] of the tool frame of arm 0 (left) or 1 (right) at its joint positions `arm_pos` [n d], rad."""
    return pose_from_matrix(tool_matrix(robot, arm, np.asarray(arm_pos, float)))


def tool_poses(robot: RobotSpec, action: np.ndarray) -> np.ndarray:
    """World poses [n 2 7] of the left and right tool frame at canonical rows `action` [n 16] (joints in rad)."""
    arms = [action[:, joints][:, : robot.arm_joint_count] for joints, _ in ARMS]
    return np.stack([tool_pose(robot, arm, arm_pos) for arm, arm_pos in enumerate(arms)], axis=1)


def tool_matrix(robot: RobotSpec, arm: int, arm_pos: np.ndarray) -> np.ndarray:
    """As `tool_pose`, as transforms [n 4 4]; joints that are not the arm's stay at 0."""
    side = robot.arms[arm]
    frame = np.tile(matrix_from_pose(side.root_pose), (len(arm_pos), 1, 1))
    for joint in load_urdf(robot.urdf).chain(side.tool_link):
        frame = frame @ joint.origin
        if joint.name in side.joints:
            frame = frame @ joint_motion(joint, arm_pos[:, side.joints.index(joint.name)])
    return frame @ matrix_from_pose(side.tool_pose)


def joint_positions(robot: RobotSpec, action: np.ndarray) -> tuple[np.ndarray, ...]:
    """Positions of all URDF joints at canonical rows `action` [n 16] (joints in rad, grippers 0 closed to 1 open).

    Returns:
        One [n j] per copy of the URDF: one if it holds both arms, else left and right. Other joints are at 0.
    """
    names = load_urdf(robot.urdf).joint_names
    sides = []
    for arm, (joints, gripper) in zip(robot.arms, ARMS, strict=True):
        joint_pos = np.zeros((len(action), len(names)))
        joint_pos[:, [names.index(name) for name in arm.joints]] = action[:, joints][:, : len(arm.joints)]
        joint_pos[:, [names.index(name) for name in arm.fingers]] = finger_positions(arm, action[:, gripper])
        sides.append(joint_pos)
    return (sides[0] + sides[1],) if robot.one_urdf_holds_both_arms else tuple(sides)


def finger_positions(arm: Arm, gripper: np.ndarray) -> np.ndarray:
    """Positions [n 2] of an arm's finger joints at gripper values [n] in 0 (closed) to 1 (open)."""
    closed, opened = np.array(arm.finger_closed), np.array(arm.finger_open)
    return closed + np.asarray(gripper, float)[:, None] * (opened - closed)


def link_poses(robot: RobotSpec, action: np.ndarray) -> tuple[dict[str, np.ndarray], ...]:
    """World poses [n 7] of every link at canonical rows `action` [n 16], one dict per copy of the URDF."""
    urdf = load_urdf(robot.urdf)
    placed = []
    for arm, joint_pos in zip(robot.arms, joint_positions(robot, np.asarray(action, float)), strict=False):
        root = matrix_from_pose(arm.root_pose)
        placed.append({name: pose_from_matrix(root @ frame) for name, frame in link_matrices(urdf, joint_pos).items()})
    return tuple(placed)

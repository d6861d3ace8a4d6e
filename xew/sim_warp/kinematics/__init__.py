"""Joint positions to poses and back: forward kinematics on the host and on a device, inverse kinematics in batches.

`forward_kinematics` and its relatives are pure functions of joint positions [rad, m] in a robot's root frame;
the batched ones take arrays of configurations and leave them on the device.
"""

from xew.sim_warp.kinematics.forward import (
    finger_positions,
    forward_kinematics,
    joint_motion,
    joint_positions,
    link_matrices,
    link_poses,
    tool_matrix,
    tool_pose,
    tool_poses,
)

__all__ = [
    "finger_positions",
    "forward_kinematics",
    "joint_motion",
    "joint_positions",
    "link_matrices",
    "link_poses",
    "tool_matrix",
    "tool_pose",
    "tool_poses",
]

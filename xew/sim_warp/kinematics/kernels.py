"""Forward kinematics on a device: one thread per configuration walks the tree of joints from the root outward.

The pose of a link follows from the pose of its parent, `above`: pose = pose[above] * origin * motion(joint_pos[column]).
"""

# Annotations of kernels are types of Warp, which mypy does not know.
# mypy: ignore-errors

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

FIXED, TURNING, SLIDING = 0, 1, 2
"""Kinds of joint above a link."""
TYPES = {wp.float32: (wp.vec3f, wp.quatf, wp.transformf), wp.float64: (wp.vec3d, wp.quatd, wp.transformd)}


@wp.func
def normalize_rotation(
    # In
    turn: Any,  # quaternion x y z w, float32 or float64, within rounding of unit length
):
    """The quaternion at unit length with w >= 0. Rounding moves the length by little: one Newton step for 1/sqrt is enough."""
    scale = turn.dtype(1.5) - turn.dtype(0.5) * wp.dot(turn, turn)
    return turn * wp.where(turn[3] < turn.dtype(0.0), -scale, scale)


@cache
def kinematics_kernels(scalar: type) -> SimpleNamespace:
    """The kernel for `wp.float32` or `wp.float64`, with the `Tree` that it reads and the types of its arrays."""
    vector, rotation, frame = TYPES[scalar]

    @wp.struct
    class Tree:
        """The links of a robot, parents before their children."""

        above: wp.array(dtype=int)  # [l] int32, the parent link; -1 for none
        kind: wp.array(dtype=int)  # [l] int32, FIXED, TURNING or SLIDING
        origin: wp.array(dtype=frame)  # [l] m and quaternion x y z w, the link in the one above at joint position 0
        axis: wp.array(dtype=vector)  # [l] unit vector in the frame of the link
        column: wp.array(dtype=int)  # [l] int32, column of joint_pos

    @wp.kernel(module="unique")
    def forward_kinematics(
        # In
        tree: Tree,  # links of the robot
        joint_pos: wp.array2d(dtype=scalar),  # [n j] float32 or float64, rad or m
        # Out
        pose_out: wp.array3d(dtype=scalar),  # [l 7 n] as joint_pos, m and quaternion x y z w; threads write adjacent numbers
    ):
        """Walk the links of one configuration from the root outward: a thread makes the poses [l 7] of one row of [n]."""
        row = wp.tid()
        place = vector(scalar(0.0))
        turn = wp.quat_identity(dtype=scalar)
        for link in range(tree.above.shape[0]):
            above = tree.above[link]
            if above != link - 1:
                place = vector(pose_out[above, 0, row], pose_out[above, 1, row], pose_out[above, 2, row])
                turn = rotation(
                    pose_out[above, 3, row], pose_out[above, 4, row], pose_out[above, 5, row], pose_out[above, 6, row]
                )
            place += wp.quat_rotate(turn, wp.transform_get_translation(tree.origin[link]))
            turn = turn * wp.transform_get_rotation(tree.origin[link])
            if tree.kind[link] != wp.static(FIXED):
                position = joint_pos[row, tree.column[link]]
                if tree.kind[link] == wp.static(TURNING):
                    turn = turn * wp.quat_from_axis_angle(tree.axis[link], position)
                else:
                    place += wp.quat_rotate(turn, tree.axis[link] * position)
            turn = normalize_rotation(turn)
            for i in range(3):
                pose_out[link, i, row] = place[i]
            for i in range(4):
                pose_out[link, 3 + i, row] = turn[i]

    return SimpleNamespace(Tree=Tree, forward_kinematics=forward_kinematics, vector=vector, frame=frame)

"""Kernels round MuJoCo Warp's step: targets in, joints and contacts out."""

# Annotations of kernels are types of Warp, which mypy does not know.
# mypy: ignore-errors

import warp as wp

from xew.sim_warp.physics.worlds import FIRST_OBJECT, LEFT_ARM_LINKS, LEFT_FINGERS, RIGHT_ARM_LINKS, RIGHT_FINGERS, TABLE


@wp.kernel
def set_targets(
    # In:
    joints: wp.array3d[wp.float32],  # [n t 18] commanded robot joints at stored frames
    frame: wp.array[wp.int32],  # [1]
    share: wp.float32,
    frame_rate: wp.float32,
    # Out:
    ctrl_out: wp.array2d[wp.float32],  # [n 36]
) -> None:
    """Targets of one step: position and velocity of each joint, commands being linear between frames."""
    world, joint = wp.tid()
    before = joints[world, frame[0], joint]
    after = joints[world, frame[0] + 1, joint]
    ctrl_out[world, 2 * joint] = before + share * (after - before)
    ctrl_out[world, 2 * joint + 1] = (after - before) * frame_rate


@wp.kernel
def record_joints(
    # In:
    qpos: wp.array2d[wp.float32],
    qvel: wp.array2d[wp.float32],
    frame: wp.array[wp.int32],
    # Out:
    qpos_out: wp.array3d[wp.float32],  # [n t q]
    qvel_out: wp.array3d[wp.float32],  # [n t v]
):
    world, index = wp.tid()
    if index < qpos.shape[1]:
        qpos_out[world, frame[0], index] = qpos[world, index]
    if index < qvel.shape[1]:
        qvel_out[world, frame[0], index] = qvel[world, index]


@wp.func
def side_of(owner: int) -> int:
    """0 for any part of the left arm, 1 for the right, -1 for what is no robot."""
    if owner == wp.static(LEFT_FINGERS) or owner == wp.static(LEFT_ARM_LINKS):
        return 0
    if owner == wp.static(RIGHT_FINGERS) or owner == wp.static(RIGHT_ARM_LINKS):
        return 1
    return -1


@wp.kernel
def record_contacts(
    # In:
    count: wp.array[wp.int32],  # [1] contacts of all worlds
    geom: wp.array[wp.vec2i],
    world_of: wp.array[wp.int32],
    distance: wp.array[wp.float32],
    owners: wp.array2d[wp.int32],  # [n g]
    frame: wp.array[wp.int32],
    # Out:
    contact_out: wp.array3d[wp.int32],  # [n t 2] bit i: fingers on object i
    penetration_out: wp.array3d[wp.float32],  # [n t o] m
    overlap_out: wp.array2d[wp.float32],  # [n 2] m
):
    """Which fingers touch which objects, how deep objects are in anything else, and arms in the table or in each other."""
    index = wp.tid()
    if index >= wp.min(count[0], geom.shape[0]) or distance[index] >= 0.0:
        return
    world = world_of[index]
    low = wp.min(owners[world, geom[index][0]], owners[world, geom[index][1]])
    high = wp.max(owners[world, geom[index][0]], owners[world, geom[index][1]])
    if low >= 0 and low < wp.static(FIRST_OBJECT) and high >= wp.static(FIRST_OBJECT):
        wp.atomic_or(contact_out, world, frame[0], low, 1 << (high - wp.static(FIRST_OBJECT)))
    if low != high:
        if low >= wp.static(FIRST_OBJECT):
            wp.atomic_max(penetration_out, world, frame[0], low - wp.static(FIRST_OBJECT), -distance[index])
        if high >= wp.static(FIRST_OBJECT):
            wp.atomic_max(penetration_out, world, frame[0], high - wp.static(FIRST_OBJECT), -distance[index])
    first = side_of(low)
    second = side_of(high)
    if (low == wp.static(TABLE) and second >= 0) or (high == wp.static(TABLE) and first >= 0):
        wp.atomic_max(overlap_out, world, 0, -distance[index])
    if first >= 0 and second >= 0 and first != second:
        wp.atomic_max(overlap_out, world, 1, -distance[index])


@wp.kernel
def advance(frame: wp.array[wp.int32]):
    frame[0] = frame[0] + 1

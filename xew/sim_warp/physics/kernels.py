"""Warp kernels before and after MuJoCo Warp's step: they set targets, and record joints and contacts.

Letters of shapes: n worlds, t stored frames, q joint coordinates, v joint velocities, c contacts of the buffer, g collision
shapes of a world, o objects.
"""

# Annotations of kernels are types of Warp, which mypy does not know.
# mypy: ignore-errors

import warp as wp

from xew.sim_warp.physics.worlds import FIRST_OBJECT, LEFT_ARM_LINKS, LEFT_FINGERS, RIGHT_ARM_LINKS, RIGHT_FINGERS, TABLE


@wp.kernel
def set_targets(
    # In:
    joints: wp.array3d[wp.float32],  # [n t 18] float32 commanded robot joints at stored frames [rad; fingers m]
    frame: wp.array[wp.int32],  # [1] int32 stored frame before this step
    share: wp.float32,  # of the time to the next stored frame that has gone by at the end of this step, 0 to 1
    frame_rate: wp.float32,  # Hz
    # Out:
    ctrl_out: wp.array2d[wp.float32],  # [n 36] float32 position [rad, m] and velocity [rad/s, m/s] of each joint in turn
):
    """Set the targets of one step; commands are linear between stored frames."""
    world, joint = wp.tid()
    before = joints[world, frame[0], joint]
    after = joints[world, frame[0] + 1, joint]
    ctrl_out[world, 2 * joint] = before + share * (after - before)
    ctrl_out[world, 2 * joint + 1] = (after - before) * frame_rate


@wp.kernel
def record_joints(
    # In:
    qpos: wp.array2d[wp.float32],  # [n q] float32 the template's joint coordinates [rad, m]
    qvel: wp.array2d[wp.float32],  # [n v] float32 their velocities [rad/s, m/s]
    frame: wp.array[wp.int32],  # [1] int32 stored frame that has been reached
    # Out:
    qpos_out: wp.array3d[wp.float32],  # [n t q] float32 [rad, m]
    qvel_out: wp.array3d[wp.float32],  # [n t v] float32 [rad/s, m/s]
):
    """Record joint coordinates and velocities."""
    world, index = wp.tid()
    if index < qpos.shape[1]:
        qpos_out[world, frame[0], index] = qpos[world, index]
    if index < qvel.shape[1]:
        qvel_out[world, frame[0], index] = qvel[world, index]


@wp.func
def side_of(owner: int) -> int:
    """0 for any part of the left arm, 1 for the right, -1 otherwise."""
    if owner == wp.static(LEFT_FINGERS) or owner == wp.static(LEFT_ARM_LINKS):
        return 0
    if owner == wp.static(RIGHT_FINGERS) or owner == wp.static(RIGHT_ARM_LINKS):
        return 1
    return -1


@wp.kernel
def record_contacts(
    # In:
    count: wp.array[wp.int32],  # [1] int32 contacts of all worlds
    geom: wp.array[wp.vec2i],  # [c 2] int32 the two collision shapes of a contact
    world_of: wp.array[wp.int32],  # [c] int32 world of a contact
    distance: wp.array[wp.float32],  # [c] float32 m, negative where the shapes overlap
    owners: wp.array2d[wp.int32],  # [n g] int32 what each collision shape belongs to, see `worlds.shape_owners`
    frame: wp.array[wp.int32],  # [1] int32 stored frame that has been reached
    # Out:
    contact_out: wp.array3d[wp.int32],  # [n t 2] int32, bit i says that the left, right fingers touch object i
    penetration_out: wp.array3d[wp.float32],  # [n t o] float32 m, how deep an object and anything else are in each other
    overlap_out: wp.array2d[wp.float32],  # [n 2] float32 m, how deep an arm was in the table, and the arms in each other
):
    """Record contacts of fingers and objects, and penetrations."""
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
def advance_frame(
    # In:
    frame: wp.array[wp.int32],  # [1] int32 stored frame
    # Out:
    frame_out: wp.array[wp.int32],  # [1] int32 stored frame after it; may be the same array
):
    """Count one stored frame more."""
    frame_out[0] = frame[0] + 1

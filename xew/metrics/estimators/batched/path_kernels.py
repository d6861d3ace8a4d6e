"""Warp kernel that finds the cheapest path of each point through all frames (Viterbi), for tracks.py.

A point's path depends on no other point, so a block of threads walks through all frames with one; on a CPU it is one thread.
Letters of shapes as in track_kernels.py; c the proposals of a frame, the first three by flow and the rest by search.
"""

# Annotations of kernels are types of Warp, which mypy does not know.
# mypy: ignore-errors

import warp as wp

from xew.metrics.estimators import tracks
from xew.metrics.estimators.batched.mask_kernels import find_place, read_flow
from xew.metrics.estimators.batched.track_kernels import GIVEN_UP, PROPOSALS, Images, Truth, improve_by_both

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SURE = wp.constant(tracks.SURE)
STRAYING = wp.constant(tracks.STRAYING)
JUMP = wp.constant(wp.float64(tracks.JUMP))
LOST = wp.constant(wp.float64(tracks.LOST))
HIDDEN = wp.constant(tracks.HIDDEN)
INNER_MOTION = wp.constant(tracks.INNER_MOTION)

Places = wp.types.matrix(shape=(3 + tracks.PEAKS, 2), dtype=float)
Costs = wp.types.vector(length=4 + tracks.PEAKS, dtype=wp.float64)
"""Costs of the proposals and, last, of being lost."""


@wp.func
def move(flow: wp.array3d(dtype=wp.vec2), n: int, place: wp.vec2) -> wp.vec2:
    return place + read_flow(flow, n, find_place(place, flow.shape[1], flow.shape[2]))


@wp.func
def stray(offset: wp.vec2, inner: wp.vec2) -> wp.float64:
    """0 to 1, how far a place is from where one before was carried, with or without `inner`."""
    square = wp.min(wp.dot(offset, offset), wp.dot(offset - inner, offset - inner))
    return wp.float64(square / (square + STRAYING * STRAYING))


@wp.func
def cheapest(total: Costs, count: int) -> int:
    best = wp.int32(0)
    for i in range(count):
        if total[i] < total[best]:
            best = i
    return best


@wp.func
def carry_on(flow: wp.array3d(dtype=wp.vec2), t: int, place: Places, first: wp.vec2) -> Places:
    """The places of the frame before, carried to frame t; in the first frame all are where the point truly is."""
    carried = Places()
    for i in range(PROPOSALS):
        at = first
        if t > 0:
            at = move(flow, t - 1, wp.vec2(place[i, 0], place[i, 1]))
        carried[i, 0] = at[0]
        carried[i, 1] = at[1]
    return carried


@wp.func
def inner_motion(truth: Truth, flow: wp.array3d(dtype=wp.vec2), t: int, k: int) -> wp.vec2:
    """How the true point moves otherwise than flow; 0 where that is unknown or too much to be believed."""
    inner = wp.vec2()
    if t > 0 and truth.visible[t, k] != wp.uint8(0) and truth.visible[t - 1, k] != wp.uint8(0):
        apart = truth.point[t, k] - move(flow, t - 1, truth.point[t - 1, k])
        if wp.length(apart) < INNER_MOTION:
            inner = apart
    return inner


@wp.func
def hidden_place(truth: Truth, repeats: wp.array(dtype=wp.uint8), t: int, k: int, i: int, given: wp.vec3) -> wp.vec3:
    """One of the first two proposals: the second is where the most similar frame has a point that it hides, if it is the same
    moment."""
    other = truth.alike[t]
    if i == 1 and other != t and repeats[t] != wp.uint8(0) and truth.visible[other, k] == wp.uint8(0):
        return wp.vec3(truth.point[other, k][0], truth.point[other, k][1], HIDDEN)
    return given


@wp.func
def third_or_peak(third: wp.vec3, peak: wp.array2d(dtype=wp.vec3), search: int, unsure: bool, i: int) -> wp.vec3:
    """One of the other proposals: the third, or one of a search's where the first three are not sure."""
    if i == 2:
        return third
    if unsure:
        return peak[search, i - 3]
    return wp.vec3(0.0, 0.0, GIVEN_UP)


@wp.func
def cheapest_way(total: Costs, place: Places, carried: Places, inner: wp.vec2, charge: wp.float64, to: int) -> wp.vec2d:
    """The state before that is the cheapest to come from to a state, and what that has cost."""
    origin, least = wp.int32(0), wp.float64(1.0e30)
    for j in range(PROPOSALS + 1):
        step = JUMP
        if to < PROPOSALS and j < PROPOSALS:
            offset = wp.vec2(place[to, 0] - carried[j, 0], place[to, 1] - carried[j, 1])
            step = charge * stray(offset, inner)
        if to == PROPOSALS and j == PROPOSALS:
            step = wp.float64(0.0)
        if total[j] + step < least:
            least = total[j] + step
            origin = j
    return wp.vec2d(wp.float64(origin), least)


@wp.kernel
def walk(
    # In:
    images: Images,
    truth: Truth,
    repeats: wp.array(dtype=wp.uint8),  # [t] uint8, 1 where the most similar frame is the same moment, hidden points included
    seen_flow: wp.array3d(dtype=wp.vec2),  # [t-1 h w 2] float32 pixels, of the predicted video to the following frame
    true_flow: wp.array3d(dtype=wp.vec2),  # [t-1 h w 2] float32 pixels, of the true video
    proposal: wp.array3d(dtype=wp.vec3),  # [t k 2 3] float32
    search: wp.array2d(dtype=int),  # [t k] int32, the search for a point, -1 where there was none
    peak: wp.array2d(dtype=wp.vec3),  # [q PEAKS 3] float32
    # Out:
    place_out: wp.array3d(dtype=wp.vec2),  # [t k c 2] float32 pixels, all proposals
    origin_out: wp.array3d(dtype=int),  # [t k c+1] int32, the state before, on the cheapest path to each
    total_out: wp.array2d(dtype=wp.float64),  # [k c+1] float64, what the cheapest path to each last state costs
):
    """The cheapest path of each point to each proposal, frame by frame (Viterbi)."""
    k, lane = wp.tid()
    total = Costs()
    place = Places()
    for t in range(truth.point.shape[0]):
        now = truth.visible[t, k] != wp.uint8(0)
        carried = carry_on(seen_flow, t, place, truth.point[0, k])
        inner = inner_motion(truth, true_flow, t, k)
        likeliest = cheapest(total, PROPOSALS)
        third = improve_by_both(images, truth, t, k, wp.vec2(carried[likeliest, 0], carried[likeliest, 1]), lane)
        least = wp.min(wp.min(proposal[t, k, 0][2], proposal[t, k, 1][2]), third[2])
        unsure = least > 1.0 - SURE and search[t, k] >= 0
        cost = Costs()
        for i in range(PROPOSALS):
            given = wp.vec3(carried[i, 0], carried[i, 1], 0.0)
            if now and i < 2:
                given = hidden_place(truth, repeats, t, k, i, proposal[t, k, wp.min(i, 1)])
            elif now:
                given = third_or_peak(third, peak, search[t, k], unsure, i)
            place[i, 0] = given[0]
            place[i, 1] = given[1]
            cost[i] = wp.float64(given[2])
        cost[PROPOSALS] = wp.where(now, LOST, wp.float64(0.0))
        charge = wp.where(truth.visible[wp.max(t - 1, 0), k] != wp.uint8(0) or not now, JUMP, wp.float64(0.0))
        following = Costs()
        for i in range(PROPOSALS + 1):
            way = cheapest_way(total, place, carried, inner, charge, i)
            following[i] = cost[i] + wp.where(t > 0, way[1], wp.float64(0.0))
            if lane == 0:
                origin_out[t, k, i] = int(way[0])
                if i < PROPOSALS:
                    place_out[t, k, i] = wp.vec2(place[i, 0], place[i, 1])
        total = following
    if lane == 0:
        for i in range(PROPOSALS + 1):
            total_out[k, i] = total[i]

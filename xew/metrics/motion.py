"""Steadiness and events: what means over a video do not see. Flicker, ghosts, an object's last frames, the first motion of
objects, and the aperture of hands.

Each needs the ground truth of a simulator, and no network's weights.
"""

import functools
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float32, Int

from xew.metrics.metric import (
    AnyArray,
    ByFrame,
    Masks,
    Scalar,
    Tracks,
    Valid,
    Video,
    check_first,
    check_masked_videos,
    check_tracks,
    check_videos,
    map_chunks,
)
from xew.metrics.track import SIDE, TAPVID_SIDE, TOLERANCES, break_unknown, found_points, strict_distances

Numbers: TypeAlias = Int[AnyArray, " k"]
"""A number for each point."""

STILL = 2
"""Largest change [levels] from frame to frame of a pixel that stands still in the target."""
GHOST = 24.0
"""Least difference [levels] from the still scene, of the mean of four pixels, at which something else is shown."""
GHOST_MARGIN = 4
"""Number of pixels round the target's bodies that are left out: a body that is slightly off is no ghost."""
EXPOSURE = 32.0
"""Largest difference [levels] of a pixel that counts towards a frame's exposure."""
LAST_SHARE = 10
"""Divisor of the number of frames that gives the number of last frames."""
MOVED = 4.0
"""Distance [pixels of TAPVID_SIDE] from its first place from which on a point has moved."""
LASTING = 8
"""Number of frames, half a second, that a motion lasts to count as begun."""
MOST_MOVED, FEWEST_FOUND = 0.75, 0.5
"""Least share of an object's found points that have moved in these frames, and of its visible points that are found: lost
points neither make nor interrupt a motion."""
LATEST = 16
"""Largest shift of an onset [frames], about a second, which a motion that never begins has."""


@check_first(check_videos)
@functools.partial(jax.jit, static_argnames="chunk")
def flicker(prediction: Video, target: Video, *, chunk: int | None = None) -> Scalar:
    """Change [levels] of the residual between frames where the target stands still; 0 is best, a constant error has 0.

    Args:
        prediction, target: [t h w 3] uint8, or floating in [0, 1].
        chunk: most frames computed at once; by default 1 on a CPU and 64 elsewhere.

    Returns:
        Scalar float32, mean over frames and pixels; NaN where no two frames have a still pixel in common.
    """
    return _mean_of_counted(*flicker_parts(prediction, target, chunk=chunk))


@check_first(check_videos)
@functools.partial(jax.jit, static_argnames="chunk")
def flicker_frames(prediction: Video, target: Video, *, chunk: int | None = None) -> ByFrame:
    """`flicker` of videos [t h w 3] before the mean, [t] float32; NaN in the first frame."""
    values, counts = flicker_parts(prediction, target, chunk=chunk)
    return jnp.where(counts, values, jnp.nan)


@check_first(check_videos)
@functools.partial(jax.jit, static_argnames="chunk")
def flicker_parts(prediction: Video, target: Video, *, chunk: int | None = None) -> tuple[ByFrame, Bool[jax.Array, " t"]]:
    """Values [t] float32 that `flicker` of videos [t h w 3] is the mean of, and [t] bool, which count."""

    def of_frames(pairs: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        change, true_change = _changes(pairs)
        still = jnp.max(jnp.abs(true_change), axis=-1) <= STILL
        return _mean_change(change - true_change, still, _is_broken(*pairs))

    return _counting_pairs(map_chunks(of_frames, _pairs(prediction, target), chunk))


@check_first(check_masked_videos)
@functools.partial(jax.jit, static_argnames="chunk")
def flicker_robot(prediction: Video, target: Video, target_mask: Masks, *, chunk: int | None = None) -> Scalar:
    """Change [levels] of the residual between frames where the target shows the robot in both; 0 is best.

    A robot in the wrong place changes its residual too. Compare with videos that are as far off.

    Args:
        prediction, target: [t h w 3] uint8, or floating in [0, 1]. target_mask: [t h w] bool.
        chunk: as in `flicker`.

    Returns:
        Scalar float32, mean over frames and pixels; NaN where no two frames have a pixel of the robot in common.
    """
    return _mean_of_counted(*flicker_robot_parts(prediction, target, target_mask, chunk=chunk))


@check_first(check_masked_videos)
@functools.partial(jax.jit, static_argnames="chunk")
def flicker_robot_frames(prediction: Video, target: Video, target_mask: Masks, *, chunk: int | None = None) -> ByFrame:
    """`flicker_robot` of videos [t h w 3] and masks [t h w] before the mean, [t] float32; NaN in the first frame."""
    values, counts = flicker_robot_parts(prediction, target, target_mask, chunk=chunk)
    return jnp.where(counts, values, jnp.nan)


@check_first(check_masked_videos)
@functools.partial(jax.jit, static_argnames="chunk")
def flicker_robot_parts(
    prediction: Video, target: Video, target_mask: Masks, *, chunk: int | None = None
) -> tuple[ByFrame, Bool[jax.Array, " t"]]:
    """Values [t] float32 that `flicker_robot` of videos [t h w 3], masks [t h w] is the mean of, and [t] bool, which count."""

    def of_frames(pairs: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        change, true_change = _changes(pairs[:4])
        return _mean_change(change - true_change, pairs[4] & pairs[5], _is_broken(*pairs[:4]))

    return _counting_pairs(map_chunks(of_frames, _pairs(prediction, target, jnp.asarray(target_mask)), chunk))


@check_first(check_masked_videos)
@functools.partial(jax.jit, static_argnames="chunk")
def ghosts(prediction: Video, target: Video, target_mask: Masks, *, chunk: int | None = None) -> ByFrame:
    """Share of a frame, in [0, 1], where the target shows the still scene and the prediction something else; lower is better.

    It is seen in means of 2x2 pixels after the frame's mean exposure is taken out, so grain and brightness are no ghosts.

    Args:
        prediction, target: [t h w 3] uint8, or floating in [0, 1]; sides of at least 2 pixels.
        target_mask: [t h w] bool, the robot and the objects in the target.
        chunk: as in `flicker`.

    Returns:
        [t] float32.
    """

    def of_frames(frames: tuple[jax.Array, ...]) -> jax.Array:
        seen, true, mask = frames
        scene = ~jnp.any(_cells(_grow(mask)), axis=(2, 4))
        difference = jnp.mean(_cells(_levels(seen) - _levels(true)), axis=(2, 4))
        exposure = _mean_where(jnp.clip(difference, -EXPOSURE, EXPOSURE), scene[..., None])
        shown = jnp.max(jnp.abs(difference - exposure), axis=-1) > GHOST
        share = jnp.mean((shown & scene).astype(jnp.float32), axis=(1, 2))
        return jnp.where(_is_broken(seen, true), jnp.nan, share)

    return map_chunks(of_frames, (prediction, target, jnp.asarray(target_mask)), chunk)


@check_first(check_tracks)
@jax.jit
def final_object_error(
    prediction: Tracks,
    target: Tracks,
    valid: Valid,
    side: float | jax.Array = SIDE,
    frames: int | jax.Array | None = None,
) -> Scalar:
    """`trajectory_error_strict` over the last tenth of the frames: how far objects are from where the episode leaves them.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        side: square root of the image's area [pixels].
        frames: number of the video's frames, where arrays are filled up behind them; by default all.

    Returns:
        Scalar float32 from 0 to `failure_distance(side)`; NaN where no point is valid then.
    """
    return _mean_of_counted(*final_distances(prediction, target, valid, side, frames))


@check_first(check_tracks)
@jax.jit
def final_distances(
    prediction: Tracks,
    target: Tracks,
    valid: Valid,
    side: float | jax.Array = SIDE,
    frames: int | jax.Array | None = None,
) -> tuple[Float32[jax.Array, "t k"], Valid]:
    """What `final_object_error` of tracks [t k 2] is the mean of: [t k] float32 pixels, and [t k] bool, which count."""
    count = jnp.asarray(len(target) if frames is None else frames)
    last = jnp.arange(len(target)) >= count - (count + LAST_SHARE - 1) // LAST_SHARE
    values, counts = strict_distances(prediction, target, valid, side)
    return values, counts & last[:, None]


@check_first(check_tracks)
@jax.jit
def onset_shift(
    prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE, body: Numbers | None = None
) -> Scalar:
    """Number of frames between an object's true and predicted first motion, early or late, mean over objects; 0 is best.

    An object moves from the frame on in which most of its found points are 4 px of 256 from their true first places, and three
    quarters of those found in the half second from then on.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        side: square root of the image's area [pixels].
        body: [k] the object that each point lies on; by default the same.

    Returns:
        Scalar float32 in [0, 16], 16 for an object that never moves; NaN where the target moves none so far.
    """
    return _mean_of_counted(*onset_shifts(prediction, target, valid, side, body))


@check_first(check_tracks)
@jax.jit
def onset_shifts(
    prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE, body: Numbers | None = None
) -> tuple[Float32[jax.Array, " k"], Bool[jax.Array, " k"]]:
    """What `onset_shift` of tracks [t k 2] is the mean of: [k] float32 frames, and [k] bool, the first point of each object."""
    if 0 in valid.shape:
        return jnp.zeros(valid.shape[1], jnp.float32), jnp.zeros(valid.shape[1], bool)
    body = jnp.zeros(valid.shape[1], jnp.int32) if body is None else jnp.asarray(body)
    same = body[:, None] == body[None]
    first = jnp.argmax(same, axis=1) == jnp.arange(len(body))
    most = jnp.asarray(MOVED / TAPVID_SIDE * side, jnp.float32)
    onset, true_onset = (_onset(points, target[:1], valid, same, most) for points in (prediction, target))
    shift = jnp.minimum(jnp.abs(onset - true_onset), LATEST)
    return break_unknown(shift.astype(jnp.float32), first & (true_onset < len(target)), target, valid)


def _onset(points: AnyArray, start: AnyArray, valid: AnyArray, same: jax.Array, most: jax.Array) -> jax.Array:
    """First frame [k] in which the body of each point [t k 2] has moved from its start [1 k 2]; t where it never does."""
    known = found_points(points) & valid
    points = jnp.asarray(points, jnp.float32)
    start = jnp.broadcast_to(jnp.asarray(start, jnp.float32), points.shape)
    moved = known & (jnp.sum(jnp.square(jnp.where(known[..., None], points, start) - start), axis=-1) > most**2)
    shown, found, away = (jnp.matmul(flags.astype(jnp.float32), same.astype(jnp.float32)) for flags in (valid, known, moved))
    lasting_shown, lasting_found, lasting_away = (_sum_ahead(count) for count in (shown, found, away))
    lasts = (lasting_away >= MOST_MOVED * lasting_found) & (lasting_found >= FEWEST_FOUND * lasting_shown)
    begins = (2 * away > found) & lasts
    return jnp.where(jnp.any(begins, axis=0), jnp.argmax(begins, axis=0), len(begins))


def _sum_ahead(counts: jax.Array) -> jax.Array:
    """Sums [t k] of counts [t k] over LASTING frames from each on, fewer at the end."""
    return lax.reduce_window(counts, np.float32(0), lax.add, (LASTING, 1), (1, 1), ((0, LASTING - 1), (0, 0)))


@check_first(check_tracks)
@jax.jit
def gripper_error(
    prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE, finger: Numbers | None = None
) -> Scalar:
    """Error [pixels] of each hand's aperture, the distance between the points of its two fingers; lower is better.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        side: square root of the image's area [pixels].
        finger: [k] the finger that each point lies on, 0 and 1 of the left hand, 2 and 3 of the right, -1 for none; by default
            points of one hand's fingers in turn.

    Returns:
        Scalar float32 from 0 to 16 px of 256, which a hand without a found point on a finger has; NaN where the target never
        shows both fingers of a hand.
    """
    return _mean_of_counted(*aperture_errors(prediction, target, valid, side, finger))


@check_first(check_tracks)
@jax.jit
def aperture_errors(
    prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE, finger: Numbers | None = None
) -> tuple[Float32[jax.Array, "t 2"], Bool[jax.Array, "t 2"]]:
    """What `gripper_error` of tracks [t k 2] is the mean of: [t 2] float32 pixels by hand, and [t 2] bool, which count."""
    finger = jnp.arange(valid.shape[1]) % 2 if finger is None else jnp.asarray(finger)
    of_finger = (finger[None] == jnp.arange(4)[:, None]).astype(jnp.float32)
    known = found_points(prediction) & valid
    shown, found = (jnp.matmul(flags.astype(jnp.float32), of_finger.T) for flags in (valid, known))
    apertures = []
    for points in (prediction, target):
        places = jnp.where(known[..., None], jnp.asarray(points, jnp.float32), 0)
        middle = jnp.einsum("tkc,fk->tfc", places, of_finger) / jnp.maximum(found, 1)[..., None]
        apertures.append(jnp.linalg.norm(middle[:, 0::2] - middle[:, 1::2], axis=-1))
    most = jnp.asarray(TOLERANCES[-1] / TAPVID_SIDE * side, jnp.float32)
    both_shown, both_found = (jnp.minimum(count[:, 0::2], count[:, 1::2]) > 0 for count in (shown, found))
    error = jnp.where(both_found, jnp.minimum(jnp.abs(apertures[0] - apertures[1]), most), most)
    unknown = jnp.any(valid & ~found_points(target), axis=1, keepdims=True)
    return jnp.where(unknown, jnp.nan, error), both_shown | unknown


def _mean_of_counted(values: jax.Array, counts: AnyArray) -> jax.Array:
    return jnp.sum(jnp.where(counts, values, 0)) / jnp.sum(counts).astype(jnp.float32)


def _pairs(*videos: AnyArray) -> tuple[jax.Array, ...]:
    """Of each array [t ...] itself and the frame before each, the first its own: twice as many arrays [t ...]."""
    return tuple(array for video in videos for array in (jnp.asarray(video), jnp.concatenate([video[:1], video[:-1]])))


def _changes(pairs: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
    """Change [n h w 3] float32 levels of the prediction and of the target since the frame before."""
    now, before, true, true_before = (_levels(frames) for frames in pairs)
    return now - before, true - true_before


def _levels(frames: jax.Array) -> jax.Array:
    """Frames [...] in levels of 255, float32."""
    return frames.astype(jnp.float32) * (1 if frames.dtype == jnp.uint8 else 255)


def _mean_change(change: jax.Array, where: jax.Array, broken: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean size [n] of changes [n h w 3] where [n h w], NaN of broken ones [n]; and whether there is any pixel [n]."""
    count = jnp.sum(where, axis=(1, 2))
    total = jnp.sum(jnp.where(where, jnp.mean(jnp.abs(change), axis=-1), 0), axis=(1, 2))
    return jnp.where(broken, jnp.nan, total / jnp.maximum(count, 1).astype(jnp.float32)), (count > 0) | broken


def _is_broken(*frames: jax.Array) -> jax.Array:
    """[n] bool, whether a number in any of some frames [n h w 3] is NaN; bytes never are."""
    if frames[0].dtype == jnp.uint8:
        return jnp.zeros(len(frames[0]), bool)
    return functools.reduce(jnp.logical_or, (jnp.any(jnp.isnan(one), axis=(1, 2, 3)) for one in frames))


def _mean_where(values: jax.Array, where: jax.Array) -> jax.Array:
    """Mean [n 1 1 c] of values [n h w c] where [n h w 1]; 0 where there is none."""
    count = jnp.maximum(jnp.sum(where, axis=(1, 2), keepdims=True), 1).astype(jnp.float32)
    return jnp.sum(jnp.where(where, values, 0), axis=(1, 2), keepdims=True) / count


def _counting_pairs(values_and_counts: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """Values [t] and which count [t], never the first frame, which has none before it."""
    values, counts = values_and_counts
    return values, counts & (jnp.arange(len(values)) > 0)


def _grow(mask: jax.Array) -> jax.Array:
    """A mask [n h w] bool grown by GHOST_MARGIN on all sides, along one axis after the other."""
    size = 2 * GHOST_MARGIN + 1
    for window in ((1, size, 1), (1, 1, size)):
        mask = lax.reduce_window(mask, False, lax.bitwise_or, window, (1, 1, 1), "same")
    return mask


def _cells(image: jax.Array) -> jax.Array:
    """An image [n h w ...] in cells of 2x2 pixels [n h/2 2 w/2 2 ...]; odd rests are left out."""
    n, h, w = image.shape[0], image.shape[1] // 2, image.shape[2] // 2
    return image[:, : 2 * h, : 2 * w].reshape(n, h, 2, w, 2, *image.shape[3:])

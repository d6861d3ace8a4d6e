"""Robot kinematics and object dynamics by tracked points in the image plane.

Tracks are float [t k 2] pixels (x right, y down); validity bool [t k] says that the target shows the point. A prediction holds
NaN where it lost a point. By the paper's definitions a lost point is a miss for PCK and is left out of errors. By the strict
ones, whose names say so, it has the error of failure, and one tolerance holds for all robots.
"""

import functools
import math
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float32

from xew.metrics.metric import AnyArray, ByFrame, Scalar, Tracks, Valid, check_first, check_tracks

PointValues: TypeAlias = Float32[jax.Array, "t k"]
Known: TypeAlias = tuple[jax.Array, jax.Array, jax.Array]
"""Arrays that `_path_cost` carries on: the cells diagonal to the next ones [t], the last ones [t], and the cost so far."""

TAPVID_SIDE = 256.0
"""Side [pixels] of the square images that TAP-Vid's tolerances are stated for."""
TOLERANCES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Tolerances [pixels of TAPVID_SIDE] that `pck_strict` is the mean of, TAP-Vid's (C. Doersch et al., NeurIPS 2022)."""
FAILURE = 50.0
"""Distance [pixels of TAPVID_SIDE] from which on a point counts as lost: the failure of PointOdyssey's survival rate
(Y. Zheng et al., ICCV 2023), which CoTracker's evaluation uses too."""
SIDE = math.sqrt(320 * 240)
"""Side [pixels] of the square with the area of an episode's image."""


@check_first(check_tracks)
@jax.jit
def pck(prediction: Tracks, target: Tracks, valid: Valid, alpha: float | jax.Array = 0.1) -> Scalar:
    """Percentage of correct keypoints: the share in [0, 1] that lie nearer than alpha x d_t, higher is better.

    d_t is the diagonal of the bounding box of the frame's valid target points (the paper's definition). A frame whose
    box has no extent sets no scale and is left out.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        alpha: the paper's tables use 0.1, its evaluator also 0.05.

    Returns:
        Scalar float32; NaN where no point counts.
    """
    return _masked_mean(*hits(prediction, target, valid, alpha))


@check_first(check_tracks)
@jax.jit
def pck_05(prediction: Tracks, target: Tracks, valid: Valid) -> Scalar:
    """`pck` of tracks [t k 2] at alpha = 0.05, the second tolerance of the paper's evaluator: scalar float32."""
    return pck(prediction, target, valid, alpha=0.05)


@check_first(check_tracks)
@jax.jit
def coverage(prediction: Tracks, target: Tracks, valid: Valid) -> Scalar:
    """Share in [0, 1] of the valid points that the prediction has, higher is better; reported with every error.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.

    Returns:
        Scalar float32; NaN where no point is valid.
    """
    return _masked_mean(*presence(prediction, target, valid))


@check_first(check_tracks)
@jax.jit
def keypoint_error(prediction: Tracks, target: Tracks, valid: Valid) -> Scalar:
    """Mean distance [pixels] over the valid points that the prediction has, lower is better.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.

    Returns:
        Scalar float32; NaN where there is no such point.
    """
    return _masked_mean(*distances(prediction, target, valid))


@check_first(check_tracks)
@jax.jit
def trajectory_error(prediction: Tracks, target: Tracks, valid: Valid) -> Scalar:
    """Distance [pixels] of tracked objects, mean over each object's valid frames, then over objects; lower is better.

    Args:
        prediction, target: [t o 2] pixels. valid: [t o] bool.

    Returns:
        Scalar float32; NaN where no object is ever valid.
    """
    distance, tracked = distances(prediction, target, valid)
    return _masked_mean(_masked_mean(distance, tracked, axis=0), jnp.any(tracked, axis=0))


@check_first(check_tracks)
@jax.jit
def ndtw(prediction: Tracks, target: Tracks, valid: Valid) -> Scalar:
    """Normalized dynamic time warping of each keypoint's path, mean over keypoints; lower is better, 0 is best.

    Classic DTW with Euclidean cost, over the frames in which the point is valid and found, divided by the sum of the two
    lengths and by the mean over those frames of the diagonal d_t of `pck` (the paper's definition).

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.

    Returns:
        Scalar float32; NaN where no keypoint has a path with a scale.
    """
    return _masked_mean(*warpings(prediction, target, valid))


@check_first(check_tracks)
@jax.jit
def pck_strict(prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE) -> Scalar:
    """Share in [0, 1] of the valid points nearer than a tolerance of the image, mean over `TOLERANCES`; higher is better.

    TAP-Vid's average position accuracy: points that are visible in the target count whether or not the prediction has them.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        side: square root of the image's area [pixels].

    Returns:
        Scalar float32; NaN where no point is valid.
    """
    return _masked_mean(*strict_hits(prediction, target, valid, side))


@check_first(check_tracks)
@jax.jit
def keypoint_error_strict(prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE) -> Scalar:
    """Mean distance [pixels] over the valid points; a lost point has the distance of failure, and none has more.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        side: square root of the image's area [pixels].

    Returns:
        Scalar float32 from 0 to `failure_distance(side)`; NaN where no point is valid.
    """
    return _masked_mean(*strict_distances(prediction, target, valid, side))


@check_first(check_tracks)
@jax.jit
def trajectory_error_strict(prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE) -> Scalar:
    """`keypoint_error_strict` of points on objects [t k 2], mean over frames and points; scalar float32, lower is better."""
    return keypoint_error_strict(prediction, target, valid, side)


@check_first(check_tracks)
@jax.jit
def ndtw_strict(prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE) -> Scalar:
    """Dynamic time warping of each point's path over its valid frames, mean over points; lower is better, 0 is best.

    Classic DTW with the error of `keypoint_error_strict` as cost, divided by the sum of both lengths and the distance of
    failure.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        side: square root of the image's area [pixels].

    Returns:
        Scalar float32 in [0, 0.5], 0.5 for points that are always lost; NaN where no point is valid.
    """
    return _masked_mean(*strict_warpings(prediction, target, valid, side))


def failure_distance(side: float | jax.Array = SIDE) -> float | jax.Array:
    """The error [...] [pixels] of a lost point in an image with the area of a square of this side [...] [pixels]."""
    return FAILURE / TAPVID_SIDE * side


@check_first(check_tracks)
@jax.jit
def hits(prediction: Tracks, target: Tracks, valid: Valid, alpha: float | jax.Array = 0.1) -> tuple[PointValues, Valid]:
    """What `pck` of tracks [t k 2] is the mean of: [t k] float32, 1 where one is near enough, and [t k] bool, which count."""
    diagonal = box_diagonal(target, valid)
    correct = _distance(prediction, target) < alpha * diagonal[:, None]
    return _break(correct.astype(jnp.float32), valid & (diagonal > 0)[:, None], target, valid)


@check_first(check_tracks)
@jax.jit
def presence(prediction: Tracks, target: Tracks, valid: Valid) -> tuple[PointValues, Valid]:
    """What `coverage` of tracks [t k 2] is the mean of: [t k] float32, 1 where one was found, and [t k] bool, which count."""
    return _break(_is_found(prediction).astype(jnp.float32), valid, target, valid)


@check_first(check_tracks)
@jax.jit
def distances(prediction: Tracks, target: Tracks, valid: Valid) -> tuple[PointValues, Valid]:
    """What errors of tracks [t k 2] are means of: [t k] float32 pixels, infinite where lost, and [t k] bool, which count."""
    return _break(_distance(prediction, target), valid & _is_found(prediction), target, valid)


@check_first(check_tracks)
@jax.jit
def warpings(prediction: Tracks, target: Tracks, valid: Valid) -> tuple[Float32[jax.Array, " k"], Bool[jax.Array, " k"]]:
    """What `ndtw` of tracks [t k 2] is the mean of: [k] float32, and [k] bool, which count."""
    tracked = valid & _is_found(prediction)
    diagonal = jnp.broadcast_to(box_diagonal(target, valid)[:, None], valid.shape)
    scale = _masked_mean(diagonal, tracked, axis=0)
    length = jnp.sum(tracked, axis=0)
    cost = _path_costs(prediction, target, tracked)
    counts = (length > 0) & (scale > 0)
    return _break(cost / jnp.where(counts, 2 * length.astype(jnp.float32) * scale, 1), counts, target, valid)


@check_first(check_tracks)
@jax.jit
def strict_hits(prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE) -> tuple[PointValues, Valid]:
    """What `pck_strict` of tracks [t k 2] is the mean of: [t k] float32, share of the tolerances met, and [t k] bool."""
    tolerances = jnp.asarray(TOLERANCES, jnp.float32) / TAPVID_SIDE * side
    near = _distance(prediction, target)[..., None] < tolerances.reshape(1, 1, -1)
    return _break(jnp.mean(near.astype(jnp.float32), axis=-1), valid, target, valid)


@check_first(check_tracks)
@jax.jit
def strict_distances(
    prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE
) -> tuple[PointValues, Valid]:
    """What strict errors of tracks [t k 2] are means of: [t k] float32 pixels, never above failure, and [t k] bool."""
    failure = jnp.asarray(failure_distance(side), jnp.float32)
    return _break(jnp.minimum(_distance(prediction, target), failure), valid, target, valid)


@check_first(check_tracks)
@jax.jit
def strict_warpings(
    prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE
) -> tuple[Float32[jax.Array, " k"], Bool[jax.Array, " k"]]:
    """What `ndtw_strict` of tracks [t k 2] is the mean of: [k] float32, and [k] bool, which count."""
    failure = jnp.asarray(failure_distance(side), jnp.float32)
    length = jnp.sum(valid, axis=0)
    cost = _path_costs(prediction, target, valid, failure)
    return _break(cost / (2 * jnp.maximum(length, 1).astype(jnp.float32) * failure), length > 0, target, valid)


def _break(values: jax.Array, counts: AnyArray, target: Tracks, valid: Valid) -> tuple[jax.Array, jax.Array]:
    """Values and which count, [t k] or [k], where a valid point of the target [t k 2] is not known: NaN, which counts."""
    broken = valid & ~_is_found(target)
    broken = broken if values.ndim == 2 else jnp.any(broken, axis=0)
    return jnp.where(broken, jnp.nan, values), jnp.logical_or(counts, broken)


def box_diagonal(points: Tracks, valid: Valid) -> ByFrame:
    """[t] float32, diagonal [pixels] of the bounding box of each frame's valid points; 0 where there is none.

    Args:
        points: [t k 2] pixels. valid: [t k] bool.
    """
    points = _in_float32(points)
    low = jnp.min(jnp.where(valid[..., None], points, jnp.inf), axis=1, initial=jnp.inf)
    high = jnp.max(jnp.where(valid[..., None], points, -jnp.inf), axis=1, initial=-jnp.inf)
    extent = jnp.where(jnp.any(valid, axis=1)[:, None], high - low, 0)
    return _norm(extent)


def _path_costs(prediction: AnyArray, target: AnyArray, tracked: AnyArray, most: float | jax.Array = math.inf) -> jax.Array:
    """`_path_cost` [k] of each of k paths [t k 2]; 0 where there is no frame."""
    if 0 in tracked.shape:
        return jnp.zeros(tracked.shape[1], jnp.float32)
    return jax.vmap(functools.partial(_path_cost, most=most), in_axes=1)(prediction, target, tracked)


def _path_cost(prediction: AnyArray, target: AnyArray, tracked: AnyArray, most: float | jax.Array = math.inf) -> jax.Array:
    """DTW cost of two paths [t 2] over the tracked frames; a step costs at most `most`, and a lost place costs `most`.

    Tracked frames come first, so the cost is the cell (n - 1, n - 1) of the table, which no later frame touches. Cells of an
    anti-diagonal do not depend on each other.
    """
    order = jnp.argsort(~tracked, stable=True)
    keep = tracked[order][:, None]
    a, b = (jnp.where(keep, _in_float32(path)[order], 0) for path in (prediction, target))
    has_place = _is_found(a)
    a = jnp.where(has_place[:, None], a, 0)
    t = len(a)
    rows, end = jnp.arange(t), jnp.maximum(jnp.sum(tracked) - 1, 0)
    x, y = a.T

    def fill(known: Known, d: jax.Array) -> tuple[Known, None]:
        diagonal, last, total = known
        facing_x, facing_y = b[jnp.clip(d - rows, 0, t - 1)].T
        cost = jnp.where(has_place, jnp.minimum(_root(jnp.square(x - facing_x) + jnp.square(y - facing_y)), most), most)
        up = jnp.concatenate([jnp.full(1, jnp.inf, jnp.float32), last[:-1]])
        cells = cost + jnp.where(d == 0, 0, jnp.minimum(jnp.minimum(up, last), diagonal))
        cells = jnp.where((rows <= d) & (rows > d - t), cells, jnp.inf)
        # Not taken from a table of all cells: for 300 frames of 80 points it has 60 MB, which take time to fill.
        return (up, cells, jnp.where(d == 2 * end, cells[end], total)), None

    # Infinity that is made of the data lies where the data lie, as shard_map wants it of what a scan carries.
    nothing = lax.stop_gradient(jnp.maximum(jnp.where(has_place, jnp.minimum(_norm(a - b), most), most), jnp.inf))
    (_, _, total), _ = lax.scan(fill, (nothing, nothing, nothing[0]), jnp.arange(2 * t - 1))
    return total


def _distance(prediction: AnyArray, target: AnyArray) -> jax.Array:
    """[t k] Euclidean distance; infinite where the prediction has no point."""
    has_place = _is_found(prediction)
    prediction, target = _in_float32(prediction), _in_float32(target)
    return jnp.where(has_place, _norm(jnp.where(has_place[..., None], prediction, target) - target), jnp.inf)


def _is_found(points: AnyArray) -> jax.Array:
    return jnp.all(jnp.isfinite(points), axis=-1)


def _in_float32(points: AnyArray) -> jax.Array:
    """Points [...] to compute with: bfloat16 has 8 bits, which is a pixel in a width of 256."""
    return jnp.asarray(points, jnp.float32)


def _norm(vector: jax.Array) -> jax.Array:
    """Length along the last axis, with gradient 0 instead of NaN at zero."""
    return _root(jnp.sum(jnp.square(vector), axis=-1))


def _root(square: jax.Array) -> jax.Array:
    """Square root [...], with gradient 0 instead of NaN at zero."""
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0).astype(jnp.float32)


def _masked_mean(values: jax.Array, keep: AnyArray, axis: int | None = None) -> jax.Array:
    return jnp.sum(jnp.where(keep, values, 0), axis=axis) / jnp.sum(keep, axis=axis).astype(jnp.float32)

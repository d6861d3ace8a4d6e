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
from jaxtyping import Bool, Float, Float32

from xew.metrics.metric import AnyArray, ByFrame, Scalar, Tracks, Valid, check_first, check_tracks

PointValues: TypeAlias = Float32[jax.Array, "t k"]
PathValues: TypeAlias = Float32[jax.Array, " k"]
Diagonals: TypeAlias = Float[AnyArray, " t"]
"""Diagonal [pixels] of a box in each frame."""
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
LARGEST = math.hypot(320, 240)
"""Diagonal [pixels] of an episode's image: no two points in it are farther apart."""
PATHS_AT_ONCE = 32
"""Number of paths that are warped at once on a CPU. XLA divides the steps of more among all cores, which takes longer than the
steps themselves."""


@check_first(check_tracks)
@jax.jit
def pck(
    prediction: Tracks,
    target: Tracks,
    valid: Valid,
    alpha: float | jax.Array = 0.1,
    diagonal: Diagonals | None = None,
) -> Scalar:
    """Percentage of correct keypoints: the share in [0, 1] that lie nearer than alpha x d_t, higher is better.

    d_t is the diagonal of the bounding box of the frame's target points (the paper's definition). A frame whose box has no
    extent sets no scale and is left out.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        alpha: the paper's tables use 0.1, its evaluator also 0.05.
        diagonal: d_t [t] pixels; by default of the valid points. `evaluate` gives that of all origins inside the image.

    Returns:
        Scalar float32; NaN where no point counts.
    """
    return _masked_mean(*hits(prediction, target, valid, alpha, diagonal))


@check_first(check_tracks)
@jax.jit
def pck_05(prediction: Tracks, target: Tracks, valid: Valid, diagonal: Diagonals | None = None) -> Scalar:
    """`pck` of tracks [t k 2] at alpha = 0.05, the second tolerance of the paper's evaluator: scalar float32."""
    return pck(prediction, target, valid, alpha=0.05, diagonal=diagonal)


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
def keypoint_error(prediction: Tracks, target: Tracks, valid: Valid, largest: float | jax.Array = LARGEST) -> Scalar:
    """Mean distance [pixels] over the valid points that the prediction has, lower is better.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        largest: the image's diagonal [pixels], the most that a distance counts, so one wild point does not outweigh the rest.

    Returns:
        Scalar float32 from 0 to `largest`; NaN where there is no such point.
    """
    return _masked_mean(*distances(prediction, target, valid, largest))


@check_first(check_tracks)
@jax.jit
def trajectory_error(prediction: Tracks, target: Tracks, valid: Valid, largest: float | jax.Array = LARGEST) -> Scalar:
    """Distance [pixels] of tracked objects, mean over each object's valid frames, then over objects; lower is better.

    Args:
        prediction, target: [t o 2] pixels. valid: [t o] bool.
        largest: the image's diagonal [pixels], the most that a distance counts.

    Returns:
        Scalar float32 from 0 to `largest`; NaN where no object is ever valid.
    """
    distance, tracked = distances(prediction, target, valid, largest)
    return _masked_mean(_masked_mean(distance, tracked, axis=0), jnp.any(tracked, axis=0))


@check_first(check_tracks)
@jax.jit
def ndtw(prediction: Tracks, target: Tracks, valid: Valid, diagonal: Diagonals | None = None) -> Scalar:
    """Normalized dynamic time warping of each keypoint's path, mean over keypoints; lower is better, 0 is best.

    Classic DTW with Euclidean cost over a point's valid frames, divided by the sum of the two lengths and by the mean diagonal
    (the paper's definition): the mean over the video's frames of d_t of `pck`, where it has an extent. It depends on the
    target alone. A step costs at most this diagonal, and a lost place costs as much, so no path has more than 0.5.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        diagonal: d_t [t] pixels as in `pck`.

    Returns:
        Scalar float32 in [0, 0.5]; NaN where no point is valid, or no frame has a diagonal.
    """
    return _masked_mean(*warpings(prediction, target, valid, diagonal))


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
def found_error(prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE) -> Scalar:
    """Mean distance [pixels] of the valid points that the prediction has, at most that of failure; lower is better.

    It says where points are, and `coverage` whether they are: `keypoint_error_strict` joins both in one number.

    Args:
        prediction, target: [t k 2] pixels. valid: [t k] bool.
        side: square root of the image's area [pixels].

    Returns:
        Scalar float32 from 0 to `failure_distance(side)`; NaN where no valid point was found.
    """
    return _masked_mean(*found_distances(prediction, target, valid, side))


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
def hits(
    prediction: Tracks,
    target: Tracks,
    valid: Valid,
    alpha: float | jax.Array = 0.1,
    diagonal: Diagonals | None = None,
) -> tuple[PointValues, Valid]:
    """What `pck` of tracks [t k 2] is the mean of: [t k] float32, 1 where one is near enough, and [t k] bool, which count."""
    diagonal = box_diagonal(target, valid) if diagonal is None else jnp.asarray(diagonal)
    correct = _distance(prediction, target) < alpha * diagonal[:, None]
    return break_unknown(correct.astype(jnp.float32), valid & (diagonal > 0)[:, None], target, valid)


@check_first(check_tracks)
@jax.jit
def presence(prediction: Tracks, target: Tracks, valid: Valid) -> tuple[PointValues, Valid]:
    """What `coverage` of tracks [t k 2] is the mean of: [t k] float32, 1 where one was found, and [t k] bool, which count."""
    return break_unknown(found_points(prediction).astype(jnp.float32), valid, target, valid)


@check_first(check_tracks)
@jax.jit
def distances(
    prediction: Tracks, target: Tracks, valid: Valid, largest: float | jax.Array = LARGEST
) -> tuple[PointValues, Valid]:
    """What errors of tracks [t k 2] are means of: [t k] float32 pixels, at most `largest`, and [t k] bool, which count."""
    capped = jnp.minimum(_distance(prediction, target), jnp.asarray(largest, jnp.float32))
    return break_unknown(capped, valid & found_points(prediction), target, valid)


@check_first(check_tracks)
@jax.jit
def warpings(
    prediction: Tracks, target: Tracks, valid: Valid, diagonal: Diagonals | None = None
) -> tuple[PathValues, Bool[jax.Array, " k"]]:
    """What `ndtw` of tracks [t k 2] is the mean of: [k] float32, and [k] bool, which count."""
    diagonal = box_diagonal(target, valid) if diagonal is None else jnp.asarray(diagonal)
    has_scale = jnp.any(diagonal > 0)
    most = jnp.where(has_scale, _masked_mean(diagonal, (diagonal > 0) | ~has_scale), 1)
    values, counts = _bounded_warpings(prediction, target, valid, most)
    return break_unknown(values, counts & has_scale, target, valid)


@check_first(check_tracks)
@jax.jit
def strict_hits(prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE) -> tuple[PointValues, Valid]:
    """What `pck_strict` of tracks [t k 2] is the mean of: [t k] float32, share of the tolerances met, and [t k] bool."""
    tolerances = jnp.asarray(TOLERANCES, jnp.float32) / TAPVID_SIDE * side
    near = _distance(prediction, target)[..., None] < tolerances.reshape(1, 1, -1)
    return break_unknown(jnp.mean(near.astype(jnp.float32), axis=-1), valid, target, valid)


@check_first(check_tracks)
@jax.jit
def strict_distances(
    prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE
) -> tuple[PointValues, Valid]:
    """What strict errors of tracks [t k 2] are means of: [t k] float32 pixels, never above failure, and [t k] bool."""
    failure = jnp.asarray(failure_distance(side), jnp.float32)
    return break_unknown(jnp.minimum(_distance(prediction, target), failure), valid, target, valid)


@check_first(check_tracks)
@jax.jit
def found_distances(
    prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE
) -> tuple[PointValues, Valid]:
    """What `found_error` of tracks [t k 2] is the mean of: [t k] float32 pixels, and [t k] bool, which count."""
    values, _ = strict_distances(prediction, target, valid, side)
    return break_unknown(values, valid & found_points(prediction), target, valid)


@check_first(check_tracks)
@jax.jit
def strict_warpings(
    prediction: Tracks, target: Tracks, valid: Valid, side: float | jax.Array = SIDE
) -> tuple[PathValues, Bool[jax.Array, " k"]]:
    """What `ndtw_strict` of tracks [t k 2] is the mean of: [k] float32, and [k] bool, which count."""
    values, counts = _bounded_warpings(prediction, target, valid, jnp.asarray(failure_distance(side), jnp.float32))
    return break_unknown(values, counts, target, valid)


def _bounded_warpings(prediction: AnyArray, target: AnyArray, valid: AnyArray, most: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Warping cost [k] of paths [t k 2] over their valid frames, divided by both lengths and the most that a step costs."""
    length = jnp.sum(valid, axis=0)
    cost = _path_costs(prediction, target, valid, most)
    return cost / (2 * jnp.maximum(length, 1).astype(jnp.float32) * most), length > 0


def break_unknown(values: jax.Array, counts: AnyArray, target: AnyArray, valid: AnyArray) -> tuple[jax.Array, jax.Array]:
    """Values and which count, [t k] or [k], where a valid point of the target [t k 2] is not known: NaN, which counts."""
    broken = valid & ~found_points(target)
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


def _path_costs(prediction: AnyArray, target: AnyArray, tracked: AnyArray, most: jax.Array) -> jax.Array:
    """`_path_cost` [k] of each of k paths [t k 2]; 0 where there is no frame."""
    if 0 in tracked.shape:
        return jnp.zeros(tracked.shape[1], jnp.float32)
    paths = tuple(jnp.moveaxis(array, 1, 0) for array in (prediction, target, tracked))
    device = jax.config.jax_default_device or jax.devices()[0]  # type: ignore[attr-defined]
    on_cpu = getattr(device, "platform", device) == "cpu"
    return lax.map(functools.partial(_path_cost, most=most), paths, batch_size=PATHS_AT_ONCE if on_cpu else len(paths[0]))


def _path_cost(paths: tuple[AnyArray, AnyArray, AnyArray], most: jax.Array) -> jax.Array:
    """DTW cost of two paths [t 2] over the tracked frames; a step costs at most `most`, and a lost place costs `most`.

    Tracked frames come first, so the cost is the cell (n - 1, n - 1) of the table, which no later frame touches. Cells of an
    anti-diagonal do not depend on each other.
    """
    prediction, target, tracked = paths
    order = jnp.argsort(~tracked, stable=True)
    keep = tracked[order][:, None]
    a, b = (jnp.where(keep, _in_float32(path)[order], 0) for path in (prediction, target))
    has_place = found_points(a)
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
    has_place = found_points(prediction)
    prediction, target = _in_float32(prediction), _in_float32(target)
    return jnp.where(has_place, _norm(jnp.where(has_place[..., None], prediction, target) - target), jnp.inf)


def found_points(points: AnyArray) -> jax.Array:
    """[t k] bool, which points [t k 2] have a place."""
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

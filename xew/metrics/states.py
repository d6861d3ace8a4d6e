"""Metrics by parts: states that are made of parts of a video and merged, so that no split and no order changes a number.

    ssim = STATES["ssim"]
    state = ssim.init()
    for prediction, target in parts:
        state = ssim.update(state, prediction, target)
    ssim.compute(state)                    # what the whole video gives

A state is a tree of integers; sums of floats are exact, so `merge` is associative and commutative to the last bit. Any split
into batches, any number of hosts and any order give the same bits, as long as a frame's own value does not depend on the
batch that it is computed in. On a CPU it does not; on a GPU, convolutions of other batch sizes may round a frame's LPIPS
otherwise in its last digit. All functions are pure and work under jit; `lax.scan` can carry a state.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from xew.metrics.image import attainable_psnr, finite_psnr, mean_squared_error, ssim
from xew.metrics.mask import boundary_f1, mask_iou
from xew.metrics.metric import check_tracks, check_videos
from xew.metrics.perceptual import lpips, region_lpips_frames
from xew.metrics.track import distances, hits, presence, warpings

BITS, LIMBS = 16, 20
"""Of an exact sum: 320 bits, of which one float32 needs 277 and the rest is room for more values than can be counted."""
LOWEST = -149
"""The smallest float32 above zero is two to this power."""
BLOCK = 4096
"""Values that are added up before carrying: each is under 2^17 in any one limb, which int32 holds so often."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mean:
    """Of finite float32 values: their exact sum and their number."""

    total: jax.Array
    """[... 20] int32, the sum in units of 2^-149: 16 bits each from the lowest, the last with the sign."""
    count: jax.Array
    """[...] int32."""

    @property
    def value(self) -> jax.Array:
        """[...] float32, within 5e-7 of the true mean relative to it; NaN where nothing was counted."""
        return _as_float(self.total) / self.count.astype(jnp.float32)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CappedMean:
    """Of PSNR: exact frames count as the largest finite value, which is not known before all parts are there."""

    finite: Mean
    exact: jax.Array
    """int32, number of exact frames."""
    largest: jax.Array
    """float32, of the finite values; -inf where there is none."""
    attainable: jax.Array
    """float32, what exact frames count as where no frame is inexact."""

    @property
    def value(self) -> jax.Array:
        """float32, as the mean of `psnr` over all frames of the video."""
        cap = jnp.where(self.finite.count > 0, self.largest, self.attainable)
        finite = jnp.where(self.finite.count > 0, _as_float(self.finite.total), 0)
        return (finite + jnp.where(self.exact > 0, self.exact * cap, 0)) / (self.finite.count + self.exact)


@dataclass(frozen=True)
class Mergeable:
    """The four functions of one metric's states."""

    init: Callable[..., Any]
    """() -> state of nothing; of metrics by object (number of objects)."""
    update: Callable[..., Any]
    """(state, *what the metric function takes, **its options) -> state."""
    merge: Callable[[Any, Any], Any]
    compute: Callable[[Any], jax.Array]
    """state -> scalar float32; NaN where nothing was counted."""


def empty_mean(shape: tuple[int, ...] = ()) -> Mean:
    """Of no values, or of a shape of means."""
    return Mean(jnp.zeros((*shape, LIMBS), jnp.int32), jnp.zeros(shape, jnp.int32))


@jax.jit
def mean_of(values: jax.Array, keep: jax.Array | bool = True) -> Mean:
    """The mean along the first axis of the kept values [n ...]. What is not finite is not counted; `count` tells."""
    keep = jnp.isfinite(values) & keep
    limbs = jnp.where(keep[..., None], _limbs(values.astype(jnp.float32)), 0)
    block = max(1, min(BLOCK, len(limbs)))
    filled = jnp.pad(limbs, ((0, -len(limbs) % block), *[(0, 0)] * (limbs.ndim - 1)))
    sums = _carried(jnp.sum(filled.reshape(-1, block, *limbs.shape[1:]), axis=1))
    return Mean(_carried(jnp.sum(sums, axis=0)), jnp.sum(keep, axis=0, dtype=jnp.int32))


@jax.jit
def merge_means(a: Mean, b: Mean) -> Mean:
    return Mean(_carried(a.total + b.total), a.count + b.count)


def _limbs(values: jax.Array) -> jax.Array:
    """float32 [...] as an integer multiple of 2^-149 in LIMBS parts of BITS bits [... 20], each of the value's sign."""
    bits = lax.bitcast_convert_type(values, jnp.int32)
    exponent = (bits >> 23) & 0xFF
    mantissa = (bits & 0x7FFFFF) | jnp.where(exponent > 0, 1 << 23, 0)
    place = jnp.maximum(exponent, 1) - 1
    first, shift = place // BITS, place % BITS
    low, high = (mantissa & 0xFFFF) << shift, (mantissa >> BITS) << shift
    parts = low & 0xFFFF, (low >> BITS) + (high & 0xFFFF), high >> BITS
    limbs = sum(jnp.where(np.arange(LIMBS) == (first + i)[..., None], part[..., None], 0) for i, part in enumerate(parts))
    return jnp.where(bits < 0, -1, 1)[..., None] * limbs


def _carried(limbs: jax.Array) -> jax.Array:
    """The same integer with all limbs but the last in [0, 2^16): one form for each number."""

    def step(carry: jax.Array, limb: jax.Array) -> tuple[jax.Array, jax.Array]:
        return (limb + carry) >> BITS, (limb + carry) & 0xFFFF

    carry, low = lax.scan(step, jnp.zeros_like(limbs[..., 0]), jnp.moveaxis(limbs[..., :-1], -1, 0))
    return jnp.concatenate([jnp.moveaxis(low, 0, -1), (limbs[..., -1] + carry)[..., None]], axis=-1)


@jax.jit
def _as_float(limbs: jax.Array) -> jax.Array:
    """float32 [...] of exact sums [... 20]."""
    negative = limbs[..., -1] < 0
    magnitude = _carried(jnp.where(negative[..., None], -limbs, limbs))
    with np.errstate(over="ignore"):
        units = np.ldexp(np.float32(1), LOWEST + BITS * np.arange(LIMBS)).astype(np.float32)
    total = jnp.sum(jnp.where(magnitude > 0, magnitude * units, 0), axis=-1)
    return jnp.where(negative, -total, total)


def _mean_over(values: Callable[..., tuple[jax.Array, jax.Array | None]]) -> Mergeable:
    """Of a metric that is the mean of values that some parts have: function of the inputs to values and which count."""

    def update(state: Mean, *inputs: jax.Array, **options: Any) -> Mean:
        found, counts = values(*inputs, **options)
        return merge_means(state, mean_of(found.reshape(-1), True if counts is None else counts.reshape(-1)))

    return Mergeable(empty_mean, update, merge_means, lambda state: state.value)


def _mean_over_frames(curve: Callable[..., jax.Array]) -> Mergeable:
    return _mean_over(lambda *inputs, **options: (curve(*inputs, **options), None))


def _update_psnr(state: CappedMean, prediction: jax.Array, target: jax.Array, *, chunk: int | None = None) -> CappedMean:
    check_videos(prediction, target)
    error = mean_squared_error(prediction, target, chunk)
    values = finite_psnr(error)
    return _merge_capped(
        state,
        CappedMean(
            finite=mean_of(values, error > 0),
            exact=jnp.sum(error == 0, dtype=jnp.int32),
            largest=jnp.max(jnp.where(error > 0, values, -jnp.inf)),
            attainable=attainable_psnr(np.shape(target)),
        ),
    )


def _merge_capped(a: CappedMean, b: CappedMean) -> CappedMean:
    return CappedMean(
        finite=merge_means(a.finite, b.finite),
        exact=a.exact + b.exact,
        largest=jnp.maximum(a.largest, b.largest),
        attainable=jnp.maximum(a.attainable, b.attainable),
    )


def _empty_capped() -> CappedMean:
    nothing = jnp.float32(-jnp.inf)
    return CappedMean(empty_mean(), jnp.int32(0), nothing, nothing)


def _update_objects(state: Mean, prediction: jax.Array, target: jax.Array, valid: jax.Array) -> Mean:
    check_tracks(prediction, target, valid)
    return merge_means(state, mean_of(*distances(prediction, target, valid)))


def _mean_over_objects(state: Mean) -> jax.Array:
    seen = state.count > 0
    return jnp.sum(jnp.where(seen, state.value, 0)) / jnp.sum(seen)


STATES = {
    "psnr": Mergeable(_empty_capped, _update_psnr, _merge_capped, lambda state: state.value),
    "ssim": _mean_over_frames(ssim),
    "lpips": _mean_over_frames(lpips),
    "mask_iou": _mean_over_frames(mask_iou),
    "boundary_f1": _mean_over_frames(boundary_f1),
    "region_lpips": _mean_over_frames(region_lpips_frames),
    "pck": _mean_over(hits),
    "pck_05": _mean_over(functools.partial(hits, alpha=0.05)),
    "keypoint_error": _mean_over(distances),
    "ndtw": _mean_over(warpings),
    "coverage": _mean_over(presence),
    "trajectory_error": Mergeable(lambda objects: empty_mean((objects,)), _update_objects, merge_means, _mean_over_objects),
    "object_coverage": _mean_over(presence),
}
"""By the names of METRICS. The parts are the frames of one video, with three remarks. `region_lpips` needs the box of the whole
video: `update(state, prediction, target, mask, box=union_box(all_masks))`. A path cannot be cut, so `ndtw` takes all frames
at once, and its state is the mean over keypoints of several such. States of several videos, merged, are means over all their
frames or points; for the mean over videos, each counting the same, give one number a video to MEAN."""

MEAN = _mean_over(lambda values: (values, None))
"""The mean of numbers [n], such as one score for each video. NaN, the score where no point is valid, is not counted."""

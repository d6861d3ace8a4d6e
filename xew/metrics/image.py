"""Visual quality without a network: PSNR and SSIM, one value a frame.

uint8 is computed with integers: sums of squares and window moments are exact, and results agree with a float64 reference to
about 1e-7. Floating input in [0, 1] is for use as a loss.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool

from xew.metrics.metric import ByFrame, Video, check_first, check_videos, map_frames

SSIM_WINDOW = 7
SSIM_C1, SSIM_C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2


@check_first(check_videos)
@functools.partial(jax.jit, static_argnames="chunk")
def psnr(prediction: Video, target: Video, *, chunk: int | None = None) -> ByFrame:
    """Peak signal-to-noise ratio of each frame [dB], higher is better.

    Exact frames have no finite PSNR. They are capped at the most that an inexact frame can attain, one channel of one pixel
    off by one level (101.76 dB at 320x240), so a frame's value does not depend on other frames. Report the mean with the count
    of `exact_frames`, because a cap can move it.

    Args:
        prediction, target: [t h w 3] uint8, or floating in [0, 1].
        chunk: most frames computed at once; by default 1 on a CPU, where that is fastest, and 64 elsewhere.

    Returns:
        [t] float32; NaN where a pixel of either frame is NaN.
    """
    error = mean_squared_error(prediction, target, chunk)
    attainable = 10 * jnp.log10(jnp.float32(255**2 * math.prod(np.shape(target)[1:])))
    return jnp.where(error == 0, attainable, -10 * jnp.log10(jnp.where(error == 0, 1, error) / 255**2))


@check_first(check_videos)
@jax.jit
def exact_frames(prediction: Video, target: Video) -> Bool[jax.Array, " t"]:
    """[t] bool, which frames equal the target in every pixel: those whose PSNR is a cap.

    Args:
        prediction, target: [t h w 3] uint8, or floating in [0, 1].
    """
    return jnp.all(prediction == target, axis=(1, 2, 3))


def mean_squared_error(prediction: Video, target: Video, chunk: int | None = None) -> ByFrame:
    """[t] float32, mean over a frame of two videos [t h w 3] of the squared difference in levels of 255; exact up to its last
    rounding."""
    return map_frames(lambda pair: _frame_error(*pair), (prediction, target), chunk)


def _frame_error(x: jax.Array, y: jax.Array) -> jax.Array:
    if x.dtype != jnp.uint8:
        return jnp.mean(jnp.square((x.astype(jnp.float32) - y.astype(jnp.float32)) * 255))
    difference = x.astype(jnp.int32) - y.astype(jnp.int32)
    rows = jnp.sum(difference * difference, axis=(1, 2))
    # A frame's sum passes 2^31. Its high and low parts do not, and both are integers that float32 holds.
    high, low = jnp.sum(rows >> 12), jnp.sum(rows & 4095)
    return (high.astype(jnp.float32) * 4096 + low.astype(jnp.float32)) / x.size


@check_first(check_videos, smallest_side=SSIM_WINDOW)
@functools.partial(jax.jit, static_argnames="chunk")
def ssim(prediction: Video, target: Video, *, chunk: int | None = None) -> ByFrame:
    """Structural similarity of each frame in [-1, 1], higher is better.

    The definition of scikit-image's `structural_similarity(channel_axis=-1, data_range=255)`: uniform 7x7 windows that
    lie inside the image, sample covariance, K1 = 0.01, K2 = 0.03, mean over windows and channels.

    Args:
        prediction, target: [t h w 3] uint8, or floating in [0, 1]; sides of at least 7 pixels.
        chunk: as in `psnr`.

    Returns:
        [t] float32; NaN where a pixel of either frame is NaN.

    Raises:
        ValueError: shapes differ or a side is under 7 pixels.
    """
    return map_frames(lambda pair: _frame_ssim(*pair), (prediction, target), chunk)


def _frame_ssim(x: jax.Array, y: jax.Array) -> jax.Array:
    """Of one frame [h w 3]. With S the sum over a window of n: n (Sxx + Syy) <= 312,250,050, so int32 is exact."""
    x, y, offset = _levels(x, y)
    n = SSIM_WINDOW**2
    sum_x, sum_y, squares, products = (_window_sum(image) for image in (x, y, x * x + y * y, x * y))
    spread = n * squares - sum_x * sum_x - sum_y * sum_y
    shared = n * products - sum_x * sum_y
    sum_x, sum_y = sum_x + n * offset, sum_y + n * offset
    # Of equal frames both ratios are of equal integers, treated alike: what lacks of 1 is exactly 0.
    samples = n * (n - 1)
    numerator = _stabilize(2 * sum_x * sum_y, n * n, SSIM_C1) * _stabilize(2 * shared, samples, SSIM_C2)
    denominator = _stabilize(sum_x * sum_x + sum_y * sum_y, n * n, SSIM_C1) * _stabilize(spread, samples, SSIM_C2)
    # One axis at a time: a single running float32 sum over 200,000 windows would lose the last three digits.
    return 1 - jnp.mean(jnp.mean(1 - numerator / denominator, axis=0))


def _stabilize(total: jax.Array, size: int, constant: float) -> jax.Array:
    return total.astype(jnp.float32) / size + constant


def _levels(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, int | float]:
    """Both as [h w*3] in levels of 255 less an offset: integers as they are, floats centered to keep their squares small."""
    x, y = (image.reshape(len(image), -1) for image in (x, y))
    if x.dtype == jnp.uint8:
        return x.astype(jnp.int32), y.astype(jnp.int32), 0
    return x.astype(jnp.float32) * 255 - 127.5, y.astype(jnp.float32) * 255 - 127.5, 127.5


def _window_sum(image: jax.Array) -> jax.Array:
    """Sums over all 7x7 windows inside an image [h w*3]; along a row the pixels of a channel are three apart.

    Channels side by side in one long row are almost three times as fast on a CPU as an axis of their own.
    """
    zero = np.zeros((), image.dtype)  # a constant, else JAX does not see that this is a sum and has no gradient
    for window, dilation in (((SSIM_WINDOW, 1), (1, 1)), ((1, SSIM_WINDOW), (1, 3))):
        image = lax.reduce_window(image, zero, lax.add, window, (1, 1), "valid", window_dilation=dilation)
    return image

"""Metrics, visual quality without a network: PSNR and SSIM. (prediction, target) -> one value a frame.

uint8 goes through integers: sums of squares and window moments are exact, so that flat bright images lose nothing to
float32 and results agree with a float64 reference to about 1e-7. Floating input in [0, 1] is for use as a loss.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from xew.metrics.metric import check_videos

SSIM_WINDOW = 7
SSIM_C1, SSIM_C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2


@jax.jit
def psnr(prediction: jax.Array, target: jax.Array) -> jax.Array:
    """Peak signal-to-noise ratio of each frame [dB], higher is better.

    Frames that are exact have no finite PSNR. As in the paper they are capped at the largest finite value among the
    frames of the same call (one video); where all are exact, at the most that any inexact frame of this size can have:
    one channel of one pixel off by one level (101.76 dB at 320x240).

    Args:
        prediction, target: [t h w 3] uint8, or floating in [0, 1].

    Returns:
        [t] float32.
    """
    check_videos(prediction, target)
    error = mean_squared_error(prediction, target)
    finite = -10 * jnp.log10(jnp.where(error > 0, error, 1) / 255**2)
    attainable = 10 * jnp.log10(jnp.float32(255**2) * target[0].size)
    largest = jnp.max(jnp.where(error > 0, finite, -jnp.inf))
    return jnp.where(error > 0, finite, jnp.where(jnp.isfinite(largest), largest, attainable))


def mean_squared_error(prediction: jax.Array, target: jax.Array) -> jax.Array:
    """[t] float32, mean over a frame of the squared difference in levels of 255; exact up to its last rounding."""
    if target.dtype != jnp.uint8:
        return jnp.mean(jnp.square((prediction - target) * 255), axis=(1, 2, 3), dtype=jnp.float32)
    difference = prediction.astype(jnp.int32) - target.astype(jnp.int32)
    rows = jnp.sum(difference * difference, axis=(2, 3))
    # A frame's sum passes 2^31. Its high and low parts do not, and both are integers that float32 holds.
    high, low = jnp.sum(rows >> 12, axis=1), jnp.sum(rows & 4095, axis=1)
    return (high.astype(jnp.float32) * 4096 + low.astype(jnp.float32)) / target[0].size


@functools.partial(jax.jit, static_argnames="chunk")
def ssim(prediction: jax.Array, target: jax.Array, *, chunk: int = 1) -> jax.Array:
    """Structural similarity of each frame in [-1, 1], higher is better.

    The definition of scikit-image's `structural_similarity(channel_axis=-1, data_range=255)`: uniform 7x7 windows that
    lie inside the image, sample covariance, K1 = 0.01, K2 = 0.03, mean over windows and channels.

    Args:
        prediction, target: [t h w 3] uint8, or floating in [0, 1]; sides of at least 7 pixels.
        chunk: frames computed at once; 1 is fastest on a CPU.

    Returns:
        [t] float32.

    Raises:
        ValueError: shapes differ or a side is under 7 pixels.
    """
    check_videos(prediction, target, smallest_side=SSIM_WINDOW)
    return lax.map(lambda pair: _frame_ssim(*pair), (prediction, target), batch_size=chunk)


def _frame_ssim(x: jax.Array, y: jax.Array) -> jax.Array:
    """Of one frame [h w 3]. With S the sum over a window of n: n Sxx - Sx^2 <= 156,125,025, so int32 is exact."""
    x, y, offset = _levels(x, y)
    n = SSIM_WINDOW**2
    sum_x, sum_y = _window_sum(x), _window_sum(y)
    spread = n * _window_sum(x * x) - sum_x * sum_x + n * _window_sum(y * y) - sum_y * sum_y
    shared = n * _window_sum(x * y) - sum_x * sum_y
    mean_x, mean_y = (total.astype(jnp.float32) / n + offset for total in (sum_x, sum_y))
    samples = n * (n - 1)
    numerator = (2 * mean_x * mean_y + SSIM_C1) * (2 * shared.astype(jnp.float32) / samples + SSIM_C2)
    denominator = (mean_x * mean_x + mean_y * mean_y + SSIM_C1) * (spread.astype(jnp.float32) / samples + SSIM_C2)
    # One axis at a time: a single running float32 sum over 200,000 windows would lose the last three digits.
    return jnp.mean(jnp.mean(jnp.mean(numerator / denominator, axis=1), axis=0))


def _levels(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, float]:
    """Both in levels of 255 less an offset: integers as they are, floats centred, which keeps their squares small."""
    if x.dtype == jnp.uint8:
        return x.astype(jnp.int32), y.astype(jnp.int32), 0.0
    return x.astype(jnp.float32) * 255 - 127.5, y.astype(jnp.float32) * 255 - 127.5, 127.5


def _window_sum(image: jax.Array) -> jax.Array:
    """Sums over all 7x7 windows inside an image [h w 3], rows first, then columns."""
    zero = np.zeros((), image.dtype)  # a constant, else JAX does not see that this is a sum and has no gradient
    for axis in (0, 1):
        window = tuple(SSIM_WINDOW if i == axis else 1 for i in range(3))
        image = lax.reduce_window(image, zero, lax.add, window, (1, 1, 1), "valid")
    return image

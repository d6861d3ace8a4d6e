"""Metrics, visual quality and morphology by a network: LPIPS (AlexNet, v0.1) on frames and on the robot's region.

R. Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018. Convolutions run at
HIGHEST precision: TF32, the default of some GPUs, changes the fourth digit.
"""

import functools
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from xew.metrics.alexnet import read_alexnet
from xew.metrics.metric import check_masks, check_videos

SMALLEST_SIDE = 31
"""Below it the second pooling has no window and the mean over nothing would be NaN."""

SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
SCALE = np.array([0.458, 0.448, 0.450], np.float32)
"""The input scaling of LPIPS, on RGB in [-1, 1]."""

CONVOLUTIONS = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))
"""Stride, zero padding, and whether a 3x3 pooling of stride 2 comes first. torchvision's AlexNet up to its fifth ReLU."""

Weights = Mapping[str, jax.Array]


def lpips(prediction: jax.Array, target: jax.Array, *, chunk: int | None = None) -> jax.Array:
    """Learned perceptual distance of each frame, 0 for equal frames, lower is better.

    Agrees with `lpips.LPIPS(net="alex", version="0.1")` to 1e-6.

    Args:
        prediction, target: [t h w 3] RGB, uint8, or floating in [0, 1]; sides of at least 31 pixels.
        chunk: frames computed at once; by default 1 on a CPU, where that is fastest, and 16 elsewhere.

    Returns:
        [t] float32.

    Raises:
        ValueError: shapes differ or a side is under 31 pixels.
        FileNotFoundError: the weights are not installed.
    """
    check_videos(prediction, target, SMALLEST_SIDE)
    region = tuple(jnp.int32(side) for side in (0, 0, *np.shape(target)[1:3]))
    return _region_distance(_weights(), prediction, target, region, _chunk(chunk))


def region_lpips(prediction: jax.Array, target: jax.Array, target_mask: jax.Array, *, chunk: int | None = None) -> jax.Array:
    """LPIPS inside the bounding box of the union over time of the target's robot masks, mean over frames.

    The box is one for the whole video, and is cut out before the network, as if the video were no larger. Under a jit of
    the caller's, where its size is not known beforehand, a box too small gives NaN in place of the error.

    Args:
        prediction, target: [t h w 3] RGB, uint8, or floating in [0, 1].
        target_mask: [t h w] bool.
        chunk: as in `lpips`.

    Returns:
        Scalar float32, lower is better.

    Raises:
        ValueError: shapes differ, no pixel is masked, or the box has a side under 31 pixels.
    """
    return jnp.mean(region_lpips_frames(prediction, target, target_mask, chunk=chunk))


def region_lpips_frames(
    prediction: jax.Array, target: jax.Array, target_mask: jax.Array, *, chunk: int | None = None
) -> jax.Array:
    """`region_lpips` before the mean over frames: [t] float32."""
    check_videos(prediction, target, SMALLEST_SIDE)
    check_masks(target_mask, jnp.zeros(np.shape(target)[:3], bool))
    region = union_box(target_mask)
    if not isinstance(region[2], jax.core.Tracer):
        height, width = int(region[2]), int(region[3])
        if min(height, width) < SMALLEST_SIDE:
            raise ValueError(
                f"the robot's box is {height} x {width} pixels; region LPIPS needs sides of at least {SMALLEST_SIDE}. "
                "Check that the masks belong to this video."
            )
    return _region_distance(_weights(), prediction, target, region, _chunk(chunk))


@jax.jit
def union_box(mask: jax.Array) -> tuple[jax.Array, ...]:
    """Bounding box (top, left, height, width) int32 [pixels] of all that [t h w] covers at any time; zeros if nothing."""
    covered = jnp.any(mask, axis=0)
    rows, columns = jnp.any(covered, axis=1), jnp.any(covered, axis=0)
    top, left = jnp.argmax(rows), jnp.argmax(columns)
    height = jnp.where(jnp.any(rows), len(rows) - jnp.argmax(rows[::-1]) - top, 0)
    width = jnp.where(jnp.any(columns), len(columns) - jnp.argmax(columns[::-1]) - left, 0)
    return top, left, height, width


def _weights() -> Weights:
    return {name: jnp.asarray(array) for name, array in read_alexnet().items()}


def _chunk(chunk: int | None) -> int:
    return chunk or (1 if jax.default_backend() == "cpu" else 16)


@functools.partial(jax.jit, static_argnames="chunk")
def _region_distance(
    weights: Weights, prediction: jax.Array, target: jax.Array, region: tuple[jax.Array, ...], chunk: int
) -> jax.Array:
    """LPIPS [t] of the region (top, left, height, width) of both videos.

    The size is data, not shape: one program serves the whole frame and every box. The region is moved to the upper left
    of a canvas of the frame's size, and what lies outside is set to zero before each layer, which is what a network on
    the small image pads with.
    """
    top, left, height, width = region

    def distance(pair: jax.Array) -> jax.Array:
        layers = _features(weights, pair, height, width)
        return jnp.sum(jnp.stack([_layer_distance(weights[f"head{i}"], *layer) for i, layer in enumerate(layers)]))

    def of_frames(frames: tuple[jax.Array, jax.Array]) -> jax.Array:
        pair = (_signed(jnp.stack(frames)) - SHIFT.reshape(1, 1, 1, 3)) / SCALE.reshape(1, 1, 1, 3)
        pair = _keep(jnp.roll(pair, -jnp.stack((top, left)), axis=(1, 2)), height, width)
        # Equal images are at distance 0, though the compiler may round the two halves of a pair differently.
        return lax.cond(jnp.all(pair[0] == pair[1]), lambda _: jnp.float32(0), distance, pair)

    return lax.map(of_frames, (prediction, target), batch_size=chunk if chunk > 1 else None)


def _signed(frames: jax.Array) -> jax.Array:
    """RGB in [-1, 1] float32."""
    unit = frames.astype(jnp.float32) / 255 if frames.dtype == jnp.uint8 else frames.astype(jnp.float32)
    return unit * 2 - 1


def _features(
    weights: Weights, pair: jax.Array, height: jax.Array, width: jax.Array
) -> list[tuple[jax.Array, jax.Array, jax.Array]]:
    """Five ReLU outputs [2 h w d] of two images [2 h w 3] that are zero beyond height x width, each with its valid size."""
    layers, x = [], pair
    for i, (stride, padding, pool_first) in enumerate(CONVOLUTIONS):
        if pool_first:
            x = lax.reduce_window(x, -jnp.inf, lax.max, (1, 3, 3, 1), (1, 2, 2, 1), "valid")
            height, width = (height - 3) // 2 + 1, (width - 3) // 2 + 1
            x = _keep(x, height, width)
        kernel = weights[f"conv{i}_kernel"]
        x = lax.conv_general_dilated(
            x,
            kernel,
            (stride, stride),
            [(padding, padding)] * 2,
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            precision=lax.Precision.HIGHEST,
        )
        height, width = ((side + 2 * padding - kernel.shape[0]) // stride + 1 for side in (height, width))
        x = _keep(jax.nn.relu(x + weights[f"conv{i}_bias"].reshape(1, 1, 1, -1)), height, width)
        layers.append((x, height, width))
    return layers


def _keep(x: jax.Array, height: jax.Array, width: jax.Array) -> jax.Array:
    """Zero outside the upper left height x width of [2 h w d]."""
    rows, columns = jnp.arange(x.shape[1]) < height, jnp.arange(x.shape[2]) < width
    return jnp.where((rows[:, None] & columns[None, :])[None, :, :, None], x, 0)


def _layer_distance(head: jax.Array, pair: jax.Array, height: jax.Array, width: jax.Array) -> jax.Array:
    """Squared difference of unit feature vectors [2 h w d], weighted by the head [d], mean over the valid part."""
    unit = _unit(pair)
    weighted = jnp.einsum("hwd,d->hw", jnp.square(unit[0] - unit[1]), head, precision=lax.Precision.HIGHEST)
    return jnp.sum(jnp.sum(weighted, axis=1)) / (height * width).astype(jnp.float32)


def _unit(x: jax.Array) -> jax.Array:
    """Feature vectors divided by their length + 1e-10, as LPIPS does it; gradient 0 where a vector is zero."""
    square = jnp.sum(jnp.square(x), axis=-1, keepdims=True)
    length = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    return x / (length + 1e-10)

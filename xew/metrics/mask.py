"""Robot morphology by masks: IoU and boundary F1, one value a frame.

Masks are packed, eight pixels of a column in a byte, and counted by population count. All counts are integers, so scores do not
depend on the machine. Each step is its own program: in one program XLA repeats the first steps for each use and counts without
vector instructions (three times the time on a CPU).
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from xew.metrics.metric import ByFrame, Masks, check_first, check_masks

BYTE = 8
SQUARE = (1, 1)
"""Shape of a pixel and its eight neighbors: half heights of the columns at distance 0 and 1."""


@check_first(check_masks)
def mask_iou(prediction: Masks, target: Masks) -> ByFrame:
    """Intersection over union of each frame in [0, 1], higher is better; it punishes missed and invented pixels alike.

    Args:
        prediction, target: [t h w] bool.

    Returns:
        [t] float32; 1 where both masks are empty, 0 where one is.
    """
    p, t = _pack(prediction), _pack(target)
    return _iou(p, t, p & t)


@check_first(check_masks)
def boundary_f1(prediction: Masks, target: Masks, tolerance: int | float = 2) -> ByFrame:
    """F1 of contour pixels matched within a tolerance, each frame in [0, 1], higher is better.

    Pinned, because each choice moves the value by up to 0.2: a contour pixel belongs to the mask and has one of its
    eight neighbors outside (the image's border is no contour); pixels match within a Euclidean disc. Precision is the
    matched share of the prediction's contour, recall that of the target's.

    Args:
        prediction, target: [t h w] bool.
        tolerance: radius of the disc [pixels], at least 0; a Python number, also under jit.

    Returns:
        [t] float32. Without any contour: 1 where the masks are equal, else 0. With a contour on one side only: 0.

    Raises:
        ValueError: shapes differ, or the tolerance is negative.
        TypeError: a mask is not bool.
    """
    p, t = _pack(prediction), _pack(target)
    return _f1(p, t, np.shape(target)[1], _disc(tolerance))


@jax.jit
def _pack(mask: jax.Array) -> jax.Array:
    """[t h w] bool to [t bytes w] uint8: pixel (x, y) is bit y % 8 of byte (x, y // 8); no pixel is beyond the height."""
    t, height, width = mask.shape
    rows = jnp.pad(mask, ((0, 0), (0, -height % BYTE), (0, 0))).reshape(t, -1, BYTE, width)
    places = jnp.arange(BYTE, dtype=jnp.uint8)[None, None, :, None]
    return jnp.sum(rows.astype(jnp.uint8) << places, axis=2, dtype=jnp.uint8)


@jax.jit
def _iou(p: jax.Array, t: jax.Array, both: jax.Array) -> jax.Array:
    intersection = _count(both)
    union = _count(p) + _count(t) - intersection
    return jnp.where(union > 0, intersection / jnp.maximum(union, 1), 1.0).astype(jnp.float32)


def _f1(p: jax.Array, t: jax.Array, height: int, disc: tuple[int, ...]) -> jax.Array:
    edges = _inner_edges(p, t, height=height)
    return _f1_of_pixels(*edges, *_match(*edges, disc=disc), p ^ t)


@jax.jit
def _f1_of_pixels(
    edge_p: jax.Array, edge_t: jax.Array, matched_p: jax.Array, matched_t: jax.Array, different: jax.Array
) -> jax.Array:
    count_p, count_t = _count(edge_p), _count(edge_t)
    precision, recall = _count(matched_p) / jnp.maximum(count_p, 1), _count(matched_t) / jnp.maximum(count_t, 1)
    total = precision + recall
    score = jnp.where(total > 0, 2 * precision * recall / jnp.where(total > 0, total, 1), 0.0)
    without_edges = (_count(different) == 0).astype(score.dtype)
    return jnp.where(count_p + count_t > 0, score, without_edges).astype(jnp.float32)


def _count(packed: jax.Array) -> jax.Array:
    """[t] int32, pixels of each packed mask."""
    per_column = jnp.sum(lax.population_count(packed), axis=1, dtype=jnp.uint16)
    return jnp.sum(per_column.astype(jnp.int32), axis=1)


@functools.partial(jax.jit, static_argnames="height")
def _inner_edges(*masks: jax.Array, height: int) -> list[jax.Array]:
    """Pixels of packed masks with an 8-neighbor outside. Beyond the image there is no outside."""
    image = np.packbits(np.arange(masks[0].shape[1] * BYTE) < height, bitorder="little")[None, :, None]
    return [mask & _grow(~mask & image, SQUARE) for mask in masks]


@functools.partial(jax.jit, static_argnames="disc")
def _match(edge_p: jax.Array, edge_t: jax.Array, disc: tuple[int, ...]) -> list[jax.Array]:
    """The pixels of each edge that lie within the disc of a pixel of the other."""
    return [edge_p & _grow(edge_t, disc), edge_t & _grow(edge_p, disc)]


def _disc(radius: int | float) -> tuple[int, ...]:
    if not radius >= 0:
        raise ValueError(f"the tolerance is {radius}, expected a radius of at least 0 pixels.")
    return tuple(math.isqrt(math.floor(radius * radius) - x * x) for x in range(math.floor(radius) + 1))


def _grow(packed: jax.Array, half_heights: tuple[int, ...]) -> jax.Array:
    """The union of a packed mask's shifts over a shape whose columns, at distances 0, 1, ..., have these half heights."""
    count, width = packed.shape[1:]
    reach, border = len(half_heights) - 1, half_heights[0] // BYTE + 1
    padded = jnp.pad(packed, ((0, 0), (border, border), (reach, reach)))

    def lift(y: int) -> jax.Array:
        """The mask y pixels up (or down, where y is negative)."""
        step, bits = divmod(y, BYTE)
        low, high = (padded[:, border + step + i : border + step + i + count] for i in (0, 1))
        return low if bits == 0 else (low >> bits) | (high << (BYTE - bits))

    grown, column, reached = jnp.zeros_like(packed), lift(0), 0
    for x in reversed(range(reach + 1)):  # from the shape's lowest column, at its rim, to its highest
        for y in range(reached + 1, half_heights[x] + 1):
            column = column | lift(y) | lift(-y)
        reached = half_heights[x]
        grown = grown | column[:, :, reach - x : reach - x + width] | column[:, :, reach + x : reach + x + width]
    return grown

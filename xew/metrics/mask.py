"""Metrics, robot morphology by masks: IoU and boundary F1. bool masks -> one value a frame."""

import functools

import jax
import jax.numpy as jnp

from xew.metrics.metric import check_masks


@jax.jit
def mask_iou(prediction: jax.Array, target: jax.Array) -> jax.Array:
    """Intersection over union of each frame in [0, 1], higher is better; it punishes missed and invented pixels alike.

    Args:
        prediction, target: [t h w] bool.

    Returns:
        [t] float32; 1 where both masks are empty.
    """
    check_masks(prediction, target)
    intersection = jnp.sum(prediction & target, axis=(1, 2))
    union = jnp.sum(prediction | target, axis=(1, 2))
    return jnp.where(union > 0, intersection / jnp.maximum(union, 1), 1.0).astype(jnp.float32)


@functools.partial(jax.jit, static_argnames="tolerance")
def boundary_f1(prediction: jax.Array, target: jax.Array, tolerance: float = 2) -> jax.Array:
    """F1 of contour pixels matched within a tolerance, each frame in [0, 1], higher is better.

    Pinned, because each choice moves the value by up to 0.2: a contour pixel belongs to the mask and has one of its
    eight neighbours outside (the image's border is no contour); pixels match within a Euclidean disc. Precision is the
    matched share of the prediction's contour, recall that of the target's.

    Args:
        prediction, target: [t h w] bool.
        tolerance: radius of the disc [pixels].

    Returns:
        [t] float32. Without any contour: 1 where the masks are equal, else 0. With a contour on one side only: 0.
    """
    check_masks(prediction, target)
    edge_p, edge_t = _inner_edge(prediction), _inner_edge(target)
    count_p, count_t = jnp.sum(edge_p, axis=(1, 2)), jnp.sum(edge_t, axis=(1, 2))
    precision = jnp.sum(edge_p & _dilate(edge_t, tolerance), axis=(1, 2)) / jnp.maximum(count_p, 1)
    recall = jnp.sum(edge_t & _dilate(edge_p, tolerance), axis=(1, 2)) / jnp.maximum(count_t, 1)
    total = precision + recall
    score = jnp.where(total > 0, 2 * precision * recall / jnp.where(total > 0, total, 1), 0.0)
    equal = jnp.all(prediction == target, axis=(1, 2)).astype(jnp.float32)
    return jnp.where(count_p + count_t > 0, score.astype(jnp.float32), equal)


def _inner_edge(mask: jax.Array) -> jax.Array:
    """Pixels of a mask with an 8-neighbour outside it; beyond the image the mask goes on as it ended."""
    height, width = mask.shape[1:]
    padded = jnp.pad(mask, ((0, 0), (1, 1), (1, 1)), mode="edge")
    rows = padded[:, :height] & padded[:, 1 : height + 1] & padded[:, 2:]
    return mask & ~(rows[:, :, :width] & rows[:, :, 1 : width + 1] & rows[:, :, 2:])


def _dilate(mask: jax.Array, radius: float) -> jax.Array:
    """Pixels within `radius` of a pixel of the mask: the union of the mask's shifts over a Euclidean disc."""
    height, width = mask.shape[1:]
    reach = int(radius)
    padded = jnp.pad(mask, ((0, 0), (reach, reach), (reach, reach)))
    shifts = range(-reach, reach + 1)
    disc = [(y, x) for y in shifts for x in shifts if y * y + x * x <= radius * radius]
    views = [padded[:, reach + y : reach + y + height, reach + x : reach + x + width] for y, x in disc]
    return functools.reduce(jnp.logical_or, views)

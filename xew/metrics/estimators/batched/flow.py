"""Dense optical flow of many pairs of images at once: OpenCV's dense inverse search as Warp kernels (flow_kernels.py).

Reads  gray images on a device, and which of them are pairs
Writes flow on the device
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from xew.metrics.estimators.batched import flow_kernels as kernels

PATCH = 8
"""Side of a patch [pixels]."""
Array = Any
"""Array of Warp, on a device."""


@dataclass(frozen=True)
class Search:
    """Settings of dense inverse search."""

    finest: int
    """Level of the pyramid that flow is computed at, 0 for the image itself; it is enlarged from there."""
    stride: int
    """Distance from patch to patch [pixels]."""
    steps: int
    """Most steps of descent of a patch, half of them on the way there and half on the way back."""


@dataclass(frozen=True)
class Level:
    """One level of a pyramid of images, with what the search needs of each."""

    packed: Array
    """[n h w] int32, pixels with their gradients."""
    tensor: Array
    """[n r c 3] float32, structure tensor of each patch."""
    sums: Array
    """[n r c 2] float32, sums of the gradients of each patch."""


@dataclass(frozen=True)
class Pyramid:
    """Images as the search reads them."""

    levels: dict[int, Level]
    """By level, from the finest."""
    shape: tuple[int, int]
    """Height and width of the images [pixels]."""
    search: Search


def coarsest_level(shape: tuple[int, int]) -> int:
    """The coarsest level of the pyramid of images of this height and width [pixels]."""
    return min(int(math.log2(max(shape) / (4 * PATCH)) + 0.5), int(math.log2(min(shape) // PATCH)))


def build_pyramid(gray: Array, search: Search) -> Pyramid:
    """The pyramid of gray images [n h w] uint8 on a device.

    Raises ValueError where they are too small for the search's finest level.
    """
    shape = (gray.shape[1], gray.shape[2])
    if min(shape) < PATCH or coarsest_level(shape) < search.finest:
        raise ValueError(f"images of {shape} are too small for flow at level {search.finest}.")
    device = gray.device
    levels = {}
    for index in range(1, coarsest_level(shape) + 1):
        half = wp.empty((gray.shape[0], gray.shape[1] // 2, gray.shape[2] // 2), dtype=wp.uint8, device=device)
        wp.launch(kernels.halve, half.shape, [gray], [half], device=device)
        gray = half
        if index >= search.finest:
            levels[index] = _prepare_level(gray, search)
    return Pyramid(levels, shape, search)


def _prepare_level(gray: Array, search: Search) -> Level:
    device = gray.device
    packed = wp.empty(gray.shape, dtype=int, device=device)
    wp.launch(kernels.pack_gradients, gray.shape, [gray], [packed], device=device)
    patches = (gray.shape[0], *(1 + (side - PATCH) // search.stride for side in gray.shape[1:]))
    tensor, sums = (wp.empty(patches, dtype=dtype, device=device) for dtype in (wp.vec3, wp.vec2))
    wp.launch(kernels.sum_gradients, patches, [packed, search.stride, PATCH], [tensor, sums], device=device)
    return Level(packed, tensor, sums)


def find_flow(pyramid: Pyramid, pairs: np.ndarray) -> Array:
    """[p h w 2] float32 [pixels], where each pixel of one image goes in another, on the pyramid's device.

    Args:
        pyramid: of n images.
        pairs: [p 2] int, the images that flow starts and ends at.
    """
    search, coarsest = pyramid.search, max(pyramid.levels)
    device = pyramid.levels[coarsest].packed.device
    pair = wp.array(pairs.astype(np.int32), dtype=wp.vec2i, device=device)
    height, width = pyramid.levels[coarsest].packed.shape[1:]
    flow = wp.zeros((len(pairs), height, width), dtype=wp.vec2, device=device)
    for index in range(coarsest, search.finest - 1, -1):
        level = pyramid.levels[index]
        patch_flow = wp.empty((len(pairs), *level.tensor.shape[1:]), dtype=wp.vec2, device=device)
        wp.launch(kernels.begin_patches, patch_flow.shape, [flow, search.stride], [patch_flow], device=device)
        _search_level(level, pair, patch_flow, search)
        inputs = [level.packed, pair, patch_flow, search.stride]
        wp.launch(kernels.spread_patches, flow.shape, inputs, [flow], device=device)
        finer = index - 1 if index > search.finest else 0
        shape = pyramid.levels[finer].packed.shape[1:] if finer in pyramid.levels else pyramid.shape
        larger = wp.empty((len(pairs), *shape), dtype=wp.vec2, device=device)
        wp.launch(kernels.enlarge_flow, larger.shape, [flow, float(2 ** (index - finer))], [larger], device=device)
        flow = larger
    return flow


def _search_level(level: Level, pair: Array, patch_flow: Array, search: Search) -> None:
    """Improve the patches' flow [p r c 2], there and back through each stripe."""
    count, rows, columns = patch_flow.shape
    thickness = -(-rows // int(kernels.STRIPES))
    for forward in (1, -1):
        for diagonal in range(columns + thickness - 1):
            settings = [search.stride, PATCH, diagonal, forward, search.steps // 2]
            inputs = [level.packed, pair, level.tensor, level.sums, *settings]
            wp.launch(kernels.search_diagonal, (count, rows), inputs, [patch_flow], device=patch_flow.device)

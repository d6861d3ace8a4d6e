"""Dense optical flow of many pairs of images at once: OpenCV's dense inverse search as Warp kernels (flow_kernels.py)."""

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from xew.metrics.estimators.batched import flow_kernels as kernels
from xew.metrics.estimators.batched import refinement_kernels as refinement

PATCH = 8
"""Side of a patch [pixels]."""
RELAXATIONS = 5
"""Number of steps of relaxation that solve the equations of a refinement."""
Array = Any
"""Array of Warp, on a device."""

THREADS = 64
"""Threads of a block: few, because a diagonal has few patches, and a GPU many processors."""
_launch = functools.partial(wp.launch, block_dim=THREADS)  # as all launches of the module, else it is compiled twice


@dataclass(frozen=True)
class Search:
    """Settings of dense inverse search."""

    finest: int
    """Level of the pyramid that flow is computed at, 0 for the image itself; it is enlarged from there."""
    stride: int
    """Distance from patch to patch [pixels]."""
    steps: int
    """Most steps of descent of a patch, half of them on the way there and half on the way back."""
    refinements: int = 0


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
    shape: tuple[int, int]
    """Height and width of the images [pixels]."""
    search: Search


def coarsest_level(shape: tuple[int, int]) -> int:
    """The coarsest level of the pyramid of images of this height and width [pixels]; -1 where they are smaller than a patch."""
    if min(shape) < PATCH:
        return -1
    return min(int(math.log2(max(shape) / (4 * PATCH)) + 0.5), int(math.log2(min(shape) // PATCH)))


def is_large_enough(shape: tuple[int, int], search: Search) -> bool:
    """Whether images of this height and width [pixels] reach the search's finest level; for smaller ones OpenCV has others."""
    return coarsest_level(shape) >= search.finest


def build_pyramid(gray: Array, search: Search) -> Pyramid:
    """The pyramid of gray images [n h w] uint8 on a device, which are large enough for the search."""
    shape = (gray.shape[1], gray.shape[2])
    device = gray.device
    levels = {}
    for index in range(search.finest, coarsest_level(shape) + 1):
        factor = 2**index if index == search.finest else 2
        small = wp.empty((gray.shape[0], *(side // factor for side in gray.shape[1:])), dtype=wp.uint8, device=device)
        _launch(kernels.shrink, small.shape, [gray], [small], device=device)
        gray = small
        levels[index] = _prepare_level(gray, search)
    return Pyramid(levels, shape, search)


def _prepare_level(gray: Array, search: Search) -> Level:
    device = gray.device
    packed = wp.empty(gray.shape, dtype=int, device=device)
    _launch(kernels.pack_gradients, gray.shape, [gray], [packed], device=device)
    patches = (gray.shape[0], *(1 + (side - PATCH) // search.stride for side in gray.shape[1:]))
    tensor, sums = (wp.empty(patches, dtype=dtype, device=device) for dtype in (wp.vec3, wp.vec2))
    _launch(kernels.sum_gradients, patches, [packed, search.stride, PATCH], [tensor, sums], device=device)
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
        _launch(kernels.begin_patches, patch_flow.shape, [flow, search.stride], [patch_flow], device=device)
        _search_level(level, pair, patch_flow, search)
        inputs = [level.packed, pair, patch_flow, search.stride]
        _launch(kernels.spread_patches, flow.shape, inputs, [flow], device=device)
        if search.refinements:
            flow = _refine(level, pair, flow, search.refinements)
        finer = index - 1 if index > search.finest else 0
        shape = pyramid.levels[finer].packed.shape[1:] if finer in pyramid.levels else pyramid.shape
        larger = wp.empty((len(pairs), *shape), dtype=wp.vec2, device=device)
        _launch(kernels.enlarge_flow, larger.shape, [flow, float(2 ** (index - finer))], [larger], device=device)
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
            _launch(kernels.search_diagonal, (count, rows), inputs, [patch_flow], device=patch_flow.device)


def _refine(level: Level, pair: Array, flow: Array, refinements: int) -> Array:
    """The flow [p h w 2] after some variational refinements."""
    device, shape = flow.device, flow.shape

    def launch(kernel: Any, inputs: list[Any], *dtypes: Any) -> list[Array]:
        outputs = [wp.empty(shape, dtype=dtype, device=device) for dtype in dtypes]
        wp.launch(kernel, shape, inputs, outputs, device=device)
        return outputs

    (blended,) = launch(refinement.blend, [level.packed, pair, flow], wp.vec2)
    slope_x, slope_y = launch(refinement.differentiate, [blended], wp.vec2, wp.vec2)
    slope_xx, slope_xy = launch(refinement.differentiate, [slope_x], wp.vec2, wp.vec2)
    _, slope_yy = launch(refinement.differentiate, [slope_y], wp.vec2, wp.vec2)
    slopes = [blended, slope_x, slope_y, slope_xy, slope_xx, slope_yy]
    change, changed = wp.zeros(shape, dtype=wp.vec2, device=device), flow
    for _ in range(refinements):
        (weight,) = launch(refinement.weigh_smoothness, [changed], float)
        matrix, side = launch(refinement.build_system, [*slopes, weight, flow, change], wp.vec3, wp.vec2)
        for step in range(2 * RELAXATIONS):
            wp.launch(refinement.relax, shape, [matrix, side, weight, step % 2], [change], device=device)
        (changed,) = launch(refinement.add_change, [flow, change], wp.vec2)
    return changed

"""Procedural images for surfaces: periodic, and the same bytes on every machine, by + - * / alone.

Letter of shapes: p pixels of a side.
"""

from collections.abc import Callable, Sequence

import numpy as np

from xew.sim_warp.geometry.meshes import Color

SIZE = 256
"""Side of an image [pixels]."""


def blend(share: np.ndarray, first: Color, second: Color) -> np.ndarray:
    """[p p 3] uint8, from the first color where the share [p p] is 0 to the second where it is 1."""
    share = np.clip(share, 0, 1)[..., None]
    return np.round((1 - share) * np.array(first) + share * np.array(second)).astype(np.uint8)


def noise(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    """[p p] smooth periodic noise from 0 to 1, with this number of knots in either direction."""
    values = rng.random((rows, columns))
    for axis, knots in enumerate((rows, columns)):
        at = np.arange(SIZE) * knots / SIZE
        low = at.astype(int)
        share = at - low
        share = (share * share * (3 - 2 * share)).reshape((-1, 1) if axis == 0 else (1, -1))
        values = (1 - share) * values.take(low, axis) + share * values.take((low + 1) % knots, axis)
    return values


def stripes(count: int) -> np.ndarray:
    """[p] int, 0 and 1 in turn, `count` pairs of equal stripes."""
    return np.arange(SIZE) * 2 * count // SIZE % 2


def joints(count: int, width: float) -> np.ndarray:
    """[p] float64, 1 on thin lines between `count` parts, 0 between them; `width` is a line's share of a part."""
    return (np.arange(SIZE) * count / SIZE % 1 < width).astype(float)


def plain(rng: np.random.Generator, colors: Sequence[Color]) -> np.ndarray:
    """One color: [p p 3] uint8."""
    return blend(np.zeros((SIZE, SIZE)), *colors)


def plaster(rng: np.random.Generator, colors: Sequence[Color]) -> np.ndarray:
    """Clouds of one color on another: [p p 3] uint8."""
    return blend(0.4 * noise(rng, 6, 6) + 0.3 * noise(rng, 24, 24), *colors)


def wood(rng: np.random.Generator, colors: Sequence[Color]) -> np.ndarray:
    """Four planks with their grain along x: [p p 3] uint8."""
    plank = np.arange(SIZE) * 4 // SIZE
    grain = 0.3 * noise(rng, 16, 2) + 0.2 * noise(rng, 64, 4) + 0.25 * rng.random(4)[plank][:, None]
    return blend(np.maximum(grain, joints(4, 0.04)[:, None]), *colors)


def cloth(rng: np.random.Generator, colors: Sequence[Color]) -> np.ndarray:
    """Gingham, stripes in both directions: [p p 3] uint8."""
    count = int(rng.integers(4, 8))
    return blend((stripes(count)[:, None] + stripes(count)) / 2, *colors)


def tiles(rng: np.random.Generator, colors: Sequence[Color]) -> np.ndarray:
    """Checkered tiles with joints: [p p 3] uint8."""
    checks = (stripes(2)[:, None] + stripes(2)) % 2 * 0.75
    return blend(np.maximum(checks, np.maximum(joints(4, 0.06)[:, None], joints(4, 0.06))), *colors)


def bricks(rng: np.random.Generator, colors: Sequence[Color]) -> np.ndarray:
    """Rows of bricks, every second one shifted by half a brick: [p p 3] uint8."""
    row = np.arange(SIZE) * 8 // SIZE
    upright = np.stack([joints(4, 0.08), np.roll(joints(4, 0.08), SIZE // 8)])[row % 2]
    return blend(np.maximum(np.maximum(joints(8, 0.12)[:, None], upright), 0.5 * noise(rng, 8, 8)), *colors)


Draw = Callable[[np.random.Generator, Sequence[Color]], np.ndarray]

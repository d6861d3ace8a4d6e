"""Paint: the same robot in other colors, which follow from its key and a number.

Each color of the robot becomes one that is drawn anew, wherever it stands; shapes, joints and motion stay as they are.
"""

import colorsys
import zlib
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from xew.sim_warp.geometry.meshes import Color, Mesh

COLORS = {
    "white": (228, 229, 231),
    "light": (186, 189, 194),
    "silver": (146, 150, 157),
    "slate": (92, 97, 106),
    "dark": (58, 60, 66),
    "black": (30, 31, 34),
}
"""Colors that most real arms have, sRGB."""


def draw_color(rng: np.random.Generator, plain: float = 0.6) -> Color:
    """A color of real arms with the probability `plain`, else any hue; sRGB."""
    if rng.random() < plain:
        return tuple(COLORS.values())[int(rng.integers(len(COLORS)))]
    hue, saturation, value = rng.uniform([0, 0.35, 0.3], [1, 0.95, 0.95])
    red, green, blue = (round(255 * channel) for channel in colorsys.hsv_to_rgb(hue, saturation, value))
    return red, green, blue


def paint_meshes(meshes: Iterable[Mesh], key: str, number: int) -> list[Mesh]:
    """The meshes of a robot's links in other colors.

    Args:
        meshes: all that are seen of the robot.
        key: of the robot without paint.
        number: of the paint, from 1.
    """
    meshes = list(meshes)
    rng = np.random.Generator(np.random.Philox(key=[zlib.crc32(key.encode()), number]))
    old = np.unique(np.concatenate([mesh.colors for mesh in meshes]), axis=0)
    new = np.array([draw_color(rng) for _ in old], np.uint8)
    places = {tuple(color): place for place, color in enumerate(old.tolist())}
    return [replace(mesh, colors=new[[places[tuple(color)] for color in mesh.colors.tolist()]]) for mesh in meshes]

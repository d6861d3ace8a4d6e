"""Colors of procedural bodies."""

import colorsys

import numpy as np

from xew.sim_warp.geometry.meshes import Color

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

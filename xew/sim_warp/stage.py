"""The static stage: table, wall, ground and lights, as plain data for scenes, physics and renderer.

Sizes and lights are RoboTwin 2.0's (`demo_clean`), in meters and the world frame. To add a light, add a line to LIGHTS.
"""

from dataclasses import dataclass

import numpy as np

from xew.sim_warp.geometry.meshes import Color, Mesh, box, merge

TABLE_TOP = 0.74
"""Height of the table's surface [m]."""
TABLE_SIZE = (1.2, 0.7, 0.05)
"""Full size of the table's plate [m]; its center is over the world's origin."""
LEG_SIZE = 0.05
LEG_XY = (0.55, 0.30)
"""Distances of the four legs from the table's center along x and y [m]."""
WALL_CENTER = (0.0, 1.0, 1.5)
WALL_SIZE = (6.0, 1.2, 3.0)
GROUND_SIZE = 12.0

TABLE_COLOR: Color = (255, 255, 255)
WALL_COLOR: Color = (255, 230, 230)
GROUND_COLOR: Color = (150, 150, 150)

AMBIENT = 0.5
"""Ambient light on surfaces that face up; see `SKY_SHARE`."""
SKY_SHARE = 0.35
"""Share of the ambient light from above, which surfaces facing down do not receive."""
EXPOSURE = 0.5
"""Factor from light to linear image value; the lit white table is 0.8."""
KNEE, CEILING = 0.7, 0.95
"""Linear image values: above the knee they are compressed below the ceiling."""
SPECULAR = 0.12
"""Strength of the highlight of all surfaces."""


@dataclass(frozen=True)
class Light:
    """A directional light or, where `position` is given, a point light that falls off with the squared distance."""

    intensity: float
    direction: tuple[float, float, float]
    """Direction in which it shines; for a point light the axis of its shadow map."""
    position: tuple[float, float, float] | None = None
    """Position in the world frame [m]; None makes the light directional."""
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear RGB."""


LIGHTS = (
    Light(0.5, (0.0, 0.5, -1.0)),
    Light(1.0, (-1.0, 0.0, -0.95), (1.0, 0.0, 1.8)),
    Light(1.0, (1.0, 0.0, -0.95), (-1.0, 0.0, 1.8)),
)
SKY = (1.0, 1.0, 1.0)
"""Linear color of the background."""
SHADOW_CENTER = (0.0, -0.1, 0.85)
"""Middle of the volume that the directional light's shadow map covers [m]."""
SHADOW_WIDTH = 1.8
"""Side of the square that the directional light's shadow map covers [m]."""
SHADOW_DISTANCE = 4.0
"""Distance from that middle at which the directional light's shadow map begins [m]."""
SHADOW_ANGLE = 80.0
"""Full angle of a point light's shadow map [deg]."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """A periodic image on the horizontal or vertical faces of one part of the stage."""

    image: np.ndarray
    """[p p 3] uint8, sRGB; its columns run along x, or along y on faces that face x."""
    period: float
    """Side of the image on the surface [m]."""


@dataclass(frozen=True)
class Stage:
    """Lights and surfaces round the objects, as the renderer shows them."""

    lights: tuple[Light, ...] = LIGHTS
    ambient: float = AMBIENT
    """As `AMBIENT`."""
    raised: float = 0.0
    """Height of the table's top over the standard one [m]."""
    table: Pattern | None = None
    wall: Pattern | None = None
    ground: Pattern | None = None
    """Patterns of the surfaces; None shows their plain colors."""
    only_hides: bool = False
    """Whether there is only the table, which hides what lies behind it and is not drawn itself."""


STANDARD = Stage()
"""The stage of all unchanged scenes."""


def stage_parts(stage: Stage = STANDARD) -> list[tuple[Mesh, Pattern | None]]:
    """Table, wall, ground and legs in the world frame, each with its pattern."""
    top = TABLE_TOP + stage.raised
    leg_height = top - TABLE_SIZE[2]
    legs = [
        box((LEG_SIZE, LEG_SIZE, leg_height), TABLE_COLOR).transformed((x * LEG_XY[0], y * LEG_XY[1], leg_height / 2))
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    plate = box(TABLE_SIZE, TABLE_COLOR).transformed((0, 0, top - TABLE_SIZE[2] / 2))
    wall = box(WALL_SIZE, WALL_COLOR).transformed(WALL_CENTER)
    ground = box((GROUND_SIZE, GROUND_SIZE, 0.1), GROUND_COLOR).transformed((0, 0, -0.05))
    return [(plate, stage.table), (wall, stage.wall), (ground, stage.ground), *((leg, stage.table) for leg in legs)]


def stage_mesh(stage: Stage = STANDARD) -> Mesh:
    """Table, wall and ground, or only the table, as one mesh in the world frame."""
    plate, wall, ground, *legs = (mesh for mesh, _ in stage_parts(stage))
    return merge([plate, *legs] if stage.only_hides else [plate, wall, ground, *legs])


def linear_from_srgb(color: np.ndarray) -> np.ndarray:
    """Linear light [...] float64, 0 to 1, of sRGB values [...] from 0 to 255 (IEC 61966-2-1)."""
    value = np.asarray(color, np.float64) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(light: np.ndarray) -> np.ndarray:
    """sRGB values [...] uint8 of linear light [...], clipped to 0 to 1 (IEC 61966-2-1)."""
    light = np.clip(np.asarray(light, np.float64), 0, 1)
    value = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(value * 255).astype(np.uint8)

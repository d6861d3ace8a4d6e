"""The look of a change: lights, surfaces and camera, as functions of its level alone."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from xew.protocol import HEAD_SPEC, STRENGTHS, CameraSpec, Change
from xew.sim_warp import stage
from xew.sim_warp.changes import patterns
from xew.sim_warp.changes.scenes import change_rng, raised_by
from xew.sim_warp.geometry.camera import spec_camera
from xew.sim_warp.geometry.meshes import Color
from xew.sim_warp.stage import STANDARD, Light, Pattern, Stage

LAMP_COLORS = ((1.0, 0.62, 0.3), (0.45, 0.7, 1.0), (1.0, 0.85, 0.45), (1.0, 0.5, 0.5), (0.7, 0.55, 1.0))
"""Linear colors of a changed lamp at full strength."""
TABLE_COLORS: tuple[tuple[Color, Color], ...] = (
    ((232, 205, 160), (150, 100, 60)),
    ((178, 206, 222), (70, 110, 150)),
    ((190, 214, 178), (90, 130, 85)),
    ((226, 186, 178), (160, 85, 80)),
    ((206, 190, 220), (110, 90, 140)),
)
"""Light and dark color of a changed table: objects and robots of all colors stand out from the mixtures."""
ROOM_COLORS: tuple[tuple[Color, Color], ...] = (
    ((190, 205, 170), (110, 95, 70)),
    ((170, 190, 215), (95, 85, 110)),
    ((222, 190, 150), (120, 70, 60)),
    ((200, 175, 205), (70, 95, 100)),
)
"""Light and dark color of a changed wall and ground."""
TABLE_PATTERNS: tuple[tuple[patterns.Draw, float], ...] = (
    (patterns.plain, 1.0),
    (patterns.wood, 0.6),
    (patterns.cloth, 0.35),
)
WALL_PATTERNS: tuple[tuple[patterns.Draw, float], ...] = (
    (patterns.plain, 1.0),
    (patterns.plaster, 0.8),
    (patterns.bricks, 0.6),
)
GROUND_PATTERNS: tuple[tuple[patterns.Draw, float], ...] = (
    (patterns.plain, 1.0),
    (patterns.wood, 0.8),
    (patterns.tiles, 0.8),
)
"""Pattern and its period [m] on table, wall and ground, by strength."""
LAMP_TURN = 25.0
"""Angle about the table's center by which a step of strength turns the lamps [deg]."""
CAMERA_TURN, CAMERA_SHIFT = 1.5, 0.015
"""Angle [deg] by which a step of strength turns a camera, and way that it moves as a share of the distance to its target."""


@lru_cache(maxsize=16)
def stage_of(change: Change | None) -> Stage:
    """The stage of a changed scene; STANDARD if the change does not concern it."""
    makers = {"light": _relight, "background": _redecorate, "table": _cover, "height": _raise}
    return makers[change.factor](change) if change and change.factor in makers else STANDARD


def camera_of(change: Change | None, spec: CameraSpec = HEAD_SPEC) -> CameraSpec:
    """The camera of a changed scene, turned and moved in its own frame; the same camera if the change is another."""
    if change is None or change.factor != "camera":
        return spec
    turn, shift = (vector / np.linalg.norm(vector) for vector in change_rng(change).uniform(-1, 1, (2, 3)))
    axes = spec_camera(spec).extrinsics[:3, :3]
    turned = Rotation.from_rotvec(change.strength * np.radians(CAMERA_TURN) * turn).as_matrix() @ axes
    distance = np.linalg.norm(np.subtract(spec.target, spec.position))
    position = spec.position + change.strength * CAMERA_SHIFT * distance * shift @ axes
    position, target, up = (_plain(vector.round(6)) for vector in (position, position + distance * turned[2], -turned[1]))
    return replace(spec, position=position, target=target, up=up)


def _relight(change: Change) -> Stage:
    """One lamp brighter and colored, the other dimmer, both turned about the table, and less light from elsewhere."""
    rng, share = change_rng(change), change.strength / STRENGTHS
    brighter, side = 1 + int(rng.integers(2)), rng.choice((-1.0, 1.0))
    color = np.array(LAMP_COLORS[change.draw % len(LAMP_COLORS)])
    turn = Rotation.from_euler("z", side * LAMP_TURN * change.strength, degrees=True)
    lights = []
    for number, light in enumerate(stage.LIGHTS):
        strength = {0: 1 - 0.6 * share, brighter: 1 + 0.9 * share}.get(number, 1 - 0.8 * share)
        tint = 1 - share * (1 - color) if number == brighter else np.ones(3)
        lights.append(_turned(light, turn, light.intensity * strength, tint))
    return Stage(lights=tuple(lights), ambient=stage.AMBIENT * (1 - 0.4 * share))


def _turned(light: Light, turn: Rotation, intensity: float, color: np.ndarray) -> Light:
    """A light turned about the world's z, with another intensity and color [3]."""
    position = None if light.position is None else _plain(turn.apply(light.position))
    return Light(intensity, _plain(turn.apply(light.direction)), position, _plain(color))


def _plain(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z


def _cover(change: Change) -> Stage:
    """A table of one color, of wood, or covered by a checked cloth."""
    draw, period = TABLE_PATTERNS[change.strength - 1]
    return Stage(table=Pattern(draw(change_rng(change), TABLE_COLORS[change.draw % len(TABLE_COLORS)]), period))


def _redecorate(change: Change) -> Stage:
    """Wall and ground: plain in another color, of plaster and wood, or of bricks and tiles."""
    rng = change_rng(change)
    wall, ground = (ROOM_COLORS[(change.draw + number) % len(ROOM_COLORS)] for number in (0, 1))
    surfaces = []
    for kinds, colors in ((WALL_PATTERNS, wall), (GROUND_PATTERNS, ground)):
        draw, period = kinds[change.strength - 1]
        surfaces.append(Pattern(draw(rng, colors), period))
    return Stage(wall=surfaces[0], ground=surfaces[1])


def _raise(change: Change) -> Stage:
    return Stage(raised=raised_by(change))

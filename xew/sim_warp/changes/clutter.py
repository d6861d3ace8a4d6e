"""Clutter: fixed objects that nothing needs, away from the way of both tools and from the task's objects.

A scene's clutter is the same for all robots. It is not simulated: `find_struck` checks that no link of the robot and no object
comes near it, so it cannot change a motion.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.distance import cdist

from xew.sim_warp import objects
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.camera import HEAD_CAMERA, project
from xew.sim_warp.geometry.meshes import Color
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import ToolPath
from xew.sim_warp.rendering.observe import Recording
from xew.sim_warp.rendering.surfaces import surface_points
from xew.sim_warp.scene import Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP

COUNTS = (2, 4, 7)
"""Number of objects by strength."""
AREA = ((-0.46, -0.30), (0.46, 0.32))
"""Corners of the part of the table that is used, as far as the head camera sees it [m]."""
SHOULDERS = ((-0.25, -0.45), (0.25, -0.45))
"""Spots from which the arms reach over the table, common to all robots [m]."""
HAND, FOREARM, GAP = 0.11, 0.07, 0.02
"""Distances from the way of a tool, from the line to its shoulder, and between objects [m]."""
CLEARANCE = 0.02
"""Least distance of clutter from dense points on all links and objects, at every frame [m]."""
MARGIN = 8
"""Least distance of a place from the picture's border [pixels]."""
TRIES = 300
"""Number of places that are tried for one object."""


def _box(rng: np.random.Generator, color: Color) -> Shape:
    return objects.block(tuple(rng.uniform((0.03, 0.03, 0.02), (0.07, 0.05, 0.07))), color)


def _can(rng: np.random.Generator, color: Color) -> Shape:
    radius, height = rng.uniform((0.018, 0.05), (0.03, 0.09))
    body = meshes.cylinder(radius, height, color).transformed((0, 0, height / 2))
    lid = meshes.cylinder(0.9 * radius, 0.004, objects.darken(color, 0.6)).transformed((0, 0, height + 0.002))
    return Shape(meshes.merge([body, lid]))


def _ball(rng: np.random.Generator, color: Color) -> Shape:
    radius = rng.uniform(0.018, 0.03)
    return Shape(meshes.sphere(radius, color, 3).transformed((0, 0, radius)))


def _bowl(rng: np.random.Generator, color: Color) -> Shape:
    radius = rng.uniform(0.03, 0.045)
    return objects.vessel([(0.5 * radius, 0.0), (radius, 0.8 * radius)], 0.004, color, objects.darken(color, 0.7))


KINDS: tuple[Callable[[np.random.Generator, Color], Shape], ...] = (_box, _can, _ball, _bowl)


def scatter(rng: np.random.Generator, scene: Scene, path: ToolPath, strength: int) -> tuple[SceneObject, ...]:
    """Clutter of a scene, in colors that its instruction does not name; a weaker change has the first objects of a stronger."""
    clutter: list[SceneObject] = []
    colors = [str(color) for color in rng.permutation(sorted(objects.PALETTE)) if color not in scene.words.values()]
    for number in range(COUNTS[-1]):
        shape = KINDS[rng.integers(len(KINDS))](rng, objects.PALETTE[colors[number % len(colors)]])
        places, yaw = _in_view(rng.uniform(*AREA, (TRIES, 2))), rng.uniform(-np.pi, np.pi)
        free = places[_clearance(places, [*scene.objects, *clutter], path) > _radius(shape)]
        if len(free):
            clutter.append(SceneObject(f"clutter {len(clutter) + 1}", shape, upright(free[0], TABLE_TOP, yaw)))
    return tuple(clutter[: COUNTS[strength - 1]])


def _in_view(places: np.ndarray) -> np.ndarray:
    """Those of some places [n 2] m on the table that the head camera sees."""
    pixels, _ = project(HEAD_CAMERA, np.column_stack([places, np.full(len(places), TABLE_TOP)]))
    return places[((pixels > MARGIN) & (pixels < np.array([HEAD_CAMERA.width, HEAD_CAMERA.height]) - MARGIN)).all(1)]


def _clearance(places: np.ndarray, things: list[SceneObject], path: ToolPath) -> np.ndarray:
    """[n] largest radius of an object at each place [n 2] m, between other objects and the ways of tools and forearms [m]."""
    free = np.full(len(places), np.inf)
    for thing in things:
        free = np.minimum(free, np.hypot(*(places - thing.pose[:2]).T) - _radius(thing.shape) - GAP)
    for arm, shoulder in enumerate(SHOULDERS):
        tools = np.unique(path.pose[:, arm, :2].round(3), axis=0)
        free = np.minimum(free, cdist(places, tools).min(1) - HAND)
        forearms = np.concatenate([tools + share * (shoulder - tools) for share in np.linspace(0, 1, 12)])
        free = np.minimum(free, cdist(places, forearms).min(1) - FOREARM)
    return free


def _radius(shape: Shape) -> float:
    """Radius of an upright cylinder about a shape's z axis [m]."""
    return float(np.hypot(*shape.mesh.vertices[:, :2].T).max())


def find_struck(clutter: tuple[SceneObject, ...], moving: Recording) -> str | None:
    """Description of the first clutter that comes within `CLEARANCE` of the robot or an object, None if there is none."""
    if not clutter:
        return None
    points = surface_points(moving)
    for thing in clutter:
        above = points[:, 2] - thing.pose[2] - thing.shape.mesh.vertices[:, 2].max()
        beside = np.hypot(*(points[:, :2] - thing.pose[:2]).T) - _radius(thing.shape)
        nearest = np.maximum(above, beside).min()
        if nearest < CLEARANCE:
            return f"{thing.name} is in the way: something comes within {max(0.0, 1000 * nearest):.0f} mm of it"
    return None

"""Task: put a bowl or a cup on a plate, with one hand by the rim.

Randomization: a bowl or a cup at |x| in [.20, .28], y in [-.10, .05]; the plate (fixed to the table) on the same side,
    |x| in [.02, .08], y in [-.15, -.10], clear of the container; size and colors of both.
Success: container within 50 mm of the plate's center in x and y and standing on it (10 mm), both grippers open.
After RoboTwin 2.0's place_container_plate, whose plate is wider by a quarter.
"""

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.assets import containers
from xew.sim_warp.geometry.meshes import Color, Mesh
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import Moment, Task, carry_by_rim, point_above, share_carried, vessel_pose

WALL = 0.005
RIM_DEPTH = 0.007
WITHIN = (0.05, 0.05, 0.01)
"""Largest offset from the goal in x, y and z [m]."""
CLEAR = 0.17
"""Least distance between the centers of container and plate [m]."""
SLOPE, PLATE_HEIGHT = 0.030, 0.014
"""Width and height of a plate's rim [m]."""
CHINA: Color = (240, 238, 232)


def bowl(rng: np.random.Generator, color: Color) -> Shape:
    radius, height = rng.uniform([0.052, 0.046], [0.062, 0.054])
    return objects.vessel([(radius - 0.026, 0), (radius - 0.006, 0.4 * height), (radius, height)], WALL, color, CHINA)


def cup(rng: np.random.Generator, color: Color) -> Shape:
    radius, height, taper = rng.uniform([0.037, 0.075, 0.004], [0.043, 0.092, 0.010])
    return objects.vessel([(radius - taper, 0), (radius, height)], WALL, color, CHINA)


def plate(rng: np.random.Generator, color: Color) -> Shape:
    """A shallow white plate with a colored rim."""
    radius, rim = rng.uniform([0.086, 0.006], [0.094, 0.024])
    flat, edge = radius - SLOPE, radius - rim
    shape = objects.vessel([(flat, 0), (radius, PLATE_HEIGHT)], WALL, CHINA)
    mesh = objects.vessel([(flat, 0), (edge, (1 - rim / SLOPE) * PLATE_HEIGHT), (radius, PLATE_HEIGHT)], WALL, CHINA).mesh
    outside = np.hypot(*mesh.vertices[mesh.triangles].mean(1)[:, :2].T) > edge - WALL
    painted = outside & (mesh.normals.mean(1)[:, 2] > 0)
    colors = np.where(painted[:, None], np.array(color, np.uint8), mesh.colors)
    return Shape(Mesh(mesh.vertices, mesh.triangles, colors, mesh.normals), shape.hulls)


def sample(rng: np.random.Generator, seed: int) -> Scene:
    side = rng.choice([-1.0, 1.0])
    at = rng.uniform([0.20, -0.10], [0.28, 0.05])
    dish = draw(rng, [0.02, -0.15], [0.08, -0.10], lambda p: np.hypot(*(p - at)) >= CLEAR)
    kind = ("bowl", "cup")[rng.integers(2)]
    color, trim = containers.draw_color_names(rng, 2)
    shape = {"bowl": bowl, "cup": cup}[kind](rng, objects.PALETTE[color])
    return Scene(
        "place_container_plate",
        seed,
        (
            SceneObject("container", shape, vessel_pose(at * [side, 1]), mass=0.12),
            SceneObject("plate", plate(rng, objects.PALETTE[trim]), upright(dish * [side, 1], TABLE_TOP)),
        ),
        words={"color": color, "kind": kind},
    )


def plan(scene: Scene) -> Timeline:
    goal = point_above(scene.object("plate"), WALL + 0.002)
    timeline = Timeline()
    carry_by_rim(timeline, scene.object("container"), goal, WALL, RIM_DEPTH)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    offset = np.abs(now.object_pose[scene.index("container"), :3] - scene.object("plate").pose[:3] - [0, 0, WALL])
    return bool((offset < WITHIN).all() and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    goal = point_above(scene.object("plate"), WALL)
    return share_carried(scene, first, now, {"container": goal}, WITHIN)


TASK = Task("place_container_plate", "place the {color} {kind} on the plate", sample, plan, success, approach)

"""Surface tracks: pixels and visibility of points on the robot's moving links, on objects and on hinged lids.

A point is fixed to its body. It is visible if the renderer's buffer shows its body at its pixel and depth. Among many sampled
points of a body, few are selected: enough to see some in every frame in which the body is visible. For frames with too few, for
example of a lid seen edge-on, more points are sampled and a few of them added.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.geometry.camera import HEAD_CAMERA, Camera, project
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.geometry.surface_points import sample_surface
from xew.sim_warp.rendering.bodies import SIDES, body_names, robot_bodies
from xew.sim_warp.rendering.observe import Recording, recording_world
from xew.sim_warp.rendering.render import Frames, Renderer, nearest_pixel
from xew.sim_warp.stage import STANDARD, Stage

LINK_CANDIDATES, THING_CANDIDATES = 64, 256
"""Numbers of sampled points on each moving link, and on each object and hinged lid."""
WANTED_OF_LINK, WANTED_OF_THING = 3, 8
"""Numbers of visible points per frame on each, if there are as many candidates."""
DEPTH_MARGIN = 0.01
"""Largest difference [m] between a point's depth and its body's depth at the pixel's center."""
LEAST_FACING = 0.15
"""Least cosine between a point's normal and the direction to the camera."""
AIM_OF_ROBOT, AIM_OF_THING = 8, 4
"""Target numbers of visible points per frame of the whole robot, and of a moving object; denser sets fill other frames."""
LEAST_SHOWN = 16
"""Least number of pixels of a body that is filled; of smaller ones, other surfaces surround a point."""
DENSE_LINK_CANDIDATES, DENSE_THING_CANDIDATES = 256, 1024
"""Numbers of points of the denser sets on each moving link and on each object."""
LEAST_DENSE_FACING = 0.0
"""Least cosine for points of the denser sets, for lids seen edge-on."""
MOVED = 0.01
"""Least displacement of a moved body since the first frame [m]."""
MOVING = 0.001
"""Least displacement of a moving body between frames [m]."""


@dataclass(frozen=True)
class SurfaceTracks:
    """Surface points of an episode: p points on b movable bodies."""

    pixels: np.ndarray
    """[t p 2] float32 x right, y down; NaN behind the camera."""
    visible: np.ndarray
    """[t p] bool."""
    body: np.ndarray
    """[p] int32, index of a point's body."""
    local: np.ndarray
    """[p 3] float32, place of a point in its body's frame [m]."""
    shown: np.ndarray
    """[t h w] int16, index of a pixel's body, -1 for any other."""
    names: tuple[str, ...]
    """Names of the b bodies: side and link of the robot, names of objects and of their lids."""
    is_robot: np.ndarray
    """[b] bool."""
    displacement: np.ndarray
    """[t b] float32, largest displacement of a body's points since the first frame [m]."""
    step: np.ndarray
    """[t b] float32, largest displacement of a body's points since the previous frame [m], 0 in the first."""


@dataclass(frozen=True)
class _Points:
    """Points of one body, in its frame."""

    xyz: np.ndarray
    """[n 3] m."""
    normal: np.ndarray
    """[n 3]."""


@dataclass(frozen=True)
class _Placed:
    """Points of several bodies in the world."""

    xyz: np.ndarray
    """[t p 3] m."""
    normal: np.ndarray
    """[t p 3]."""
    body: np.ndarray
    """[p] int, index of each point's body in its world."""
    local: np.ndarray
    """[p 3] m, frame of the body."""


@dataclass(frozen=True)
class _View:
    """An episode of t frames and its images."""

    recording: Recording
    pose: np.ndarray
    """[t b 7] poses of all bodies, xyz [m] and quaternion xyzw, world."""
    shown: Frames
    camera: Camera


@dataclass(frozen=True)
class _Seen:
    """Points of several bodies in the image."""

    pixels: np.ndarray
    """[t p 2] float64 x right, y down; NaN behind the camera."""
    visible: np.ndarray
    """[t p] bool."""
    body: np.ndarray
    """[p] int, index of each point's body in its world."""
    local: np.ndarray
    """[p 3] m, frame of the body."""

    def select(self, points: np.ndarray) -> "_Seen":
        """The points of an index [k]."""
        return _Seen(self.pixels[:, points], self.visible[:, points], self.body[points], self.local[points])


def track_surfaces(
    recordings: Sequence[Recording],
    thing_names: Sequence[Sequence[str]],
    renderer: Renderer,
    camera: Camera = HEAD_CAMERA,
    stage: Stage = STANDARD,
) -> list[SurfaceTracks]:
    """Tracks of many episodes at once, with the names of each recording's things; results do not depend on the batch."""
    worlds = [recording_world(recording) for recording in recordings]
    placed = [_place(_candidates(recording), world.pose) for recording, world in zip(recordings, worlds, strict=True)]
    worlds = [replace(world, points=points.xyz) for world, points in zip(worlds, placed, strict=True)]
    seen = renderer.probe_batch(worlds, camera, stage)
    return [
        _tracks(_View(recording, world.pose, shown, camera), names, points)
        for recording, names, world, points, shown in zip(recordings, thing_names, worlds, placed, seen, strict=True)
    ]


def surface_points(recording: Recording) -> np.ndarray:
    """[n 3] m, world: dense points on the robot's moving links and on all things, at all frames."""
    pose = recording_world(recording).pose
    things = [_Points(*sample_surface(thing.mesh, DENSE_THING_CANDIDATES)) for thing in recording.things]
    points = [*robot_points(recording.robot, DENSE_LINK_CANDIDATES), *things]
    return np.concatenate([_place({body: some}, pose).xyz.reshape(-1, 3) for body, some in enumerate(points)])


def _candidates(recording: Recording) -> dict[int, _Points]:
    """The candidate points of each body."""
    things = [_Points(*sample_surface(thing.mesh, THING_CANDIDATES)) for thing in recording.things]
    return dict(enumerate([*robot_points(recording.robot), *things]))


def _place(points: Mapping[int, _Points], pose: np.ndarray) -> _Placed:
    """Points of bodies with these poses [t b 7], in the world."""
    body = np.repeat(np.array([*points], int), [len(some.xyz) for some in points.values()])
    matrix = matrix_from_pose(pose)[:, body]
    xyz, normal = (np.concatenate([getattr(some, name) for some in points.values()]) for name in ("xyz", "normal"))
    world = np.einsum("tpij,pj->tpi", matrix[..., :3, :3], xyz) + matrix[..., :3, 3]
    return _Placed(world, np.einsum("tpij,pj->tpi", matrix[..., :3, :3], normal), body, xyz)


@lru_cache(maxsize=32)
def robot_points(robot: RobotSpec, count: int = LINK_CANDIDATES) -> tuple[_Points, ...]:
    """Points of each of the robot's visible links, in the order of `robot_bodies`; none on fixed links."""
    urdf = load_urdf(robot.urdf)
    moving = {name for arm in robot.arms for name in (*arm.joints, *arm.fingers)}
    points = []
    for body, (_, link) in zip(robot_bodies(robot), body_names(robot), strict=True):
        moves = any(joint.name in moving for joint in urdf.chain(link))
        points.append(_Points(*sample_surface(body.mesh, count if moves else 0)))
    return tuple(points)


def _tracks(view: _View, thing_names: Sequence[str], placed: _Placed) -> SurfaceTracks:
    """Tracks from the candidates, with which the view's frames were probed."""
    seen = _see(view.camera, placed, view.shown.point_body, view.shown.point_depth, LEAST_FACING)
    links = _link_names(view.recording.robot)
    bodies = np.unique(placed.body)
    wanted = {b: WANTED_OF_LINK if b < len(links) else WANTED_OF_THING for b in bodies}
    chosen = [np.flatnonzero(seen.body == b)[choose_points(seen.visible[:, seen.body == b], wanted[b])] for b in bodies]
    far = [_motion(placed.xyz[:, placed.body == b]) for b in bodies]
    first = seen.select(np.concatenate(chosen))
    parts = [first, _fill(view, bodies[bodies < len(links)].tolist(), AIM_OF_ROBOT, first)]
    for b, (displacement, step) in zip(bodies, far, strict=True):
        if b >= len(links) and displacement.max() > MOVED:
            parts.append(_fill(view, [b], np.where(step > MOVING, AIM_OF_THING, 0), first))
    points = _join(parts)
    number = np.full(len(links) + len(thing_names) + 1, -1, np.int16)  # the last entry is for body -1
    number[bodies] = np.arange(len(bodies))
    return SurfaceTracks(
        pixels=points.pixels.astype(np.float32),
        visible=points.visible,
        body=number[points.body].astype(np.int32),
        local=points.local.astype(np.float32),
        shown=number[view.shown.body],
        names=tuple([*links, *thing_names][b] for b in bodies),
        is_robot=bodies < len(links),
        displacement=np.stack([of_body[0] for of_body in far], axis=1),
        step=np.stack([of_body[1] for of_body in far], axis=1),
    )


def _see(camera: Camera, placed: _Placed, body: np.ndarray, depth: np.ndarray, least_facing: float) -> _Seen:
    """Points in the image; visible are those that face the camera where the buffer has their body and depth, both [t p]."""
    pixels, own_depth = project(camera, placed.xyz)
    to_camera = camera.position[..., None, :] - placed.xyz
    facing = np.einsum("tpi,tpi->tp", placed.normal, to_camera) > least_facing * np.linalg.norm(to_camera, axis=-1)
    near = (own_depth > 0) & (np.abs(depth - own_depth) < DEPTH_MARGIN)
    return _Seen(pixels, (body == placed.body) & facing & near, placed.body, placed.local)


def _join(parts: Sequence[_Seen]) -> _Seen:
    """The points of all parts."""
    pixels, visible = (np.concatenate([getattr(part, name) for part in parts], axis=1) for name in ("pixels", "visible"))
    return _Seen(pixels, visible, *(np.concatenate([getattr(part, name) for part in parts]) for name in ("body", "local")))


def _fill(view: _View, bodies: Sequence[int], aim: int | np.ndarray, first: _Seen) -> _Seen:
    """Few points of the denser sets to add on some bodies, for frames with fewer visible points than `aim`, one or [t].

    `bodies` are the robot's links together, or one object; `first` are the points so far.
    """
    missing = np.maximum(aim - np.sum(first.visible[:, np.isin(first.body, bodies)], axis=1), 0)
    lacking = np.flatnonzero(missing)
    pixels = np.stack([np.sum(view.shown.body[lacking] == body, axis=(1, 2)) for body in bodies])
    missing[lacking[pixels.sum(axis=0) < LEAST_SHOWN]] = 0
    sets = [_look(view, body) for body, of_body in zip(bodies, pixels, strict=True) if of_body[missing[lacking] > 0].any()]
    if not sets:
        return first.select(np.zeros(0, int))
    dense = _join(sets)
    return dense.select(choose_points(dense.visible, missing))


def _look(view: _View, body: int) -> _Seen:
    """The denser set on one body in the view's frames."""
    links = robot_bodies(view.recording.robot)
    if body < len(links):
        points = robot_points(view.recording.robot, DENSE_LINK_CANDIDATES)[body]
    else:
        points = _Points(*sample_surface(view.recording.things[body - len(links)].mesh, DENSE_THING_CANDIDATES))
    placed = _place({body: points}, view.pose)
    column, row = np.moveaxis(nearest_pixel(view.camera, placed.xyz), -1, 0)
    inside = (column >= 0) & (column < view.camera.width) & (row >= 0) & (row < view.camera.height)
    at = np.arange(len(view.pose))[:, None], np.where(inside, row, 0), np.where(inside, column, 0)
    there = np.where(inside, view.shown.body[at], -2), view.shown.depth[at]
    return _see(view.camera, placed, *there, LEAST_DENSE_FACING)


def choose_points(visible: np.ndarray, wanted: int | np.ndarray) -> np.ndarray:
    """Ascending indices [k] int of few points, enough visible in every frame, by greedy set cover; of equals the earlier.

    Args:
        visible: [t n] bool, visibility of each point by frame.
        wanted: number of visible points for every frame, or [t] for each; all visible points if there are fewer.
    """
    missing = np.minimum(visible.sum(axis=1), wanted)
    left = visible.copy()
    chosen: list[int] = []
    while (missing > 0).any():
        best = int(left[missing > 0].sum(axis=0).argmax())
        chosen.append(best)
        missing = missing - left[:, best]
        left[:, best] = False
    return np.array(sorted(chosen), int)


def _motion(world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`displacement` and `step` [t] float32 m of a body with these points [t n 3]."""
    moved = world - world[:1], np.diff(world, axis=0, prepend=world[:1])
    displacement, step = (np.linalg.norm(by, axis=-1).max(axis=1).astype(np.float32) for by in moved)
    return displacement, step


def _link_names(robot: RobotSpec) -> list[str]:
    """Names of the robot's bodies, with the side if each arm has a copy of the URDF."""
    names = body_names(robot)
    return [link if robot.one_urdf_holds_both_arms else f"{SIDES[copy]}/{link}" for copy, link in names]

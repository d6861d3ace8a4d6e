"""Points on surfaces: where they are in the image, and whether the camera sees them, as recorded states have it.

Reads  `Recording`s: a robot, its measured joints, and things with their measured poses
Writes `SurfaceTracks`: pixels and visibility of points on the robot's moving links, on objects and on hinged lids

A point is fixed to its body, so that its path follows from the states. It is seen where the renderer's own buffer shows its
body at its pixel, at its depth: what hides it may be the robot, an object, the table, or its own body. Of many points sampled
on each body, few are kept: as many as it takes to see some of them in every frame in which the body is seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.geometry.camera import HEAD_CAMERA, Camera, project
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.geometry.surface_points import sample_surface
from xew.sim_warp.rendering.bodies import SIDES, body_names, robot_bodies, robot_pose
from xew.sim_warp.rendering.observe import Recording
from xew.sim_warp.rendering.render import Frames, Renderer, World

LINK_CANDIDATES, THING_CANDIDATES = 64, 256
"""Numbers of points that are sampled on each link that an arm or a gripper moves, and on each object and hinged lid: of what a
hand holds only a rim may be seen, and parts of a mesh lie inside others."""
WANTED_OF_LINK, WANTED_OF_THING = 3, 8
"""Numbers of visible points of each that are kept for every frame, as far as so many of the candidates are seen in it."""
DEPTH_MARGIN = 0.01
"""Largest distance in depth [m] between a point and what its pixel shows of its own body at the pixel's center."""
LEAST_FACING = 0.15
"""Least cosine between a point's normal and the direction to the camera; what is seen at a flatter angle is a rim."""


@dataclass(frozen=True)
class SurfaceTracks:
    """Points on the surfaces of an episode: p points on b bodies that can move."""

    pixels: np.ndarray
    """[t p 2] float32 x right, y down; NaN behind the camera."""
    visible: np.ndarray
    """[t p] bool."""
    body: np.ndarray
    """[p] int32, index of the body that a point lies on."""
    shown: np.ndarray
    """[t h w] int16, index of the body that a pixel shows, -1 for any other."""
    names: tuple[str, ...]
    """Names of the b bodies: side and link of a robot, name of an object, and name and lid of what has a hinge."""
    is_robot: np.ndarray
    """[b] bool."""
    displacement: np.ndarray
    """[t b] float32, the farthest that any of a body's points is from where it was in the first frame [m]."""
    step: np.ndarray
    """[t b] float32, the farthest that any of a body's points has moved since the frame before [m], 0 in the first."""


@dataclass(frozen=True)
class _Points:
    """Points of one body, in its frame."""

    xyz: np.ndarray
    """[n 3] m."""
    normal: np.ndarray
    """[n 3]."""


def track_surfaces(
    recordings: Sequence[Recording], thing_names: Sequence[Sequence[str]], renderer: Renderer, camera: Camera = HEAD_CAMERA
) -> list[SurfaceTracks]:
    """Follow the points of many episodes at once; the result of each does not depend on the others.

    Args:
        recordings: what the camera looks at.
        thing_names: for each, the names of its things, in order.
        renderer: whose buffer says what is seen.
        camera: the camera.
    """
    placed = [_place(recording) for recording in recordings]
    worlds = [
        World([*robot_bodies(recording.robot), *recording.things], pose, xyz)
        for recording, (pose, xyz, _, _) in zip(recordings, placed, strict=True)
    ]
    seen = renderer.probe_batch(worlds, camera)
    return [
        _tracks(recording, names, where[1:], shown, camera)
        for recording, names, where, shown in zip(recordings, thing_names, placed, seen, strict=True)
    ]


def _place(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Poses of all bodies [t n 7], and of all points their places [t p 3] m and normals [t p 3], world, and bodies [p]."""
    pose = robot_pose(recording.robot, recording.joint_pos)
    if recording.thing_pose is not None:
        pose = np.concatenate([pose, recording.thing_pose], 1)
    points = [*robot_points(recording.robot)]
    points += [_Points(*sample_surface(thing.mesh, THING_CANDIDATES)) for thing in recording.things]
    body = np.repeat(np.arange(len(points)), [len(some.xyz) for some in points])
    matrix = matrix_from_pose(pose)[:, body]
    xyz, normal = (np.concatenate([getattr(some, name) for some in points]) for name in ("xyz", "normal"))
    world = np.einsum("tpij,pj->tpi", matrix[..., :3, :3], xyz) + matrix[..., :3, 3]
    return pose, world, np.einsum("tpij,pj->tpi", matrix[..., :3, :3], normal), body


@lru_cache(maxsize=32)
def robot_points(robot: RobotSpec) -> tuple[_Points, ...]:
    """Points of each of the robot's visible links, in the order of `robot_bodies`; none on links that nothing moves."""
    urdf = load_urdf(robot.urdf)
    moving = {name for arm in robot.arms for name in (*arm.joints, *arm.fingers)}
    found = []
    for body, (_, link) in zip(robot_bodies(robot), body_names(robot), strict=True):
        moves = any(joint.name in moving for joint in urdf.chain(link))
        found.append(_Points(*sample_surface(body.mesh, LINK_CANDIDATES if moves else 0)))
    return tuple(found)


def _tracks(
    recording: Recording,
    thing_names: Sequence[str],
    where: tuple[np.ndarray, np.ndarray, np.ndarray],
    shown: Frames,
    camera: Camera,
) -> SurfaceTracks:
    """Tracks from the candidates' places and normals [t p 3] and bodies [p], and from what the camera sees."""
    world, normal, body = where
    pixels, depth = project(camera, world)
    to_camera = camera.position - world
    facing = np.einsum("tpi,tpi->tp", normal, to_camera) > LEAST_FACING * np.linalg.norm(to_camera, axis=-1)
    visible = (shown.point_body == body) & facing & (depth > 0) & (np.abs(shown.point_depth - depth) < DEPTH_MARGIN)
    links = _link_names(recording.robot)
    bodies = np.unique(body)
    kept = [
        np.flatnonzero(body == b)[choose_points(visible[:, body == b], WANTED_OF_LINK if b < len(links) else WANTED_OF_THING)]
        for b in bodies
    ]
    far = [_motion(world[:, body == b]) for b in bodies]
    points = np.concatenate(kept)
    number = np.full(len(links) + len(thing_names) + 1, -1, np.int16)  # the last is that of body -1
    number[bodies] = np.arange(len(bodies))
    return SurfaceTracks(
        pixels=pixels[:, points].astype(np.float32),
        visible=visible[:, points],
        body=np.repeat(np.arange(len(bodies), dtype=np.int32), [len(some) for some in kept]),
        shown=number[shown.body],
        names=tuple([*links, *thing_names][b] for b in bodies),
        is_robot=bodies < len(links),
        displacement=np.stack([of_body[0] for of_body in far], axis=1),
        step=np.stack([of_body[1] for of_body in far], axis=1),
    )


def choose_points(visible: np.ndarray, wanted: int) -> np.ndarray:
    """Indices of few points of a body of which enough are seen in every frame, by greedy set cover; the earlier of equals.

    Args:
        visible: [t n] bool, in which frames each of the body's points is seen.
        wanted: how many should be seen in a frame; all that are, where they are fewer.

    Returns:
        [k] int, ascending.
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
    """Names of the robot's bodies; of a URDF that stands for both arms, with the side."""
    names = body_names(robot)
    return [link if robot.one_urdf_holds_both_arms else f"{SIDES[copy]}/{link}" for copy, link in names]

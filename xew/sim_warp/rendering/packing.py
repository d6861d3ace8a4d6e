"""Packing of geometry and poses of many worlds into device arrays; worlds with equal meshes share one copy."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import warp as wp

from xew.sim_warp.geometry.meshes import Mesh
from xew.sim_warp.rendering import raster_kernels as kernels
from xew.sim_warp.stage import linear_from_srgb


@dataclass(frozen=True)
class Body:
    """A visible rigid body; bodies with the same `Mesh` object share its storage."""

    mesh: Mesh
    """In the frame of the body."""
    is_robot: bool


@dataclass(frozen=True)
class World:
    """One episode to render: bodies and their poses at each frame."""

    bodies: Sequence[Body]
    pose: np.ndarray
    """[t b 7] xyz [m] and quaternion xyzw of each body, world frame."""
    points: np.ndarray | None = None
    """[t k 3] world points [m] to look up in the finished frames (`Frames.point_body`), if any."""


@dataclass(frozen=True)
class FrameTable:
    """Indices of the geometry and poses of all frames of all worlds, in order."""

    world: np.ndarray
    """[t] int32 index of each frame's world among the packed geometry's distinct worlds."""
    pose: np.ndarray
    """[t] int32 index of the frame's first body in the packed poses."""
    next_pose: np.ndarray
    """[t] int32 the same for the world's next frame; for the last frame its own."""
    frame: np.ndarray
    """[t] int32 index of the frame among all frames."""
    next_frame: np.ndarray
    """[t] int32 the same of the world's next frame; for the last frame its own."""

    def select(self, chunk: slice) -> "FrameTable":
        """Some of the frames."""
        return FrameTable(*(getattr(self, column.name)[chunk] for column in fields(self)))


@dataclass(frozen=True)
class PackedGeometry:
    """The triangles of several distinct worlds on the device, and how many each has."""

    arrays: kernels.Geometry
    vertex_counts: np.ndarray
    """[w] int64 vertices of each distinct world."""
    triangle_counts: np.ndarray
    """[w] int64 triangles of each distinct world."""


def check_world(world: World) -> None:
    """Raise ValueError if poses or points do not fit the bodies and frames, or are not finite."""
    shape = np.shape(world.pose)
    if len(shape) != 3 or shape[1:] != (len(world.bodies), 7):
        raise ValueError(f"pose has shape {shape}, expected (frames, {len(world.bodies)}, 7): one pose for each of the bodies.")
    if shape[0] == 0:
        raise ValueError("pose has no frames; an episode to render needs at least one.")
    if not np.isfinite(world.pose).all():
        frame, body = np.argwhere(~np.isfinite(world.pose))[0, :2]
        raise ValueError(f"pose of body {body} at frame {frame} is not finite; the simulation before it has diverged.")
    if world.points is not None and (np.ndim(world.points) != 3 or len(world.points) != shape[0]):
        raise ValueError(
            f"points have shape {np.shape(world.points)}, expected ({shape[0]}, points, 3): as many frames as poses."
        )


def distinct_worlds(worlds: Sequence[World]) -> tuple[list[Sequence[Body]], list[int]]:
    """The distinct lists of bodies among the worlds, and the index of each world's list."""
    indices: dict[tuple[tuple[int, bool], ...], int] = {}
    kinds: list[Sequence[Body]] = []
    index = []
    for world in worlds:
        key = tuple((id(body.mesh), body.is_robot) for body in world.bodies)
        if key not in indices:
            indices[key] = len(kinds)
            kinds.append(world.bodies)
        index.append(indices[key])
    return kinds, index


def pack_geometry(kinds: Sequence[Sequence[Body]], device: wp.Device) -> PackedGeometry:
    """Device arrays of the triangles of several worlds, see `raster_kernels.Geometry`."""
    packed = kernels.Geometry()
    meshes = [body.mesh for bodies in kinds for body in bodies]
    local_body = [index for bodies in kinds for index in range(len(bodies))]
    vertices = [len(mesh.vertices) for mesh in meshes]
    triangles = [len(mesh.triangles) for mesh in meshes]
    packed.vertex = wp.array(_concatenate([m.vertices for m in meshes], (3,), np.float32), dtype=wp.vec3, device=device)
    packed.vertex_body = wp.array(np.repeat(local_body, vertices).astype(np.int32), dtype=int, device=device)
    packed.triangle = wp.array(_local_triangles(kinds), dtype=wp.vec3i, device=device)
    packed.triangle_body = wp.array(np.repeat(local_body, triangles).astype(np.int32), dtype=int, device=device)
    packed.normal = wp.array(_concatenate([m.normals for m in meshes], (3, 3), np.float32), dtype=wp.vec3, device=device)
    albedo = linear_from_srgb(_concatenate([m.colors for m in meshes], (3,), np.uint8)).astype(np.float32)
    packed.albedo = wp.array(albedo, dtype=wp.vec3, device=device)
    is_robot = np.array([body.is_robot for bodies in kinds for body in bodies], np.int32)
    packed.body_is_robot = wp.array(is_robot, dtype=int, device=device)
    vertex_counts = np.array([sum(len(body.mesh.vertices) for body in bodies) for bodies in kinds])
    triangle_counts = np.array([sum(len(body.mesh.triangles) for body in bodies) for bodies in kinds])
    packed.vertex_range = wp.array(_ranges(vertex_counts), dtype=wp.vec2i, device=device)
    packed.triangle_range = wp.array(_ranges(triangle_counts), dtype=wp.vec2i, device=device)
    body_first = _ranges(np.array([len(bodies) for bodies in kinds]))[:, 0]
    packed.body_first = wp.array(body_first.copy(), dtype=int, device=device)
    return PackedGeometry(packed, vertex_counts, triangle_counts)


def _local_triangles(kinds: Sequence[Sequence[Body]]) -> np.ndarray:
    """[f 3] vertex indices that start at zero in each world."""
    shifted = []
    for bodies in kinds:
        offset = 0
        for body in bodies:
            shifted.append(body.mesh.triangles + offset)
            offset += len(body.mesh.vertices)
    return _concatenate(shifted, (3,), np.int32)


def _concatenate(arrays: list[np.ndarray], tail: tuple[int, ...], dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros((0, *tail), dtype), *arrays]).astype(dtype)


def _ranges(counts: np.ndarray) -> np.ndarray:
    """[n 2] first index and count of consecutive ranges."""
    first = np.cumsum(counts) - counts
    return np.stack([first, counts], -1).astype(np.int32)


def pack_frames(worlds: Sequence[World], kind: Sequence[int]) -> tuple[FrameTable, np.ndarray]:
    """The table of all frames, and all poses [p 7] float32 xyz [m] and quaternion xyzw, world, that it indexes.

    `kind` is the index of each world among the distinct worlds.
    """
    columns: list[tuple[np.ndarray, ...]] = []
    first = begin = 0
    for world, index in zip(worlds, kind, strict=True):
        count, bodies = world.pose.shape[:2]
        frame = np.arange(count)
        after = np.minimum(frame + 1, count - 1)
        columns.append((np.full(count, index), first + frame * bodies, first + after * bodies, begin + frame, begin + after))
        first += count * bodies
        begin += count
    poses = _concatenate([np.reshape(world.pose, (-1, 7)) for world in worlds], (7,), np.float32)
    return FrameTable(*(np.concatenate(column).astype(np.int32) for column in zip(*columns, strict=True))), poses


def pack_points(worlds: Sequence[World]) -> np.ndarray:
    """[t k 3] float64 points of all frames [m], world frame; worlds with fewer points are filled up with NaN."""
    most = max((world.points.shape[1] for world in worlds if world.points is not None), default=0)
    padded_worlds = []
    for world in worlds:
        padded = np.full((len(world.pose), most, 3), np.nan)
        if world.points is not None:
            padded[:, : world.points.shape[1]] = world.points
        padded_worlds.append(padded)
    return np.concatenate(padded_worlds)

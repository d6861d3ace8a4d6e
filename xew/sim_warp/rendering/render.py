"""The renderer: posed bodies to images, for observe.py (what the camera sees) and streams.py (what commands say).

Reads  `World`s: meshes and their poses; a camera; the stage
Writes `Frames`: RGB, robot mask, depth, bodies, optical flow

It makes two kinds of frame: with the stage (table, wall, ground, shadows) what the head camera sees of an episode, without
it the bodies alone on white. The kernels (raster_kernels.py, then shading_kernels.py) are the same on CPU and GPU, and a
frame's bytes do not depend on what else is rendered with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from xew.sim_warp import stage
from xew.sim_warp.devices.waiting import wait_for
from xew.sim_warp.geometry.camera import HEAD_CAMERA, Camera, look_at, project
from xew.sim_warp.rendering import raster_kernels as raster
from xew.sim_warp.rendering import shading_kernels as shading
from xew.sim_warp.rendering.packing import (
    Body,
    FrameTable,
    PackedGeometry,
    World,
    check_world,
    distinct_worlds,
    pack_frames,
    pack_geometry,
    pack_points,
)
from xew.threads import PARSING

__all__ = ["FLOW_LIMIT", "Body", "Frames", "Renderer", "World"]

FLOW_LIMIT = 25.0
"""Longest optical flow [pixels], the paper's clip."""
SHADOW_SIZE = 512
"""Side of a shadow map [texels], about 3.5 mm each on the table: less than two pixels of the head camera."""
FRAMES_PER_CHUNK = {"cpu": 4, "cuda": 512}
"""Number of frames that are on the device at once; one takes about 6 MB."""
STRIPES = {"cpu": 1, "cuda": 8}
"""Number of threads that share a triangle's rows, so that one large triangle does not hold up a GPU."""
STAGES_KEPT = 16
"""Number of cameras whose lit stage is kept, about 10 MB each."""
IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def _nothing() -> np.ndarray:
    return np.empty(0)


@dataclass(frozen=True)
class Frames:
    """Images of one world. What was not asked for has no elements."""

    rgb: np.ndarray = field(default_factory=_nothing)
    """[t h w 3] uint8, sRGB, anti-aliased."""
    robot_mask: np.ndarray = field(default_factory=_nothing)
    """[t h w] bool, whether the first thing that the ray through the pixel's center meets is the robot."""
    depth: np.ndarray = field(default_factory=_nothing)
    """[t h w] float32 depth along the optical axis at the pixel's center [m], 0 where nothing is."""
    body: np.ndarray = field(default_factory=_nothing)
    """[t h w] int16 index of the body at the pixel's center, -1 where there is none."""
    optical_flow: np.ndarray = field(default_factory=_nothing)
    """[t h w 2] float32 motion (x right, y down) [pixels] from this frame to the next of the robot's surface point
    under the pixel's center, no longer than `FLOW_LIMIT`; zero off the robot and in the last frame."""
    point_body: np.ndarray = field(default_factory=_nothing)
    """[t k] int32 index of the body seen in the pixel of each of the world's points, -1 none, -2 outside the image."""
    point_depth: np.ndarray = field(default_factory=_nothing)
    """[t k] float32 depth of what is seen there [m], 0 where nothing is."""


class Renderer:
    """Renders worlds in batches; keeps the lit stage of each camera.

    Args:
        device: Warp's name of a device, None for Warp's default.
        frames_per_chunk: frames in flight, None for a default by kind of device. It bounds the memory and changes
            nothing else.
    """

    def __init__(self, device: str | None = None, frames_per_chunk: int | None = None) -> None:
        self.device = wp.get_device(device)
        kind = "cuda" if self.device.is_cuda else "cpu"
        self._frames_per_chunk = frames_per_chunk or FRAMES_PER_CHUNK[kind]
        self._stripes = STRIPES[kind]
        self._lights = wp.array([_light(light) for light in stage.LIGHTS], dtype=raster.Light, device=self.device)
        self._shading = _shading()
        ramp = stage.srgb_from_linear(np.linspace(0, 1, shading.COLORS))
        self._srgb = wp.array(ramp, dtype=wp.uint8, device=self.device)
        self._pinned = wp.empty(0, dtype=wp.uint8, device="cpu")
        self._stages: dict[tuple[bytes, int, int], shading.LitStage] = {}

    def render(
        self,
        bodies: Sequence[Body],
        pose: np.ndarray,
        camera: Camera = HEAD_CAMERA,
        ground: bool = True,
        *,
        points: np.ndarray | None = None,
        depth: bool = False,
        body: bool = False,
        optical_flow: bool = False,
    ) -> Frames:
        """Render one world, a batch of one; arguments as of `World` and `render_batch`.

        Args:
            pose: [t b 7] xyz [m] and quaternion xyzw of each body, world.
            points: [t k 3] points to look up [m], world.
        """
        worlds = [World(bodies, pose, points)]
        return self.render_batch(worlds, camera, ground, depth=depth, body=body, optical_flow=optical_flow)[0]

    def render_batch(
        self,
        worlds: Sequence[World],
        camera: Camera = HEAD_CAMERA,
        ground: bool = True,
        *,
        depth: bool = False,
        body: bool = False,
        optical_flow: bool = False,
    ) -> list[Frames]:
        """Render worlds of any length and content.

        Args:
            ground: True for table, wall, ground and shadows; False for the bodies alone on white, without shadows.
            depth, body, optical_flow: which of the optional images of `Frames` to make.

        Raises:
            ValueError: poses or points do not fit, or are not finite.
        """
        for world in worlds:
            check_world(world)
        if not worlds:
            return []
        optional = {"depth": depth, "body": body, "optical_flow": optical_flow}
        wanted = frozenset(name for name, asked_for in optional.items() if asked_for)
        with PARSING:  # threads take turns at the device, whose buffers and modules are shared; the latter are parsed
            return _split_by_world(self._render_worlds(worlds, camera, ground, wanted), worlds)

    def probe_batch(self, worlds: Sequence[World], camera: Camera = HEAD_CAMERA) -> list[Frames]:
        """Look up the points of worlds with the stage about them, and which body each pixel shows, without any colors.

        Returns:
            For each world its frames as `render_batch` gives them, of which `rgb` and what is optional but `body` are empty.

        Raises:
            ValueError: poses or points do not fit, or are not finite, or a world has no points.
        """
        for world in worlds:
            check_world(world)
            if world.points is None or not world.points.shape[1]:
                raise ValueError("a world has no points to look up; give World.points [t k 3].")
        if not worlds:
            return []
        with PARSING:
            images = self._render_worlds(worlds, camera, True, frozenset({"body"}), colors=False)
            return _split_by_world(images, worlds)

    def _render_worlds(
        self, worlds: Sequence[World], camera: Camera, ground: bool, wanted: frozenset[str], colors: bool = True
    ) -> dict[str, np.ndarray]:
        """Images of all frames of all worlds on the host, by the names of `Frames`; colors, with shadows, if asked for."""
        kinds, kind = distinct_worlds(worlds)
        table, pose = pack_frames(worlds, kind)
        call = _Call(
            geometry=pack_geometry(kinds, self.device),
            pose=wp.array(pose, dtype=wp.transform, device=self.device),
            camera=camera,
            view=_camera_view(camera),
            stage=self._stage(camera, ground),
            shadows=len(stage.LIGHTS) if ground and colors else 0,
            wanted=wanted,
            colors=colors,
        )
        pixel = _nearest_pixel(camera, pack_points(worlds))
        chunks = [slice(i, i + self._frames_per_chunk) for i in range(0, len(table.world), self._frames_per_chunk)]
        host: dict[str, np.ndarray] = {}
        for chunk in chunks:
            for name, image in self._render_chunk(call, table.select(chunk), pixel[chunk]).items():
                self._fetch(image, host, name, chunk, len(table.world))
        return host

    def _fetch(self, image: wp.array, host: dict[str, np.ndarray], name: str, chunk: slice, count: int) -> None:
        """Copy a chunk's image to its place among all frames of a call.

        From a GPU by way of memory that the driver has pinned: that is forty times as fast as without.
        """
        view = image
        if self.device.is_cuda:
            size = image.size * wp.types.type_size_in_bytes(image.dtype)
            if self._pinned.size < size:
                self._pinned = wp.empty(size, dtype=wp.uint8, device="cpu", pinned=True)
            view = wp.array(ptr=self._pinned.ptr, shape=image.shape, dtype=image.dtype, device="cpu", copy=False, pinned=True)
            wp.copy(view, image)
            wait_for(self.device)
        values = view.numpy()
        if name not in host:
            host[name] = np.empty((count, *values.shape[1:]), values.dtype)
        host[name][chunk] = values

    def _render_chunk(self, call: "_Call", frames: FrameTable, pixel: np.ndarray) -> dict[str, wp.array]:
        """Images of some frames on the device, by the names of `Frames`."""
        chunk = _Chunk(self.device, call.geometry, frames)
        drawn = self._draw(call, chunk)
        images = {"rgb": self._shade(call, chunk, drawn)} if call.colors else {}
        images |= self._measure(call, chunk, drawn)
        if pixel.shape[1]:
            images |= self._probe(call, chunk, drawn, pixel)
        return images

    def _draw(self, call: "_Call", chunk: "_Chunk") -> "_Drawn":
        """Visibility of a chunk's frames and, if there are shadows, their shadow maps."""
        count, lights = chunk.count, call.shadows
        drawn = _Drawn(
            vertex=self._zeros((count, chunk.vertex_count), wp.vec3),
            shadow_vertex=self._zeros((count, lights, chunk.vertex_count), wp.vec3),
            key=self._zeros((count, raster.SAMPLES, call.camera.height, call.camera.width), wp.uint64),
            shadow_map=self._zeros((count, lights, SHADOW_SIZE, SHADOW_SIZE), wp.uint32),
            shadow_tile=self._zeros((count, lights, SHADOW_SIZE // raster.TILE, SHADOW_SIZE // raster.TILE), wp.uint32),
        )
        self._launch(
            raster.place_vertices,
            (count, chunk.vertex_count),
            [call.geometry.arrays, chunk.world, chunk.pose, call.pose, call.view, self._lights],
            [drawn.vertex, drawn.shadow_vertex],
        )
        self._launch(
            raster.draw_triangles,
            (count, chunk.triangle_count, self._stripes),
            [call.geometry.arrays, chunk.world, call.view, drawn.vertex, self._stripes],
            [drawn.key],
        )
        self._launch(
            raster.draw_shadows,
            (count, lights, chunk.triangle_count),
            [call.geometry.arrays, chunk.world, drawn.shadow_vertex],
            [drawn.shadow_map, drawn.shadow_tile],
        )
        return drawn

    def _shade(self, call: "_Call", chunk: "_Chunk", drawn: "_Drawn") -> wp.array:
        """Colors of a chunk's frames."""
        height, width = call.camera.height, call.camera.width
        posed = [call.geometry.arrays, chunk.world, chunk.pose, call.pose, call.view]
        seen = [drawn.vertex, drawn.key, drawn.shadow_map, drawn.shadow_tile]
        rgb = self._empty((chunk.count, height, width, 3), wp.uint8)
        self._launch(
            shading.shade_pixels,
            (chunk.count, height, width),
            [*posed, self._lights, self._shading, call.stage, self._srgb, *seen],
            [rgb],
        )
        return rgb

    def _measure(self, call: "_Call", chunk: "_Chunk", drawn: "_Drawn") -> dict[str, wp.array]:
        """Mask, bodies, depth and optical flow of a chunk's frames, as far as wanted."""
        shape = (chunk.count, call.camera.height, call.camera.width)
        posed = [call.geometry.arrays, chunk.world, chunk.pose, chunk.next_pose, call.pose, call.view]
        images = {"robot_mask": self._empty(shape, wp.bool)}
        for name, dtype in (("body", wp.int16), ("depth", wp.float32), ("optical_flow", wp.vec2)):
            images[name] = self._empty(shape if name in call.wanted else (0, 0, 0), dtype)
        self._launch(
            shading.measure_pixels,
            shape,
            [*posed, call.stage, FLOW_LIMIT, drawn.key],
            list(images.values()),
        )
        return {name: image for name, image in images.items() if image.size}

    def _probe(self, call: "_Call", chunk: "_Chunk", drawn: "_Drawn", pixel: np.ndarray) -> dict[str, wp.array]:
        """What is seen at pixels [t k 2] x y of a chunk's frames."""
        shape = pixel.shape[:2]
        images = {"point_body": self._empty(shape, int), "point_depth": self._empty(shape, float)}
        self._launch(
            shading.probe_pixels,
            shape,
            [call.geometry.arrays, chunk.world, call.stage, wp.array(pixel, dtype=wp.vec2i, device=self.device), drawn.key],
            list(images.values()),
        )
        return images

    def _stage(self, camera: Camera, ground: bool) -> shading.LitStage:
        """What never moves as this camera sees it; drawn and lit at first use. Nothing looks the same from anywhere."""
        view = camera.intrinsics.tobytes() + camera.extrinsics.tobytes() if ground else b""
        key = (view, camera.width, camera.height)
        if key not in self._stages:
            if len(self._stages) >= STAGES_KEPT:
                self._stages.clear()
            self._stages[key] = self._lit_stage(camera, ground)
        return self._stages[key]

    def _lit_stage(self, camera: Camera, ground: bool) -> shading.LitStage:
        bodies = [Body(stage.stage_mesh(), False)] if ground else []
        table, pose = pack_frames([World(bodies, np.tile(IDENTITY, (1, len(bodies), 1)))], [0])
        call = _Call(
            geometry=pack_geometry([bodies], self.device),
            pose=wp.array(pose, dtype=wp.transform, device=self.device),
            camera=camera,
            view=_camera_view(camera),
            stage=shading.LitStage(),
        )
        chunk = _Chunk(self.device, call.geometry, table)
        drawn = self._draw(call, chunk)
        height, width, lights = camera.height, camera.width, len(stage.LIGHTS) if ground else 0
        lit = shading.LitStage()
        lit.key = drawn.key[0]
        lit.ambient = self._zeros((height, width), wp.vec3)
        lit.direct = self._zeros((lights, height, width), wp.vec3)
        lit.shadow_texel = self._zeros((lights, height, width), wp.vec3)
        self._launch(
            shading.light_stage,
            (height, width),
            [call.geometry.arrays, call.view, self._lights, self._shading, drawn.vertex, drawn.key, wp.vec3(*stage.SKY)],
            [lit.ambient, lit.direct, lit.shadow_texel],
        )
        return lit

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _zeros(self, shape: tuple[int, ...], dtype: type) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def _empty(self, shape: tuple[int, ...], dtype: type) -> wp.array:
        return wp.empty(shape, dtype=dtype, device=self.device)


@dataclass(frozen=True)
class _Call:
    """What is the same for all frames of a call of the renderer."""

    geometry: PackedGeometry
    pose: wp.array
    camera: Camera
    view: raster.View
    stage: shading.LitStage
    shadows: int = 0
    wanted: frozenset[str] = frozenset()
    colors: bool = True


class _Chunk:
    """The frames that are on the device at once."""

    def __init__(self, device: wp.Device, geometry: PackedGeometry, frames: FrameTable) -> None:
        self.count = len(frames.world)
        self.vertex_count = int(geometry.vertex_counts[frames.world].max())
        self.triangle_count = int(geometry.triangle_counts[frames.world].max())
        self.world, self.pose, self.next_pose = (
            wp.array(column, dtype=int, device=device) for column in (frames.world, frames.pose, frames.next_pose)
        )


@dataclass(frozen=True)
class _Drawn:
    """What `_draw` leaves for the kernels after it, as they describe it in raster_kernels.py."""

    vertex: wp.array
    shadow_vertex: wp.array
    key: wp.array
    shadow_map: wp.array
    shadow_tile: wp.array


def _split_by_world(images: dict[str, np.ndarray], worlds: Sequence[World]) -> list[Frames]:
    """Images of all frames [t ...] -> frames by world."""
    ends = np.cumsum([len(world.pose) for world in worlds])
    frames = []
    for world, end in zip(worlds, ends, strict=True):
        own = {name: image[end - len(world.pose) : end] for name, image in images.items()}
        points = 0 if world.points is None else world.points.shape[1]
        for name in ("point_body", "point_depth"):
            if name in own:
                own[name] = own[name][:, :points]
        frames.append(Frames(**own))
    return frames


def _nearest_pixel(camera: Camera, points: np.ndarray) -> np.ndarray:
    """[t k 2] int32 pixel x, y of points [t k 3]; (-1, -1) for those behind the camera."""
    pixel, _ = project(camera, points)
    return np.where(np.isfinite(pixel), np.clip(np.round(pixel), -1, 1 << 20), -1).astype(np.int32)


def _camera_view(camera: Camera) -> raster.View:
    view = raster.View()
    view.rotation = wp.mat33(*camera.extrinsics[:3, :3].ravel())
    view.translation = wp.vec3(*camera.extrinsics[:3, 3])
    view.focal = wp.vec2(camera.intrinsics[0, 0], camera.intrinsics[1, 1])
    view.center = wp.vec2(*camera.intrinsics[:2, 2])
    return view


def _light(source: stage.Light) -> raster.Light:
    """A light with the view of its shadow map."""
    light = raster.Light()
    light.intensity = source.intensity
    direction = np.array(source.direction) / np.linalg.norm(source.direction)
    light.to_light = wp.vec3(*-direction)
    if source.position is None:
        position = np.array(stage.SHADOW_CENTER) - direction * stage.SHADOW_DISTANCE
    else:
        position = np.array(source.position)
    light.position = wp.vec3(*position)
    camera = look_at(position, position + direction, (0.0, 1.0, 0.0), stage.SHADOW_ANGLE, SHADOW_SIZE, SHADOW_SIZE)
    light.view = _camera_view(camera)
    if source.position is None:
        light.view.parallel = 1
        light.view.focal = wp.vec2(SHADOW_SIZE / stage.SHADOW_WIDTH, SHADOW_SIZE / stage.SHADOW_WIDTH)
    return light


def _shading() -> shading.Shading:
    values = shading.Shading()
    values.ambient = stage.AMBIENT
    values.sky_share = stage.SKY_SHARE
    values.exposure = stage.EXPOSURE
    values.specular = stage.SPECULAR
    values.knee, values.ceiling = stage.KNEE, stage.CEILING
    return values

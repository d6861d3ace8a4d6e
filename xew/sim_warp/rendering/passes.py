"""The renderer's passes over a chunk of frames on the device: visibility and shadow maps (`Passes.draw`), then images."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from xew.sim_warp import stage
from xew.sim_warp.geometry.camera import Camera
from xew.sim_warp.rendering import raster_kernels as raster
from xew.sim_warp.rendering import shading_kernels as shading
from xew.sim_warp.rendering.lighting import SHADOW_SIZE, camera_views, light_of, pack_patterns, stage_shading
from xew.sim_warp.rendering.packing import Body, FrameTable, PackedGeometry, World, pack_frames, pack_geometry

FLOW_LIMIT = 25.0
"""Longest optical flow [pixels], the paper's clip."""
STRIPES = {"cpu": 1, "cuda": 8}
"""Number of threads per triangle; a GPU splits large triangles by rows."""
IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Look:
    """Lights, shading and patterns of a stage as arguments of the kernels."""

    lights: wp.array
    """[l] raster.Light."""
    patterns: shading.Patterns
    shading: shading.Shading


@dataclass(frozen=True)
class Call:
    """Arguments of the renderer for all frames of a call."""

    geometry: PackedGeometry
    pose: wp.array
    """[P] wp.transform, poses of the bodies of all frames, world."""
    camera: Camera
    look: Look
    shadows: int = 0
    """Number of lights with shadow maps."""
    wanted: frozenset[str] = frozenset()
    """Names of the requested optional images of `render.Frames`."""
    colors: bool = True
    """Whether colors are requested."""


class Chunk:
    """The frames that are on the device at once."""

    def __init__(self, device: wp.Device, geometry: PackedGeometry, frames: FrameTable, camera: Camera) -> None:
        self.count = len(frames.world)
        self.vertex_count = int(geometry.vertex_counts[frames.world].max())
        self.triangle_count = int(geometry.triangle_counts[frames.world].max())
        self.world, self.pose, self.next_pose = (
            wp.array(column, dtype=int, device=device) for column in (frames.world, frames.pose, frames.next_pose)
        )
        self.cameras, self.next_cameras = (
            wp.array(camera_views(camera, column), dtype=raster.View, device=device)
            for column in (frames.frame, frames.next_frame)
        )


@dataclass(frozen=True)
class Drawn:
    """Output of `Passes.draw` for the next kernels, see raster_kernels.py."""

    vertex: wp.array
    """[n v] wp.vec3, m, camera's frame."""
    shadow_vertex: wp.array
    """[n l v] wp.vec3, x y [texels] and nearness on each shadow map."""
    key: wp.array
    """[n s h w] uint64, nearness and triangle of each sample."""
    shadow_map: wp.array
    """[n l m m] uint32, nearness of the nearest caster at each texel."""
    shadow_tile: wp.array
    """[n l q q] uint32, largest nearness in and round each tile."""


class Passes:
    """The renderer's kernels on one device, with lights and shading of the stage."""

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._stripes = STRIPES["cuda" if device.is_cuda else "cpu"]
        ramp = stage.srgb_from_linear(np.linspace(0, 1, shading.COLORS))
        self._srgb = wp.array(ramp, dtype=wp.uint8, device=device)

    def look(self, shown: stage.Stage) -> Look:
        """The look of a stage on the device."""
        lights = wp.array([light_of(light) for light in shown.lights], dtype=raster.Light, device=self.device)
        return Look(lights, pack_patterns(shown, self.device), stage_shading(shown.ambient))

    def draw(self, call: Call, chunk: Chunk) -> Drawn:
        """Visibility of a chunk's frames and, if there are shadows, their shadow maps."""
        count, lights = chunk.count, call.shadows
        drawn = Drawn(
            vertex=self._zeros((count, chunk.vertex_count), wp.vec3),
            shadow_vertex=self._zeros((count, lights, chunk.vertex_count), wp.vec3),
            key=self._zeros((count, raster.SAMPLES, call.camera.height, call.camera.width), wp.uint64),
            shadow_map=self._zeros((count, lights, SHADOW_SIZE, SHADOW_SIZE), wp.uint32),
            shadow_tile=self._zeros((count, lights, SHADOW_SIZE // raster.TILE, SHADOW_SIZE // raster.TILE), wp.uint32),
        )
        self._launch(
            raster.place_vertices,
            (count, chunk.vertex_count),
            [call.geometry.arrays, chunk.world, chunk.pose, call.pose, chunk.cameras, call.look.lights],
            [drawn.vertex, drawn.shadow_vertex],
        )
        self._launch(
            raster.draw_triangles,
            (count, chunk.triangle_count, self._stripes),
            [call.geometry.arrays, chunk.world, chunk.cameras, drawn.vertex, self._stripes],
            [drawn.key],
        )
        self._launch(
            raster.draw_shadows,
            (count, lights, chunk.triangle_count),
            [call.geometry.arrays, chunk.world, drawn.shadow_vertex],
            [drawn.shadow_map, drawn.shadow_tile],
        )
        return drawn

    def shade(self, call: Call, chunk: Chunk, drawn: Drawn, lit: shading.LitStage) -> wp.array:
        """Colors [t h w 3] uint8 of a chunk's frames."""
        height, width = call.camera.height, call.camera.width
        posed = [call.geometry.arrays, chunk.world, chunk.pose, call.pose, chunk.cameras]
        seen = [drawn.vertex, drawn.key, drawn.shadow_map, drawn.shadow_tile]
        rgb = self._empty((chunk.count, height, width, 3), wp.uint8)
        self._launch(
            shading.shade_pixels,
            (chunk.count, height, width),
            [*posed, call.look.lights, call.look.shading, lit, self._srgb, *seen],
            [rgb],
        )
        return rgb

    def measure(self, call: Call, chunk: Chunk, drawn: Drawn, lit: shading.LitStage) -> dict[str, wp.array]:
        """Masks of a chunk's frames and, if requested, bodies, depth [m] (all [t h w]) and optical flow [t h w 2] px."""
        shape = (chunk.count, call.camera.height, call.camera.width)
        posed = [call.geometry.arrays, chunk.world, chunk.pose, chunk.next_pose, call.pose]
        images = {"robot_mask": self._empty(shape, wp.bool)}
        for name, dtype in (("body", wp.int16), ("depth", wp.float32), ("optical_flow", wp.vec2)):
            images[name] = self._empty(shape if name in call.wanted else (0, 0, 0), dtype)
        self._launch(
            shading.measure_pixels,
            shape,
            [*posed, chunk.cameras, chunk.next_cameras, lit, FLOW_LIMIT, drawn.key],
            list(images.values()),
        )
        return {name: image for name, image in images.items() if image.size}

    def probe(self, call: Call, chunk: Chunk, drawn: Drawn, lit: shading.LitStage, pixel: np.ndarray) -> dict[str, wp.array]:
        """Body [t k] and depth [t k] m that are seen at pixels [t k 2] x y of a chunk's frames."""
        shape = pixel.shape[:2]
        images = {"point_body": self._empty(shape, int), "point_depth": self._empty(shape, float)}
        self._launch(
            shading.probe_pixels,
            shape,
            [call.geometry.arrays, chunk.world, lit, wp.array(pixel, dtype=wp.vec2i, device=self.device), drawn.key],
            list(images.values()),
        )
        return images

    def light_stage(self, camera: Camera, shown: stage.Stage | None, look: Look) -> shading.LitStage:
        """A stage with its look in the view of a camera, or in each view of one that moves; empty without a stage.

        A stage that only hides has depth and the sky's color.
        """
        is_drawn = shown is not None and not shown.only_hides
        bodies = [] if shown is None else [Body(stage.stage_mesh(shown), False)]
        views = len(camera.extrinsics) if camera.moves else 1
        table, pose = pack_frames([World(bodies, np.tile(IDENTITY, (views, len(bodies), 1)))], [0])
        call = Call(
            geometry=pack_geometry([bodies], self.device),
            pose=wp.array(pose, dtype=wp.transform, device=self.device),
            camera=camera,
            look=look,
        )
        chunk = Chunk(self.device, call.geometry, table, camera)
        drawn = self.draw(call, chunk)
        height, width, lights = camera.height, camera.width, len(look.lights) if is_drawn else 0
        key = drawn.key if is_drawn else self._zeros(drawn.key.shape, wp.uint64)
        lighting = [look.lights, look.shading, drawn.vertex, key, wp.vec3(*stage.SKY), look.patterns]
        lit = shading.LitStage()
        lit.key = drawn.key
        lit.ambient = self._zeros((views, height, width), wp.vec3)
        lit.direct = self._zeros((views, lights, height, width), wp.vec3)
        lit.shadow_texel = self._zeros((views, lights, height, width), wp.vec3)
        self._launch(
            shading.light_stage,
            (views, height, width),
            [call.geometry.arrays, chunk.cameras, *lighting],
            [lit.ambient, lit.direct, lit.shadow_texel],
        )
        return lit

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _zeros(self, shape: tuple[int, ...], dtype: type) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def _empty(self, shape: tuple[int, ...], dtype: type) -> wp.array:
        return wp.empty(shape, dtype=dtype, device=self.device)

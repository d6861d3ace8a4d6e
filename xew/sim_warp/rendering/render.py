"""The renderer: posed bodies to images, for observe.py (recorded states) and streams.py (commands).

Frames show the stage (table, wall, ground, shadows), or the bodies alone on white. This file splits worlds into chunks of
frames for passes.py and joins their images. CPU and GPU run the same kernels, and a frame's bytes do not depend on the batch.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from xew.concurrency import PARSING
from xew.episode import HEIGHT, WIDTH
from xew.sim_warp.devices.waiting import wait_for
from xew.sim_warp.geometry.camera import HEAD_CAMERA, Camera, project
from xew.sim_warp.rendering import shading_kernels as shading
from xew.sim_warp.rendering.packing import (
    Body,
    FrameTable,
    World,
    check_world,
    distinct_worlds,
    pack_frames,
    pack_geometry,
    pack_points,
)
from xew.sim_warp.rendering.passes import FLOW_LIMIT, Call, Chunk, Look, Passes
from xew.sim_warp.stage import STANDARD, Stage

__all__ = ["FLOW_LIMIT", "Body", "Frames", "Renderer", "World"]

FRAMES_PER_CHUNK = {"cpu": 4, "cuda": 512}
"""Number of frames of 320x240 pixels on the device at once, about 6 MB each; 16 MB where the camera moves."""
MOVING_COST = 3
"""Memory of a frame of a camera that moves, relative to one that stands still: the lit stage is the frame's own."""
STAGES_KEPT = 16
"""Number of cameras and stages with a cached lit stage, about 10 MB each."""


def _nothing() -> np.ndarray:
    return np.empty(0)


@dataclass(frozen=True)
class Frames:
    """Images of one world; arrays that were not requested are empty."""

    rgb: np.ndarray = field(default_factory=_nothing)
    """[t h w 3] uint8, sRGB, anti-aliased."""
    robot_mask: np.ndarray = field(default_factory=_nothing)
    """[t h w] bool, whether the ray through the pixel's center meets the robot first."""
    depth: np.ndarray = field(default_factory=_nothing)
    """[t h w] float32 depth along the optical axis at the pixel's center [m], 0 for none."""
    body: np.ndarray = field(default_factory=_nothing)
    """[t h w] int16 index of the body at the pixel's center, -1 for none."""
    optical_flow: np.ndarray = field(default_factory=_nothing)
    """[t h w 2] float32 motion (x right, y down) [pixels] from this frame to the next of the robot's surface point
    under the pixel's center, no longer than `FLOW_LIMIT`; zero off the robot and in the last frame."""
    point_body: np.ndarray = field(default_factory=_nothing)
    """[t k] int32 index of the body seen in the pixel of each of the world's points, -1 none, -2 outside the image."""
    point_depth: np.ndarray = field(default_factory=_nothing)
    """[t k] float32 depth at that pixel [m], 0 for none."""


class Renderer:
    """Renders worlds in batches; caches the lit stage of each camera.

    Args:
        device: Warp's name of a device, None for Warp's default.
        frames_per_chunk: frames in flight, None for a default by kind of device; bounds the memory.
    """

    def __init__(self, device: str | None = None, frames_per_chunk: int | None = None) -> None:
        self.device = wp.get_device(device)
        kind = "cuda" if self.device.is_cuda else "cpu"
        self._frames_per_chunk = frames_per_chunk or FRAMES_PER_CHUNK[kind]
        self._passes = Passes(self.device)
        self._pinned = wp.empty(0, dtype=wp.uint8, device="cpu")
        self._looks: dict[Stage, Look] = {}
        self._stages: dict[tuple[bytes, int, int, Stage | None], shading.LitStage] = {}

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
        """Render one world; `pose` [t b 7] and `points` [t k 3] as of `World`, other arguments as of `render_batch`."""
        worlds = [World(bodies, pose, points)]
        return self.render_batch(worlds, camera, ground, depth=depth, body=body, optical_flow=optical_flow)[0]

    def render_batch(
        self,
        worlds: Sequence[World],
        camera: Camera = HEAD_CAMERA,
        ground: bool = True,
        *,
        stage: Stage = STANDARD,
        depth: bool = False,
        body: bool = False,
        optical_flow: bool = False,
        colors: bool = True,
    ) -> list[Frames]:
        """Render worlds of any length and content.

        Args:
            camera: of all worlds; one that moves has a pose for each frame of all worlds, in order.
            ground: True for table, wall, ground and shadows; False for the bodies alone on white, without shadows.
            stage: table, wall, ground and lights of all worlds; without the ground the light is the standard one.
                One that only hides (`Stage.only_hides`) casts no shadows.
            depth, body, optical_flow: requests for the optional images of `Frames`.
            colors: whether to make `rgb`.

        Raises:
            ValueError: poses or points do not fit, or are not finite.
        """
        check_worlds(worlds, camera)
        if not worlds:
            return []
        optional = {"depth": depth, "body": body, "optical_flow": optical_flow}
        wanted = frozenset(name for name, asked_for in optional.items() if asked_for)
        with PARSING:  # threads share the device's buffers and modules
            images = self._render_worlds(worlds, camera, stage if ground else None, wanted, colors)
            return _split_by_world(images, worlds)

    def probe_batch(self, worlds: Sequence[World], camera: Camera = HEAD_CAMERA, stage: Stage = STANDARD) -> list[Frames]:
        """As `render_batch` with stage, bodies and depth, but without `rgb`, for worlds with points.

        Raises:
            ValueError: poses or points do not fit, or are not finite, or a world has no points.
        """
        check_worlds(worlds, camera)
        for world in worlds:
            if world.points is None or not world.points.shape[1]:
                raise ValueError("a world has no points to look up; give World.points [t k 3].")
        if not worlds:
            return []
        with PARSING:
            images = self._render_worlds(worlds, camera, stage, frozenset({"body", "depth"}), colors=False)
            return _split_by_world(images, worlds)

    def _render_worlds(
        self, worlds: Sequence[World], camera: Camera, stage: Stage | None, wanted: frozenset[str], colors: bool = True
    ) -> dict[str, np.ndarray]:
        """Images of all frames of all worlds on the host, by the names of `Frames`; colors, with shadows, if asked for."""
        kinds, kind = distinct_worlds(worlds)
        table, pose = pack_frames(worlds, kind)
        look = self._look(stage or STANDARD)
        call = Call(
            geometry=pack_geometry(kinds, self.device),
            pose=wp.array(pose, dtype=wp.transform, device=self.device),
            camera=camera,
            look=look,
            shadows=len(stage.lights) if stage and colors and not stage.only_hides else 0,
            wanted=wanted,
            colors=colors,
        )
        pixel = nearest_pixel(camera, pack_points(worlds))
        count = self._chunk_size(camera)
        host: dict[str, np.ndarray] = {}
        for chunk in (slice(i, i + count) for i in range(0, len(table.world), count)):
            at_chunk = replace(camera, extrinsics=camera.extrinsics[chunk]) if camera.moves else camera
            lit = self._stage(at_chunk, stage, look)
            for name, image in self._render_chunk(call, table.select(chunk), lit, pixel[chunk]).items():
                self._fetch(image, host, name, chunk, len(table.world))
        return host

    def _chunk_size(self, camera: Camera) -> int:
        """Number of a camera's frames on the device at once: in memory as many as `frames_per_chunk` of the head camera."""
        cost = camera.width * camera.height / (WIDTH * HEIGHT) * (MOVING_COST if camera.moves else 1)
        return max(1, int(self._frames_per_chunk / cost))

    def _fetch(self, image: wp.array, host: dict[str, np.ndarray], name: str, chunk: slice, count: int) -> None:
        """Copy a chunk's image to its place among all frames; from a GPU by pinned memory, which is forty times as fast."""
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

    def _render_chunk(self, call: Call, frames: FrameTable, lit: shading.LitStage, pixel: np.ndarray) -> dict[str, wp.array]:
        """Images of some frames on the device, by the names of `Frames`."""
        passes, chunk = self._passes, Chunk(self.device, call.geometry, frames, call.camera)
        drawn = passes.draw(call, chunk)
        images = {"rgb": passes.shade(call, chunk, drawn, lit)} if call.colors else {}
        images |= passes.measure(call, chunk, drawn, lit)
        if pixel.shape[1]:
            images |= passes.probe(call, chunk, drawn, lit, pixel)
        return images

    def _look(self, stage: Stage) -> Look:
        """Lights, shading and patterns of a stage, cached."""
        if stage not in self._looks:
            if len(self._looks) >= STAGES_KEPT:
                self._looks.clear()
            self._looks[stage] = self._passes.look(stage)
        return self._looks[stage]

    def _stage(self, camera: Camera, stage: Stage | None, look: Look) -> shading.LitStage:
        """The lit stage of a camera, cached if it stands still; without a stage one entry serves all cameras of a size."""
        if camera.moves and stage:
            return self._passes.light_stage(camera, stage, look)
        if camera.moves:
            camera = replace(camera, extrinsics=camera.extrinsics[0])
        view = camera.intrinsics.tobytes() + camera.extrinsics.tobytes() if stage else b""
        key = (view, camera.width, camera.height, stage)
        if key not in self._stages:
            if len(self._stages) >= STAGES_KEPT:
                self._stages.clear()
            self._stages[key] = self._passes.light_stage(camera, stage, look)
        return self._stages[key]


def check_worlds(worlds: Sequence[World], camera: Camera) -> None:
    """Raise ValueError as `check_world`, or if the camera does not have a pose for each frame."""
    for world in worlds:
        check_world(world)
    frames = sum(len(world.pose) for world in worlds)
    if camera.moves and len(camera.extrinsics) != frames:
        raise ValueError(f"the camera has {len(camera.extrinsics)} poses, expected one for each of the {frames} frames.")


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


def nearest_pixel(camera: Camera, points: np.ndarray) -> np.ndarray:
    """[t k 2] int32 pixel x, y of points [t k 3]; (-1, -1) for those behind the camera."""
    pixel, _ = project(camera, points)
    return np.where(np.isfinite(pixel), np.clip(np.round(pixel), -1, 1 << 20), -1).astype(np.int32)

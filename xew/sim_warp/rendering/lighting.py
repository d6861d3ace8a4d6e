"""Camera, lights and shading of the stage as arguments of the kernels."""

from typing import Any

import numpy as np
import warp as wp

from xew.sim_warp import stage
from xew.sim_warp.geometry.camera import Camera, look_at
from xew.sim_warp.rendering import raster_kernels as raster
from xew.sim_warp.rendering import shading_kernels as shading

SHADOW_SIZE = 512
"""Side of a shadow map [texels], about 3.5 mm each on the table: less than two pixels of the head camera."""


def camera_views(camera: Camera, frames: np.ndarray) -> np.ndarray:
    """The camera as an argument of the kernels, `raster_kernels.View` by field: [n] at frames [n] if it moves, else [1]."""
    extrinsics = camera.extrinsics[frames] if camera.moves else camera.extrinsics[None]
    fields: Any = raster.View
    views: Any = np.zeros(len(extrinsics), fields.numpy_dtype())
    views["rotation"], views["translation"] = extrinsics[:, :3, :3], extrinsics[:, :3, 3]
    views["focal"], views["center"] = camera.intrinsics[[0, 1], [0, 1]], camera.intrinsics[:2, 2]
    views["near"] = raster.NEAR_OF_MOVING if camera.moves else raster.NEAR
    return views


def light_view(camera: Camera) -> raster.View:
    """The view of a light's shadow map."""
    view = raster.View()
    view.rotation = wp.mat33(*camera.extrinsics[:3, :3].ravel())
    view.translation = wp.vec3(*camera.extrinsics[:3, 3])
    view.focal = wp.vec2(camera.intrinsics[0, 0], camera.intrinsics[1, 1])
    view.center = wp.vec2(*camera.intrinsics[:2, 2])
    return view


def light_of(source: stage.Light) -> raster.Light:
    """A light of the stage, with the view of its shadow map."""
    light = raster.Light()
    light.intensity = wp.vec3(*(source.intensity * np.array(source.color)))
    direction = np.array(source.direction) / np.linalg.norm(source.direction)
    light.to_light = wp.vec3(*-direction)
    if source.position is None:
        position = np.array(stage.SHADOW_CENTER) - direction * stage.SHADOW_DISTANCE
    else:
        position = np.array(source.position)
    light.position = wp.vec3(*position)
    camera = look_at(position, position + direction, (0.0, 1.0, 0.0), stage.SHADOW_ANGLE, SHADOW_SIZE, SHADOW_SIZE)
    light.view = light_view(camera)
    if source.position is None:
        light.view.parallel = 1
        light.view.focal = wp.vec2(SHADOW_SIZE / stage.SHADOW_WIDTH, SHADOW_SIZE / stage.SHADOW_WIDTH)
    return light


def pack_patterns(look: stage.Stage, device: wp.Device) -> shading.Patterns:
    """The patterns of the stage's surfaces on a device."""
    parts = stage.stage_parts(look)
    shown = list({id(pattern): pattern for _, pattern in parts if pattern is not None}.values())
    index = [-1 if pattern is None else shown.index(pattern) for _, pattern in parts]
    images = stage.linear_from_srgb(np.array([pattern.image for pattern in shown])).astype(np.float32)
    packed = shading.Patterns()
    packed.image = wp.array(images if shown else np.zeros((0, 1, 1, 3), np.float32), dtype=wp.vec3, device=device)
    packed.period = wp.array([pattern.period for pattern in shown], dtype=float, device=device)
    packed.of_triangle = wp.array(np.repeat(index, [len(mesh.triangles) for mesh, _ in parts]), dtype=int, device=device)
    return packed


def stage_shading(ambient: float) -> shading.Shading:
    """Exposure, ambient light and gloss of the stage."""
    values = shading.Shading()
    values.ambient = ambient
    values.sky_share = stage.SKY_SHARE
    values.exposure = stage.EXPOSURE
    values.specular = stage.SPECULAR
    values.knee, values.ceiling = stage.KNEE, stage.CEILING
    return values

"""Warp kernels that make colors, masks, depth and optical flow from the samples of raster_kernels.py.

A pixel is shaded once per visible triangle, at the mean of that triangle's samples, in linear light. The light on the stage is
cached per camera and source; a frame multiplies it with its shadows. Frames of reference and letters of shapes are as in
raster_kernels.py; k counts points to look up in a frame.
"""

# Warp does not know any().
# ruff: noqa: SIM110

# Annotations of kernels are types of Warp, which mypy does not know.
# mypy: ignore-errors

import warp as wp

from xew.sim_warp.rendering.raster_kernels import (
    CENTER,
    OFFSET_X,
    OFFSET_Y,
    SAMPLES,
    TILE,
    Geometry,
    Light,
    View,
    bits,
    to_screen,
    to_view,
    vec5,
    view_of,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})  # why: see raster_kernels.py

SHADOW_BIAS = wp.constant(0.0015)
"""Distance behind a surface up to which a point is still lit [m]."""
COLORS = wp.constant(8192)
"""Number of entries of the table from linear light to sRGB."""


@wp.struct
class Shading:
    """The constants by which surfaces answer light; stage.py says what each is."""

    ambient: float
    sky_share: float
    exposure: float
    specular: float
    knee: float
    ceiling: float


@wp.struct
class LitStage:
    """The static stage in a camera's view: keys of its samples and, per pixel, its light without shadows.

    The views u are one for a camera that stands still, and one for each frame of the chunk for one that moves.
    """

    key: wp.array4d(dtype=wp.uint64)  # [u s h w] uint64
    ambient: wp.array3d(dtype=wp.vec3)  # [u h w 3] float32 linear RGB
    direct: wp.array4d(dtype=wp.vec3)  # [u l h w 3] float32 linear RGB, by light
    shadow_texel: wp.array4d(dtype=wp.vec3)  # [u l h w 3] float32 x y [texels] and nearness of the pixel's center


@wp.struct
class Patterns:
    """Periodic images on surfaces of the stage."""

    image: wp.array3d(dtype=wp.vec3)  # [x m m 3] float32 linear RGB
    period: wp.array(dtype=float)  # [x] float32 m, side of each image on its surface
    of_triangle: wp.array(dtype=int)  # [f] int32 index of a triangle's image, -1 for its plain color


# ---- shadows


@wp.func
def shadow_reach(texel: wp.vec3, parallel: int) -> float:
    """Nearness beyond which something on the map shades the point at `texel`."""
    if parallel == 1:
        return texel[2] + SHADOW_BIAS
    return texel[2] + SHADOW_BIAS * texel[2] * texel[2]


@wp.func
def lit_share(
    texel: wp.vec3,
    reach: float,
    frame: int,
    light: int,
    map_in: wp.array4d(dtype=wp.uint32),  # [n l m m] uint32 bits of nearness
    tile_in: wp.array4d(dtype=wp.uint32),  # [n l q q] uint32 bits of nearness
) -> float:
    """Share of the light that arrives: nine texels round the point, each with bilinear weights (16 comparisons)."""
    size = float(map_in.shape[2])
    if texel[0] < 2.0 or texel[1] < 2.0 or texel[0] > size - 4.0 or texel[1] > size - 4.0:
        return 1.0
    threshold = bits(reach)
    x = int(texel[0])
    y = int(texel[1])
    if tile_in[frame, light, y / TILE, x / TILE] <= threshold:
        return 1.0
    fx = texel[0] - float(x)
    fy = texel[1] - float(y)
    shaded = 0.0
    texels = map_in[frame, light]
    for j in range(4):
        row = texels[y + j - 1]
        in_row = wp.where(row[x - 1] > threshold, 1.0 - fx, 0.0) + wp.where(row[x] > threshold, 1.0, 0.0)
        in_row += wp.where(row[x + 1] > threshold, 1.0, 0.0) + wp.where(row[x + 2] > threshold, fx, 0.0)
        shaded += in_row * wp.where(j == 0, 1.0 - fy, wp.where(j == 3, fy, 1.0))
    return 1.0 - shaded / 9.0


# ---- light on surfaces


@wp.struct
class Surface:
    """A point of a triangle that a pixel sees."""

    point: wp.vec3  # m, world
    normal: wp.vec3  # unit vector, world
    to_eye: wp.vec3  # unit vector, world
    albedo: wp.vec3  # linear RGB


@wp.func
def corner_weights(a: wp.vec3, b: wp.vec3, c: wp.vec3, p: wp.vec3) -> wp.vec3:
    """Barycentric coordinates of a point of the triangle's plane, clipped to the triangle."""
    plane = wp.cross(b - a, c - a)
    scale = 1.0 / wp.max(wp.dot(plane, plane), 1.0e-30)
    v = wp.clamp(wp.dot(plane, wp.cross(c - a, a - p)) * scale, 0.0, 1.0)
    w = wp.clamp(wp.dot(plane, wp.cross(a - b, a - p)) * scale, 0.0, 1.0)
    return wp.vec3(wp.max(1.0 - v - w, 0.0), v, w)


@wp.func
def pixel_ray(camera: View, x: float, y: float) -> wp.vec3:
    """The ray through a pixel, as its point at a depth of 1 m in the camera's frame."""
    return wp.vec3((x - camera.center[0]) / camera.focal[0], (y - camera.center[1]) / camera.focal[1], 1.0)


@wp.func
def surface_at(
    geometry: Geometry,
    packed: int,
    body_pose: wp.transform,
    camera: View,
    seen: wp.vec3,
    frame: int,
    vertex_in: wp.array2d(dtype=wp.vec3),  # [n v 3] float32 m, camera's frame
) -> Surface:
    """The point `seen` (camera's frame) of a triangle: point and shading normal in the world, color."""
    corner = geometry.triangle[packed]
    weight = corner_weights(vertex_in[frame, corner[0]], vertex_in[frame, corner[1]], vertex_in[frame, corner[2]], seen)
    normal = (
        geometry.normal[packed, 0] * weight[0] + geometry.normal[packed, 1] * weight[1] + geometry.normal[packed, 2] * weight[2]
    )
    surface = Surface()
    surface.point = wp.transpose(camera.rotation) * (seen - camera.translation)
    surface.normal = wp.normalize(wp.transform_vector(body_pose, normal))
    surface.to_eye = wp.transpose(camera.rotation) * (-wp.normalize(seen))
    surface.albedo = geometry.albedo[packed]
    return surface


@wp.func
def pattern_at(image: wp.array2d(dtype=wp.vec3), u: float, v: float) -> wp.vec3:
    """The color of a periodic image at u to the right and v upward, in pixels, with bilinear weights."""
    size = float(image.shape[0])
    x = u - wp.floor(u / size) * size
    y = v - wp.floor(v / size) * size
    left = wp.min(int(x), image.shape[1] - 1)
    low = wp.min(int(y), image.shape[0] - 1)
    right = (left + 1) % image.shape[1]
    high = (low + 1) % image.shape[0]
    fx = x - float(left)
    fy = y - float(low)
    below = image[low, left] * (1.0 - fx) + image[low, right] * fx
    above = image[high, left] * (1.0 - fx) + image[high, right] * fx
    return below * (1.0 - fy) + above * fy


@wp.func
def stage_albedo(patterns: Patterns, triangle: int, surface: Surface) -> wp.vec3:
    """The color of a point of the stage: linear RGB."""
    pattern = patterns.of_triangle[triangle]
    if pattern < 0:
        return surface.albedo
    image = patterns.image[pattern]
    scale = float(image.shape[0]) / patterns.period[pattern]
    point = surface.point * scale
    if wp.abs(surface.normal[2]) > 0.5:
        return pattern_at(image, point[0], point[1])
    if wp.abs(surface.normal[1]) > 0.5:
        return pattern_at(image, point[0], point[2])
    return pattern_at(image, point[1], point[2])


@wp.func
def ambient_light(surface: Surface, shading: Shading) -> wp.vec3:
    """Light from everywhere, less of it on what faces down: linear RGB."""
    strength = shading.ambient * (1.0 - shading.sky_share * 0.5 * (1.0 - surface.normal[2]))
    return surface.albedo * (strength * shading.exposure)


@wp.func
def direct_light(surface: Surface, light: Light, shading: Shading) -> wp.vec3:
    """Lambert's diffuse light and Blinn-Phong's highlight (power 32) of one light, without shadow: linear RGB."""
    to_light = light.to_light
    intensity = light.intensity
    if light.view.parallel == 0:
        offset = light.position - surface.point
        squared = wp.length_sq(offset)
        to_light = offset / wp.sqrt(squared)
        intensity = light.intensity / squared
    facing = wp.dot(surface.normal, to_light)
    if facing <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    shine = wp.max(wp.dot(surface.normal, wp.normalize(to_light + surface.to_eye)), 0.0)
    shine = shine * shine
    shine = shine * shine
    shine = shine * shine
    shine = shine * shine
    gloss = shading.specular * shine * shine
    return wp.cw_mul(surface.albedo * facing + wp.vec3(gloss, gloss, gloss), intensity * shading.exposure)


@wp.func
def compress_highlight(light: float, shading: Shading) -> float:
    """Compress bright light below a ceiling, for contrast between a white robot and a white ground."""
    above = light - shading.knee
    if above <= 0.0:
        return light
    headroom = shading.ceiling - shading.knee
    return shading.knee + headroom * (above / (above + headroom))


@wp.func
def compress_highlights(light: wp.vec3, shading: Shading) -> wp.vec3:
    """`compress_highlight` of each channel of linear RGB."""
    return wp.vec3(
        compress_highlight(light[0], shading), compress_highlight(light[1], shading), compress_highlight(light[2], shading)
    )


@wp.func
def nearness_of(key: wp.uint64) -> float:
    """1 / depth [1/m] of a key, 0 where nothing is seen."""
    return wp.cast(wp.uint32(key >> wp.uint64(32)), float)


@wp.func
def depth_of(key: wp.uint64) -> float:
    """Depth along the optical axis [m], 0 where nothing is seen."""
    if key == wp.uint64(0):
        return 0.0
    return 1.0 / nearness_of(key)


@wp.func
def owner(key: wp.uint64, stage_key: wp.uint64) -> int:
    """The triangle that a sample shows, -1 if it shows the stage."""
    if key <= stage_key:
        return -1
    return int(key & wp.uint64(0xFFFFFFFF)) - 1


@wp.kernel
def light_stage(
    # In:
    geometry: Geometry,
    cameras: wp.array(dtype=View),  # [u]
    lights: wp.array(dtype=Light),  # [l] lights with the views of their shadow maps
    shading: Shading,
    vertex_in: wp.array2d(dtype=wp.vec3),  # [u v 3] float32 m, camera's frame
    key_in: wp.array4d(dtype=wp.uint64),  # [u s h w] uint64, see `draw_triangles`
    sky: wp.vec3,  # linear RGB where nothing is
    patterns: Patterns,
    # Out:
    ambient_out: wp.array3d(dtype=wp.vec3),  # [u h w 3] float32 linear RGB
    direct_out: wp.array4d(dtype=wp.vec3),  # [u l h w 3] float32 linear RGB, without shadows
    shadow_texel_out: wp.array4d(dtype=wp.vec3),  # [u l h w 3] float32 x y [texels] and nearness on each shadow map
):
    """Light the stage once per view, by source; frames multiply it with their shadows."""
    u, row, column = wp.tid()
    camera = cameras[u]
    ambient = wp.vec3(0.0, 0.0, 0.0)
    for sample in range(SAMPLES):
        triangle = owner(key_in[u, sample, row, column], wp.uint64(0))
        if triangle < 0:
            if sample != CENTER:
                ambient += sky * 0.25
        else:
            ray = pixel_ray(camera, float(column) + OFFSET_X[sample], float(row) + OFFSET_Y[sample])
            seen = ray / nearness_of(key_in[u, sample, row, column])
            surface = surface_at(geometry, triangle, wp.transform_identity(), camera, seen, u, vertex_in)
            surface.albedo = stage_albedo(patterns, triangle, surface)
            if sample != CENTER:
                ambient += ambient_light(surface, shading) * 0.25
            for i in range(direct_out.shape[1]):
                if sample == CENTER:
                    shadow_texel_out[u, i, row, column] = to_screen(lights[i].view, to_view(lights[i].view, surface.point))
                else:
                    direct_out[u, i, row, column] += direct_light(surface, lights[i], shading) * 0.25
    ambient_out[u, row, column] = ambient


# ---- from visibility to images


@wp.func
def to_srgb(
    light: float,
    srgb: wp.array(dtype=wp.uint8),  # [8192] uint8 sRGB of evenly spaced linear light
) -> wp.uint8:
    """The sRGB value of linear light, clipped to 0 to 1."""
    return srgb[int(wp.clamp(light, 0.0, 1.0) * float(COLORS - 1) + 0.5)]


@wp.func
def stage_key_of(stage: LitStage, frame: int, sample: int, row: int, column: int) -> wp.uint64:
    """The stage's key at a sample of a frame."""
    return stage.key[wp.min(frame, stage.key.shape[0] - 1), sample, row, column]


@wp.func
def stage_light(
    stage: LitStage,
    lights: wp.array(dtype=Light),  # [l]
    shading: Shading,
    frame: int,
    row: int,
    column: int,
    map_in: wp.array4d(dtype=wp.uint32),  # [n l m m] uint32 bits of nearness
    tile_in: wp.array4d(dtype=wp.uint32),  # [n l q q] uint32 bits of nearness
) -> wp.vec3:
    """Light of the stage in a pixel, with a frame's shadows: linear RGB."""
    u = wp.min(frame, stage.key.shape[0] - 1)
    total = stage.ambient[u, row, column]
    if stage.direct.shape[1] == 0:
        return total
    for i in range(stage.direct.shape[1]):
        share = 1.0
        if map_in.shape[1] > 0:
            texel = stage.shadow_texel[u, i, row, column]
            share = lit_share(texel, shadow_reach(texel, lights[i].view.parallel), frame, i, map_in, tile_in)
        total += stage.direct[u, i, row, column] * share
    return compress_highlights(total, shading)


@wp.func
def surface_light(
    surface: Surface,
    lights: wp.array(dtype=Light),  # [l]
    shading: Shading,
    frame: int,
    map_in: wp.array4d(dtype=wp.uint32),  # [n l m m] uint32 bits of nearness
    tile_in: wp.array4d(dtype=wp.uint32),  # [n l q q] uint32 bits of nearness
) -> wp.vec3:
    """Light of a surface, with a frame's shadows: linear RGB."""
    total = ambient_light(surface, shading)
    for i in range(lights.shape[0]):
        light = lights[i]
        arriving = direct_light(surface, light, shading)
        if map_in.shape[1] > 0 and arriving[0] + arriving[1] + arriving[2] > 0.0:
            texel = to_screen(light.view, to_view(light.view, surface.point))
            arriving = arriving * lit_share(texel, shadow_reach(texel, light.view.parallel), frame, i, map_in, tile_in)
        total += arriving
    return compress_highlights(total, shading)


@wp.func
def is_shown_before(shown: wp.vec4i, sample: int) -> bool:
    """Whether an earlier sample shows the same triangle."""
    for earlier in range(sample):
        if shown[earlier] == shown[sample]:
            return True
    return False


@wp.kernel
def shade_pixels(
    # In:
    geometry: Geometry,
    frame_world: wp.array(dtype=int),  # [n] int32 index of the frame's world among the distinct worlds
    frame_pose: wp.array(dtype=int),  # [n] int32 index into `pose` of the frame's first body
    pose: wp.array(dtype=wp.transform),  # [P 7] float32 xyz [m] and quaternion xyzw of bodies, world
    cameras: wp.array(dtype=View),  # [n] or [1], see `view_of`
    lights: wp.array(dtype=Light),  # [l] lights with the views of their shadow maps
    shading: Shading,
    stage: LitStage,
    srgb: wp.array(dtype=wp.uint8),  # [8192] uint8 sRGB of evenly spaced linear light
    vertex_in: wp.array2d(dtype=wp.vec3),  # [n v 3] float32 m, camera's frame
    key_in: wp.array4d(dtype=wp.uint64),  # [n s h w] uint64, see `draw_triangles`
    map_in: wp.array4d(dtype=wp.uint32),  # [n l m m] uint32 bits of nearness, see `draw_shadows`
    tile_in: wp.array4d(dtype=wp.uint32),  # [n l q q] uint32 bits of nearness
    # Out:
    rgb_out: wp.array4d(dtype=wp.uint8),  # [n h w 3] uint8 sRGB
):
    """Color pixels: each triangle among a pixel's four samples is lit once, at the mean of its samples."""
    frame, row, column = wp.tid()
    drawn = key_in[frame, 0, row, column] | key_in[frame, 1, row, column]
    drawn = drawn | key_in[frame, 2, row, column] | key_in[frame, 3, row, column]
    if drawn == wp.uint64(0):
        plain = stage_light(stage, lights, shading, frame, row, column, map_in, tile_in)
        for channel in range(3):
            rgb_out[frame, row, column, channel] = to_srgb(plain[channel], srgb)
        return
    camera = view_of(cameras, frame)
    first_triangle = geometry.triangle_range[frame_world[frame]][0]
    shown = wp.vec4i(-1, -1, -1, -1)
    for s in range(4):
        shown[s] = owner(key_in[frame, s, row, column], stage_key_of(stage, frame, s, row, column))
    total = wp.vec3(0.0, 0.0, 0.0)
    for s in range(4):
        triangle = shown[s]
        if not is_shown_before(shown, s):
            place = vec5(0.0, 0.0, 0.0, 0.0, 0.0)
            for other in range(s, 4):
                if shown[other] == triangle:
                    nearness = nearness_of(key_in[frame, other, row, column])
                    place += vec5(1.0, OFFSET_X[other], OFFSET_Y[other], nearness, 0.0)
            count = place[0]
            if triangle < 0:
                total += stage_light(stage, lights, shading, frame, row, column, map_in, tile_in) * (0.25 * count)
            else:
                packed = first_triangle + triangle
                # nearness is affine over the screen: its mean belongs to the mean of the samples
                ray = pixel_ray(camera, float(column) + place[1] / count, float(row) + place[2] / count)
                body_pose = pose[frame_pose[frame] + geometry.triangle_body[packed]]
                surface = surface_at(geometry, packed, body_pose, camera, ray * (count / place[3]), frame, vertex_in)
                total += surface_light(surface, lights, shading, frame, map_in, tile_in) * (0.25 * count)
    for channel in range(3):
        rgb_out[frame, row, column, channel] = to_srgb(total[channel], srgb)


@wp.func
def carry_point(from_pose: wp.transform, to_pose: wp.transform, point: wp.vec3) -> wp.vec3:
    """A point [m] of a body after the body moves from one pose to another; all in the world."""
    return wp.transform_point(to_pose, wp.transform_point(wp.transform_inverse(from_pose), point))


@wp.func
def screen_motion(camera: View, seen: wp.vec3, next_camera: View, after: wp.vec3, limit: float) -> wp.vec2:
    """Motion in pixels between a point of the camera's frame and one of the next camera's frame, no longer than `limit`."""
    now = to_screen(camera, seen)
    later = to_screen(next_camera, wp.vec3(after[0], after[1], wp.max(after[2], next_camera.near)))
    motion = wp.vec2(later[0] - now[0], later[1] - now[1])
    length = wp.length(motion)
    if length > limit:
        motion = motion * (limit / length)
    return motion


@wp.kernel
def measure_pixels(
    # In:
    geometry: Geometry,
    frame_world: wp.array(dtype=int),  # [n] int32 index of the frame's world among the distinct worlds
    frame_pose: wp.array(dtype=int),  # [n] int32 index into `pose` of the frame's first body
    frame_next_pose: wp.array(dtype=int),  # [n] int32 the same of the episode's next frame
    pose: wp.array(dtype=wp.transform),  # [P 7] float32 xyz [m] and quaternion xyzw of bodies, world
    cameras: wp.array(dtype=View),  # [n] or [1], see `view_of`
    next_cameras: wp.array(dtype=View),  # [n] or [1], the same of the episode's next frame
    stage: LitStage,
    flow_limit: float,  # longest optical flow [pixels]
    key_in: wp.array4d(dtype=wp.uint64),  # [n s h w] uint64, see `draw_triangles`
    # Out:
    mask_out: wp.array3d(dtype=wp.bool),  # [n h w] bool, True on the robot
    body_out: wp.array3d(dtype=wp.int16),  # [n h w] int16 index of the body, -1 for none; or [0 0 0]
    depth_out: wp.array3d(dtype=float),  # [n h w] float32 m, 0 where nothing is; or [0 0 0]
    flow_out: wp.array3d(dtype=wp.vec2),  # [n h w 2] float32 pixels to the next frame, x right, y down; or [0 0 0 2]
):
    """Measure the surface at each pixel's center; empty outputs are skipped."""
    frame, row, column = wp.tid()
    world = frame_world[frame]
    body = -1
    robot = 0
    flow = wp.vec2(0.0, 0.0)
    stage_key = stage_key_of(stage, frame, CENTER, row, column)
    key = wp.max(key_in[frame, CENTER, row, column], stage_key)
    triangle = owner(key, stage_key)
    if triangle >= 0:
        body = geometry.triangle_body[geometry.triangle_range[world][0] + triangle]
        robot = geometry.body_is_robot[geometry.body_first[world] + body]
        if flow_out.shape[0] > 0 and robot == 1 and frame_next_pose[frame] != frame_pose[frame]:
            camera = view_of(cameras, frame)
            next_camera = view_of(next_cameras, frame)
            seen = pixel_ray(camera, float(column), float(row)) / nearness_of(key)
            point = wp.transpose(camera.rotation) * (seen - camera.translation)
            after = carry_point(pose[frame_pose[frame] + body], pose[frame_next_pose[frame] + body], point)
            flow = screen_motion(camera, seen, next_camera, to_view(next_camera, after), flow_limit)
    mask_out[frame, row, column] = robot == 1
    if body_out.shape[0] > 0:
        body_out[frame, row, column] = wp.int16(body)
    if depth_out.shape[0] > 0:
        depth_out[frame, row, column] = depth_of(key)
    if flow_out.shape[0] > 0:
        flow_out[frame, row, column] = flow


@wp.kernel
def probe_pixels(
    # In:
    geometry: Geometry,
    frame_world: wp.array(dtype=int),  # [n] int32 index of the frame's world among the distinct worlds
    stage: LitStage,
    pixel: wp.array2d(dtype=wp.vec2i),  # [n k 2] int32 x y of the pixels to look up
    key_in: wp.array4d(dtype=wp.uint64),  # [n s h w] uint64, see `draw_triangles`
    # Out:
    body_out: wp.array2d(dtype=int),  # [n k] int32 index of the body, -1 for none, -2 outside the image
    depth_out: wp.array2d(dtype=float),  # [n k] float32 m, 0 where nothing is
):
    """Look up body and depth at the centers of a few pixels of every frame."""
    frame, k = wp.tid()
    column = pixel[frame, k][0]
    row = pixel[frame, k][1]
    if column < 0 or row < 0 or row >= key_in.shape[2] or column >= key_in.shape[3]:
        body_out[frame, k] = -2
        depth_out[frame, k] = 0.0
        return
    stage_key = stage_key_of(stage, frame, CENTER, row, column)
    key = wp.max(key_in[frame, CENTER, row, column], stage_key)
    triangle = owner(key, stage_key)
    body_out[frame, k] = -1
    depth_out[frame, k] = depth_of(key)
    if triangle >= 0:
        body_out[frame, k] = geometry.triangle_body[geometry.triangle_range[frame_world[frame]][0] + triangle]

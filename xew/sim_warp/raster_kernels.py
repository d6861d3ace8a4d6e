"""All Warp kernels of the renderer: a visibility-buffer rasteriser. `render.py` launches them, in the order of this file.

Every frame is a row of a chunk; a chunk mixes frames of different worlds. A sample of the image keeps one 64-bit key:
the bits of 1 / depth over the index of the triangle. Keys meet in an atomic maximum, which has no order, so an image
has the same bytes whatever the device's schedule and whatever else is in the chunk. Colours are made afterwards, once
per pixel and triangle. Triangles are counter-clockwise seen from outside, camera frame x right, y down, z forward.
"""

# Warp reads this file in its own way: a variable that a loop changes begins as float(0.0), and any() is unknown.
# ruff: noqa: UP018, SIM110

import warp as wp

wp.set_module_options({"enable_backward": False})  # nobody differentiates images; halves the time to compile

NEAR = wp.constant(0.1)
"""Near plane of the camera [m]; triangles are cut there."""
SAMPLES = wp.constant(5)
"""Four samples of a rotated grid make the colour; the fifth, the pixel's centre, makes mask, depth, flow and body."""
vec5 = wp.types.vector(length=5, dtype=float)
OFFSET_X = wp.constant(vec5(-0.125, 0.375, -0.375, 0.125, 0.0))
OFFSET_Y = wp.constant(vec5(-0.375, -0.125, 0.125, 0.375, 0.0))
CENTER = wp.constant(4)
TILE = wp.constant(16)
"""Side of the shadow map's tiles [texels]; a tile knows its nearest depth, so that most lookups end there."""
SHADOW_FAR = wp.constant(8.0)
"""Depth at which the directional light's shadow map ends [m]."""
SHADOW_BIAS = wp.constant(0.0015)
"""How far behind a surface a point is still lit [m]."""
COLORS = wp.constant(8192)
"""Entries of the table from linear light to sRGB."""


@wp.struct
class View:
    """A camera or a light's shadow map."""

    rotation: wp.mat33
    translation: wp.vec3
    focal: wp.vec2
    center: wp.vec2
    parallel: int


@wp.struct
class Light:
    """A light: the direction to it and its strength, or its position if it is near (`parallel` of its view is 0)."""

    view: View
    position: wp.vec3
    to_light: wp.vec3
    intensity: float


@wp.struct
class Shading:
    """How surfaces answer light; see stage.py."""

    ambient: float
    sky_share: float
    exposure: float
    specular: float
    shininess: float
    knee: float
    ceiling: float


@wp.struct
class Geometry:
    """The triangles of all distinct worlds, packed one after another; a world's own indices start at zero."""

    vertex: wp.array(dtype=wp.vec3)
    vertex_body: wp.array(dtype=int)
    triangle: wp.array(dtype=wp.vec3i)
    triangle_body: wp.array(dtype=int)
    normal: wp.array2d(dtype=wp.vec3)
    albedo: wp.array(dtype=wp.vec3)
    body_is_robot: wp.array(dtype=int)
    vertex_range: wp.array(dtype=wp.vec2i)
    triangle_range: wp.array(dtype=wp.vec2i)
    body_first: wp.array(dtype=int)


@wp.struct
class Stage:
    """What never moves, seen by one camera: keys of its samples and, per pixel, its light without shadows."""

    key: wp.array3d(dtype=wp.uint64)
    ambient: wp.array2d(dtype=wp.vec3)
    direct: wp.array3d(dtype=wp.vec3)
    shadow_texel: wp.array3d(dtype=wp.vec3)


# ---- from the world to the screen


@wp.func
def in_view(view: View, world: wp.vec3) -> wp.vec3:
    return view.rotation * world + view.translation


@wp.func
def on_screen(view: View, p: wp.vec3) -> wp.vec3:
    """Pixel x, y and a nearness that is affine over the screen: 1 / depth, or far - depth of a parallel view."""
    if view.parallel == 1:
        return wp.vec3(view.focal[0] * p[0] + view.center[0], view.focal[1] * p[1] + view.center[1], SHADOW_FAR - p[2])
    nearness = 1.0 / p[2]
    return wp.vec3(view.focal[0] * p[0] * nearness + view.center[0], view.focal[1] * p[1] * nearness + view.center[1], nearness)


@wp.kernel
def place_vertices(
    geometry: Geometry,
    frame_world: wp.array(dtype=int),
    frame_pose: wp.array(dtype=int),
    pose: wp.array(dtype=wp.transform),
    camera: View,
    lights: wp.array(dtype=Light),
    vertex_out: wp.array2d(dtype=wp.vec3),
    shadow_vertex_out: wp.array3d(dtype=wp.vec3),
):
    """Every vertex to the camera's frame [m] and to every light's shadow map [texels, nearness]."""
    frame, vertex = wp.tid()
    owned = geometry.vertex_range[frame_world[frame]]
    if vertex >= owned[1]:
        return
    packed = owned[0] + vertex
    body_pose = pose[frame_pose[frame] + geometry.vertex_body[packed]]
    world = wp.transform_point(body_pose, geometry.vertex[packed])
    vertex_out[frame, vertex] = in_view(camera, world)
    for i in range(shadow_vertex_out.shape[1]):
        view = lights[i].view
        seen = in_view(view, world)
        if view.parallel == 0 and seen[2] < NEAR:
            shadow_vertex_out[frame, i, vertex] = wp.vec3(0.0, 0.0, -1.0)
        else:
            shadow_vertex_out[frame, i, vertex] = on_screen(view, seen)


# ---- filling triangles


@wp.func
def crossing(p: wp.vec3, q: wp.vec3, y: float) -> float:
    """x at which an edge meets a scanline; the ends are put in order so that both neighbours get the same bits."""
    if p[1] < q[1]:
        return p[0] + (q[0] - p[0]) * ((y - p[1]) / (q[1] - p[1]))
    return q[0] + (p[0] - q[0]) * ((y - q[1]) / (p[1] - q[1]))


@wp.func
def widened(span: wp.vec2, p: wp.vec3, q: wp.vec3, y: float) -> wp.vec2:
    if (p[1] <= y) == (q[1] <= y):
        return span
    x = crossing(p, q, y)
    return wp.vec2(wp.min(span[0], x), wp.max(span[1], x))


@wp.func
def row_span(a: wp.vec3, b: wp.vec3, c: wp.vec3, y: float) -> wp.vec2:
    """The half-open interval [low, high) of x that a triangle covers on a scanline; low > high if none."""
    span = wp.vec2(1.0e9, -1.0e9)
    span = widened(span, a, b, y)
    span = widened(span, b, c, y)
    return widened(span, c, a, y)


@wp.func
def clamped(x: float, size: int) -> int:
    """The first pixel at or right of x, kept in [0, size]."""
    return int(wp.clamp(wp.ceil(x), 0.0, float(size)))


@wp.func
def nearness_slope(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec2:
    """Change of nearness per pixel in x and y over a triangle on the screen."""
    ab = b - a
    ac = c - a
    area = ab[0] * ac[1] - ab[1] * ac[0]
    if area == 0.0:
        return wp.vec2(0.0, 0.0)
    return wp.vec2((ab[2] * ac[1] - ab[1] * ac[2]) / area, (ab[0] * ac[2] - ab[2] * ac[0]) / area)


@wp.func
def nearness_at(a: wp.vec3, slope: wp.vec2, limits: wp.vec2, x: float, y: float) -> float:
    """Nearness at a point of the screen, never beyond the triangle's own (edge-on triangles have steep slopes)."""
    return wp.clamp(a[2] + slope[0] * (x - a[0]) + slope[1] * (y - a[1]), limits[0], limits[1])


@wp.func
def bits(nearness: float) -> wp.uint32:
    """Positive floats keep their order as integers."""
    return wp.cast(nearness, wp.uint32)


@wp.func
def draw(
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    triangle: int,
    frame: int,
    stripe: int,
    stripes: int,
    key_out: wp.array4d(dtype=wp.uint64),
):
    """Put one triangle of the screen into the keys: the rows of its box that belong to this stripe."""
    height = key_out.shape[2]
    width = key_out.shape[3]
    slope = nearness_slope(a, b, c)
    limits = wp.vec2(wp.min(a[2], wp.min(b[2], c[2])), wp.max(a[2], wp.max(b[2], c[2])))
    top = clamped(wp.min(a[1], wp.min(b[1], c[1])) - 0.375, height)
    bottom = clamped(wp.max(a[1], wp.max(b[1], c[1])) + 0.375, height - 1) + 1
    name = wp.uint64(triangle + 1)
    for row in range(top + stripe, bottom, stripes):
        for sample in range(SAMPLES):
            y = float(row) + OFFSET_Y[sample]
            span = row_span(a, b, c, y)
            if span[0] < span[1]:
                shift = OFFSET_X[sample]
                for column in range(clamped(span[0] - shift, width), clamped(span[1] - shift, width)):
                    nearness = nearness_at(a, slope, limits, float(column) + shift, y)
                    wp.atomic_max(key_out, frame, sample, row, column, (wp.uint64(bits(nearness)) << wp.uint64(32)) | name)


@wp.func
def cut(behind: wp.vec3, front: wp.vec3) -> wp.vec3:
    """Where an edge of the camera's frame meets the near plane."""
    return behind + (front - behind) * ((NEAR - behind[2]) / (front[2] - behind[2]))


@wp.func
def draw_cut(
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    camera: View,
    triangle: int,
    frame: int,
    stripe: int,
    stripes: int,
    key_out: wp.array4d(dtype=wp.uint64),
):
    """Draw what lies beyond the near plane of a triangle of which `a` alone is on its side of the plane."""
    if a[2] < NEAR:
        ab = on_screen(camera, cut(a, b))
        ac = on_screen(camera, cut(a, c))
        sb = on_screen(camera, b)
        draw(ab, sb, on_screen(camera, c), triangle, frame, stripe, stripes, key_out)
        draw(ab, on_screen(camera, c), ac, triangle, frame, stripe, stripes, key_out)
    else:
        ab = on_screen(camera, cut(b, a))
        ac = on_screen(camera, cut(c, a))
        draw(on_screen(camera, a), ab, ac, triangle, frame, stripe, stripes, key_out)


@wp.kernel
def draw_triangles(
    geometry: Geometry,
    frame_world: wp.array(dtype=int),
    camera: View,
    vertex_in: wp.array2d(dtype=wp.vec3),
    stripes: int,
    key_out: wp.array4d(dtype=wp.uint64),
):
    """Visibility: every triangle that faces the camera into the keys [frame, sample, row, column]."""
    frame, triangle, stripe = wp.tid()
    owned = geometry.triangle_range[frame_world[frame]]
    if triangle >= owned[1]:
        return
    corner = geometry.triangle[owned[0] + triangle]
    a = vertex_in[frame, corner[0]]
    b = vertex_in[frame, corner[1]]
    c = vertex_in[frame, corner[2]]
    if wp.dot(wp.cross(b - a, c - a), a) >= 0.0:
        return
    near_a = a[2] < NEAR
    near_b = b[2] < NEAR
    near_c = c[2] < NEAR
    if near_a and near_b and near_c:
        return
    if near_a == near_b and near_b == near_c:
        sa = on_screen(camera, a)
        sb = on_screen(camera, b)
        sc = on_screen(camera, c)
        draw(sa, sb, sc, triangle, frame, stripe, stripes, key_out)
    elif near_b == near_c:
        draw_cut(a, b, c, camera, triangle, frame, stripe, stripes, key_out)
    elif near_c == near_a:
        draw_cut(b, c, a, camera, triangle, frame, stripe, stripes, key_out)
    else:
        draw_cut(c, a, b, camera, triangle, frame, stripe, stripes, key_out)


# ---- shadow maps


@wp.kernel
def draw_shadows(
    geometry: Geometry,
    frame_world: wp.array(dtype=int),
    shadow_vertex_in: wp.array3d(dtype=wp.vec3),
    map_out: wp.array4d(dtype=wp.uint32),
    tile_out: wp.array4d(dtype=wp.uint32),
):
    """Shadow maps [frame, light, row, column] of nearness. Only faces turned away from the light cast: lit faces are
    then clear of their own depth, which saves a bias, and shadows still begin where things touch the table."""
    frame, light, triangle = wp.tid()
    owned = geometry.triangle_range[frame_world[frame]]
    if triangle >= owned[1]:
        return
    corner = geometry.triangle[owned[0] + triangle]
    a = shadow_vertex_in[frame, light, corner[0]]
    b = shadow_vertex_in[frame, light, corner[1]]
    c = shadow_vertex_in[frame, light, corner[2]]
    nearest = wp.max(a[2], wp.max(b[2], c[2]))
    farthest = wp.min(a[2], wp.min(b[2], c[2]))
    if farthest <= 0.0 or (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) <= 0.0:
        return
    size = map_out.shape[2]
    left = wp.min(a[0], wp.min(b[0], c[0]))
    right = wp.max(a[0], wp.max(b[0], c[0]))
    low = wp.min(a[1], wp.min(b[1], c[1]))
    high = wp.max(a[1], wp.max(b[1], c[1]))
    # lookups reach two texels beyond their own, so a tile must know of triangles that close to it
    for tile_y in range(clamped(low - 3.0, size) / TILE, (clamped(high + 2.0, size - 1)) / TILE + 1):
        for tile_x in range(clamped(left - 3.0, size) / TILE, (clamped(right + 2.0, size - 1)) / TILE + 1):
            if tile_x < tile_out.shape[3] and tile_y < tile_out.shape[2]:
                wp.atomic_max(tile_out, frame, light, tile_y, tile_x, bits(nearest))
    slope = nearness_slope(a, b, c)
    limits = wp.vec2(farthest, nearest)
    for row in range(clamped(low, size), clamped(high, size)):
        span = row_span(a, b, c, float(row))
        for column in range(clamped(span[0], size), clamped(span[1], size)):
            nearness = nearness_at(a, slope, limits, float(column), float(row))
            wp.atomic_max(map_out, frame, light, row, column, bits(nearness))


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
    map_in: wp.array4d(dtype=wp.uint32),
    tile_in: wp.array4d(dtype=wp.uint32),
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

    point: wp.vec3
    normal: wp.vec3
    albedo: wp.vec3


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
    return wp.vec3((x - camera.center[0]) / camera.focal[0], (y - camera.center[1]) / camera.focal[1], 1.0)


@wp.func
def surface_at(
    geometry: Geometry,
    packed: int,
    body_pose: wp.transform,
    camera: View,
    seen: wp.vec3,
    frame: int,
    vertex_in: wp.array2d(dtype=wp.vec3),
) -> Surface:
    """The point `seen` (camera's frame) of a triangle: point and shading normal in the world, colour."""
    corner = geometry.triangle[packed]
    weight = corner_weights(vertex_in[frame, corner[0]], vertex_in[frame, corner[1]], vertex_in[frame, corner[2]], seen)
    normal = (
        geometry.normal[packed, 0] * weight[0] + geometry.normal[packed, 1] * weight[1] + geometry.normal[packed, 2] * weight[2]
    )
    surface = Surface()
    surface.point = wp.transpose(camera.rotation) * (seen - camera.translation)
    surface.normal = wp.normalize(wp.transform_vector(body_pose, normal))
    surface.albedo = geometry.albedo[packed]
    return surface


@wp.func
def ambient_light(surface: Surface, shading: Shading) -> wp.vec3:
    strength = shading.ambient * (1.0 - shading.sky_share * 0.5 * (1.0 - surface.normal[2]))
    return surface.albedo * (strength * shading.exposure)


@wp.func
def direct_light(surface: Surface, light: Light, eye: wp.vec3, shading: Shading) -> wp.vec3:
    """Lambert's diffuse and Blinn-Phong's highlight of one light, without shadow."""
    to_light = light.to_light
    intensity = light.intensity
    if light.view.parallel == 0:
        offset = light.position - surface.point
        intensity /= wp.length_sq(offset)
        to_light = wp.normalize(offset)
    facing = wp.dot(surface.normal, to_light)
    if facing <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    halfway = wp.normalize(to_light + wp.normalize(eye - surface.point))
    gloss = shading.specular * wp.pow(wp.max(wp.dot(surface.normal, halfway), 0.0), shading.shininess)
    return (surface.albedo * facing + wp.vec3(gloss, gloss, gloss)) * (intensity * shading.exposure)


@wp.func
def toned(light: float, shading: Shading) -> float:
    """Bright light bends towards a ceiling below white, so that a lit white robot keeps its shape on a white ground."""
    above = light - shading.knee
    if above <= 0.0:
        return light
    room = shading.ceiling - shading.knee
    return shading.knee + room * (1.0 - wp.exp(-above / room))


@wp.func
def toned_color(light: wp.vec3, shading: Shading) -> wp.vec3:
    return wp.vec3(toned(light[0], shading), toned(light[1], shading), toned(light[2], shading))


@wp.func
def eye_of(camera: View) -> wp.vec3:
    return -(wp.transpose(camera.rotation) * camera.translation)


@wp.func
def nearness_of(key: wp.uint64) -> float:
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
    geometry: Geometry,
    camera: View,
    lights: wp.array(dtype=Light),
    shading: Shading,
    vertex_in: wp.array2d(dtype=wp.vec3),
    key_in: wp.array4d(dtype=wp.uint64),
    sky: wp.vec3,
    ambient_out: wp.array2d(dtype=wp.vec3),
    direct_out: wp.array3d(dtype=wp.vec3),
    shadow_texel_out: wp.array3d(dtype=wp.vec3),
):
    """Light on the stage, once per camera: by source, so that a frame only has to multiply with its shadows."""
    row, column = wp.tid()
    eye = eye_of(camera)
    ambient = wp.vec3(0.0, 0.0, 0.0)
    for sample in range(SAMPLES):
        triangle = owner(key_in[0, sample, row, column], wp.uint64(0))
        if triangle < 0:
            if sample != CENTER:
                ambient += sky * 0.25
        else:
            ray = pixel_ray(camera, float(column) + OFFSET_X[sample], float(row) + OFFSET_Y[sample])
            seen = ray / nearness_of(key_in[0, sample, row, column])
            surface = surface_at(geometry, triangle, wp.transform_identity(), camera, seen, 0, vertex_in)
            if sample != CENTER:
                ambient += ambient_light(surface, shading) * 0.25
            for i in range(direct_out.shape[0]):
                if sample == CENTER:
                    shadow_texel_out[i, row, column] = on_screen(lights[i].view, in_view(lights[i].view, surface.point))
                else:
                    direct_out[i, row, column] += direct_light(surface, lights[i], eye, shading) * 0.25
    ambient_out[row, column] = ambient


# ---- from visibility to images


@wp.func
def encoded(light: float, srgb: wp.array(dtype=wp.uint8)) -> wp.uint8:
    return srgb[int(wp.clamp(light, 0.0, 1.0) * float(COLORS - 1) + 0.5)]


@wp.func
def stage_light(
    stage: Stage,
    lights: wp.array(dtype=Light),
    shading: Shading,
    frame: int,
    row: int,
    column: int,
    map_in: wp.array4d(dtype=wp.uint32),
    tile_in: wp.array4d(dtype=wp.uint32),
) -> wp.vec3:
    total = stage.ambient[row, column]
    if stage.direct.shape[0] == 0:
        return total
    for i in range(stage.direct.shape[0]):
        share = 1.0
        if map_in.shape[1] > 0:
            texel = stage.shadow_texel[i, row, column]
            share = lit_share(texel, shadow_reach(texel, lights[i].view.parallel), frame, i, map_in, tile_in)
        total += stage.direct[i, row, column] * share
    return toned_color(total, shading)


@wp.func
def surface_light(
    surface: Surface,
    camera: View,
    lights: wp.array(dtype=Light),
    shading: Shading,
    frame: int,
    map_in: wp.array4d(dtype=wp.uint32),
    tile_in: wp.array4d(dtype=wp.uint32),
) -> wp.vec3:
    total = ambient_light(surface, shading)
    for i in range(lights.shape[0]):
        light = lights[i]
        arriving = direct_light(surface, light, eye_of(camera), shading)
        if map_in.shape[1] > 0 and arriving[0] + arriving[1] + arriving[2] > 0.0:
            texel = on_screen(light.view, in_view(light.view, surface.point))
            arriving = arriving * lit_share(texel, shadow_reach(texel, light.view.parallel), frame, i, map_in, tile_in)
        total += arriving
    return toned_color(total, shading)


@wp.func
def shown_before(shown: wp.vec4i, sample: int) -> bool:
    """Did an earlier sample show the same triangle?"""
    for earlier in range(sample):
        if shown[earlier] == shown[sample]:
            return True
    return False


@wp.kernel
def shade_pixels(
    geometry: Geometry,
    frame_world: wp.array(dtype=int),
    frame_pose: wp.array(dtype=int),
    pose: wp.array(dtype=wp.transform),
    camera: View,
    lights: wp.array(dtype=Light),
    shading: Shading,
    stage: Stage,
    srgb: wp.array(dtype=wp.uint8),
    vertex_in: wp.array2d(dtype=wp.vec3),
    key_in: wp.array4d(dtype=wp.uint64),
    map_in: wp.array4d(dtype=wp.uint32),
    tile_in: wp.array4d(dtype=wp.uint32),
    rgb_out: wp.array4d(dtype=wp.uint8),
):
    """Colour: each triangle among a pixel's four samples is lit once, at the mean of its samples."""
    frame, row, column = wp.tid()
    drawn = key_in[frame, 0, row, column] | key_in[frame, 1, row, column]
    drawn = drawn | key_in[frame, 2, row, column] | key_in[frame, 3, row, column]
    if drawn == wp.uint64(0):
        plain = stage_light(stage, lights, shading, frame, row, column, map_in, tile_in)
        for channel in range(3):
            rgb_out[frame, row, column, channel] = encoded(plain[channel], srgb)
        return
    first_triangle = geometry.triangle_range[frame_world[frame]][0]
    shown = wp.vec4i(-1, -1, -1, -1)
    for s in range(4):
        shown[s] = owner(key_in[frame, s, row, column], stage.key[s, row, column])
    total = wp.vec3(0.0, 0.0, 0.0)
    for s in range(4):
        triangle = shown[s]
        if not shown_before(shown, s):
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
                total += surface_light(surface, camera, lights, shading, frame, map_in, tile_in) * (0.25 * count)
    for channel in range(3):
        rgb_out[frame, row, column, channel] = encoded(total[channel], srgb)


@wp.func
def moved(from_pose: wp.transform, to_pose: wp.transform, point: wp.vec3) -> wp.vec3:
    """Where a point of a body goes when the body goes from one pose to another; all in the world."""
    return wp.transform_point(to_pose, wp.transform_point(wp.transform_inverse(from_pose), point))


@wp.func
def motion_on_screen(camera: View, seen: wp.vec3, after: wp.vec3, limit: float) -> wp.vec2:
    """Motion in pixels between two points of the camera's frame, no longer than `limit`."""
    now = on_screen(camera, seen)
    later = on_screen(camera, wp.vec3(after[0], after[1], wp.max(after[2], NEAR)))
    motion = wp.vec2(later[0] - now[0], later[1] - now[1])
    length = wp.length(motion)
    if length > limit:
        motion = motion * (limit / length)
    return motion


@wp.kernel
def measure_pixels(
    geometry: Geometry,
    frame_world: wp.array(dtype=int),
    frame_pose: wp.array(dtype=int),
    frame_next_pose: wp.array(dtype=int),
    pose: wp.array(dtype=wp.transform),
    camera: View,
    stage: Stage,
    flow_limit: float,
    key_in: wp.array4d(dtype=wp.uint64),
    mask_out: wp.array3d(dtype=wp.bool),
    body_out: wp.array3d(dtype=wp.int16),
    depth_out: wp.array3d(dtype=float),
    flow_out: wp.array3d(dtype=wp.vec2),
):
    """Geometry at the pixel's centre; outputs of shape zero are left out."""
    frame, row, column = wp.tid()
    world = frame_world[frame]
    body = -1
    robot = 0
    flow = wp.vec2(0.0, 0.0)
    stage_key = stage.key[CENTER, row, column]
    key = wp.max(key_in[frame, CENTER, row, column], stage_key)
    triangle = owner(key, stage_key)
    if triangle >= 0:
        body = geometry.triangle_body[geometry.triangle_range[world][0] + triangle]
        robot = geometry.body_is_robot[geometry.body_first[world] + body]
        if flow_out.shape[0] > 0 and robot == 1 and frame_next_pose[frame] != frame_pose[frame]:
            seen = pixel_ray(camera, float(column), float(row)) / nearness_of(key)
            point = wp.transpose(camera.rotation) * (seen - camera.translation)
            after = moved(pose[frame_pose[frame] + body], pose[frame_next_pose[frame] + body], point)
            flow = motion_on_screen(camera, seen, in_view(camera, after), flow_limit)
    mask_out[frame, row, column] = robot == 1
    if body_out.shape[0] > 0:
        body_out[frame, row, column] = wp.int16(body)
    if depth_out.shape[0] > 0:
        depth_out[frame, row, column] = depth_of(key)
    if flow_out.shape[0] > 0:
        flow_out[frame, row, column] = flow


@wp.kernel
def probe_pixels(
    geometry: Geometry,
    frame_world: wp.array(dtype=int),
    stage: Stage,
    pixel: wp.array2d(dtype=wp.vec2i),
    key_in: wp.array4d(dtype=wp.uint64),
    body_out: wp.array2d(dtype=int),
    depth_out: wp.array2d(dtype=float),
):
    """Body (-1 none, -2 outside the image) and depth at the centres of a few pixels (x, y) of every frame."""
    frame, k = wp.tid()
    column = pixel[frame, k][0]
    row = pixel[frame, k][1]
    if column < 0 or row < 0 or row >= key_in.shape[2] or column >= key_in.shape[3]:
        body_out[frame, k] = -2
        depth_out[frame, k] = 0.0
        return
    stage_key = stage.key[CENTER, row, column]
    key = wp.max(key_in[frame, CENTER, row, column], stage_key)
    triangle = owner(key, stage_key)
    body_out[frame, k] = -1
    depth_out[frame, k] = depth_of(key)
    if triangle >= 0:
        body_out[frame, k] = geometry.triangle_body[geometry.triangle_range[frame_world[frame]][0] + triangle]

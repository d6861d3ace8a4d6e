"""Warp kernels that find the triangle of each image sample and draw shadow maps; `passes.py` launches them.

A chunk mixes frames of different worlds. A sample has one 64-bit key: the bits of 1 / depth over the index of the triangle.
Keys are combined by an atomic maximum, which is independent of order: an image's bytes do not depend on the schedule or
the chunk. shading_kernels.py makes colors afterwards. Triangles are counter-clockwise seen from outside.

Frames of reference: the world (z up); the camera's frame (x right, y down, z forward); pixels (x right, y down), in which
the center of the first pixel is (0, 0). Letters of shapes: n frames of the chunk, l lights, v vertices and f triangles of the
largest world, s samples of a pixel, h w the image, m the side of a shadow map and q its side in tiles; of packed arrays:
V vertices, F triangles, B bodies and W worlds of all distinct worlds, P poses of all frames of a call.
"""

# Annotations of kernels are types of Warp, which mypy does not know.
# mypy: ignore-errors

import warp as wp

# No gradients: halves the compile time. Without fused multiply-adds and functions other than + - * / and sqrt, all IEEE 754
# processors make the same bytes.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NEAR = wp.constant(0.1)
"""Near plane of lights and of cameras that stand still [m]."""
NEAR_OF_MOVING = 0.02
"""Near plane of cameras that move with the robot, close to its hand [m]."""
SAMPLES = wp.constant(5)
"""Number of samples of a pixel: four of a rotated square make the color, the fifth at its center makes mask, depth, flow
and body."""
vec5 = wp.types.vector(length=5, dtype=float)
OFFSET_X = wp.constant(vec5(-0.125, 0.375, -0.375, 0.125, 0.0))
OFFSET_Y = wp.constant(vec5(-0.375, -0.125, 0.125, 0.375, 0.0))
CENTER = wp.constant(4)
TILE = wp.constant(16)
"""Side of the shadow map's tiles [texels]; most lookups end at a tile's nearest depth."""
SHADOW_FAR = wp.constant(8.0)
"""Depth at which the directional light's shadow map ends [m]."""


@wp.struct
class View:
    """A camera or a light's shadow map."""

    rotation: wp.mat33  # from the world to the view's frame
    translation: wp.vec3  # m
    focal: wp.vec2  # focal lengths [pixels], or pixels a meter where the view is parallel
    center: wp.vec2  # principal point [pixels]
    near: float  # near plane of a camera [m]; triangles are cut there
    parallel: int  # 1 for a directional light, else 0


@wp.struct
class Light:
    """A light: the direction to it and its strength, or its position if it is near (`parallel` of its view is 0)."""

    view: View
    position: wp.vec3  # m, world
    to_light: wp.vec3  # unit vector, world
    intensity: wp.vec3  # linear RGB, of a near light at a distance of 1 m


@wp.struct
class Geometry:
    """The triangles of all distinct worlds, packed one after another; a world's own indices start at zero."""

    vertex: wp.array(dtype=wp.vec3)  # [V 3] float32 m, frame of the body
    vertex_body: wp.array(dtype=int)  # [V] int32 index of the body in its world
    triangle: wp.array(dtype=wp.vec3i)  # [F 3] int32 indices of vertices in their world
    triangle_body: wp.array(dtype=int)  # [F] int32 index of the body in its world
    normal: wp.array2d(dtype=wp.vec3)  # [F 3 3] float32 unit normals at the corners, frame of the body
    albedo: wp.array(dtype=wp.vec3)  # [F 3] float32 linear RGB, 0 to 1
    body_is_robot: wp.array(dtype=int)  # [B] int32, 1 for links of the robot
    vertex_range: wp.array(dtype=wp.vec2i)  # [W 2] int32 first vertex of a world and how many it has
    triangle_range: wp.array(dtype=wp.vec2i)  # [W 2] int32 first triangle of a world and how many it has
    body_first: wp.array(dtype=int)  # [W] int32 first body of a world


# ---- from the world to the screen


@wp.func
def view_of(views: wp.array(dtype=View), frame: int) -> View:
    """The camera at a frame of the chunk; a camera that stands still has one view for all."""
    return views[wp.min(frame, views.shape[0] - 1)]


@wp.func
def to_view(view: View, world: wp.vec3) -> wp.vec3:
    """A point [m] of the world in the frame of a camera or light."""
    return view.rotation * world + view.translation


@wp.func
def to_screen(view: View, p: wp.vec3) -> wp.vec3:
    """Pixel x, y of a point [m] of the view's frame, and a nearness that is affine over the screen: 1 / depth [1/m], or
    far - depth [m] of a parallel view."""
    if view.parallel == 1:
        return wp.vec3(view.focal[0] * p[0] + view.center[0], view.focal[1] * p[1] + view.center[1], SHADOW_FAR - p[2])
    nearness = 1.0 / p[2]
    return wp.vec3(view.focal[0] * p[0] * nearness + view.center[0], view.focal[1] * p[1] * nearness + view.center[1], nearness)


@wp.kernel
def place_vertices(
    # In:
    geometry: Geometry,
    frame_world: wp.array(dtype=int),  # [n] int32 index of the frame's world among the distinct worlds
    frame_pose: wp.array(dtype=int),  # [n] int32 index into `pose` of the frame's first body
    pose: wp.array(dtype=wp.transform),  # [P 7] float32 xyz [m] and quaternion xyzw of bodies, world
    cameras: wp.array(dtype=View),  # [n] or [1], see `view_of`
    lights: wp.array(dtype=Light),  # [l] lights with the views of their shadow maps
    # Out:
    vertex_out: wp.array2d(dtype=wp.vec3),  # [n v 3] float32 m, camera's frame
    shadow_vertex_out: wp.array3d(dtype=wp.vec3),  # [n l v 3] float32 x y [texels] and nearness on each shadow map
):
    """Bring every vertex to the camera's frame and to every light's shadow map."""
    frame, vertex = wp.tid()
    owned = geometry.vertex_range[frame_world[frame]]
    if vertex >= owned[1]:
        return
    packed = owned[0] + vertex
    body_pose = pose[frame_pose[frame] + geometry.vertex_body[packed]]
    world = wp.transform_point(body_pose, geometry.vertex[packed])
    vertex_out[frame, vertex] = to_view(view_of(cameras, frame), world)
    for i in range(shadow_vertex_out.shape[1]):
        view = lights[i].view
        seen = to_view(view, world)
        if view.parallel == 0 and seen[2] < NEAR:
            shadow_vertex_out[frame, i, vertex] = wp.vec3(0.0, 0.0, -1.0)
        else:
            shadow_vertex_out[frame, i, vertex] = to_screen(view, seen)


# ---- filling triangles


@wp.func
def crossing(p: wp.vec3, q: wp.vec3, y: float) -> float:
    """x at which an edge meets a scanline; the ordered ends give both neighbors the same bits."""
    if p[1] < q[1]:
        return p[0] + (q[0] - p[0]) * ((y - p[1]) / (q[1] - p[1]))
    return q[0] + (p[0] - q[0]) * ((y - q[1]) / (p[1] - q[1]))


@wp.func
def widen_span(span: wp.vec2, p: wp.vec3, q: wp.vec3, y: float) -> wp.vec2:
    """The interval of x [pixels] on a scanline, widened to where the edge from p to q meets it."""
    if (p[1] <= y) == (q[1] <= y):
        return span
    x = crossing(p, q, y)
    return wp.vec2(wp.min(span[0], x), wp.max(span[1], x))


@wp.func
def row_span(a: wp.vec3, b: wp.vec3, c: wp.vec3, y: float) -> wp.vec2:
    """The half-open interval [low, high) of x that a triangle covers on a scanline; low > high if none."""
    span = wp.vec2(1.0e9, -1.0e9)
    span = widen_span(span, a, b, y)
    span = widen_span(span, b, c, y)
    return widen_span(span, c, a, y)


@wp.func
def first_pixel(x: float, size: int) -> int:
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
    """The bits of a nearness as an integer: positive floats keep their order."""
    return wp.cast(nearness, wp.uint32)


@wp.func
def draw(
    a: wp.vec3,  # x y [pixels] and nearness
    b: wp.vec3,
    c: wp.vec3,
    triangle: int,
    frame: int,
    stripe: int,
    stripes: int,
    key_out: wp.array4d(dtype=wp.uint64),  # [n s h w] uint64
):
    """Put one triangle of the screen into the keys: the rows of its box that belong to this stripe."""
    height = key_out.shape[2]
    width = key_out.shape[3]
    slope = nearness_slope(a, b, c)
    limits = wp.vec2(wp.min(a[2], wp.min(b[2], c[2])), wp.max(a[2], wp.max(b[2], c[2])))
    top = first_pixel(wp.min(a[1], wp.min(b[1], c[1])) - 0.375, height)
    bottom = first_pixel(wp.max(a[1], wp.max(b[1], c[1])) + 0.375, height - 1) + 1
    name = wp.uint64(triangle + 1)
    for row in range(top + stripe, bottom, stripes):
        for sample in range(SAMPLES):
            y = float(row) + OFFSET_Y[sample]
            span = row_span(a, b, c, y)
            if span[0] < span[1]:
                shift = OFFSET_X[sample]
                for column in range(first_pixel(span[0] - shift, width), first_pixel(span[1] - shift, width)):
                    nearness = nearness_at(a, slope, limits, float(column) + shift, y)
                    wp.atomic_max(key_out, frame, sample, row, column, (wp.uint64(bits(nearness)) << wp.uint64(32)) | name)


@wp.func
def cut(behind: wp.vec3, front: wp.vec3, near: float) -> wp.vec3:
    """Where an edge of the camera's frame meets the near plane."""
    return behind + (front - behind) * ((near - behind[2]) / (front[2] - behind[2]))


@wp.func
def draw_cut(
    a: wp.vec3,  # m, camera's frame
    b: wp.vec3,
    c: wp.vec3,
    camera: View,
    triangle: int,
    frame: int,
    stripe: int,
    stripes: int,
    key_out: wp.array4d(dtype=wp.uint64),  # [n s h w] uint64
):
    """Draw what lies beyond the near plane of a triangle of which `a` alone is on its side of the plane."""
    if a[2] < camera.near:
        ab = to_screen(camera, cut(a, b, camera.near))
        ac = to_screen(camera, cut(a, c, camera.near))
        sb = to_screen(camera, b)
        draw(ab, sb, to_screen(camera, c), triangle, frame, stripe, stripes, key_out)
        draw(ab, to_screen(camera, c), ac, triangle, frame, stripe, stripes, key_out)
    else:
        ab = to_screen(camera, cut(b, a, camera.near))
        ac = to_screen(camera, cut(c, a, camera.near))
        draw(to_screen(camera, a), ab, ac, triangle, frame, stripe, stripes, key_out)


@wp.kernel
def draw_triangles(
    # In:
    geometry: Geometry,
    frame_world: wp.array(dtype=int),  # [n] int32 index of the frame's world among the distinct worlds
    cameras: wp.array(dtype=View),  # [n] or [1], see `view_of`
    vertex_in: wp.array2d(dtype=wp.vec3),  # [n v 3] float32 m, camera's frame
    stripes: int,  # threads that share the rows of a triangle
    # Out:
    key_out: wp.array4d(dtype=wp.uint64),  # [n s h w] uint64 bits of nearness over 1 + index of the triangle, 0 for none
):
    """Draw every triangle that faces the camera into the keys, where the nearest one stays."""
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
    camera = view_of(cameras, frame)
    near_a = a[2] < camera.near
    near_b = b[2] < camera.near
    near_c = c[2] < camera.near
    if near_a and near_b and near_c:
        return
    if near_a == near_b and near_b == near_c:
        sa = to_screen(camera, a)
        sb = to_screen(camera, b)
        sc = to_screen(camera, c)
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
    # In:
    geometry: Geometry,
    frame_world: wp.array(dtype=int),  # [n] int32 index of the frame's world among the distinct worlds
    shadow_vertex_in: wp.array3d(dtype=wp.vec3),  # [n l v 3] float32 x y [texels] and nearness on each shadow map
    # Out:
    map_out: wp.array4d(dtype=wp.uint32),  # [n l m m] uint32 bits of the nearness of the nearest caster, 0 for none
    tile_out: wp.array4d(dtype=wp.uint32),  # [n l q q] uint32 bits of the largest nearness in and round each tile
):
    """Draw shadow maps. Only faces turned away from the light cast shadows: lit faces need no depth bias, and shadows begin at
    contacts with the table."""
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
    for tile_y in range(first_pixel(low - 3.0, size) / TILE, (first_pixel(high + 2.0, size - 1)) / TILE + 1):
        for tile_x in range(first_pixel(left - 3.0, size) / TILE, (first_pixel(right + 2.0, size - 1)) / TILE + 1):
            if tile_x < tile_out.shape[3] and tile_y < tile_out.shape[2]:
                wp.atomic_max(tile_out, frame, light, tile_y, tile_x, bits(nearest))
    slope = nearness_slope(a, b, c)
    limits = wp.vec2(farthest, nearest)
    for row in range(first_pixel(low, size), first_pixel(high, size)):
        span = row_span(a, b, c, float(row))
        for column in range(first_pixel(span[0], size), first_pixel(span[1], size)):
            nearness = nearness_at(a, slope, limits, float(column), float(row))
            wp.atomic_max(map_out, frame, light, row, column, bits(nearness))

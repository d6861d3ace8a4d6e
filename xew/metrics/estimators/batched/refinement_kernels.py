"""Warp kernels of the variational refinement of flow, for many pairs of images at once, as OpenCV has it.

The flow is changed so colors and their gradients stay the same along it and that it is smooth, all by a robust penalty:
the system of equations for the change is made a few times (refine_flow in flow.py), and each is solved by relaxation.

Letters of shapes: n images, p pairs, h w an image of one level of the pyramid.
"""

# Annotations of kernels are types of Warp, which mypy does not know.
# mypy: ignore-errors

import warp as wp

from xew.metrics.estimators.batched.flow_kernels import level

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SMOOTHNESS, COLOR, GRADIENTS = wp.constant(10.0), wp.constant(2.5), wp.constant(5.0)
"""Halves of the weights of smooth flow, of constant color and of constant gradients."""
OVERSHOOT = wp.constant(1.6)
"""Factor of a step of relaxation."""
ZETA, EPSILON = wp.constant(0.1 * 0.1), wp.constant(0.01 * 0.01)
"""Added to squared gradients, and to squared errors, so nothing is divided by zero."""


@wp.kernel
def blend(
    # In:
    packed: wp.array3d(dtype=int),  # [n h w] int32
    pair: wp.array(dtype=wp.vec2i),  # [p 2] int32
    flow: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels
    # Out:
    blend_out: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32, mean and difference of an image and the one carried to it
):
    p, y, x = wp.tid()
    height, width = packed.shape[1], packed.shape[2]
    to_x, to_y = float(x) + flow[p, y, x][0], float(y) + flow[p, y, x][1]
    j, i = wp.floor(to_x), wp.floor(to_y)
    share_x, share_y = to_x - j, to_y - i
    left, right = wp.clamp(int(j), 0, width - 1), wp.clamp(int(j) + 1, 0, width - 1)
    above, below = wp.clamp(int(i), 0, height - 1), wp.clamp(int(i) + 1, 0, height - 1)
    n = pair[p][1]
    upper = level(packed[n, above, left]) * (1.0 - share_x) + level(packed[n, above, right]) * share_x
    lower = level(packed[n, below, left]) * (1.0 - share_x) + level(packed[n, below, right]) * share_x
    there = upper * (1.0 - share_y) + lower * share_y
    here = level(packed[pair[p][0], y, x])
    blend_out[p, y, x] = wp.vec2(0.5 * here + 0.5 * there, there - here)


@wp.kernel
def differentiate(
    # In:
    image: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32
    # Out:
    along_x_out: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32, differences of the right and the left neighbor
    along_y_out: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32, of the one below and the one above
):
    p, y, x = wp.tid()
    height, width = image.shape[1], image.shape[2]
    along_x_out[p, y, x] = image[p, y, wp.min(x + 1, width - 1)] - image[p, y, wp.max(x - 1, 0)]
    along_y_out[p, y, x] = image[p, wp.min(y + 1, height - 1), x] - image[p, wp.max(y - 1, 0), x]


@wp.kernel
def weigh_smoothness(
    # In:
    flow: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels, changed so far
    # Out:
    weight_out: wp.array3d(dtype=float),  # [p h w] float32, of the differences to the neighbors on the right and below
):
    p, y, x = wp.tid()
    here = flow[p, y, x]
    along_x = flow[p, y, wp.min(x + 1, flow.shape[2] - 1)] - here
    along_y = flow[p, wp.min(y + 1, flow.shape[1] - 1), x] - here
    weight_out[p, y, x] = SMOOTHNESS / wp.sqrt(wp.dot(along_x, along_x) + wp.dot(along_y, along_y) + EPSILON)


@wp.kernel
def build_system(
    # In:
    blended: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32
    slope_x: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32, differences of mean and change along x
    slope_y: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32, along y
    slope_xy: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32, of the former along y
    slope_xx: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32, and along x
    slope_yy: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32
    weight: wp.array3d(dtype=float),  # [p h w] float32
    flow: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels, unchanged
    change: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels
    # Out:
    matrix_out: wp.array3d(dtype=wp.vec3),  # [p h w 3] float32, x x, x y and y y
    side_out: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32, right side of the equations
):
    p, y, x = wp.tid()
    u, v = change[p, y, x][0], change[p, y, x][1]
    ix, iy, iz = slope_x[p, y, x][0], slope_y[p, y, x][0], blended[p, y, x][1]
    norm = ix * ix + iy * iy + ZETA
    error = iz + ix * u + iy * v
    factor = COLOR / wp.sqrt(error * error / norm + EPSILON) / norm
    matrix = wp.vec3(factor * ix * ix + ZETA, factor * ix * iy, factor * iy * iy + ZETA)
    side = -factor * iz * wp.vec2(ix, iy)
    ixx, ixy, iyy = slope_xx[p, y, x][0], slope_xy[p, y, x][0], slope_yy[p, y, x][0]
    ixz, iyz = slope_x[p, y, x][1], slope_y[p, y, x][1]
    norm_x, norm_y = ixx * ixx + ixy * ixy + ZETA, iyy * iyy + ixy * ixy + ZETA
    error_x, error_y = ixz + ixx * u + ixy * v, iyz + ixy * u + iyy * v
    factor = GRADIENTS / wp.sqrt(error_x * error_x / norm_x + error_y * error_y / norm_y + EPSILON)
    matrix += factor * wp.vec3(
        ixx * ixx / norm_x + ixy * ixy / norm_y,
        ixx * ixy / norm_x + ixy * iyy / norm_y,
        ixy * ixy / norm_x + iyy * iyy / norm_y,
    )
    side -= factor * wp.vec2(ixx * ixz / norm_x + ixy * iyz / norm_y, ixy * ixz / norm_x + iyy * iyz / norm_y)
    here, own, stiffness = flow[p, y, x], weight[p, y, x], wp.float32(0.0)
    if x < flow.shape[2] - 1:
        stiffness += own
        side += own * (flow[p, y, x + 1] - here)
    if x > 0:
        stiffness += weight[p, y, x - 1]
        side -= weight[p, y, x - 1] * (here - flow[p, y, x - 1])
    if y < flow.shape[1] - 1:
        stiffness += own
        side += own * (flow[p, y + 1, x] - here)
    if y > 0:
        stiffness += weight[p, y - 1, x]
        side -= weight[p, y - 1, x] * (here - flow[p, y - 1, x])
    matrix_out[p, y, x] = matrix + stiffness * wp.vec3(1.0, 0.0, 1.0)
    side_out[p, y, x] = side


@wp.kernel
def relax(
    # In:
    matrix: wp.array3d(dtype=wp.vec3),  # [p h w 3] float32
    side: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32
    weight: wp.array3d(dtype=float),  # [p h w] float32
    color: int,  # 0 or 1: which fields of the chess board
    # Out:
    change_out: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels
):
    p, y, x = wp.tid()
    if (x + y) % 2 != color:
        return
    pull = wp.vec2(side[p, y, x][0], side[p, y, x][1])
    if x > 0:
        pull += weight[p, y, x - 1] * change_out[p, y, x - 1]
    if x < change_out.shape[2] - 1:
        pull += weight[p, y, x] * change_out[p, y, x + 1]
    if y > 0:
        pull += weight[p, y - 1, x] * change_out[p, y - 1, x]
    if y < change_out.shape[1] - 1:
        pull += weight[p, y, x] * change_out[p, y + 1, x]
    m = matrix[p, y, x]
    u, v = float(change_out[p, y, x][0]), float(change_out[p, y, x][1])
    u += OVERSHOOT * ((pull[0] - v * m[1]) / m[0] - u)
    v += OVERSHOOT * ((pull[1] - u * m[1]) / m[2] - v)
    change_out[p, y, x] = wp.vec2(u, v)


@wp.kernel
def add_change(
    # In:
    flow: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels
    change: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels
    # Out:
    flow_out: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels
):
    p, y, x = wp.tid()
    flow_out[p, y, x] = flow[p, y, x] + change[p, y, x]

"""Warp kernels of dense inverse search (Kroeger et al. 2016), for many pairs of images at once.

They follow OpenCV's `DISOpticalFlow` with patches of 8 pixels, mean normalization and spatial propagation, so both give
the same flow up to rounding. Its propagation goes from patch to patch within each of eight stripes of rows; patches on a
diagonal of a stripe do not depend on each other, so a launch does one diagonal of all stripes of all pairs.

Letters of shapes: n images, p pairs, h w an image of one level of the pyramid, r c its patches in rows and columns.
An image is kept with its gradients, as one int32 a pixel (`packed`), which one load reads.
"""

# Annotations of kernels are types of Warp, which mypy does not know.
# mypy: ignore-errors

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PATCH = wp.constant(8)
"""Side of a patch [pixels]."""
ROW = wp.types.vector(length=9, dtype=float)
"""One more pixel than a patch is wide: what its row is interpolated between."""
STRIPES = wp.constant(8)
"""Number of stripes; flow is not handed on from one to another."""
GRADIENT = wp.constant(1024)
"""Number added to a gradient, so it is packed without its sign."""
SMALL = wp.constant(0.001)
"""Least determinant of a structure tensor, and what a place keeps away from the last pixel."""
MOST = wp.constant(1.0e10)
BORDER = wp.constant(16.0)
"""Width of the border that OpenCV adds, which places are counted from, for the same rounding [pixels]."""


@wp.func
def level(packed: int) -> float:
    """The gray level of a packed pixel."""
    return float(packed & 255)


@wp.func
def gradient_x(packed: int) -> float:
    return float(((packed >> 8) & 4095) - GRADIENT)


@wp.func
def gradient_y(packed: int) -> float:
    return float(((packed >> 20) & 4095) - GRADIENT)


@wp.func
def mirror(i: int, size: int) -> int:
    """The index that stands for one beyond the border: the image is mirrored at the center of its last pixel."""
    j = wp.abs(i)
    if j >= size:
        j = 2 * size - 2 - j
    return wp.clamp(j, 0, size - 1)


@wp.kernel
def shrink(
    # In:
    image: wp.array3d(dtype=wp.uint8),  # [n H W] uint8
    # Out:
    small_out: wp.array3d(dtype=wp.uint8),  # [n h w] uint8, means of the areas that its pixels cover
):
    n, y, x = wp.tid()
    height, width = small_out.shape[1], small_out.shape[2]
    if 2 * height == image.shape[1] and 2 * width == image.shape[2]:
        total = wp.int32(2)
        for i in range(2):
            for j in range(2):
                total += int(image[n, 2 * y + i, 2 * x + j])
        small_out[n, y, x] = wp.uint8(total >> 2)
        return
    step_y, step_x = float(image.shape[1]) / float(height), float(image.shape[2]) / float(width)
    top, left = float(y) * step_y, float(x) * step_x
    mean = wp.float32(0.0)
    for i in range(int(top), wp.min(int(wp.ceil(top + step_y)), image.shape[1])):
        tall = wp.min(float(i + 1), top + step_y) - wp.max(float(i), top)
        for j in range(int(left), wp.min(int(wp.ceil(left + step_x)), image.shape[2])):
            wide = wp.min(float(j + 1), left + step_x) - wp.max(float(j), left)
            mean += tall * wide * float(image[n, i, j])
    small_out[n, y, x] = wp.uint8(wp.rint(mean / (step_y * step_x)))


@wp.kernel
def pack_gradients(
    # In:
    image: wp.array3d(dtype=wp.uint8),  # [n h w] uint8
    # Out:
    packed_out: wp.array3d(dtype=int),  # [n h w] int32: level, and gradients of Sobel along x and y, in 8, 12 and 12 bits
):
    n, y, x = wp.tid()
    height, width = image.shape[1], image.shape[2]
    above, below = mirror(y - 1, height), mirror(y + 1, height)
    left, right = mirror(x - 1, width), mirror(x + 1, width)
    falling = int(image[n, below, right]) - int(image[n, above, left])
    rising = int(image[n, above, right]) - int(image[n, below, left])
    along_x = falling + rising + 2 * (int(image[n, y, right]) - int(image[n, y, left]))
    along_y = falling - rising + 2 * (int(image[n, below, x]) - int(image[n, above, x]))
    packed_out[n, y, x] = int(image[n, y, x]) | ((along_x + GRADIENT) << 8) | ((along_y + GRADIENT) << 20)


@wp.kernel
def sum_gradients(
    # In:
    packed: wp.array3d(dtype=int),  # [n h w] int32
    stride: int,
    size: int,  # PATCH, as a number that no loop is unrolled by
    # Out:
    tensor_out: wp.array3d(dtype=wp.vec3),  # [n r c 3] float32, sums over a patch of x x, x y, y y of gradients
    sums_out: wp.array3d(dtype=wp.vec2),  # [n r c 2] float32, sums of the gradients
):
    n, row, column = wp.tid()
    xx, xy, yy, sum_x, sum_y = wp.float32(0.0), wp.float32(0.0), wp.float32(0.0), wp.float32(0.0), wp.float32(0.0)
    for i in range(size):
        for j in range(size):
            pixel = packed[n, row * stride + i, column * stride + j]
            x, y = gradient_x(pixel), gradient_y(pixel)
            xx += x * x
            xy += x * y
            yy += y * y
            sum_x += x
            sum_y += y
    tensor_out[n, row, column] = wp.vec3(xx, xy, yy)
    sums_out[n, row, column] = wp.vec2(sum_x, sum_y)


@wp.func
def fold(four: wp.vec4) -> float:
    """The sum of four sums of every fourth column of a patch, in OpenCV's order."""
    return (four[0] + four[2]) + (four[1] + four[3])


@wp.func
def compare_patches(
    packed: wp.array3d(dtype=int), start: int, end: int, top: int, left: int, flow: wp.vec2, size: int
) -> wp.vec4:
    """Sums over a patch of the difference, its square, and its products with the gradients along x and y.

    The patch of one image at (top, left) is compared with that of another which the flow leads to, read between its pixels;
    beyond the border the image goes on as it ended.
    """
    height, width = packed.shape[1], packed.shape[2]
    y = wp.clamp(float(top) + flow[1] + BORDER, BORDER - float(size) + 1.0, BORDER + float(height) - 1.0)
    x = wp.clamp(float(left) + flow[0] + BORDER, BORDER - float(size) + 1.0, BORDER + float(width) - 1.0)
    floor_y, floor_x = wp.floor(y), wp.floor(x)
    share_y, share_x = y - floor_y, x - floor_x
    w11, w10 = share_y * share_x, share_y * (1.0 - share_x)
    w01, w00 = (1.0 - share_y) * share_x, (1.0 - share_y) * (1.0 - share_x)
    upper, lower = ROW(), ROW()
    first, leftmost = int(floor_y) - int(BORDER), int(floor_x) - int(BORDER)
    for j in range(9):
        upper[j] = level(packed[end, wp.clamp(first, 0, height - 1), wp.clamp(leftmost + j, 0, width - 1)])
    differences, squares, along_x, along_y = wp.vec4(), wp.vec4(), wp.vec4(), wp.vec4()
    for i in range(size):
        line = wp.clamp(first + i + 1, 0, height - 1)
        for j in range(9):
            lower[j] = level(packed[end, line, wp.clamp(leftmost + j, 0, width - 1)])
        for j in range(4):
            a = packed[start, top + i, left + j]
            b = packed[start, top + i, left + j + 4]
            d = w00 * upper[j] + w01 * upper[j + 1] + w10 * lower[j] + w11 * lower[j + 1] - level(a)
            e = w00 * upper[j + 4] + w01 * upper[j + 5] + w10 * lower[j + 4] + w11 * lower[j + 5] - level(b)
            differences[j] += d + e
            squares[j] += d * d + e * e
            along_x[j] += d * gradient_x(a) + e * gradient_x(b)
            along_y[j] += d * gradient_y(a) + e * gradient_y(b)
        upper = lower
    return wp.vec4(fold(differences), fold(squares), fold(along_x), fold(along_y))


@wp.func
def misfit(sums: wp.vec4) -> float:
    """Sum of the squared differences of two patches, less what their means differ by."""
    return sums[1] - sums[0] * sums[0] / 64.0


@wp.func
def invert(tensor: wp.vec3) -> wp.mat22:
    """The inverse of a structure tensor."""
    determinant = tensor[0] * tensor[2] - tensor[1] * tensor[1]
    if wp.abs(determinant) < SMALL:
        determinant = SMALL
    off_diagonal = -tensor[1] / determinant
    return wp.mat22(tensor[2] / determinant, off_diagonal, off_diagonal, tensor[0] / determinant)


@wp.kernel
def search_diagonal(
    # In:
    packed: wp.array3d(dtype=int),  # [n h w] int32
    pair: wp.array(dtype=wp.vec2i),  # [p 2] int32, the images that flow starts and ends at
    tensor: wp.array3d(dtype=wp.vec3),  # [n r c 3] float32
    sums: wp.array3d(dtype=wp.vec2),  # [n r c 2] float32
    stride: int,
    size: int,  # PATCH
    diagonal: int,
    forward: int,  # 1 from the upper left to the lower right, -1 back
    steps: int,  # most steps of descent
    # Out:
    flow_out: wp.array3d(dtype=wp.vec2),  # [p r c 2] float32 pixels; holds what is known before
):
    """Improve the flow of the patches on one diagonal of each stripe, from their own and from the neighbors' before them."""
    p, row = wp.tid()
    rows, columns = flow_out.shape[1], flow_out.shape[2]
    thickness = (rows + STRIPES - 1) // STRIPES
    first = (row // thickness) * thickness
    offset = row - first
    column = diagonal - offset
    if forward < 0:
        offset = wp.min(first + thickness, rows) - 1 - row
        column = columns - 1 - (diagonal - offset)
    if column < 0 or column >= columns:
        return
    start, end = pair[p][0], pair[p][1]
    top, left = row * stride, column * stride
    best = flow_out[p, row, column]
    least = misfit(compare_patches(packed, start, end, top, left, best, size))
    if column - forward >= 0 and column - forward < columns:
        other = flow_out[p, row, column - forward]
        found = misfit(compare_patches(packed, start, end, top, left, other, size))
        if found < least:
            least = found
            best = other
    if offset > 0:
        other = flow_out[p, row - forward, column]
        found = misfit(compare_patches(packed, start, end, top, left, other, size))
        if found < least:
            best = other
    slope = sums[start, row, column]
    inverse = invert(tensor[start, row, column])
    flow = best
    least = float(MOST)
    for _ in range(steps):
        found_sums = compare_patches(packed, start, end, top, left, flow, size)
        along_x = found_sums[2] - found_sums[0] * slope[0] / 64.0
        along_y = found_sums[3] - found_sums[0] * slope[1] / 64.0
        flow = flow - inverse * wp.vec2(along_x, along_y)
        found = misfit(found_sums)
        if found >= least:
            break
        least = found
    if wp.length(flow - best) <= float(PATCH):
        best = flow
    flow_out[p, row, column] = best


@wp.kernel
def begin_patches(
    # In:
    flow: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels
    stride: int,
    # Out:
    patch_flow_out: wp.array3d(dtype=wp.vec2),  # [p r c 2] float32 pixels, at the patches' middles
):
    p, row, column = wp.tid()
    patch_flow_out[p, row, column] = flow[p, row * stride + PATCH // 2, column * stride + PATCH // 2]


@wp.kernel
def spread_patches(
    # In:
    packed: wp.array3d(dtype=int),  # [n h w] int32
    pair: wp.array(dtype=wp.vec2i),  # [p 2] int32
    patch_flow: wp.array3d(dtype=wp.vec2),  # [p r c 2] float32 pixels
    stride: int,
    # Out:
    flow_out: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels
):
    """The mean of the flows of the patches that cover a pixel, each weighted by how well it fits there."""
    p, y, x = wp.tid()
    height, width = packed.shape[1], packed.shape[2]
    start, end = pair[p][0], pair[p][1]
    last_row, last_column = wp.min(y // stride, patch_flow.shape[1] - 1), wp.min(x // stride, patch_flow.shape[2] - 1)
    first_row = wp.clamp((y - PATCH + stride) // stride, 0, last_row)
    first_column = wp.clamp((x - PATCH + stride) // stride, 0, last_column)
    here = level(packed[start, y, x])
    total, weights = wp.vec2(), wp.float32(0.0)
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            flow = patch_flow[p, row, column]
            to_x = wp.clamp(float(x) + flow[0], 0.0, float(width) - 1.0 - SMALL)
            to_y = wp.clamp(float(y) + flow[1], 0.0, float(height) - 1.0 - SMALL)
            j, i = int(to_x), int(to_y)
            share_x, share_y = to_x - float(j), to_y - float(i)
            there = share_x * share_y * level(packed[end, i + 1, j + 1])
            there += (1.0 - share_x) * share_y * level(packed[end, i + 1, j])
            there += share_x * (1.0 - share_y) * level(packed[end, i, j + 1])
            there += (1.0 - share_x) * (1.0 - share_y) * level(packed[end, i, j])
            weight = 1.0 / wp.max(1.0, wp.abs(there - here))
            total += weight * flow
            weights += weight
    flow_out[p, y, x] = total / weights


@wp.kernel
def enlarge_flow(
    # In:
    flow: wp.array3d(dtype=wp.vec2),  # [p h w 2] float32 pixels
    factor: float,  # by which the flow is multiplied
    # Out:
    flow_out: wp.array3d(dtype=wp.vec2),  # [p H W 2] float32 pixels of the larger image
):
    """Flow for a larger image, read between the pixels of the smaller one."""
    p, y, x = wp.tid()
    height, width = flow.shape[1], flow.shape[2]
    from_y = wp.max((float(y) + 0.5) * (float(height) / float(flow_out.shape[1])) - 0.5, 0.0)
    from_x = wp.max((float(x) + 0.5) * (float(width) / float(flow_out.shape[2])) - 0.5, 0.0)
    i, j = wp.min(int(from_y), height - 1), wp.min(int(from_x), width - 1)
    below, right = wp.min(i + 1, height - 1), wp.min(j + 1, width - 1)
    share_y, share_x = from_y - float(i), from_x - float(j)
    upper = flow[p, i, j] * (1.0 - share_x) + flow[p, i, right] * share_x
    lower = flow[p, below, j] * (1.0 - share_x) + flow[p, below, right] * share_x
    flow_out[p, y, x] = (upper * (1.0 - share_y) + lower * share_y) * factor

"""Warp kernels of the default tracker (xew.metrics.estimators.tracks): Lucas-Kanade, likeness, search, presence, for tracks.py.

Lucas-Kanade and likeness follow OpenCV's arithmetic as `tracks` calls it. The threads of a block share the pixels round one
point; on a CPU a block is one thread.

Letters of shapes: n images (t predicted frames, then t true ones), t frames, k points, q searches of r r places, h w an image,
P all pixels of a pyramid, l its levels.
"""

# Annotations of kernels are types of Warp, which mypy does not know.
# mypy: ignore-errors

import warp as wp

from xew.metrics.estimators import presence, tracks
from xew.metrics.estimators.batched.flow_kernels import mirror
from xew.metrics.estimators.batched.mask_kernels import Place, find_place, read_color

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

WINDOW = wp.constant(15)
"""Side of the window of Lucas-Kanade [pixels]."""
HALF = wp.constant(7.0)
STEPS = wp.constant(10)
CONVERGED = wp.constant(0.03 * 0.03)
"""Squared step [pixels squared] that ends Lucas-Kanade."""
SWINGING = wp.constant(0.01)
"""Largest sum of two steps along an axis [pixels] that cancel each other."""
LEAST_EIGENVALUE = wp.constant(1.0e-4)
SCALE = wp.constant(1.0 / 1048576.0)
ONE = wp.constant(16384)
"""Number that weights of pixels add up to."""
PATCH = wp.constant(tracks.PATCH)
PATCH_STEP = wp.constant(tracks.PATCH_STEP)
SIDE = wp.constant(2 * tracks.PATCH // tracks.PATCH_STEP + 1)
FLATNESS = wp.constant(tracks.FLATNESS)
REFINEMENT = wp.constant(tracks.REFINEMENT)
STANDING = wp.constant(tracks.STANDING)
GIVEN_UP = wp.constant(tracks.GIVEN_UP)
SPACING = wp.constant(tracks.SPACING)
PEAKS = wp.constant(tracks.PEAKS)
PROPOSALS = wp.constant(3 + tracks.PEAKS)
REACH = wp.constant(tracks.REACH // 2)
"""Largest distance that is searched [pixels of half the size]."""
MARGIN = wp.constant(tracks.PATCH // 2)
"""Half the side of the patch that is searched for [pixels of half the size]."""

BODY_REACH = wp.constant(presence.REACH)
OTHER_COLOR = wp.constant(float(presence.OTHER_COLOR))
SAME_COLOR = wp.constant(float(presence.SAME_COLOR))

Sums = wp.types.vector(length=10, dtype=int)
"""Of two patches: how many pixels are compared, sums of both by channel, sums of their squares, and of their difference's."""


@wp.struct
class Images:
    """Predicted and true frames as the tracker reads them."""

    pyramid: wp.array2d(dtype=wp.uint8)  # [n P] uint8 gray
    slope: wp.array2d(dtype=int)  # [n P] int32, gradients of Scharr along x and y, 16 bits each; of true frames alone
    level: wp.array(dtype=wp.vec3i)  # [l 3] int32 first pixel, height and width of each level
    soft: wp.array4d(dtype=wp.uint8)  # [n h w 3] uint8


@wp.struct
class Truth:
    """Points where they truly are."""

    point: wp.array2d(dtype=wp.vec2)  # [t k 2] float32 pixels
    visible: wp.array2d(dtype=wp.uint8)  # [t k] uint8
    alike: wp.array(dtype=int)  # [t] int32, the true frame that looks most like each predicted one


# ---- pyramids


@wp.kernel
def fill_first_level(
    # In:
    gray: wp.array3d(dtype=wp.uint8),  # [n h w] uint8
    # Out:
    pyramid_out: wp.array2d(dtype=wp.uint8),  # [n P] uint8
):
    n, y, x = wp.tid()
    pyramid_out[n, y * gray.shape[2] + x] = gray[n, y, x]


@wp.kernel
def shrink(
    # In:
    above: wp.vec3i,  # first pixel, height and width of the larger level
    below: wp.vec3i,  # of the smaller level
    # Out:
    pyramid_out: wp.array2d(dtype=wp.uint8),  # [n P] uint8; holds the larger level
):
    n, y, x = wp.tid()
    total = wp.int32(128)
    for i in range(-2, 3):
        row = mirror(2 * y + i, above[1])
        line = wp.int32(0)
        for j in range(-2, 3):
            weight = wp.where(j == 0, 6, wp.where(wp.abs(j) == 1, 4, 1))
            line += weight * int(pyramid_out[n, above[0] + row * above[2] + mirror(2 * x + j, above[2])])
        total += wp.where(i == 0, 6, wp.where(wp.abs(i) == 1, 4, 1)) * line
    pyramid_out[n, below[0] + y * below[2] + x] = wp.uint8(total >> 8)


@wp.kernel
def take_slopes(
    # In:
    pyramid: wp.array2d(dtype=wp.uint8),  # [n P] uint8
    level: wp.vec3i,
    # Out:
    slope_out: wp.array2d(dtype=int),  # [n P] int32
):
    n, y, x = wp.tid()
    height, width, first = level[1], level[2], level[0]
    above, below = first + mirror(y - 1, height) * width, first + mirror(y + 1, height) * width
    here, left, right = first + y * width, mirror(x - 1, width), mirror(x + 1, width)
    along_x = 3 * (int(pyramid[n, above + right]) - int(pyramid[n, above + left]))
    along_x += 3 * (int(pyramid[n, below + right]) - int(pyramid[n, below + left]))
    along_x += 10 * (int(pyramid[n, here + right]) - int(pyramid[n, here + left]))
    along_y = 3 * (int(pyramid[n, below + left]) - int(pyramid[n, above + left]))
    along_y += 3 * (int(pyramid[n, below + right]) - int(pyramid[n, above + right]))
    along_y += 10 * (int(pyramid[n, below + x]) - int(pyramid[n, above + x]))
    slope_out[n, here + x] = (along_x << 16) | (along_y & 65535)


# ---- Lucas-Kanade


@wp.func
def share_out(at: wp.vec2) -> wp.vec4i:
    """Weights of the four pixels round a place."""
    a, b = at[0] - wp.floor(at[0]), at[1] - wp.floor(at[1])
    w00 = int(wp.rint((1.0 - a) * (1.0 - b) * float(ONE)))
    w01 = int(wp.rint(a * (1.0 - b) * float(ONE)))
    w10 = int(wp.rint((1.0 - a) * b * float(ONE)))
    return wp.vec4i(w00, w01, w10, ONE - w00 - w01 - w10)


@wp.func
def read_gray(images: Images, n: int, level: wp.vec3i, y: int, x: int, weight: wp.vec4i) -> int:
    """32 times the gray level between four pixels; beyond its border the image is mirrored."""
    above, below = level[0] + mirror(y, level[1]) * level[2], level[0] + mirror(y + 1, level[1]) * level[2]
    left, right = mirror(x, level[2]), mirror(x + 1, level[2])
    total = int(images.pyramid[n, above + left]) * weight[0] + int(images.pyramid[n, above + right]) * weight[1]
    total += int(images.pyramid[n, below + left]) * weight[2] + int(images.pyramid[n, below + right]) * weight[3]
    return (total + 256) >> 9


@wp.func
def slope_at(images: Images, n: int, level: wp.vec3i, y: int, x: int) -> int:
    """0 outside the image."""
    if y < 0 or y >= level[1] or x < 0 or x >= level[2]:
        return 0
    return images.slope[n, level[0] + y * level[2] + x]


@wp.func
def read_slope(images: Images, n: int, level: wp.vec3i, y: int, x: int, weight: wp.vec4i) -> wp.vec2:
    along_x, along_y = wp.int32(8192), wp.int32(8192)
    for i in range(4):
        slope = slope_at(images, n, level, y + i // 2, x + i % 2)
        along_x += (slope >> 16) * weight[i]
        along_y += ((slope << 16) >> 16) * weight[i]
    return wp.vec2(float(along_x >> 14), float(along_y >> 14))


@wp.func
def sum_up(value: wp.vec3) -> wp.vec3:
    """The sum over all threads of the block."""
    total = wp.tile_sum(wp.tile(value, preserve_type=True))
    return total[0]


@wp.func
def is_far(corner: wp.vec2, level: wp.vec3i) -> bool:
    x, y = int(wp.floor(corner[0])), int(wp.floor(corner[1]))
    return x < -WINDOW or x >= level[2] or y < -WINDOW or y >= level[1]


@wp.func
def follow_level(images: Images, source: int, seen: int, level: wp.vec3i, point: wp.vec2, guess: wp.vec2, lane: int) -> wp.vec2:
    """Where a point of one image is in another, from a guess, at one level of their pyramids."""
    corner = point - wp.vec2(HALF, HALF)
    if is_far(corner, level):
        return guess
    x, y = int(wp.floor(corner[0])), int(wp.floor(corner[1]))
    weight = share_out(corner)
    part = wp.vec3()
    for i in range(lane, WINDOW * WINDOW, wp.block_dim()):
        slope = read_slope(images, source, level, y + i // WINDOW, x + i % WINDOW, weight)
        part += wp.vec3(slope[0] * slope[0], slope[0] * slope[1], slope[1] * slope[1])
    tensor = sum_up(part) * SCALE
    determinant = tensor[0] * tensor[2] - tensor[1] * tensor[1]
    apart = tensor[0] - tensor[2]
    eigenvalue = tensor[0] + tensor[2] - wp.sqrt(apart * apart + 4.0 * tensor[1] * tensor[1])
    if eigenvalue / float(2 * WINDOW * WINDOW) < LEAST_EIGENVALUE or determinant < 1.1920929e-07:
        return guess
    found = guess
    at = guess - wp.vec2(HALF, HALF)
    last = wp.vec2()
    for step in range(STEPS):
        if is_far(at, level):
            break
        to_x, to_y = int(wp.floor(at[0])), int(wp.floor(at[1]))
        to_weight = share_out(at)
        part = wp.vec3()
        for i in range(lane, WINDOW * WINDOW, wp.block_dim()):
            row, column = i // WINDOW, i % WINDOW
            difference = float(
                read_gray(images, seen, level, to_y + row, to_x + column, to_weight)
                - read_gray(images, source, level, y + row, x + column, weight)
            )
            slope = read_slope(images, source, level, y + row, x + column, weight)
            part += wp.vec3(difference * slope[0], difference * slope[1], 0.0)
        pull = sum_up(part) * SCALE
        delta = wp.vec2(
            (tensor[1] * pull[1] - tensor[2] * pull[0]) / determinant,
            (tensor[1] * pull[0] - tensor[0] * pull[1]) / determinant,
        )
        at = at + delta
        found = at + wp.vec2(HALF, HALF)
        if wp.dot(delta, delta) <= CONVERGED:
            break
        if step > 0 and wp.abs(delta[0] + last[0]) < SWINGING and wp.abs(delta[1] + last[1]) < SWINGING:
            found = found - delta * 0.5
            break
        last = delta
    return found


@wp.func
def follow(images: Images, source: int, seen: int, coarsest: int, point: wp.vec2, start: wp.vec2, lane: int) -> wp.vec2:
    """Where a point of one image is in another, from a first guess at the coarsest level down to the image itself."""
    found = start / float(1 << coarsest)
    for i in range(coarsest + 1):
        level = coarsest - i
        if i > 0:
            found = found * 2.0
        found = follow_level(images, source, seen, images.level[level], point / float(1 << level), found, lane)
    return found


# ---- likeness


@wp.func
def read_level(soft: wp.array4d(dtype=wp.uint8), n: int, place: Place, channel: int) -> int:
    """A color between pixels, as a whole level."""
    above, below, left, right = place.above, place.below, place.left, place.right
    a, b = float(soft[n, above, left, channel]), float(soft[n, above, right, channel])
    c, d = float(soft[n, below, left, channel]), float(soft[n, below, right, channel])
    upper, lower = a + (b - a) * place.along, c + (d - c) * place.along
    return int(wp.rint(upper + (lower - upper) * place.down))


@wp.func
def is_inside(place: wp.vec2, height: int, width: int) -> bool:
    return place[0] > -0.5 and place[1] > -0.5 and place[0] < float(width) - 0.5 and place[1] < float(height) - 0.5


@wp.func
def compare(soft: wp.array4d(dtype=wp.uint8), seen: int, place: wp.vec2, source: int, point: wp.vec2, lane: int) -> float:
    """How alike the patches round a place of one image and a point of another are (`tracks.likeness`)."""
    height, width = soft.shape[1], soft.shape[2]
    part = Sums()
    for i in range(lane, SIDE * SIDE, wp.block_dim()):
        offset = wp.vec2(float((i % SIDE) * PATCH_STEP - PATCH), float((i // SIDE) * PATCH_STEP - PATCH))
        at, true = place + offset, point + offset
        if is_inside(at, height, width) and is_inside(true, height, width):
            here, there = find_place(at, height, width), find_place(true, height, width)
            part[0] += 1
            for channel in range(3):
                a, b = read_level(soft, seen, here, channel), read_level(soft, source, there, channel)
                part[1 + channel] += a
                part[4 + channel] += b
                part[7] += a * a
                part[8] += b * b
                part[9] += (a - b) * (a - b)
    total_tile = wp.tile_sum(wp.tile(part, preserve_type=True))
    total = total_tile[0]
    count = wp.max(total[0], 1)
    spread = wp.float32(0.0)
    for side in range(2):
        sums = wp.vec3i(total[1 + 3 * side], total[2 + 3 * side], total[3 + 3 * side])
        square = wp.int64(sums[0]) * wp.int64(sums[0]) + wp.int64(sums[1]) * wp.int64(sums[1])
        square += wp.int64(sums[2]) * wp.int64(sums[2])
        spread += float(wp.int64(count) * wp.int64(total[7 + side]) - square)
    variance = spread / (3.0 * float(count) * float(count))
    return 1.0 - float(total[9]) / (3.0 * float(count)) / (variance + FLATNESS)


# ---- proposals


@wp.func
def improve(images: Images, source: int, seen: int, point: wp.vec2, proposal: wp.vec3, lane: int) -> wp.vec3:
    """A proposal (x, y, cost) shifted to its best fit to a true frame, where it fits better there than before."""
    height, width = images.soft.shape[1], images.soft.shape[2]
    start = wp.vec2(proposal[0], proposal[1])
    fitted = follow(images, source, seen, wp.min(1, images.level.shape[0] - 1), point, start, lane)
    if wp.length(fitted - start) >= REFINEMENT:
        fitted = start
    like = compare(images.soft, seen, fitted, source, point, lane)
    possible = is_inside(fitted, height, width)
    if wp.length(fitted - point) > float(PATCH):
        possible = possible and compare(images.soft, seen, fitted, source, fitted, lane) <= like - STANDING
    price = wp.where(possible, wp.clamp(1.0 - like, 0.0, 1.0), GIVEN_UP)
    if price < proposal[2]:
        return wp.vec3(fitted[0], fitted[1], price)
    return proposal


@wp.func
def improve_by_both(images: Images, truth: Truth, t: int, k: int, start: wp.vec2, lane: int) -> wp.vec3:
    """A proposal improved by the true frame of the same time and by the most similar one, as far as they show the point."""
    frames = truth.point.shape[0]
    proposal = wp.vec3(start[0], start[1], GIVEN_UP)
    if truth.visible[t, k] != wp.uint8(0):
        proposal = improve(images, frames + t, t, truth.point[t, k], proposal, lane)
    other = truth.alike[t]
    if other != t and truth.visible[other, k] != wp.uint8(0):
        proposal = improve(images, frames + other, t, truth.point[other, k], proposal, lane)
    return proposal


@wp.kernel
def propose(
    # In:
    images: Images,
    truth: Truth,
    # Out:
    proposal_out: wp.array3d(dtype=wp.vec3),  # [t k 2 3] float32 x, y and cost, of flow from both true frames
):
    """Where flow from the true frame of the same time and from the most similar one takes each point."""
    t, k, which, lane = wp.tid()
    frames = truth.point.shape[0]
    source = wp.where(which == 0, t, truth.alike[t])
    proposal = wp.vec3(0.0, 0.0, GIVEN_UP)
    if (which == 0 or source != t) and truth.visible[source, k] != wp.uint8(0):
        point = truth.point[source, k]
        start = follow(images, frames + source, t, images.level.shape[0] - 1, point, point, lane)
        proposal = improve_by_both(images, truth, t, k, start, lane)
    if lane == 0:
        proposal_out[t, k, which] = proposal


@wp.kernel
def halve_colors(
    # In:
    frame: wp.array4d(dtype=wp.uint8),  # [n h w 3] uint8
    # Out:
    half_out: wp.array3d(dtype=int),  # [n h/2 w/2] int32, means of four pixels, three channels of 8 bits
):
    n, y, x = wp.tid()
    code = wp.int32(0)
    for channel in range(3):
        total = int(frame[n, 2 * y, 2 * x, channel]) + int(frame[n, 2 * y, 2 * x + 1, channel])
        total += int(frame[n, 2 * y + 1, 2 * x, channel]) + int(frame[n, 2 * y + 1, 2 * x + 1, channel])
        code = (code << 8) | ((total + 2) >> 2)
    half_out[n, y, x] = code


@wp.kernel
def match_patches(
    # In:
    half: wp.array3d(dtype=int),  # [n h/2 w/2] int32
    frame: wp.array(dtype=int),  # [q] int32, the frame that is searched
    point: wp.array(dtype=wp.vec2),  # [q 2] float32 pixels, where the point truly is
    frames: int,  # number of predicted frames, which come before the true ones
    # Out:
    likeness_out: wp.array3d(dtype=float),  # [q r r] float32, of the places within REACH; of a point outside the image -1e9
):
    s, row, column = wp.tid()
    height, width = half.shape[1], half.shape[2]
    x, y = int(wp.rint((point[s][0] - 0.5) / 2.0)), int(wp.rint((point[s][1] - 0.5) / 2.0))
    if x < 0 or y < 0 or x >= width or y >= height:
        likeness_out[s, row, column] = -1.0e9
        return
    count = (2 * MARGIN + 1) * (2 * MARGIN + 1)
    part = Sums()
    for i in range(-MARGIN, MARGIN + 1):
        line = wp.clamp(y + row - REACH + i, 0, height - 1)
        true_line = wp.clamp(y + i, 0, height - 1)
        for j in range(-MARGIN, MARGIN + 1):
            a = half[frame[s], line, wp.clamp(x + column - REACH + j, 0, width - 1)]
            b = half[frames + frame[s], true_line, wp.clamp(x + j, 0, width - 1)]
            for channel in range(3):
                seen, true = (a >> (8 * channel)) & 255, (b >> (8 * channel)) & 255
                part[1 + channel] += seen
                part[4 + channel] += true
                part[7] += seen * seen
                part[8] += true * true
                part[9] += (seen - true) * (seen - true)
    spread = wp.float32(0.0)
    for channel in range(3):
        total = wp.int64(part[1 + channel])
        spread -= float(total * total)
        total = wp.int64(part[4 + channel])
        spread -= float(total * total)
    spread += float(wp.int64(count) * wp.int64(part[7] + part[8]))
    variance = spread / (3.0 * float(count) * float(count))
    likeness_out[s, row, column] = 1.0 - float(part[9]) / float(3 * count) / (variance + FLATNESS)


@wp.func
def is_peak(likeness: wp.array3d(dtype=float), s: int, y: int, x: int) -> bool:
    own = likeness[s, y, x]
    for i in range(wp.max(y - SPACING, 0), wp.min(y + SPACING + 1, likeness.shape[1])):
        for j in range(wp.max(x - SPACING, 0), wp.min(x + SPACING + 1, likeness.shape[2])):
            if likeness[s, i, j] > own:
                return False
    return own > -1.0e8


@wp.kernel
def mark_peaks(
    # In:
    likeness: wp.array3d(dtype=float),  # [q r r] float32
    # Out:
    peak_out: wp.array3d(dtype=wp.uint8),  # [q r r] uint8, 1 where no place within SPACING is more alike
):
    s, y, x = wp.tid()
    peak_out[s, y, x] = wp.where(is_peak(likeness, s, y, x), wp.uint8(1), wp.uint8(0))


@wp.kernel
def take_peaks(
    # In:
    likeness: wp.array3d(dtype=float),  # [q r r] float32
    peak: wp.array3d(dtype=wp.uint8),  # [q r r] uint8
    point: wp.array(dtype=wp.vec2),  # [q 2] float32 pixels
    # Out:
    place_out: wp.array2d(dtype=wp.vec3),  # [q PEAKS 3] float32 x and y of the best peaks, and 1, or 0 where there are fewer
):
    s = wp.tid()
    best = wp.vec4(-1.0e9, -1.0e9, -1.0e9, -1.0e9)
    where = wp.vec4i()
    count = wp.int32(0)
    for y in range(likeness.shape[1]):
        for x in range(likeness.shape[2]):
            if peak[s, y, x] != wp.uint8(0):
                value = likeness[s, y, x]
                if value > best[PEAKS - 1]:
                    at = int(PEAKS - 1)
                    while at > 0 and value > best[wp.max(at - 1, 0)]:
                        best[at] = best[at - 1]
                        where[at] = where[at - 1]
                        at -= 1
                    best[at] = value
                    where[at] = y * likeness.shape[2] + x
                    count = wp.min(count + 1, PEAKS)
    for i in range(PEAKS):
        if i < count:
            x, y = where[i] % likeness.shape[2] - REACH, where[i] // likeness.shape[2] - REACH
            place_out[s, i] = wp.vec3(point[s][0] + 2.0 * float(x), point[s][1] + 2.0 * float(y), 1.0)
        else:
            place_out[s, i] = wp.vec3(0.0, 0.0, 0.0)


@wp.kernel
def improve_peaks(
    # In:
    images: Images,
    truth: Truth,
    frame: wp.array(dtype=int),  # [q] int32
    index: wp.array(dtype=int),  # [q] int32, the point
    place: wp.array2d(dtype=wp.vec3),  # [q PEAKS 3] float32
    # Out:
    proposal_out: wp.array2d(dtype=wp.vec3),  # [q PEAKS 3] float32 x, y and cost
):
    s, i, lane = wp.tid()
    proposal = wp.vec3(0.0, 0.0, GIVEN_UP)
    if place[s, i][2] > 0.0:
        start = wp.vec2(place[s, i][0], place[s, i][1])
        proposal = improve_by_both(images, truth, frame[s], index[s], start, lane)
    if lane == 0:
        proposal_out[s, i] = proposal


# ---- presence


@wp.func
def body_at(shown: wp.array3d(dtype=wp.int16), t: int, place: wp.vec2) -> int:
    """The body that the pixel of a place shows; of a place outside, the nearest pixel's."""
    row, column = int(wp.rint(place[1])), int(wp.rint(place[0]))
    return int(shown[t, wp.clamp(row, 0, shown.shape[1] - 1), wp.clamp(column, 0, shown.shape[2] - 1)])


@wp.func
def color_difference(soft: wp.array4d(dtype=wp.uint8), seen: int, place: wp.vec2, source: int, point: wp.vec2) -> float:
    """The largest difference of the three channels of two images' colors, each at a place of its own."""
    here, there = find_place(place, soft.shape[1], soft.shape[2]), find_place(point, soft.shape[1], soft.shape[2])
    most = wp.float32(0.0)
    for channel in range(3):
        most = wp.max(most, wp.abs(read_color(soft, seen, here, channel) - read_color(soft, source, there, channel)))
    return most


@wp.kernel
def confirm(
    # In:
    soft: wp.array4d(dtype=wp.uint8),  # [n h w 3] uint8
    found: wp.array2d(dtype=wp.vec2),  # [t k 2] float32 pixels, NaN where lost
    point: wp.array2d(dtype=wp.vec2),  # [t k 2] float32 pixels, where the points truly are
    visible: wp.array2d(dtype=wp.uint8),  # [t k] uint8
    shown: wp.array3d(dtype=wp.int16),  # [t h w] int16, the body that a pixel of the true frame shows
    body: wp.array(dtype=int),  # [k] int32, the body that each point lies on
    # Out:
    wrong_out: wp.array2d(dtype=wp.uint8),  # [t k] uint8, 1 where the place that was found does not show the point's body
):
    t, k = wp.tid()
    wrong_out[t, k] = wp.uint8(0)
    at, true = found[t, k], point[t, k]
    if visible[t, k] == wp.uint8(0) or not wp.isfinite(at[0]) or not wp.isfinite(at[1]):
        return
    height, width, source = soft.shape[1], soft.shape[2], found.shape[0] + t
    count, different, standing = wp.int32(0), wp.int32(0), wp.int32(0)
    for row in range(-BODY_REACH, BODY_REACH + 1):
        for column in range(-BODY_REACH, BODY_REACH + 1):
            offset = wp.vec2(float(column), float(row))
            own = body_at(shown, t, true + offset) == body[k]
            if own and is_inside(at + offset, height, width) and is_inside(true + offset, height, width):
                count += 1
                if color_difference(soft, t, at + offset, source, true + offset) > OTHER_COLOR:
                    different += 1
                elsewhere = body_at(shown, t, at + offset) != body[k]
                if elsewhere and color_difference(soft, t, at + offset, source, at + offset) <= SAME_COLOR:
                    standing += 1
    if 2 * different > count or 2 * standing > count:
        wrong_out[t, k] = wp.uint8(1)

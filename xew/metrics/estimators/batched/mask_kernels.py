"""Warp kernels of the default masker (xew.metrics.estimators.masks), for many frames at once; masks.py launches them.

Each does what OpenCV and NumPy do there for one frame, in the same arithmetic as far as that is integers.
Letters of shapes: n images (predicted and true frames), t predicted frames, c carriers, h w an image, k weights of a blur.
"""

# Annotations of kernels are types of Warp, which mypy does not know.
# mypy: ignore-errors

import warp as wp

from xew.metrics.estimators import masks
from xew.metrics.estimators.batched.flow_kernels import mirror

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

RESIDUAL_SCALE = wp.constant(masks.RESIDUAL_SCALE)
CLOSURE_SCALE = wp.constant(masks.CLOSURE_SCALE)
EVIDENCE_LIMIT = wp.constant(masks.EVIDENCE_LIMIT)
SHAPE_WEIGHT = wp.constant(masks.SHAPE_WEIGHT)
SHAPE_REACH = wp.constant(masks.SHAPE_REACH)
SHAPE_TRUST = wp.constant(masks.SHAPE_TRUST)
SMALLEST_PIECE = wp.constant(masks.SMALLEST_PIECE)
Piece = wp.types.vector(length=masks.SMALLEST_PIECE, dtype=int)
"""Pixels of a piece that has been followed so far."""
STRAIGHT, SLANTED = wp.constant(62587.0 / 65536.0), wp.constant(89738.0 / 65536.0)
"""Lengths of a step to a neighbor beside and across [pixels], as OpenCV measures distances with a mask of 3x3."""
WINDOW = wp.constant(6)
"""Largest distance along an axis that is looked at for the contour [pixels]; beyond it tanh is 1 up to 6e-5."""


@wp.kernel
def take_gray(
    # In:
    frame: wp.array4d(dtype=wp.uint8),  # [n h w 3] uint8 RGB
    # Out:
    gray_out: wp.array3d(dtype=wp.uint8),  # [n h w] uint8
):
    n, y, x = wp.tid()
    total = int(frame[n, y, x, 0]) * 9798 + int(frame[n, y, x, 1]) * 19235 + int(frame[n, y, x, 2]) * 3735
    gray_out[n, y, x] = wp.uint8((total + 16384) >> 15)


@wp.kernel
def blur_rows(
    # In:
    frame: wp.array4d(dtype=wp.uint8),  # [n h w 3] uint8
    weight: wp.array(dtype=int),  # [k] int32, sum 256
    # Out:
    sum_out: wp.array4d(dtype=wp.uint16),  # [n h w 3] uint16, weighted sums along rows
):
    n, y, x = wp.tid()
    reach = weight.shape[0] // 2
    for channel in range(3):
        total = wp.int32(0)
        for i in range(weight.shape[0]):
            total += weight[i] * int(frame[n, y, mirror(x + i - reach, frame.shape[2]), channel])
        sum_out[n, y, x, channel] = wp.uint16(total)


@wp.kernel
def blur_columns(
    # In:
    row_sum: wp.array4d(dtype=wp.uint16),  # [n h w 3] uint16
    weight: wp.array(dtype=int),  # [k] int32, sum 256
    # Out:
    frame_out: wp.array4d(dtype=wp.uint8),  # [n h w 3] uint8
):
    n, y, x = wp.tid()
    reach = weight.shape[0] // 2
    for channel in range(3):
        total = wp.int32(32768)
        for i in range(weight.shape[0]):
            total += weight[i] * int(row_sum[n, mirror(y + i - reach, row_sum.shape[1]), x, channel])
        frame_out[n, y, x, channel] = wp.uint8(total >> 16)


# ---- how other frames come to a predicted one


@wp.struct
class Place:
    """A place between pixels: those above, below, left and right of it, and how near the latter of each two is."""

    above: int
    below: int
    left: int
    right: int
    down: float
    along: float


@wp.func
def find_place(at: wp.vec2, height: int, width: int) -> Place:
    """Beyond its border an image goes on as it ended."""
    i, j = wp.floor(at[1]), wp.floor(at[0])
    place = Place()
    place.down = at[1] - i
    place.along = at[0] - j
    place.above = wp.clamp(int(i), 0, height - 1)
    place.below = wp.clamp(int(i) + 1, 0, height - 1)
    place.left = wp.clamp(int(j), 0, width - 1)
    place.right = wp.clamp(int(j) + 1, 0, width - 1)
    return place


@wp.func
def read_number(image: wp.array3d(dtype=float), n: int, place: Place) -> float:
    upper = image[n, place.above, place.left] * (1.0 - place.along) + image[n, place.above, place.right] * place.along
    lower = image[n, place.below, place.left] * (1.0 - place.along) + image[n, place.below, place.right] * place.along
    return upper * (1.0 - place.down) + lower * place.down


@wp.func
def read_flow(flow: wp.array3d(dtype=wp.vec2), n: int, place: Place) -> wp.vec2:
    upper = flow[n, place.above, place.left] * (1.0 - place.along) + flow[n, place.above, place.right] * place.along
    lower = flow[n, place.below, place.left] * (1.0 - place.along) + flow[n, place.below, place.right] * place.along
    return upper * (1.0 - place.down) + lower * place.down


@wp.func
def read_color(frame: wp.array4d(dtype=wp.uint8), n: int, place: Place, channel: int) -> float:
    above, below, left, right = place.above, place.below, place.left, place.right
    upper = float(frame[n, above, left, channel]) * (1.0 - place.along) + float(frame[n, above, right, channel]) * place.along
    lower = float(frame[n, below, left, channel]) * (1.0 - place.along) + float(frame[n, below, right, channel]) * place.along
    return upper * (1.0 - place.down) + lower * place.down


@wp.kernel
def weigh_carriers(
    # In:
    soft: wp.array4d(dtype=wp.uint8),  # [n h w 3] uint8, softened frames
    pair: wp.array(dtype=wp.vec2i),  # [c 2] int32, the predicted image and the one that is carried to it
    flow: wp.array3d(dtype=wp.vec2),  # [2 c h w 2] float32 pixels, from the former to the latter, then back
    # Out:
    gate_out: wp.array3d(dtype=float),  # [c h w] float32, 0 to 1, how well flow explains a pixel
    source_out: wp.array3d(dtype=wp.vec2),  # [c h w 2] float32 pixels, where in the latter it comes from
):
    c, y, x = wp.tid()
    height, width = soft.shape[1], soft.shape[2]
    there = flow[c, y, x]
    source = wp.vec2(float(x), float(y)) + there
    place = find_place(source, height, width)
    closure = wp.length(there + read_flow(flow, pair.shape[0] + c, place))
    residual = wp.float32(0.0)
    for channel in range(3):
        here = float(soft[pair[c][0], y, x, channel])
        residual = wp.max(residual, wp.abs(here - read_color(soft, pair[c][1], place, channel)))
    residual = residual / RESIDUAL_SCALE
    closure = closure / CLOSURE_SCALE
    gate_out[c, y, x] = wp.exp(-(residual * residual) - closure * closure)
    source_out[c, y, x] = source


@wp.kernel
def measure_distance(
    # In:
    mask: wp.array3d(dtype=wp.uint8),  # [n h w] uint8, 0 or 1
    first: int,  # the first that is measured
    # Out:
    distance_out: wp.array3d(dtype=float),  # [t h w] float32 distance to the contour [pixels], positive inside, cut off
):
    t, y, x = wp.tid()
    height, width = mask.shape[1], mask.shape[2]
    own = mask[first + t, y, x]
    nearest = float(WINDOW) * STRAIGHT
    for ring in range(1, WINDOW + 1):
        if float(ring) * STRAIGHT >= nearest:
            break
        for along in range(-ring, ring + 1):
            far = wp.abs(along)
            length = float(ring - far) * STRAIGHT + float(far) * SLANTED
            for side in range(4):
                i, j = along, ring
                if side == 1:
                    j = -ring
                if side >= 2:
                    i = ring
                    j = along
                if side == 3:
                    i = -ring
                inside = y + i >= 0 and y + i < height and x + j >= 0 and x + j < width
                if inside and mask[first + t, y + i, x + j] != own:
                    nearest = wp.min(nearest, length)
    nearest = nearest - 0.5
    if own == wp.uint8(0):
        nearest = -nearest
    distance_out[t, y, x] = nearest


@wp.kernel
def carry_true(
    # In:
    gate: wp.array3d(dtype=float),  # [c h w] float32
    source: wp.array3d(dtype=wp.vec2),  # [c h w 2] float32 pixels
    distance: wp.array3d(dtype=float),  # [t h w] float32 pixels, of the true masks
    carrier: wp.array2d(dtype=int),  # [t 2] int32, the carriers of each frame: of the same time, and of the most similar frame
    frame: wp.array2d(dtype=int),  # [t 2] int32, the true frames that they carry
    # Out:
    gate_out: wp.array3d(dtype=float),  # [t h w] float32, of the carrier that explains a pixel better
    shape_out: wp.array3d(dtype=float),  # [t h w] float32, -1 to 1, the mask that it carries
):
    t, y, x = wp.tid()
    chosen = wp.int32(0)
    if gate[carrier[t, 1], y, x] > gate[carrier[t, 0], y, x]:
        chosen = 1
    c = carrier[t, chosen]
    place = find_place(source[c, y, x], distance.shape[1], distance.shape[2])
    gate_out[t, y, x] = gate[c, y, x]
    shape_out[t, y, x] = wp.tanh(read_number(distance, frame[t, chosen], place) / SHAPE_REACH)


# ---- what a predicted frame looks like


@wp.kernel
def weigh_looks(
    # In:
    frame: wp.array4d(dtype=wp.uint8),  # [n h w 3] uint8
    bins: wp.array(dtype=wp.uint16),  # [256*256*256] uint16, the bin of each color
    color: wp.array(dtype=float),  # [bins] float32, evidence of a color
    background: wp.array3d(dtype=wp.uint8),  # [h w 3] uint8
    difference: wp.array(dtype=float),  # [256] float32, evidence of a difference from the background
    uncovered: wp.array2d(dtype=wp.uint8),  # [h w] uint8, 1 where the background is known
    # Out:
    looks_out: wp.array3d(dtype=float),  # [t h w] float32, evidence of both
):
    t, y, x = wp.tid()
    code, most = wp.int32(0), wp.int32(0)
    for channel in range(3):
        value = int(frame[t, y, x, channel])
        code = code * 256 + value
        most = wp.max(most, wp.abs(value - int(background[y, x, channel])))
    looks = wp.clamp(color[int(bins[code])], -EVIDENCE_LIMIT, EVIDENCE_LIMIT)
    if uncovered[y, x] != wp.uint8(0):
        looks += wp.clamp(difference[most], -EVIDENCE_LIMIT, EVIDENCE_LIMIT)
    looks_out[t, y, x] = looks


@wp.kernel
def blur_numbers(
    # In:
    image: wp.array3d(dtype=float),  # [t h w] float32
    weight: wp.array(dtype=float),  # [k] float32
    vertical: int,  # 1 along columns, 0 along rows
    # Out:
    image_out: wp.array3d(dtype=float),  # [t h w] float32
):
    t, y, x = wp.tid()
    reach = weight.shape[0] // 2
    total = wp.float32(0.0)
    for i in range(weight.shape[0]):
        if vertical == 1:
            total += weight[i] * image[t, mirror(y + i - reach, image.shape[1]), x]
        else:
            total += weight[i] * image[t, y, mirror(x + i - reach, image.shape[2])]
    image_out[t, y, x] = total


# ---- frame after frame


@wp.kernel
def decide(
    # In:
    t: int,
    looks: wp.array3d(dtype=float),  # [t h w] float32
    true_gate: wp.array3d(dtype=float),  # [t h w] float32
    true_shape: wp.array3d(dtype=float),  # [t h w] float32
    before: int,  # the carrier of the frame before, -1 where there is none
    gate: wp.array3d(dtype=float),  # [c h w] float32
    source: wp.array3d(dtype=wp.vec2),  # [c h w 2] float32 pixels
    distance: wp.array3d(dtype=float),  # [1 h w] float32 pixels, of the mask of the frame before
    # Out:
    mask_out: wp.array2d(dtype=wp.uint8),  # [h w] uint8, 1 where the evidence is for the robot
):
    y, x = wp.tid()
    weight = float(true_gate[t, y, x])
    shape = float(true_shape[t, y, x])
    if before >= 0:
        rest = wp.max(gate[before, y, x] - weight, 0.0)
        if rest > 0.0:
            place = find_place(source[before, y, x], distance.shape[1], distance.shape[2])
            carried = wp.tanh(read_number(distance, 0, place) / SHAPE_REACH)
            shape = (weight * shape + rest * carried) / (weight + rest)
            weight = weight + rest
    evidence = (1.0 - SHAPE_TRUST * weight) * looks[t, y, x] + SHAPE_WEIGHT * weight * shape
    mask_out[y, x] = wp.where(evidence > 0.0, wp.uint8(1), wp.uint8(0))


@wp.kernel
def take_median(
    # In:
    mask: wp.array2d(dtype=wp.uint8),  # [h w] uint8, 0 or 1
    # Out:
    mask_out: wp.array2d(dtype=wp.uint8),  # [h w] uint8, what most of a pixel and its eight neighbors are
):
    y, x = wp.tid()
    count = wp.int32(0)
    for i in range(-1, 2):
        for j in range(-1, 2):
            count += int(mask[wp.clamp(y + i, 0, mask.shape[0] - 1), wp.clamp(x + j, 0, mask.shape[1] - 1)])
    mask_out[y, x] = wp.where(count > 4, wp.uint8(1), wp.uint8(0))


@wp.func
def is_in(mask: wp.array2d(dtype=wp.uint8), y: int, x: int) -> bool:
    if y < 0 or y >= mask.shape[0] or x < 0 or x >= mask.shape[1]:
        return False
    return mask[y, x] != wp.uint8(0)


@wp.func
def is_large(mask: wp.array2d(dtype=wp.uint8), y: int, x: int) -> bool:
    """Does a pixel belong to a piece of at least SMALLEST_PIECE pixels? The piece is followed from it until that is known."""
    width = mask.shape[1]
    piece = Piece()
    piece[0] = y * width + x
    count, at = wp.int32(1), wp.int32(0)
    while at < count:
        row, column = piece[at] // width, piece[at] % width
        at += 1
        for i in range(-1, 2):
            for j in range(-1, 2):
                if is_in(mask, row + i, column + j):
                    code = (row + i) * width + column + j
                    known = wp.bool(False)
                    for k in range(count):
                        if piece[k] == code:
                            known = True
                    if not known:
                        if count + 1 >= SMALLEST_PIECE:
                            return True
                        piece[count] = code
                        count += 1
    return False


@wp.kernel
def drop_specks(
    # In:
    t: int,
    mask: wp.array2d(dtype=wp.uint8),  # [h w] uint8, 0 or 1
    # Out:
    mask_out: wp.array3d(dtype=wp.uint8),  # [t h w] uint8; frame t without pieces of fewer than SMALLEST_PIECE pixels
):
    y, x = wp.tid()
    kept = wp.uint8(0)
    if mask[y, x] != wp.uint8(0) and is_large(mask, y, x):
        kept = wp.uint8(1)
    mask_out[t, y, x] = kept

"""Visual quality and morphology by a network: LPIPS (AlexNet, v0.1) on frames and on the robot's region.

R. Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018. Convolutions are those of
float32 everywhere: TF32, the default of some GPUs, changes the fourth digit (`networks.convolution`).
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool

from xew.metrics.estimators.images import equal_frames
from xew.metrics.metric import (
    AnyArray,
    ByFrame,
    Masks,
    Scalar,
    Video,
    check_first,
    check_masked_videos,
    check_videos,
    map_chunks,
)
from xew.metrics.networks.alexnet import read_alexnet
from xew.metrics.networks.convolution import convolve, convolve_quickly

SMALLEST_SIDE = 31
"""Least side [pixels]: below it the second pooling has no window and the mean over nothing would be NaN."""

SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
SCALE = np.array([0.458, 0.448, 0.450], np.float32)
"""Input scaling of LPIPS, on RGB in [-1, 1]."""

CONVOLUTIONS = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))
"""Stride, zero padding, and whether a 3x3 pooling of stride 2 comes first. torchvision's AlexNet up to its fifth ReLU."""

Weights = Mapping[str, jax.Array]
Box = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""top, left, height, width; int32 [pixels]."""
Layers = tuple[tuple[jax.Array, jax.Array, jax.Array], ...]
"""Five layers of frames [n h w d] float32, each with the height and width that are valid."""
Blocks = Sequence[AnyArray]
"""An array [t ...] in blocks [n ...] of one size, on the device where they are needed; the last is filled up."""
KEPT_FEATURES = {"cpu": 512_000_000, "gpu": 1_024_000_000}
"""Size [bytes] up to which `SharedFeatures` keeps features of a true video on a device: 170 or 340 frames of 320x240, whose box
is the whole image in three of four episodes."""


@check_first(check_videos, smallest_side=SMALLEST_SIDE)
def lpips(prediction: Video, target: Video, *, chunk: int | None = None, exact: bool = True) -> ByFrame:
    """Learned perceptual distance of each frame, 0 for equal frames, lower is better.

    Agrees with `lpips.LPIPS(net="alex", version="0.1")` to 1e-6.

    Args:
        prediction, target: [t h w 3] RGB, uint8, or floating in [0, 1]; sides of at least 31 pixels.
        chunk: most frames computed at once; by default 1 on a CPU, where that is fastest, and 64 elsewhere.
        exact: whether convolutions are those of float32 on every device. Without, they are what the device has by default,
            TF32 on NVIDIA's GPUs: several times faster and about 1e-4 off, for a loss.

    Returns:
        [t] float32; NaN where a pixel of either frame is NaN.

    Raises:
        ValueError: shapes differ or a side is under 31 pixels.
        FileNotFoundError: the weights are not installed.
    """
    return _box_distance(_weights(), prediction, target, _whole_box(target), chunk, exact)


def check_region(prediction: Any, target: Any, target_mask: Any) -> None:
    """Raise ValueError or TypeError unless videos are [t h w 3], alike and large enough, and masks bool [t h w] with them."""
    check_masked_videos(prediction, target, target_mask, SMALLEST_SIDE)


@check_first(check_region)
def region_lpips(
    prediction: Video, target: Video, target_mask: Masks, *, box: Box | None = None, chunk: int | None = None
) -> Scalar:
    """LPIPS inside the bounding box of the union over time of the target's robot masks, mean over frames.

    The box is one for the whole video and is cut out before the network. A side under 31 pixels is grown to 31, since the
    network needs as many. Under a caller's jit masks without a pixel give NaN, no error.

    Args:
        prediction, target: [t h w 3] RGB, uint8, or floating in [0, 1].
        target_mask: [t h w] bool.
        box: `union_box` of the whole video's masks, where these frames are a part of a video.
        chunk: as in `lpips`.

    Returns:
        Scalar float32, lower is better.

    Raises:
        ValueError: shapes differ, no pixel is masked, or a side of the frames is under 31 pixels.
    """
    return jnp.mean(region_lpips_frames(prediction, target, target_mask, box=box, chunk=chunk))


@check_first(check_region)
def region_lpips_frames(
    prediction: Video, target: Video, target_mask: Masks, *, box: Box | None = None, chunk: int | None = None
) -> ByFrame:
    """`region_lpips` before the mean over frames, [t] float32, of videos [t h w 3] and masks [t h w] bool."""
    box = _mask_box(target_mask) if box is None else box
    return _box_distance(_weights(), prediction, target, box, chunk)


@check_first(check_region)
def robot_lpips(prediction: Video, target: Video, target_mask: Masks, *, chunk: int | None = None) -> Scalar:
    """LPIPS of the robot, mean over the frames in which the target shows it; lower is better.

    LPIPS is a mean over each layer's map of distances. Here each unit is weighted by the share of its receptive field that the
    robot covers in the target. A mask of whole frames gives LPIPS.

    Args:
        prediction, target: [t h w 3] RGB, uint8, or floating in [0, 1]; sides of at least 31 pixels.
        target_mask: [t h w] bool, the robot in the target.
        chunk: as in `lpips`.

    Returns:
        Scalar float32; NaN where no frame shows the robot, or a pixel of one that does is NaN.

    Raises:
        ValueError: shapes differ or a side is under 31 pixels.
    """
    values, shows = robot_lpips_parts(prediction, target, target_mask, chunk=chunk)
    return jnp.sum(jnp.where(shows, values, 0)) / jnp.sum(shows, dtype=jnp.float32)


@check_first(check_region)
def robot_lpips_frames(prediction: Video, target: Video, target_mask: Masks, *, chunk: int | None = None) -> ByFrame:
    """`robot_lpips` before the mean, [t] float32, NaN where no pixel is the robot; of videos [t h w 3], masks [t h w] bool."""
    values, shows = robot_lpips_parts(prediction, target, target_mask, chunk=chunk)
    return jnp.where(shows, values, jnp.nan)


@check_first(check_region)
def robot_lpips_parts(
    prediction: Video, target: Video, target_mask: Masks, *, chunk: int | None = None
) -> tuple[ByFrame, Bool[jax.Array, " t"]]:
    """Values [t] float32 that `robot_lpips` of videos [t h w 3] and masks [t h w] is the mean of, and [t] bool, which count."""
    mask = jnp.asarray(target_mask)
    return _weighted_distance(_weights(), prediction, target, mask, chunk), jnp.any(mask, axis=(1, 2))


def check_video(video: Any, target_mask: Any = None) -> None:
    """Raise ValueError or TypeError unless a video is [t h w 3] with sides that LPIPS takes, and a mask is bool [t h w]."""
    if target_mask is None:
        check_videos(video, video, SMALLEST_SIDE)
    else:
        check_region(video, video, target_mask)


@check_first(check_video)
def lpips_embedding(video: Video, target_mask: Masks | None = None, *, chunk: int | None = None) -> jax.Array:
    """Vectors whose squared Euclidean distances are `lpips`: where all of many images are compared, each is described once.

    With a mask, which all that are compared have to share, they are `robot_lpips_frames`: 0 where it is empty.

    Args:
        video: [t h w 3] RGB, uint8, or floating in [0, 1]; sides of at least 31 pixels.
        target_mask: [t h w] bool, the region that counts; None for whole frames.
        chunk: as in `lpips`.

    Returns:
        [t d] float32, 3.0 MB a frame of 320x240; NaN where a pixel of the frame is NaN.

    Raises:
        ValueError: the video has another shape, or a side is under 31 pixels.
        FileNotFoundError: the weights are not installed.
    """
    return _embed(_weights(), video, target_mask, chunk)


class SharedFeatures:
    """Features of a true video's frames, computed once for all LPIPS metrics and all predictions.

    Frame by frame on a CPU the numbers are exactly those of `lpips` and `region_lpips_frames`; `robot_lpips_frames` may differ
    in the last bit. In blocks of frames all agree within 1e-6.
    """

    def __init__(self, most_bytes: int) -> None:
        """Keep features of the true video up to this size [bytes]; others are computed again each time."""
        self._left = most_bytes
        self._true: dict[tuple[int, tuple[int, ...]], Layers] = {}

    def distances(
        self,
        prediction: np.ndarray,
        target: np.ndarray,
        robot: np.ndarray | None = None,
        box: Box | None = None,
        blocks: Sequence[Blocks] | None = None,
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """LPIPS [t] float32 inside a box, and weighted by the robot as in `robot_lpips_frames`.

        Args:
            prediction, target: [t h w 3] uint8; the target is the same video in every call.
            robot: [t h w] bool, of whole frames; None for no second answer.
            box: `union_box` of the region; None for whole frames.
            blocks: the arrays in blocks that are computed at once; None for frame by frame.
        """
        arrays = (prediction, target) if robot is None else (prediction, target, robot)
        blocks = [_frame_by_frame(array) for array in arrays] if blocks is None else blocks
        box = _whole_box(target) if box is None else box
        equal = equal_frames(prediction, target)
        plain: list[Any] = []
        weighted: list[Any] = []
        layers: Layers | None = None
        own = made_of = np.s_[0:0]
        for frames, true, *masks in zip(*blocks, strict=True):
            own = np.s_[own.stop : own.stop + len(frames)]
            if equal[own].all():
                plain.append(np.zeros(len(frames), np.float32))
                weighted.append(plain[-1])
                continue
            if layers is None or not _are_equal(prediction[own], prediction[made_of]):
                layers, made_of = _layers(_weights(), frames, box), own
            true_layers = self._of_target(own.start, true, box)
            plain.append(_distance_of_layers(_weights(), layers, true_layers))
            weighted += [_weighted_distance_of_layers(_weights(), layers, true_layers, mask) for mask in masks]
        # A convolution may round the two images of a pair differently.
        whole = np.where(equal, np.float32(0), _join(plain, len(target)))
        if robot is None:
            return whole, None
        of_robot = np.where(equal, np.float32(0), _join(weighted, len(target)))
        return whole, np.where(robot.any(axis=(1, 2)), of_robot, np.float32(np.nan))

    def _of_target(self, first: int, frames: AnyArray, box: Box) -> Layers:
        key = first, tuple(int(side) for side in box)
        layers = self._true.get(key)
        if layers is None:
            layers = _layers(_weights(), frames, box)
            self._left -= sum(layer.nbytes for layer, _, _ in layers)
            if self._left >= 0:
                self._true[key] = layers
        return layers


def _are_equal(first: np.ndarray, second: np.ndarray) -> bool:
    return len(first) == len(second) and bool(equal_frames(first, second).all())


def _frame_by_frame(array: np.ndarray) -> list[np.ndarray]:
    return [array[t : t + 1] for t in range(len(array))]


def _join(blocks: list[Any], count: int) -> np.ndarray:
    """Values of blocks [n] each, on any device, as one array [count] float32."""
    return np.concatenate(jax.device_get(blocks))[:count]


@jax.jit
def _layers(weights: Weights, frames: jax.Array, box: Box) -> Layers:
    """The five layers of a box of frames [n h w 3], each with its valid size."""
    return tuple(_features(weights, _input(frames, box), *box[2:]))


@jax.jit
def _distance_of_layers(weights: Weights, prediction: Layers, target: Layers) -> jax.Array:
    """LPIPS [n] of frames."""
    layers = [(_unit(x), _unit(y), h, w) for (x, h, w), (y, _, _) in zip(prediction, target, strict=True)]
    return _sum_of_layers(weights, layers)


@jax.jit
def _weighted_distance_of_layers(weights: Weights, prediction: Layers, target: Layers, mask: jax.Array) -> jax.Array:
    """LPIPS [n] of frames weighted by their masks [n h w]; 0 where there is none."""
    layers = [(_unit(x), _unit(y)) for (x, _, _), (y, _, _) in zip(prediction, target, strict=True)]
    return _weighted_sum_of_layers(weights, layers, mask)


@jax.jit
def union_box(mask: Masks) -> Box:
    """Bounding box (top, left, height, width) int32 [pixels] of all that [t h w] covers at any time; zeros if nothing.

    Sides under SMALLEST_SIDE are grown about their middle, as far as the image allows.
    """
    covered = jnp.any(mask, axis=0)
    top, height = _extent(jnp.any(covered, axis=1))
    left, width = _extent(jnp.any(covered, axis=0))
    return top, left, height, width


def _extent(covered: jax.Array) -> tuple[jax.Array, jax.Array]:
    """First pixel and length, int32, of what is covered of a side [n], grown to SMALLEST_SIDE; zeros if nothing."""
    first, after = jnp.argmax(covered), len(covered) - jnp.argmax(covered[::-1])
    side = jnp.minimum(jnp.maximum(after - first, SMALLEST_SIDE), len(covered))
    first = jnp.clip(first - (side - after + first) // 2, 0, len(covered) - side)
    # In 64 bits argmax is of another type than the sizes of frames.
    first, side = (jnp.where(jnp.any(covered), value, 0).astype(jnp.int32) for value in (first, side))
    return first, side


def _whole_box(video: AnyArray) -> Box:
    height, width = np.shape(video)[1:3]
    return jnp.int32(0), jnp.int32(0), jnp.int32(height), jnp.int32(width)


def _mask_box(target_mask: AnyArray) -> Box:
    """The box of the masks. Raises ValueError if they are empty, unless that is not known yet, under a jit."""
    box = union_box(target_mask)
    if not isinstance(box[2], jax.core.Tracer) and not int(box[2]):
        raise ValueError("target_mask has no pixel, so region LPIPS has no box; check that the masks belong to this video.")
    return box


@functools.cache
def _weights() -> Weights:
    """On the device, once; evaluated at once also under a jit of the caller's, so no tracer is kept."""
    with jax.ensure_compile_time_eval():
        return {name: jnp.asarray(array) for name, array in read_alexnet().items()}


@functools.partial(jax.jit, static_argnames=("chunk", "exact"))
def _box_distance(
    weights: Weights, prediction: jax.Array, target: jax.Array, box: Box, chunk: int | None, exact: bool = True
) -> jax.Array:
    """LPIPS [t] of the same box of both videos."""

    def distances(pair: tuple[jax.Array, jax.Array]) -> jax.Array:
        image, count = _input(jnp.concatenate(pair), box), len(pair[0])
        units = ((_unit(x), h, w) for x, h, w in _features(weights, image, *box[2:], exact=exact))
        values = _sum_of_layers(weights, [(both[:count], both[count:], h, w) for both, h, w in units])
        return jnp.where(_is_broken(image[:count], image[count:]), jnp.nan, values)

    return map_chunks(lambda pair: _zero_where_equal(distances, pair), (prediction, target), chunk)


def _zero_where_equal(distances: Callable[[Any], jax.Array], frames: tuple[jax.Array, ...]) -> jax.Array:
    """Distances [n] of frames, whose first two arrays [n h w 3] are compared; exactly 0 where these are equal.

    A convolution may round the two images of a pair differently.
    """
    equal = jnp.all(frames[0] == frames[1], axis=(1, 2, 3))
    # Zeros that are made of the data lie where the data lie, as shard_map wants it of both branches.
    return jnp.where(equal, 0, lax.cond(jnp.all(equal), lambda _: (~equal).astype(jnp.float32), distances, frames))


def _is_broken(*images: jax.Array) -> jax.Array:
    """[n] bool, whether a number in any of some images [n h w 3] is NaN, also where no unit of the network looks."""
    return functools.reduce(jnp.logical_or, (jnp.any(jnp.isnan(image), axis=(1, 2, 3)) for image in images))


@functools.partial(jax.jit, static_argnames="chunk")
def _weighted_distance(
    weights: Weights, prediction: jax.Array, target: jax.Array, mask: jax.Array, chunk: int | None
) -> jax.Array:
    """LPIPS [t] of whole frames, weighted by the share of the mask in each receptive field; 0 where there is no mask."""
    box = _whole_box(target)

    def distances(frames: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        image, count = _input(jnp.concatenate(frames[:2]), box), len(frames[0])
        units = [_unit(x) for x, _, _ in _features(weights, image, *box[2:])]
        values = _weighted_sum_of_layers(weights, [(both[:count], both[count:]) for both in units], frames[2])
        return jnp.where(_is_broken(image[:count], image[count:]), jnp.nan, values)

    return map_chunks(lambda frames: _zero_where_equal(distances, frames), (prediction, target, mask), chunk)


def _weighted_sum_of_layers(weights: Weights, layers: list[tuple[jax.Array, jax.Array]], mask: jax.Array) -> jax.Array:
    """LPIPS [n] from the layers' unit vectors of both videos [n h w d], weighted by the share of the mask [n h w]."""
    total = jnp.zeros(len(mask), jnp.float32)
    for i, ((x, y), field_of_unit) in enumerate(zip(layers, _receptive_fields(weights), strict=True)):
        share = _covered_share(mask, field_of_unit, x.shape[1:3])
        weighted = jnp.sum(share * _layer_map(weights[f"head{i}"], x, y), axis=(1, 2))
        weight = jnp.sum(share, axis=(1, 2))
        total = total + jnp.where(weight > 0, weighted / jnp.where(weight > 0, weight, 1), 0)
    return total


def _receptive_fields(weights: Weights) -> list[tuple[int, int, int]]:
    """Side, step and first pixel of the receptive fields of each layer's units, along either axis of the image [pixels]."""
    fields, side, step, first = [], 1, 1, 0
    for i, (stride, padding, pool_first) in enumerate(CONVOLUTIONS):
        if pool_first:
            side, step = side + 2 * step, 2 * step
        first -= padding * step
        side, step = side + (weights[f"conv{i}_kernel"].shape[0] - 1) * step, stride * step
        fields.append((side, step, first))
    return fields


def _covered_share(mask: jax.Array, receptive_field: tuple[int, int, int], shape: tuple[int, ...]) -> jax.Array:
    """Share of the mask [n h w] in the receptive field of each unit of a layer [n *shape], of what lies in the image."""
    side, step, first = receptive_field
    covered, area = mask.astype(jnp.float32), np.ones((1, 1, 1), np.float32)
    for axis, units in zip((1, 2), shape, strict=True):
        low = step * np.arange(units) + first
        start, end = (np.clip(edge, 0, mask.shape[axis]) for edge in (low, low + side))
        # Sums over windows as differences of a running sum: of whole numbers, exact in float32.
        running = jnp.pad(jnp.cumsum(covered, axis=axis), [(1, 0) if i == axis else (0, 0) for i in range(3)])
        covered = jnp.take(running, end, axis=axis) - jnp.take(running, start, axis=axis)
        area = area * np.expand_dims((end - start).astype(np.float32), (0, 3 - axis))
    return covered / area


@functools.partial(jax.jit, static_argnames="chunk")
def _box_features(weights: Weights, video: jax.Array, box: Box, chunk: int | None) -> tuple[jax.Array, ...]:
    """Unit vectors of the five layers [t h w d] of a video's box."""

    def of_frames(frames: jax.Array) -> tuple[jax.Array, ...]:
        return tuple(_unit(x) for x, _, _ in _features(weights, _input(frames, box), *box[2:]))

    return map_chunks(of_frames, video, chunk)


@functools.partial(jax.jit, static_argnames="chunk")
def _embed(weights: Weights, video: jax.Array, mask: jax.Array | None, chunk: int | None) -> jax.Array:
    """The features of whole frames, or of masked regions, weighted so squared differences add up to LPIPS: [t d]."""
    vectors = []
    layers = _box_features(weights, video, _whole_box(video), chunk)
    for i, (layer, field_of_unit) in enumerate(zip(layers, _receptive_fields(weights), strict=True)):
        shape = layer.shape[1:3]
        share = jnp.ones((1, *shape)) if mask is None else _covered_share(mask, field_of_unit, shape)
        area = jnp.sum(share, axis=(1, 2))[:, None, None, None]
        weight = weights[f"head{i}"].reshape(1, 1, 1, -1) * share[..., None] / jnp.where(area > 0, area, 1)
        vectors.append((layer * jnp.sqrt(weight)).reshape(len(layer), -1))
    return jnp.where(_is_broken(video)[:, None], jnp.nan, jnp.concatenate(vectors, axis=1))


def _input(frames: jax.Array, box: Box) -> jax.Array:
    """The box of frames [n h w 3] moved to the upper left of a canvas that is zero elsewhere, scaled as AlexNet takes it.

    The box is data, not shape: one program serves the whole frame and every box. What lies outside is set to zero before
    each layer too, which is what a network on the small image pads with.
    """
    top, left, height, width = box
    unit = frames.astype(jnp.float32) / 255 if frames.dtype == jnp.uint8 else frames.astype(jnp.float32)
    scaled = ((unit * 2 - 1) - SHIFT.reshape(1, 1, 1, 3)) / SCALE.reshape(1, 1, 1, 3)
    return _keep(jnp.roll(scaled, -jnp.stack((top, left)), axis=(1, 2)), height, width)


def _features(
    weights: Weights, x: jax.Array, height: jax.Array, width: jax.Array, *, exact: bool = True
) -> list[tuple[jax.Array, jax.Array, jax.Array]]:
    """Five ReLU outputs [n h w d] of images [n h w 3] that are zero beyond height x width, each with its valid size."""
    layers = []
    for i, (stride, padding, pool_first) in enumerate(CONVOLUTIONS):
        if pool_first:
            x = lax.reduce_window(x, -jnp.inf, lax.max, (1, 3, 3, 1), (1, 2, 2, 1), "valid")
            height, width = (height - 3) // 2 + 1, (width - 3) // 2 + 1
            x = _keep(x, height, width)
        kernel = weights[f"conv{i}_kernel"]
        x = convolve(x, kernel, stride, padding) if exact else convolve_quickly(x, kernel, stride, padding)
        height, width = ((side + 2 * padding - kernel.shape[0]) // stride + 1 for side in (height, width))
        x = _keep(jax.nn.relu(x + weights[f"conv{i}_bias"].reshape(1, 1, 1, -1)), height, width)
        layers.append((x, height, width))
    return layers


def _keep(x: jax.Array, height: jax.Array, width: jax.Array) -> jax.Array:
    """Zero outside the upper left height x width of [n h w d]."""
    rows, columns = (jnp.arange(x.shape[1 + i], dtype=side.dtype) < side for i, side in enumerate((height, width)))
    return jnp.where((rows[:, None] & columns[None, :])[None, :, :, None], x, 0)


def _sum_of_layers(weights: Weights, layers: list[tuple[jax.Array, jax.Array, jax.Array, jax.Array]]) -> jax.Array:
    """LPIPS [n] from the layers' unit vectors of both videos [n h w d], each with the height and width that are valid."""
    return jnp.sum(jnp.stack([_layer_distance(weights[f"head{i}"], *layer) for i, layer in enumerate(layers)]), axis=0)


def _layer_distance(head: jax.Array, x: jax.Array, y: jax.Array, height: jax.Array, width: jax.Array) -> jax.Array:
    """`_layer_map` of unit vectors [n h w d], mean over the valid part: [n]."""
    return jnp.sum(jnp.sum(_layer_map(head, x, y), axis=2), axis=1) / (height * width).astype(jnp.float32)


def _layer_map(head: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Squared difference of unit vectors [n h w d], weighted by the head [d]: [n h w]."""
    return jnp.einsum("nhwd,d->nhw", jnp.square(x - y), head, precision=lax.Precision.HIGHEST)


def _unit(x: jax.Array) -> jax.Array:
    """Feature vectors divided by their length + 1e-10, as LPIPS does it; gradient 0 where a vector is zero."""
    square = jnp.sum(jnp.square(x), axis=-1, keepdims=True)
    length = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    return x / (length + 1e-10)

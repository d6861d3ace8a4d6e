"""The default masker: robot masks of a predicted video without any network's weights.

Three kinds of evidence, log-likelihood ratios learned from the true episode, add up:
    color      how much more often the robot has this color than everything else
    background how far the pixel is from the empty scene behind it (the camera stands still)
    shape      a true mask, carried by optical flow onto the predicted frame: of the same time or, if it explains a pixel
        better,
               of the most similar true frame; else the mask of the predicted frame before
Shape counts only where flow explains the pixel (small residual, flow there and back closes). Without these gates a frozen video
would receive the true masks. The row `ground_truth` of `evaluate` gives the masker's error on true video.
"""

import functools
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from xew.metrics.estimators.images import sample, soften
from xew.metrics.estimators.similarity import find_most_similar

COLOR_BINS = 24
BIN_OF_LEVEL = (np.arange(256) * COLOR_BINS // 256).astype(np.uint8)
"""[256] the bin of each level of a channel."""
LEARNING_FRAMES = 32
"""Largest number of frames, spread evenly, that the appearance is learnt from."""
SOFTNESS = (1.0, 2.0)
"""Standard deviations of the blur [pixels] of the softened copies that are learnt from too."""
RESIDUAL_SOFTNESS = 1.5
"""Standard deviation [pixels] of the blur of both frames before they are compared: sharpness and grain are no motion."""
LOOKS_SOFTNESS = 0.8
"""Standard deviation [pixels] of the blur of the evidence of color and background."""
EVIDENCE_LIMIT = 4.0
"""Largest log-likelihood ratio of a single kind of evidence, exp(4) : 1; histograms of one episode know no better."""
SHAPE_WEIGHT = 9.0
"""Weight of shape, above both other kinds together: where flow explains a pixel fully, things of its colors stay out."""
SHAPE_REACH = 1.0
"""Pixels from the carried contour at which shape evidence is three quarters of its full weight."""
SHAPE_TRUST = 0.8
"""Share of the other two kinds that is dropped where flow explains a pixel fully: a carried contour is sharper than they."""
SMALLEST_PIECE = 24
"""Least size of a piece [pixels]; what is smaller is the rim of some object, not a robot."""
RESIDUAL_SCALE = 25.0
"""Color difference (levels) between a pixel and the one that flow says it came from, at which the gate is 1/e."""
CLOSURE_SCALE = 3.0
"""Distance (pixels) by which flow there and back misses its start, at which the gate is 1/e."""


@dataclass(frozen=True)
class Appearance:
    """What the true episode teaches of its robot's looks."""

    color: np.ndarray
    """[bins bins bins] float32, log-likelihood ratio robot : rest of a Lab color."""
    background: np.ndarray
    """[h w 3] uint8, the scene without the robot; what no frame uncovers is filled in from around."""
    difference: np.ndarray
    """[256] float32, log-likelihood ratio robot : rest of the largest channel difference from the background."""
    uncovered: np.ndarray
    """[h w] bool, where the background was seen in some frame."""


class Episode:
    """A true episode, whose derived arrays are shared by all its predictions.

    Args:
        video: [t h w 3] uint8 RGB, the true video.
        mask: [t h w] bool, true robot masks.
    """

    def __init__(self, video: np.ndarray, mask: np.ndarray) -> None:
        self.frames, self.mask = _Frames(video), mask
        self.appearance = learn_appearance(video, mask)
        self._distance: dict[int, np.ndarray] = {}

    def is_of(self, video: np.ndarray, mask: np.ndarray) -> bool:
        """Are video [t h w 3] and mask [t h w] the very arrays of the episode?"""
        return self.frames.video is video and self.mask is mask

    def distance(self, t: int) -> np.ndarray:
        """[h w] float32, `_signed_distance` of the mask of frame t."""
        if t not in self._distance:
            self._distance[t] = _signed_distance(self.mask[t])
        return self._distance[t]


def estimate_masks(
    prediction: np.ndarray, target: np.ndarray, target_mask: np.ndarray, episode: Episode | None = None
) -> np.ndarray:
    """Robot masks of a predicted video.

    Args:
        prediction, target: [t h w 3] uint8 RGB, predicted and true video of one episode, same frames.
        target_mask: [t h w] bool, true robot masks.
        episode: `Episode(target, target_mask)`, where several predictions of one episode share it.

    Returns:
        [t h w] bool.
    """
    episode = episode or Episode(target, target_mask)
    alike, _ = find_most_similar(prediction, target)
    seen, true = _Frames(prediction), episode.frames
    masks: list[np.ndarray] = []
    carriers: dict[int, Carrier] = {}
    resting: Carrier | None = None
    for t, frame in enumerate(prediction):
        stands = t > 0 and np.array_equal(frame, prediction[t - 1])
        known = carriers if stands else {}
        # The mask of the frame itself comes first: where both explain a pixel equally well, it is the one that counts.
        carriers = {i: known.get(i) or _find_carrier(seen, t, true, i) for i in dict.fromkeys((t, int(alike[t])))}
        shapes = [carrier.carry(episode.distance(i)) for i, carrier in carriers.items()]
        resting = (resting or _find_carrier(seen, t, seen, t)) if stands else None
        from_before = resting or (_find_carrier(seen, t, seen, t - 1) if t else None)
        before = None if from_before is None else from_before.carry(_signed_distance(masks[-1]))
        masks.append(_estimate_frame(episode.appearance, frame, shapes, before))
        seen.forget(t - 1)
    return np.stack(masks)


def learn_appearance(video: np.ndarray, mask: np.ndarray) -> Appearance:
    """Learn the colors of a robot and its background from true video [t h w 3] uint8 and masks [t h w] bool.

    Frames count as they are and softened, because predicted video is soft.
    """
    picked = np.unique(np.linspace(0, len(video) - 1, LEARNING_FRAMES).round().astype(int))
    background, uncovered = _background(video[picked], mask[picked])
    video = np.concatenate([video[picked], *([soften(frame, s) for frame in video[picked]] for s in SOFTNESS)])
    mask = np.tile(mask[picked], (1 + len(SOFTNESS), 1, 1))
    everywhere = np.ones_like(uncovered)
    lab = (cv2.cvtColor(frame, cv2.COLOR_RGB2LAB) for frame in video)
    difference = (_difference(frame, background) for frame in video)
    return Appearance(
        color=_log_ratio(lab, mask, everywhere, (COLOR_BINS,) * 3),
        background=background,
        difference=_log_ratio(difference, mask, uncovered, (256,)),
        uncovered=uncovered,
    )


Shape = tuple[np.ndarray, np.ndarray]
"""Weights [h w] from 0 to 1 of how well flow explains each pixel, and a mask carried by it [h w] from -1 (surely not) to 1."""


@dataclass(frozen=True)
class Carrier:
    """How another frame's pixels come to a predicted frame by flow."""

    gate: np.ndarray
    """[h w] from 0 to 1, how well flow explains each pixel."""
    source: np.ndarray
    """[h w 2] float32, where in the other frame each pixel comes from."""

    def carry(self, distance: np.ndarray) -> Shape:
        """The shape of the other frame's mask, of which this is the `_signed_distance` [h w]."""
        return self.gate, np.tanh(sample(distance, self.source) / SHAPE_REACH)


def _estimate_frame(appearance: Appearance, frame: np.ndarray, shapes: list[Shape], before: Shape | None) -> np.ndarray:
    gate, shape = functools.reduce(_choose_better, shapes)
    if before is not None:
        gate, shape = _fill_up((gate, shape), before)
    looks = (1 - SHAPE_TRUST * gate) * _looks(appearance, frame)
    return _drop_specks(cv2.medianBlur((looks + SHAPE_WEIGHT * gate * shape > 0).astype(np.uint8), 3))


def _looks(appearance: Appearance, frame: np.ndarray) -> np.ndarray:
    """[h w] float32, evidence of color and background."""
    color = appearance.color.reshape(-1)[color_bins(frame)]
    difference = appearance.difference[_difference(frame, appearance.background)]
    looks = np.clip(color, -EVIDENCE_LIMIT, EVIDENCE_LIMIT)
    looks += np.where(appearance.uncovered, np.clip(difference, -EVIDENCE_LIMIT, EVIDENCE_LIMIT), 0)
    return cv2.GaussianBlur(looks.astype(np.float32), (0, 0), LOOKS_SOFTNESS)


def _choose_better(a: Shape, b: Shape) -> Shape:
    take = b[0] > a[0]
    return np.where(take, b[0], a[0]), np.where(take, b[1], a[1])


def _fill_up(true: Shape, before: Shape) -> Shape:
    """Shape from the predicted frame before, where true frames explain a pixel less well.

    It counts only by the difference, so errors do not persist where a true frame explains the pixel.
    """
    rest = np.maximum(before[0] - true[0], 0)
    gate = true[0] + rest
    return gate, (true[0] * true[1] + rest * before[1]) / np.maximum(gate, np.finfo(np.float32).tiny)


def _drop_specks(mask: np.ndarray) -> np.ndarray:
    """Without pieces of fewer than SMALLEST_PIECE pixels; uint8 [h w] to bool."""
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= SMALLEST_PIECE
    large[0] = False  # the ground
    return large[pieces]


class _Frames:
    """A video [t h w 3] uint8 and what flow and its check are made of, frame by frame, each when it is first asked for."""

    def __init__(self, video: np.ndarray) -> None:
        self.video = video
        self._gray: dict[int, np.ndarray] = {}
        self._soft: dict[int, np.ndarray] = {}

    def gray(self, t: int) -> np.ndarray:
        """[h w] uint8."""
        if t not in self._gray:
            self._gray[t] = cv2.cvtColor(self.video[t], cv2.COLOR_RGB2GRAY)
        return self._gray[t]

    def soft(self, t: int) -> np.ndarray:
        """[h w 3] uint8, softened."""
        if t not in self._soft:
            self._soft[t] = soften(self.video[t], RESIDUAL_SOFTNESS)
        return self._soft[t]

    def forget(self, t: int) -> None:
        """Free what was made of a frame."""
        self._gray.pop(t, None)
        self._soft.pop(t, None)


def _find_carrier(seen: _Frames, t: int, others: _Frames, other: int) -> Carrier:
    """How another frame, a true one or the one before, comes to the predicted frame t."""
    gray, gray_other = seen.gray(t), others.gray(other)
    there, back = _flow(gray, gray_other), _flow(gray_other, gray)
    source = _grid(gray.shape) + there
    closure = cv2.magnitude(*cv2.split(there + sample(back, source)))
    residual = _difference(seen.soft(t).astype(np.float32), sample(others.soft(other).astype(np.float32), source))
    gate = np.exp(-((residual / RESIDUAL_SCALE) ** 2) - (closure / CLOSURE_SCALE) ** 2)
    return Carrier(gate, source)


def _flow(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """[h w 2] pixels from each pixel of one gray image to its place in the other (DIS).

    This setting halves the time of the medium preset, and IoU of masks stays within 0.003 (docs/performance.md).
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setPatchStride(4)
    flow.setGradientDescentIterations(16)
    flow.setVariationalRefinementIterations(0)
    return flow.calc(start, end, None)


@functools.lru_cache(maxsize=4)
def _grid(shape: tuple[int, ...]) -> np.ndarray:
    """[h w 2] float32, x and y of each pixel; not to be written to."""
    grid = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1).astype(np.float32)
    grid.setflags(write=False)
    return grid


def _signed_distance(mask: np.ndarray) -> np.ndarray:
    """[h w] float32, distance to the contour [pixels], positive inside."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
    return np.where(mask, np.minimum(inside, 1e3) - 0.5, 0.5 - np.minimum(outside, 1e3)).astype(np.float32)


def _background(video: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median over time of the frames that show each pixel without the robot; [h w 3] uint8, and where there are any."""
    level = np.where(mask[..., None], np.int16(256), video)
    rank = np.sort(np.ascontiguousarray(np.moveaxis(level, 0, -1)), axis=-1)  # sorting what lies side by side is quicker
    free_frames = np.count_nonzero(~mask, axis=0)
    middle = np.maximum(free_frames - 1, 0) // 2
    median = np.take_along_axis(rank, middle[:, :, None, None], axis=-1)[..., 0]
    uncovered = free_frames > 0
    plate = np.where(uncovered[..., None], median, 0).astype(np.uint8)
    return cv2.inpaint(plate, (~uncovered).astype(np.uint8), 3, cv2.INPAINT_TELEA), uncovered


def _difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[h w], the largest of the three channels' differences; three times as fast as a maximum over the last axis."""
    return functools.reduce(np.maximum, cv2.split(cv2.absdiff(a, b)))


def color_bins(video: np.ndarray) -> np.ndarray:
    """Index of each pixel's Lab color among the bins, [t h w] or [h w] int32 of colors [t h w 3] or [h w 3] uint8."""
    flat = video.reshape(-1, video.shape[-2], 3)
    lightness, a, b = cv2.split(cv2.LUT(cv2.cvtColor(flat, cv2.COLOR_RGB2LAB), BIN_OF_LEVEL))
    bins = lightness.astype(np.int32)
    for channel in (a, b):
        bins *= COLOR_BINS
        bins += channel
    return bins.reshape(video.shape[:-1])


def _log_ratio(images: Iterable[np.ndarray], robot: np.ndarray, counted: np.ndarray, bins: tuple[int, ...]) -> np.ndarray:
    """log p(value | robot) / p(value | rest) of pixels, from smoothed histograms.

    Args:
        images: t arrays [h w] or [h w c] uint8.
        robot: [t h w] bool, which pixels are the robot's.
        counted: [h w] bool, which pixels count.
        bins: how many bins each of the c channels has.

    Returns:
        [bins of each channel] float32.
    """
    histograms = np.zeros((2, *bins))
    channels, ends = list(range(len(bins))), [0, 256] * len(bins)
    for image, mask in zip(images, robot, strict=True):
        for histogram, members in zip(histograms, (mask & counted, ~mask & counted), strict=True):
            histogram += cv2.calcHist([image], channels, members.astype(np.uint8), bins, ends).reshape(bins)
    share, rest = ((_blur(histogram) + 1e-9) / max(histogram.sum(), 1) for histogram in histograms)
    floor = 1e-6
    return np.log((share + floor) / (rest + floor)).astype(np.float32)


def _blur(histogram: np.ndarray) -> np.ndarray:
    """Each bin shared with its neighbors along every axis, 1 : 2 : 1."""
    for axis in range(histogram.ndim):
        padded = np.pad(histogram, [(1, 1) if i == axis else (0, 0) for i in range(histogram.ndim)], mode="edge")
        before, after = (np.take(padded, range(s, s + histogram.shape[axis]), axis) for s in (0, 2))
        histogram = 0.25 * before + 0.5 * histogram + 0.25 * after
    return histogram

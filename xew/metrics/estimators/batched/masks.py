"""The default masker (xew.metrics.estimators.masks) on a device: flow, shapes and appearance of all frames at once."""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
import warp as wp

from xew.metrics.estimators import masks as reference
from xew.metrics.estimators.batched import mask_kernels as kernels
from xew.metrics.estimators.batched.devices import download
from xew.metrics.estimators.batched.flow import Array, Search, build_pyramid, find_flow, is_large_enough
from xew.metrics.estimators.images import equal_frames
from xew.metrics.estimators.similarity import find_most_similar

SEARCH = Search(finest=1, stride=4, steps=16)
FRAMES_AT_ONCE = {"cpu": 8, "cuda": 128}
"""Number of frames on the device at once; one takes about 10 MB at 320x240."""


class BatchedMasker:
    """`estimate_masks` on a device (Warp's name, None for the default), which keeps an episode while it repeats."""

    compares_colors = True

    def __init__(self, device: str | None = None) -> None:
        self._device = wp.get_device(device)
        self._known: _Episode | None = None

    def __call__(self, prediction: np.ndarray, target: np.ndarray, target_mask: np.ndarray) -> np.ndarray:
        """Masks bool [t h w] of a prediction [t h w 3] uint8, from the true video [t h w 3] uint8 and masks [t h w] bool."""
        if not is_large_enough(target.shape[1:3], SEARCH):
            return reference.estimate_masks(prediction, target, target_mask)
        known = self._known
        if known is None or known.target is not target or known.mask is not target_mask:
            appearance = reference.learn_appearance(target, target_mask)
            with wp.ScopedDevice(self._device):
                self._known = known = _Episode(target, target_mask, appearance)
        plan = _plan(prediction, find_most_similar(prediction, target)[0])
        with wp.ScopedDevice(self._device):
            masks = _estimate(wp.array(np.ascontiguousarray(prediction), dtype=wp.uint8), known, plan)
        return download(masks).astype(bool)


class _Episode:
    """A true video and its masks on a device, with space for a predicted video."""

    def __init__(self, target: np.ndarray, mask: np.ndarray, appearance: reference.Appearance) -> None:
        self.target, self.mask = target, mask
        count, *size = mask.shape
        self.frames = wp.empty((2 * count, *size, 3), dtype=wp.uint8)
        self.soft = wp.empty_like(self.frames)
        self.gray = wp.empty((2 * count, *size), dtype=wp.uint8)
        self._blur = wp.array(fixed_kernel(reference.RESIDUAL_SOFTNESS), dtype=int)
        self.put(wp.array(np.ascontiguousarray(target), dtype=wp.uint8), slice(count, None))
        self.distance = wp.empty(mask.shape, dtype=float)
        wp.launch(kernels.measure_distance, mask.shape, [wp.array(mask.astype(np.uint8)), 0], [self.distance])
        self.looks = [
            _bins_on(wp.get_device().alias),
            wp.array(appearance.color.ravel(), dtype=float),
            wp.array(appearance.background, dtype=wp.uint8),
            wp.array(appearance.difference, dtype=float),
            wp.array(appearance.uncovered.astype(np.uint8), dtype=wp.uint8),
        ]

    def put(self, video: Array, images: slice) -> None:
        """Make a video [t h w 3] uint8 on the device these images, softened and gray as well."""
        frames, soft, gray = (array[images] for array in (self.frames, self.soft, self.gray))
        wp.copy(frames, video)
        rows = wp.empty(frames.shape, dtype=wp.uint16)
        wp.launch(kernels.blur_rows, gray.shape, [frames, self._blur], [rows])
        wp.launch(kernels.blur_columns, gray.shape, [rows, self._blur], [soft])
        wp.launch(kernels.take_gray, gray.shape, [frames], [gray])


def fixed_kernel(sigma: float) -> np.ndarray:
    """[k] int32, the Gaussian that OpenCV blurs uint8 with, in 256ths."""
    return np.rint(256 * cv2.getGaussianKernel(round(sigma * 6 + 1) | 1, sigma)[:, 0]).astype(np.int32)


@functools.cache
def _bins_on(device: str) -> Array:
    """[256*256*256] uint16, the bin of each color, red first, on a device."""
    levels = np.arange(256, dtype=np.uint8)
    planes = []
    for red in levels:
        plane = np.stack(np.broadcast_arrays(red, levels[:, None], levels[None]), axis=-1)
        planes.append(reference.color_bins(plane).astype(np.uint16))
    return wp.array(np.stack(planes).ravel(), dtype=wp.uint16, device=device)


@dataclass(frozen=True)
class _Plan:
    """Which images flow goes between, each pair once. Predicted images are counted first, then true ones."""

    first_alike: np.ndarray
    """[t] int, the first frame of those equal to each: a video that stands still has one image many times."""
    alike: np.ndarray
    """[t] int, the true frame that looks most like each."""

    def carriers(self, frames: range) -> tuple[np.ndarray, np.ndarray]:
        """[c 2] int, pairs of a predicted image and one that is carried to it, and [t 3] int, for each of these frames the
        pair of the true frame of the same time, that of the most similar true frame, and that of the frame before."""
        now = np.array(frames)
        others = (
            len(self.first_alike) + now,
            len(self.first_alike) + self.alike[now],
            self.first_alike[np.maximum(now - 1, 0)],
        )
        pairs = np.concatenate([np.stack([self.first_alike[now], other], axis=-1) for other in others])
        carriers, index = np.unique(pairs, axis=0, return_inverse=True)
        return carriers, index.reshape(3, -1).T


def _plan(prediction: np.ndarray, alike: np.ndarray) -> _Plan:
    changes = np.append(True, ~equal_frames(prediction[1:], prediction[:-1]))
    return _Plan(np.maximum.accumulate(np.where(changes, np.arange(len(prediction)), 0)), alike)


def _estimate(prediction: Array, known: _Episode, plan: _Plan) -> Array:
    """Masks [t h w] uint8 of a prediction [t h w 3] uint8, both on the device; nothing is waited for."""
    count = len(prediction)
    known.put(prediction, slice(0, count))
    pyramid = build_pyramid(known.gray, SEARCH)
    masks = wp.empty(prediction.shape[:3], dtype=wp.uint8)
    step = FRAMES_AT_ONCE["cuda" if masks.device.is_cuda else "cpu"]
    for start in range(0, count, step):
        frames = range(start, min(start + step, count))
        pairs, used = plan.carriers(frames)
        flow = find_flow(pyramid, np.concatenate([pairs, pairs[:, ::-1]]))
        gate = wp.empty((len(pairs), *flow.shape[1:]), dtype=float)
        source = wp.empty(gate.shape, dtype=wp.vec2)
        carrier = wp.array(pairs.astype(np.int32), dtype=wp.vec2i)
        wp.launch(kernels.weigh_carriers, gate.shape, [known.soft, carrier, flow], [gate, source])
        true = _carry_true(known, plan, frames, used, gate, source)
        looks = _weigh_looks(known, frames)
        _decide(frames, [looks, *true], used[:, 2], [gate, source], masks)
    return masks


def _carry_true(
    known: _Episode, plan: _Plan, frames: range, used: np.ndarray, gate: Array, source: Array
) -> tuple[Array, Array]:
    """What true masks say of each frame: weights [t h w] and shapes [t h w]."""
    shape = (len(frames), *gate.shape[1:])
    true_gate, true_shape = wp.empty(shape, dtype=float), wp.empty(shape, dtype=float)
    carriers = wp.array(np.ascontiguousarray(used[:, :2], np.int32))
    true_frames = wp.array(np.stack([np.array(frames), plan.alike[frames.start : frames.stop]], axis=-1).astype(np.int32))
    inputs = [gate, source, known.distance, carriers, true_frames]
    wp.launch(kernels.carry_true, shape, inputs, [true_gate, true_shape])
    return true_gate, true_shape


def _weigh_looks(known: _Episode, frames: range) -> Array:
    """[t h w] float32, evidence of color and background."""
    looks = wp.empty((len(frames), *known.gray.shape[1:]), dtype=float)
    wp.launch(kernels.weigh_looks, looks.shape, [known.frames[frames.start : frames.stop], *known.looks], [looks])
    sigma = reference.LOOKS_SOFTNESS
    weight = wp.array(cv2.getGaussianKernel(round(sigma * 8 + 1) | 1, sigma, cv2.CV_32F)[:, 0], dtype=float)
    for vertical in (0, 1):
        soft = wp.empty_like(looks)
        wp.launch(kernels.blur_numbers, looks.shape, [looks, weight, vertical], [soft])
        looks = soft
    return looks


def _decide(frames: range, known: list[Array], before: np.ndarray, carried: list[Array], masks: Array) -> None:
    """Masks [t h w] of these frames from looks and true shapes, and from the mask of the frame before each."""
    size = masks.shape[1:]
    raw, clean = wp.empty(size, dtype=wp.uint8), wp.empty(size, dtype=wp.uint8)
    distance = wp.zeros((1, *size), dtype=float)
    for i, t in enumerate(frames):
        if t:
            wp.launch(kernels.measure_distance, distance.shape, [masks, t - 1], [distance])
        wp.launch(kernels.decide, size, [i, *known, int(before[i]) if t else -1, *carried, distance], [raw])
        wp.launch(kernels.take_median, size, [raw], [clean])
        wp.launch(kernels.drop_specks, size, [t, clean], [masks])

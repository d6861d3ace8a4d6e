"""The default tracker (xew.metrics.estimators.tracks) on a device: all points of all frames at once."""

import functools
from typing import Any

import numpy as np
import warp as wp

from xew.metrics.estimators import presence
from xew.metrics.estimators import tracks as reference
from xew.metrics.estimators.batched import mask_kernels, path_kernels
from xew.metrics.estimators.batched import track_kernels as kernels
from xew.metrics.estimators.batched.devices import download
from xew.metrics.estimators.batched.flow import Array, Search, build_pyramid, find_flow, is_large_enough
from xew.metrics.estimators.batched.masks import fixed_kernel
from xew.metrics.estimators.similarity import find_most_similar

SEARCH = Search(finest=2, stride=4, steps=16, refinements=5)
"""Settings of the flow from frame to frame, those of OpenCV's fast preset."""
LEVELS = 4
"""Most levels of the pyramid of Lucas-Kanade, the image itself among them."""
THREADS = 128
"""Threads that share the pixels round one point."""
SEARCHES_AT_ONCE = {"cpu": 64, "cuda": 4096}
"""Number of searches on the device at once; one takes 21 kB."""


_launch = functools.partial(wp.launch, block_dim=THREADS)  # as all launches of the module, else it is compiled twice


def _launch_blocks(kernel: Any, dim: list[int], inputs: list[Any], outputs: list[Any]) -> None:
    wp.launch_tiled(kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=THREADS)


class BatchedTracker:
    """`estimate_tracks` on a device (Warp's name, None for the default), which keeps two videos while they repeat."""

    pointwise = True
    compares_colors = True

    def __init__(self, device: str | None = None) -> None:
        self._device = wp.get_device(device)
        self._videos: _Videos | None = None

    def __call__(self, prediction: np.ndarray, target: np.ndarray, points: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Tracks float32 [t k 2] of points [t k 2] where `visible` [t k], in a prediction [t h w 3] of a target [t h w 3]."""
        points = np.nan_to_num(points).astype(np.float32)
        if points.shape[1] == 0:
            return points
        height, width = target.shape[1:3]
        if not is_large_enough((height, width), SEARCH) or height % 2 or width % 2:
            return reference.estimate_tracks(prediction, target, points, visible)
        with wp.ScopedDevice(self._device):
            videos = self._open(prediction, target)
            truth, proposal = _propose(videos, points, visible)
            sure = download(proposal)[..., 2].min(axis=-1) <= 1 - reference.SURE
            paths = _walk(videos, truth, proposal, points, visible & ~sure)
            place, origin, total = map(download, paths)
        return _follow_back(place, origin, total, visible)

    def _open(self, prediction: np.ndarray, target: np.ndarray) -> "_Videos":
        if self._videos is None or self._videos.target is not target:
            self._videos = _Videos(target)
        if self._videos.prediction is not prediction:
            self._videos.put_prediction(prediction, *find_most_similar(prediction, target))
        return self._videos

    def confirm(
        self,
        tracks: np.ndarray,
        prediction: np.ndarray,
        target: np.ndarray,
        points: np.ndarray,
        visible: np.ndarray,
        body_id: np.ndarray,
        body: np.ndarray,
    ) -> np.ndarray:
        """`presence.confirm_tracks` [t k 2], with the same arguments, of tracks [t k 2]."""
        videos = self._videos
        if videos is None or videos.target is not target or videos.prediction is not prediction or not tracks.size:
            return presence.confirm_tracks(tracks, prediction, target, points, visible, body_id, body)
        with wp.ScopedDevice(self._device):
            places = [wp.array(np.ascontiguousarray(array, np.float32), dtype=wp.vec2) for array in (tracks, points)]
            known = [wp.array(visible.astype(np.uint8)), videos.put_bodies(body_id), wp.array(body.astype(np.int32))]
            wrong = wp.empty(visible.shape, dtype=wp.uint8)
            _launch(kernels.confirm, wrong.shape, [videos.images.soft, *places, *known], [wrong])
        return np.where(download(wrong).astype(bool)[..., None], np.float32(np.nan), tracks)


class _Videos:
    """A true video on a device, with space for a predicted video."""

    def __init__(self, target: np.ndarray) -> None:
        self.target = target
        self.prediction: np.ndarray | None = None
        self._bodies: tuple[np.ndarray, Array] | None = None
        count, height, width = target.shape[:3]
        self._levels = [np.array([0, height, width])]
        while len(self._levels) < LEVELS and min((self._levels[-1][1:] + 1) // 2) > int(kernels.WINDOW):
            first = self._levels[-1][0] + self._levels[-1][1] * self._levels[-1][2]
            self._levels.append(np.array([first, *(self._levels[-1][1:] + 1) // 2]))
        size = int(self._levels[-1][0] + self._levels[-1][1] * self._levels[-1][2])
        self.images = kernels.Images()
        self.images.pyramid = wp.empty((2 * count, size), dtype=wp.uint8)
        self.images.slope = wp.empty((2 * count, size), dtype=int)
        self.images.level = wp.array(np.stack(self._levels).astype(np.int32), dtype=wp.vec3i)
        self.images.soft = wp.empty((2 * count, height, width, 3), dtype=wp.uint8)
        self.half = wp.empty((2 * count, height // 2, width // 2), dtype=int)
        self._blur = wp.array(fixed_kernel(reference.SOFTNESS), dtype=int)
        self.true_flow = self._put(target, slice(count, None))
        for first, *side in self._levels:
            inputs = [self.images.pyramid, wp.vec3i(first, *side)]
            _launch(kernels.take_slopes, (2 * count, *side), inputs, [self.images.slope])

    def put_prediction(self, prediction: np.ndarray, alike: np.ndarray, difference: np.ndarray) -> None:
        """Put the predicted video [t h w 3] uint8 on the device.

        Args:
            alike, difference: its `find_most_similar`.
        """
        self.alike, self.difference = alike, difference
        self.seen_flow = self._put(prediction, slice(0, len(prediction)))
        self.prediction = prediction

    def put_bodies(self, body_id: np.ndarray) -> Array:
        """[t h w] int16 on the device, the bodies that the true video's pixels show; put there once for the same array."""
        if self._bodies is None or self._bodies[0] is not body_id:
            self._bodies = body_id, wp.array(np.ascontiguousarray(body_id, np.int16), dtype=wp.int16)
        return self._bodies[1]

    def _put(self, video: np.ndarray, images: slice) -> Array:
        """Make a video [t h w 3] uint8 these images; [t-1 h w 2] float32, its optical flow from frame to frame."""
        frames = wp.array(np.ascontiguousarray(video), dtype=wp.uint8)
        count = len(frames)
        soft, half, pyramid = self.images.soft[images], self.half[images], self.images.pyramid[images]
        rows = wp.empty(frames.shape, dtype=wp.uint16)
        wp.launch(mask_kernels.blur_rows, frames.shape[:3], [frames, self._blur], [rows])
        wp.launch(mask_kernels.blur_columns, frames.shape[:3], [rows, self._blur], [soft])
        _launch(kernels.halve_colors, half.shape, [soft], [half])
        gray = wp.empty(frames.shape[:3], dtype=wp.uint8)
        wp.launch(mask_kernels.take_gray, gray.shape, [frames], [gray])
        # A kernel, since Warp's copy between strides fails where an earlier call of the thread has left an error behind.
        _launch(kernels.fill_first_level, gray.shape, [gray], [pyramid])
        for above, below in zip(self._levels, self._levels[1:], strict=False):
            inputs = [wp.vec3i(above), wp.vec3i(below)]
            _launch(kernels.shrink, (count, below[1], below[2]), inputs, [pyramid])
        first = np.arange(max(count - 1, 1))  # a single frame has no next one, and nobody asks
        return find_flow(build_pyramid(gray, SEARCH), np.stack([first, np.minimum(first + 1, count - 1)], axis=-1))


def _propose(videos: _Videos, points: np.ndarray, visible: np.ndarray) -> tuple[kernels.Truth, Array]:
    """Points [t k 2] without NaN on the device, and what flow proposes for them [t k 2 3]: x, y and cost."""
    frames, count = visible.shape
    truth = kernels.Truth()
    truth.point = wp.array(points, dtype=wp.vec2)
    truth.visible = wp.array(visible.astype(np.uint8))
    truth.alike = wp.array(videos.alike.astype(np.int32))
    proposal = wp.empty((frames, count, 2), dtype=wp.vec3)
    _launch_blocks(kernels.propose, [frames, count, 2], [videos.images, truth], [proposal])
    return truth, proposal


def _walk(
    videos: _Videos, truth: kernels.Truth, proposal: Array, points: np.ndarray, unsure: np.ndarray
) -> tuple[Array, Array, Array]:
    """Paths through all proposals, as `_follow_back` takes them; points [t k 2] are searched for where `unsure` [t k]."""
    frames, count = unsure.shape
    frame, index = np.nonzero(unsure)
    search = np.full(unsure.shape, -1, np.int32)
    search[frame, index] = np.arange(len(frame))
    peak = _search(videos, truth, frame, index, points)
    repeats = wp.array((videos.difference < reference.SAME_MOMENT).astype(np.uint8))
    states = int(kernels.PROPOSALS)
    place = wp.empty((frames, count, states), dtype=wp.vec2)
    origin = wp.empty((frames, count, states + 1), dtype=int)
    total = wp.empty((count, states + 1), dtype=wp.float64)
    known = [videos.images, truth, repeats, videos.seen_flow, videos.true_flow, proposal, wp.array(search), peak]
    _launch_blocks(path_kernels.walk, [count], known, [place, origin, total])
    return place, origin, total


def _follow_back(place: np.ndarray, origin: np.ndarray, total: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """[t k 2] float32, the cheapest path of each point where it is `visible` [t k]; NaN elsewhere and where it is lost.

    Args:
        place: [t k c 2] float32 pixels, all proposals.
        origin: [t k c+1] int, the state before on the cheapest path to each; the last state is to be lost.
        total: [k c+1], what the paths have cost.
    """
    points = np.arange(total.shape[0])
    states = np.concatenate([place, np.full_like(place[:, :, :1], np.nan)], axis=2)
    state = np.argmin(total, axis=1)
    track = np.full((*visible.shape, 2), np.nan, np.float32)
    for t in reversed(range(len(track))):
        track[t] = states[t, points, state]
        state = origin[t, points, state]
    return np.where(visible[..., None], track, np.nan).astype(np.float32)


def _search(videos: _Videos, truth: kernels.Truth, frame: np.ndarray, index: np.ndarray, points: np.ndarray) -> Array:
    """[q PEAKS 3] float32, x, y and cost of the best places for points [q] in frames [q]."""
    best = wp.zeros((max(len(frame), 1), reference.PEAKS), dtype=wp.vec3)
    step = SEARCHES_AT_ONCE["cuda" if best.device.is_cuda else "cpu"]
    side = 2 * int(kernels.REACH) + 1
    for first in range(0, len(frame), step):
        part = slice(first, min(first + step, len(frame)))
        at, which = (wp.array(array[part].astype(np.int32)) for array in (frame, index))
        point = wp.array(points[frame[part], index[part]], dtype=wp.vec2)
        like = wp.empty((len(at), side, side), dtype=float)
        _launch(kernels.match_patches, like.shape, [videos.half, at, point, len(points)], [like])
        peak, place = wp.empty(like.shape, dtype=wp.uint8), wp.empty((len(at), reference.PEAKS), dtype=wp.vec3)
        _launch(kernels.mark_peaks, like.shape, [like], [peak])
        _launch(kernels.take_peaks, len(at), [like, peak, point], [place])
        inputs = [videos.images, truth, at, which, place]
        _launch_blocks(kernels.improve_peaks, list(place.shape), inputs, [best[part]])
    return best

"""The default tracker: it finds the true video's points in a predicted video without any network's weights.

Each predicted frame is read with the help of true frames, in which every point is known, so nothing drifts: the frame
of the same time, and the one that looks most like it, which is another where a model lags, hurries or stands still.
    proposals   optical flow from both true frames, search for the patch of image round a point, and where the predicted
                video's own flow carries the point from the frame before
    similarity  how well the patch at a proposal agrees with the patch round the true point, as far as both are in the image;
                what stands at a far proposal in the true frame too is something else
    motion      how far a proposal lies from where the predicted video's flow carries the one before
The cheapest path through all frames wins (Viterbi). Where nothing looks like the point it is lost (NaN), not left where
the truth has it: a video that stands still is measured as standing still.
Its error on true video is published with every score: the row `ground_truth` of `evaluate`.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from xew.metrics.estimators.images import is_inside, sample, soften
from xew.metrics.estimators.similarity import find_most_similar

PATCH = 12
"""Half the side of the patch round a point [pixels]."""
PATCH_STEP = 2
"""Step [pixels] between the pixels of a patch that are compared."""
REACHES = np.arange(-PATCH, PATCH + 1, PATCH_STEP, dtype=np.float32)
OFFSETS = np.stack(np.meshgrid(REACHES, REACHES), axis=-1).reshape(1, -1, 2)
"""Places of these pixels from the point: [r] along one axis, and [1 r*r 2], x and y."""
SOFTNESS = 1.5
"""Standard deviation [pixels] of the blur of what is compared, so sharpness and grain do not count as motion."""
FLATNESS = 10.0
"""Variance [levels squared] added to those that differences are compared with, so flat patches are similar."""
SURE = 0.9
"""Similarity of a proposal from which on the point is not searched for."""
REACH = 64
"""Largest distance [pixels] from the true point at which it is searched for, in images of half the size."""
PEAKS = 4
SPACING = 3
"""Least distance between two of them [pixels of half the size]."""
REFINEMENT = 4.0
"""Largest distance by which optical flow may shift a proposal towards its best fit [pixels]."""
STRAYING = 2.0
"""Distance [pixels] from where the flow carries a point, at which half of JUMP is paid."""
JUMP = 0.5
"""Cost of a point's jump to anywhere, and of getting lost or found; a patch just like the true one costs 0, like nothing 1."""
STANDING = 0.3
"""Margin of similarity: a far place is no proposal if it is as similar, less this, to its own place in the true frame."""
LOST = 0.5
"""Cost of each frame in which a point is nowhere."""
INNER_MOTION = 8.0
"""Largest difference [pixels] between the motion of a link's origin, inside the link, and that of the surface before it."""
SAME_MOMENT = 4.0
"""Root mean square difference [levels] of thumbnails up to which two frames show the same moment, hidden points included."""
HIDDEN = 0.3
"""Cost of believing that a point which the most similar frame hides is where that frame has it."""
GIVEN_UP = 9.0
"""Cost of a proposal that there is not."""


@dataclass(frozen=True)
class _TrueFrame:
    """A true frame and its points."""

    soft: np.ndarray
    """[h w 3] uint8, softened."""
    gray: np.ndarray
    points: np.ndarray
    """[k 2] float32 [pixels]."""
    visible: np.ndarray
    """[k] bool."""


def estimate_tracks(prediction: np.ndarray, target: np.ndarray, points: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Where the true video's points are in a predicted video.

    Args:
        prediction, target: [t h w 3] uint8 RGB, predicted and true video of one episode, same frames.
        points: [t k 2] float32, true projections [pixels, x right, y down, the center of the first pixel at 0].
        visible: [t k] bool, where a true point is seen; elsewhere nothing is looked for.

    Returns:
        [t k 2] float32 [pixels], NaN where a point is lost or the truth does not show it. A point can be outside the image
        where the predicted frame shows a moment of the truth that has it there.
    """
    return ReferenceTracker()(prediction, target, points, visible)


class ReferenceTracker:
    """`estimate_tracks`, which keeps what it derives from two videos while the same arrays follow each other."""

    pointwise = True
    compares_colors = True

    def __init__(self) -> None:
        self._seen: _Video | None = None
        self._true: _Video | None = None
        self._similar: tuple[np.ndarray, np.ndarray] | None = None

    def __call__(self, prediction: np.ndarray, target: np.ndarray, points: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Tracks float32 [t k 2] of points [t k 2] where `visible` [t k], in a prediction [t h w 3] of a target [t h w 3]."""
        points = np.nan_to_num(points).astype(np.float32)
        if points.shape[1] == 0:
            return points
        if self._true is None or self._true.frames is not target:
            self._true, self._similar = _Video(target), None
        if self._seen is None or self._seen.frames is not prediction:
            self._seen, self._similar = _Video(prediction), None
        if self._similar is None:
            self._similar = find_most_similar(prediction, target)
        return _track(self._seen, self._true, self._similar, points, visible)


class _Video:
    """A video [t h w 3] uint8 and what the tracker makes of its frames, each when it is first asked for."""

    def __init__(self, frames: np.ndarray) -> None:
        self.frames = frames
        self.grays = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
        self._soft: dict[int, np.ndarray] = {}
        self._flow: dict[int, np.ndarray] = {}

    def soft(self, t: int) -> np.ndarray:
        """[h w 3] uint8, frame t softened."""
        if t not in self._soft:
            self._soft[t] = soften(self.frames[t], SOFTNESS)
        return self._soft[t]

    def follow(self, places: np.ndarray, t: int) -> np.ndarray:
        """Places [... 2] of frame t - 1, carried to frame t by dense optical flow."""
        if t not in self._flow:
            flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
            self._flow[t] = flow.calc(self.grays[t - 1], self.grays[t], None)
        return places + sample(self._flow[t], places.reshape(1, -1, 2)).reshape(places.shape)


def _track(
    seen: _Video, true: _Video, similar: tuple[np.ndarray, np.ndarray], points: np.ndarray, visible: np.ndarray
) -> np.ndarray:
    """`estimate_tracks` of points without NaN; `similar` is `find_most_similar` of the two videos."""
    alike, difference = similar
    truth = [
        _TrueFrame(true.soft(t), gray, *own) for t, (gray, *own) in enumerate(zip(true.grays, points, visible, strict=True))
    ]
    paths = _Paths()
    carried = np.repeat(points[0][:, None], 3 + PEAKS, axis=1)
    inner = np.zeros_like(points[0])
    for t, gray in enumerate(seen.grays):
        if t:
            carried = seen.follow(paths.places[-1], t)
            inner = _inner_motion(truth[t - 1], truth[t], true.follow(points[t - 1], t))
        same, other = truth[t], truth[alike[t]] if alike[t] != t else None
        place, cost = _propose(seen.soft(t), gray, same, other, paths.cheapest(carried))
        if other is not None and difference[t] < SAME_MOMENT:
            hidden = ~other.visible
            place[hidden, 1], cost[hidden, 1] = other.points[hidden], HIDDEN
        now = visible[t]
        place[~now], cost[~now] = carried[~now], 0
        known_before = now & visible[max(t - 1, 0)]
        step = np.where(known_before | ~now, JUMP, 0)[:, None, None] * _straying(place, carried, inner)
        paths.add(place, cost, step, lost=np.where(now, LOST, 0))
    return np.where(visible[..., None], paths.best(), np.nan).astype(np.float32)


def _propose(
    frame: np.ndarray, gray: np.ndarray, same: _TrueFrame, other: _TrueFrame | None, carried: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Proposed places [k 3 + PEAKS 2] of the points of a frame, and their costs [k 3 + PEAKS].

    The first three come from flow from both true frames and from the frame before.
    """
    place = np.full((len(same.points), 3 + PEAKS, 2), np.nan, np.float32)
    cost = np.full(place.shape[:2], GIVEN_UP)
    sources = [same] if other is None else [same, other]
    for column, source in enumerate(sources):
        place[source.visible, column] = _flow_points(source, gray)[source.visible]
    place[:, 2] = carried
    for source in sources:
        _improve(place, cost, slice(0, 3), frame, gray, source)
    unsure = same.visible & (np.min(cost, axis=1) > 1 - SURE)
    if unsure.any():
        place[unsure, 3:] = _search(frame, same.soft, same.points[unsure])
        for source in sources:
            _improve(place, cost, slice(3, None), frame, gray, source)
    return np.where(np.isfinite(place), place, 0), cost


def _improve(
    place: np.ndarray, cost: np.ndarray, columns: slice, frame: np.ndarray, gray: np.ndarray, source: _TrueFrame
) -> None:
    """Shift proposals to their best fit to a true frame, and take over what fits better than before."""
    proposed = np.isfinite(place[:, columns]).all(-1) & source.visible[:, None]
    point, column = np.nonzero(proposed)
    if not len(point):
        return
    column = column + (columns.start or 0)
    start = place[point, column]
    fitted = _flow_points(source, gray, point, start)
    near = np.linalg.norm(fitted - start, axis=-1) < REFINEMENT
    fitted = np.where(near[:, None], fitted, start)
    like = likeness(frame, fitted, source.soft, source.points[point])
    possible = is_inside(fitted, frame) & ~_is_in_true_frame(frame, fitted, source.soft, source.points[point], like)
    price = np.where(possible, np.clip(1 - like, 0, 1), GIVEN_UP)
    better = price < cost[point, column]
    place[point[better], column[better]] = fitted[better]
    cost[point[better], column[better]] = price[better]


def _is_in_true_frame(
    frame: np.ndarray, places: np.ndarray, true_frame: np.ndarray, points: np.ndarray, like: np.ndarray
) -> np.ndarray:
    """[n] is what a frame shows far from the true point there in the true frame too? Then it is no point that came there."""
    stands = np.linalg.norm(places - points, axis=-1) > PATCH
    if stands.any():
        stands[stands] = likeness(frame, places[stands], true_frame, places[stands]) > like[stands] - STANDING
    return stands


def likeness(image: np.ndarray, places: np.ndarray, true_image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[n] similarity of the patches around places [n 2] of one image and points [n 2] of another: 1 equal, 0 unrelated.

    One minus the mean squared difference over the sum of both variances, over pixels inside both images.
    """
    patch, true_patch = _patches(image, places), _patches(true_image, points)
    shared = _patch_inside(places, image) & _patch_inside(points, true_image)
    weight = shared / np.maximum(shared.sum(axis=1, keepdims=True), 1).astype(np.float32)

    def mean(values: np.ndarray) -> np.ndarray:
        """[n 3] of values [n p 3], of what is compared."""
        return np.einsum("np,npc->nc", weight, values)

    variance = sum(np.mean(mean(np.square(values)) - np.square(mean(values)), axis=-1) for values in (patch, true_patch))
    return 1 - np.mean(mean(np.square(patch - true_patch)), axis=-1) / (np.maximum(variance, 0) + FLATNESS)


def _patches(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[n p 3] float32 colors round points [n 2], read between the pixels."""
    return sample(image, points[:, None] + OFFSETS).astype(np.float32)


def _patch_inside(points: np.ndarray, image: np.ndarray) -> np.ndarray:
    """[n p] is each place of the patches round points [n 2] in a pixel of the image?"""
    inside = [
        (points[:, axis, None] + REACHES > -0.5) & (points[:, axis, None] + REACHES < size - 0.5)
        for axis, size in enumerate((image.shape[1], image.shape[0]))
    ]
    return (inside[1][:, :, None] & inside[0][:, None, :]).reshape(len(points), -1)


def _flow_points(
    source: _TrueFrame, gray: np.ndarray, index: np.ndarray | None = None, start: np.ndarray | None = None
) -> np.ndarray:
    """Where Lucas-Kanade flow takes a true frame's points, or those of an index [n] from a first guess [n 2]."""
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)
    points = source.points if index is None else source.points[index]
    if start is None:
        places, _, _ = cv2.calcOpticalFlowPyrLK(
            source.gray, gray, points[:, None], None, winSize=(15, 15), maxLevel=3, criteria=criteria
        )
    else:
        places, _, _ = cv2.calcOpticalFlowPyrLK(
            source.gray,
            gray,
            points[:, None],
            start[:, None].copy(),
            winSize=(15, 15),
            maxLevel=1,
            criteria=criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
    return places[:, 0]


def _search(frame: np.ndarray, true_frame: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[n PEAKS 2] the places within REACH that look most like the true frame's points [n 2]; NaN where there are fewer."""
    half, reach = PATCH // 2, REACH // 2
    margin = half + reach
    small, true_small = (_halve(image, margin) for image in (frame, true_frame))
    variance = _local_variance(small, 2 * half + 1)
    best = np.full((len(points), PEAKS, 2), np.nan, np.float32)
    for i, point in enumerate(points):
        x, y = np.round((point - 0.5) / 2).astype(int)  # the center of small pixel i is at 2 i + 0.5
        patch = true_small[y + reach : y + reach + 2 * half + 1, x + reach : x + reach + 2 * half + 1]
        window = small[y : y + 2 * margin + 1, x : x + 2 * margin + 1]
        if patch.shape[:2] != (2 * half + 1, 2 * half + 1) or window.shape[:2] != (2 * margin + 1, 2 * margin + 1):
            continue  # a point outside the image
        difference = cv2.matchTemplate(window, patch, cv2.TM_SQDIFF) / patch.size
        spread = (
            patch.reshape(-1, 3).var(axis=0).mean()
            + variance[y + half : y + margin + reach + 1, x + half : x + margin + reach + 1]
        )
        peaks = _peaks(1 - difference / (spread + FLATNESS))
        best[i, : len(peaks)] = point + 2 * (peaks - reach)
    return best


def _peaks(likeness: np.ndarray) -> np.ndarray:
    """[n 2] x and y of the highest local maxima, best first."""
    side = 2 * SPACING + 1
    y, x = np.nonzero(likeness >= cv2.dilate(likeness, np.ones((side, side), np.uint8)))
    order = np.argsort(-likeness[y, x], kind="stable")[:PEAKS]
    return np.stack([x[order], y[order]], axis=-1)


def _halve(image: np.ndarray, margin: int) -> np.ndarray:
    small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return cv2.copyMakeBorder(small, margin, margin, margin, margin, cv2.BORDER_REPLICATE)


def _local_variance(image: np.ndarray, side: int) -> np.ndarray:
    """[h w] variance of the square round each pixel, mean over the channels."""
    values = image.astype(np.float32)
    mean, square = (cv2.blur(v, (side, side)) for v in (values, values * values))
    return np.maximum(square - mean * mean, 0).mean(axis=-1)


def _inner_motion(before: _TrueFrame, after: _TrueFrame, carried: np.ndarray) -> np.ndarray:
    """[k 2] how each true point moves otherwise than flow, which carried it from before to here [k 2]; 0 where that is unknown
    or too much to be believed."""
    inner = after.points - carried
    sane = before.visible & after.visible & (np.linalg.norm(inner, axis=-1) < INNER_MOTION)
    return np.where(sane[:, None], inner, 0)


def _straying(place: np.ndarray, carried: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """[k c c] 0 to 1: how far each place (last) is from where each one before (first) was carried, with or without `inner`."""
    offset = place[:, None] - carried[:, :, None]
    square = np.minimum(np.sum(offset**2, axis=-1), np.sum((offset - inner[:, None, None]) ** 2, axis=-1))
    return square / (square + STRAYING**2)


class _Paths:
    """The cheapest path to each proposal, frame by frame (Viterbi). The last state of a point is to be lost."""

    def __init__(self) -> None:
        self.places: list[np.ndarray] = []
        self._total = np.zeros((0, 0))
        self._origins: list[np.ndarray] = []

    def cheapest(self, carried: np.ndarray) -> np.ndarray:
        """[k 2] of places carried on [k c 2], those whose path has cost least."""
        if not self.places:
            return carried[:, 0]
        return carried[np.arange(len(carried)), np.argmin(self._total[:, :-1], axis=1)]

    def add(self, place: np.ndarray, cost: np.ndarray, step: np.ndarray, lost: np.ndarray) -> None:
        """One frame more: proposals [k c 2], costs [k c], costs of getting there [k c c], cost of being lost [k]."""
        states = np.concatenate([cost, lost[:, None]], axis=1)
        if self.places:
            steps = np.full((*states.shape, states.shape[1]), JUMP)
            steps[:, :-1, :-1] = step
            steps[:, -1, -1] = 0
            sums = self._total[:, :, None] + steps
            origin = np.argmin(sums, axis=1)
            states = states + np.take_along_axis(sums, origin[:, None], axis=1)[:, 0]
            self._origins.append(origin)
        self._total = states
        self.places.append(place)

    def best(self) -> np.ndarray:
        """[t k 2] the cheapest path of each point; NaN where it is lost."""
        state = np.argmin(self._total, axis=1)
        points = np.arange(len(state))
        path = []
        for place, origin in zip(reversed(self.places), [*reversed(self._origins), None], strict=True):
            path.append(np.concatenate([place, np.full_like(place[:, :1], np.nan)], axis=1)[points, state])
            state = origin[points, state] if origin is not None else state
        return np.stack(path[::-1])

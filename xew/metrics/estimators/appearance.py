"""Appearance: a predicted and a true video in the same colors, so estimators judge where bodies are and not how they look.

Two differences are taken out, each only where it is plain:
    exposure   gain and offset of each predicted frame's channels, from the scene that stands still
    color      an affine map of colors for the robot and each object, from frames of the whole video where the predicted body is
               where the truth has it, else from the first that show it

The true colors remain where the predicted ones are no such map of them, or where the predicted body does not stand out from its
surroundings as the true one does: a body that is not there has no appearance.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from xew.metrics.estimators.images import soften

THUMBNAIL = (80, 60)
"""Width and height [pixels] of the frames whose exposure is compared."""
GAINS = (0.5, 2.0)
"""Least and largest gain of an exposure."""
VISIBLE = 2.0
"""Mean difference [levels] up to which an exposure is left as it is."""
INLIER = 12.0
"""Largest difference [levels] of a pixel that shows the same after the exposure."""
AGREEMENT = 0.5
"""Largest share of a difference that is left where a map explains it."""
FEWEST = 40
"""Least number of pixels that a map is fitted to."""
FIRST_FRAMES = (0, 1, 2, 3, 5, 7)
"""Frames that a body's colors are compared in, counted from the first that shows it; frame 0 is given and not compared."""
SPREAD_FRAMES = 8
"""Number of frames of the whole video that are tried first."""
TEXTURE, UNEXPLAINED = 5.0, 0.2
"""Least spread [levels] of the predicted colors of a body, and share of its variance that a map leaves, by which the body is
known to be there whatever its surroundings."""
SHOWN = 60
"""Least number of pixels of a body that a frame shows."""
OTHER_COLORS = 2.5
"""Least root mean square difference [levels] of a body whose colors are mapped."""
SOFTNESS = 1.0
"""Standard deviation [pixels] of the blur of frames whose colors are compared."""
PRIOR = 4.0
"""Weight [levels squared] of the true colors in a fit, for colors that a body does not have."""
STANDS_OUT = 0.35
"""Least share of a body's true contrast with its surroundings that the predicted body has."""
SURROUNDINGS = 7
"""Side [pixels] of the squares round the contour in which a body is compared with its surroundings."""
REST = -1
"""Label of the scene that stands still."""


class TrueAppearance:
    """The appearance of a true video, of which all its predictions share what they are compared with.

    Args:
        target: [t h w 3] uint8 RGB.
        labels: [t h w] int, the body that a pixel of the target shows, REST for the scene.
    """

    def __init__(self, target: np.ndarray, labels: np.ndarray) -> None:
        self.target, self._labels = target, labels
        self._rest: dict[int, _Rest] = {}
        self._looks: dict[tuple[int, bool], _Looks] = {}

    def match(self, prediction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A prediction [t h w 3] uint8 with the true exposure, and the true video with the predicted colors of its bodies.

        Both are the arrays themselves where nothing differs.
        """
        prediction = self.even_exposure(prediction)
        return prediction, self.take_colors(prediction)

    def even_exposure(self, prediction: np.ndarray) -> np.ndarray:
        """A prediction [t h w 3] uint8 in the true exposure, by the pixels that stand still."""
        tables = [self._find_exposure(t, frame) for t, frame in enumerate(prediction)]
        if all(table is None for table in tables):
            return prediction
        pairs = zip(prediction, tables, strict=True)
        return np.stack([frame if table is None else cv2.LUT(frame, table) for frame, table in pairs])

    def take_colors(self, prediction: np.ndarray) -> np.ndarray:
        """The true video [t h w 3] uint8, whose bodies have the colors of a prediction."""
        mapped = self.target
        for body, color_map in self._find_color_maps(prediction):
            if mapped is self.target:
                mapped = self.target.copy()
            own = self._labels == body
            mapped[own] = np.clip(np.rint(_with_one(self.target[own]) @ color_map), 0, 255).astype(np.uint8)
        return mapped

    def _find_exposure(self, t: int, frame: np.ndarray) -> np.ndarray | None:
        """Levels [1 256 3] uint8 of the true exposure for those of frame t [h w 3]; None as of `_Rest.find_exposure`."""
        if np.array_equal(frame, self.target[t]):
            return None
        if t not in self._rest:
            self._rest[t] = _Rest.of(self.target[t], self._labels[t] == REST)
        return self._rest[t].find_exposure(frame)

    def _find_color_maps(self, prediction: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Bodies that have other colors in a prediction, each with the map [4 3] from their true colors and one."""
        softened: dict[int, np.ndarray] = {}
        for body in range(self._counts.shape[1]):
            for spread in (True, False):
                color_map = self._find_looks(body, spread).find_map(prediction, softened)
                if color_map is not None:
                    yield body, color_map
                    break

    def _find_looks(self, body: int, spread: bool) -> "_Looks":
        if (body, spread) not in self._looks:
            frames = self._choose_frames(body, spread)
            self._looks[body, spread] = _Looks(self.target[frames], self._labels[frames] == body, frames)
        return self._looks[body, spread]

    def _choose_frames(self, body: int, spread: bool) -> np.ndarray:
        """Frames that a body's colors are compared in: of the whole video if `spread`, else the first that show it."""
        shows = np.flatnonzero(self._counts[1:, body] >= SHOWN) + 1
        if not spread:
            return shows[[i for i in FIRST_FRAMES if i < len(shows)]]
        return shows[np.unique(np.linspace(0, max(len(shows) - 1, 0), min(SPREAD_FRAMES, len(shows))).round().astype(int))]

    @cached_property
    def _counts(self) -> np.ndarray:
        """[t bodies] int, number of pixels that show each body."""
        bodies = range(self._labels.max(initial=REST) + 1)
        return np.array([[np.count_nonzero(frame == body) for body in bodies] for frame in self._labels])


def _shrink(image: np.ndarray) -> np.ndarray:
    return cv2.resize(image, THUMBNAIL, interpolation=cv2.INTER_AREA)


@dataclass(frozen=True)
class _Rest:
    """The scene that stands still in a frame's thumbnail."""

    kept: np.ndarray
    """[60 80] bool, its pixels."""
    colors: np.ndarray
    """[3 n] float32."""
    spread: np.ndarray
    middle: np.ndarray
    """[3], `_describe` of the colors."""

    @classmethod
    def of(cls, frame: np.ndarray, still: np.ndarray) -> "_Rest":
        """That of a frame [h w 3] uint8, by the pixels that stand still [h w] bool."""
        kept = _shrink(still.astype(np.uint8)) > 0
        levels = _shrink(frame)[kept].T
        return cls(kept, levels.astype(np.float32), *_describe(levels))

    def find_exposure(self, frame: np.ndarray) -> np.ndarray | None:
        """Levels [1 256 3] uint8 of this exposure for those of a frame [h w 3]; None where it is the same, or no exposure."""
        levels = _shrink(frame)[self.kept].T
        if levels.shape[1] < FEWEST:
            return None
        x, y = levels.astype(np.float32), self.colors
        inlier = self._find_inliers(x, *_describe(levels))
        if inlier.mean() < AGREEMENT:
            return None
        x, y = (np.ascontiguousarray(values[:, inlier].T) for values in (x, y))
        before = np.abs(x - y).mean()
        if before < VISIBLE:
            return None
        gain = _fit_gain(x, y)
        if np.abs(gain * (x - x.mean(axis=0)) + y.mean(axis=0) - y).mean() > AGREEMENT * before:
            return None
        table = gain * (np.arange(256)[:, None] - x.mean(axis=0)) + y.mean(axis=0)
        return np.clip(np.rint(table), 0, 255).astype(np.uint8)[None]

    def _find_inliers(self, x: np.ndarray, spread: np.ndarray, middle: np.ndarray) -> np.ndarray:
        """[n] bool, which colors [3 n] the exposure explains that maps the middle and the spread of all."""
        gain = np.clip(self.spread / np.maximum(spread, 1), *GAINS)
        evened = gain[:, None] * x + self.middle[:, None] - (gain * middle)[:, None]
        return np.all(np.abs(evened - self.colors) < INLIER, axis=0)


def _describe(levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of the percentiles 10 and 90 of levels [c n] uint8, and their median, both [c], as `np.percentile` has them."""
    ordered = np.sort(levels, axis=1, kind="stable").astype(np.float32)  # counts levels, which takes a tenth of the time
    low, middle, high = (_interpolate(ordered, share) for share in (0.1, 0.5, 0.9))
    return high - low, middle.astype(np.float32)


def _interpolate(ordered: np.ndarray, share: float) -> np.ndarray:
    """Quantile [c] of sorted numbers [c n]; 0 of none."""
    if not ordered.shape[1]:
        return np.zeros(len(ordered))
    place = np.float64(share) * (ordered.shape[1] - 1)
    before = int(place)
    below, above = ordered[:, before], ordered[:, min(before + 1, ordered.shape[1] - 1)]
    part = place - before
    return above - (above - below) * (1 - part) if part >= 0.5 else below + (above - below) * part


def _fit_gain(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Gains [3] by least squares that take colors [n 3] to others, both about their means."""
    centered = x - x.mean(axis=0)
    return np.clip((centered * y).sum(axis=0) / np.maximum((centered**2).sum(axis=0), 1), *GAINS)


class _Looks:
    """The true colors of a body in some frames.

    Args:
        target: [n h w 3] uint8, these frames of the true video.
        own: [n h w] bool, the body.
        frames: [n] int, their numbers.
    """

    def __init__(self, target: np.ndarray, own: np.ndarray, frames: np.ndarray) -> None:
        self._target, self._own, self._frames = target, own, frames
        if not len(frames):
            return
        self._inner = np.stack([cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) for mask in own]) > 0
        self._soft = np.stack([soften(frame, SOFTNESS) for frame in target])
        self._colors = self._soft[self._inner]

    def find_map(self, prediction: np.ndarray, softened: dict[int, np.ndarray]) -> np.ndarray | None:
        """The map [4 3] to the body's colors in a prediction [t h w 3]; None where there is none, or no body.

        `softened` collects frames of the prediction by their number.
        """
        if np.array_equal(prediction[self._frames], self._target):
            return None
        for t in self._frames.tolist():
            if t not in softened:
                softened[t] = soften(prediction[t], SOFTNESS)
        seen = np.stack([softened[t] for t in self._frames.tolist()])
        colors = seen[self._inner]
        color_map = _fit_colors(self._colors, colors)
        if color_map is None:
            return None
        spread = np.std(colors.astype(np.float64), axis=0)
        left = _with_one(self._colors) @ color_map - colors
        is_textured = np.mean(spread**2) > TEXTURE**2 and np.mean(left**2) < UNEXPLAINED * np.mean(spread**2)
        return color_map if is_textured or _contrast(seen, self._own) > STANDS_OUT * self._true_contrast else None

    @cached_property
    def _true_contrast(self) -> float:
        return _contrast(self._soft, self._own)


def _fit_colors(true: np.ndarray, seen: np.ndarray) -> np.ndarray | None:
    """The affine map [4 3] from true colors [n 3] and one to seen ones; None where they are alike, or no map explains them."""
    if len(true) < FEWEST:
        return None
    x, y = _with_one(true), seen.astype(np.float64)
    before = np.sqrt(np.mean((x[:, :3] - y) ** 2))
    if before <= OTHER_COLORS:
        return None
    weight = len(x) * PRIOR * np.diag([1.0, 1, 1, 0])
    color_map = np.linalg.solve(x.T @ x + weight, x.T @ y + weight @ np.eye(4, 3))
    after = np.sqrt(np.mean((x @ color_map - y) ** 2))
    return color_map if after < AGREEMENT * before else None


def _with_one(colors: np.ndarray) -> np.ndarray:
    """Colors [n 3] with a one behind each: [n 4] float64."""
    return np.concatenate([colors.astype(np.float64), np.ones((len(colors), 1))], axis=1)


def _contrast(video: np.ndarray, own: np.ndarray) -> float:
    """Mean difference [levels] of a body [n h w] bool from its surroundings in a video [n h w 3], along its contour."""
    total, count = 0.0, 0
    for frame, mask in zip(video, own, strict=True):
        weight = mask.astype(np.float32)
        share = cv2.blur(weight, (SURROUNDINGS, SURROUNDINGS))
        inside = cv2.blur(frame * weight[..., None], (SURROUNDINGS, SURROUNDINGS))
        whole = cv2.blur(frame.astype(np.float32), (SURROUNDINGS, SURROUNDINGS))
        contour = (share > 0.3) & (share < 0.7)
        part = share[contour][:, None]
        difference = inside[contour] / part - (whole[contour] - inside[contour]) / (1 - part)
        total, count = total + float(np.abs(difference).max(axis=1).sum()), count + int(contour.sum())
    return total / max(count, 1)

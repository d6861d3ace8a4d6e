"""Appearance: a predicted and a true video in the same colors, so estimators judge where bodies are and not how they look.

Two differences are taken out, each only where it is plain:
    exposure   gain and offset of each predicted frame's channels, from the scene that stands still
    color      an affine map of colors for the robot and each object, from frames of the whole video where the predicted body is
               where the truth has it, else from the first that show it

The true colors remain where the predicted ones are no such map of them, or where the predicted body does not stand out from its
surroundings as the true one does: a body that is not there has no appearance.
"""

from collections.abc import Iterator

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


def match_appearance(prediction: np.ndarray, target: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A predicted video with the true exposure, and the true video with the predicted colors of its bodies.

    Args:
        prediction, target: [t h w 3] uint8 RGB, predicted and true video of one episode, same frames.
        labels: [t h w] int, the body that a pixel of the target shows, REST for the scene.

    Returns:
        Both [t h w 3] uint8; the arrays themselves where nothing differs.
    """
    prediction = even_exposure(prediction, target, labels == REST)
    return prediction, take_colors(target, prediction, labels)


def even_exposure(prediction: np.ndarray, target: np.ndarray, still: np.ndarray) -> np.ndarray:
    """A prediction [t h w 3] uint8 in the exposure of a target [t h w 3] uint8, by the pixels that stand still [t h w] bool."""
    tables = [_find_exposure(*frames) for frames in zip(prediction, target, still, strict=True)]
    if all(table is None for table in tables):
        return prediction
    pairs = zip(prediction, tables, strict=True)
    return np.stack([frame if table is None else cv2.LUT(frame, table) for frame, table in pairs])


def _find_exposure(frame: np.ndarray, true_frame: np.ndarray, still: np.ndarray) -> np.ndarray | None:
    """Levels [1 256 3] uint8 of the true exposure for those of a frame [h w 3]; None where it is the same, or no exposure."""
    if np.array_equal(frame, true_frame):
        return None
    seen, true, kept = (_shrink(image) for image in (frame, true_frame, still.astype(np.uint8)))
    x, y = (image[kept > 0].astype(np.float32) for image in (seen, true))
    if len(x) < FEWEST:
        return None
    inlier = _find_inliers(x, y)
    if inlier.mean() < AGREEMENT:
        return None
    x, y = x[inlier], y[inlier]
    gain = _fit_gain(x, y)
    before, after = (np.abs(some - y).mean() for some in (x, gain * (x - x.mean(axis=0)) + y.mean(axis=0)))
    if before < VISIBLE or after > AGREEMENT * before:
        return None
    levels = gain * (np.arange(256)[:, None] - x.mean(axis=0)) + y.mean(axis=0)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)[None]


def _shrink(image: np.ndarray) -> np.ndarray:
    return cv2.resize(image, THUMBNAIL, interpolation=cv2.INTER_AREA)


def _find_inliers(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[n] bool, which colors [n 3] the exposure explains that maps the middle and the spread of all."""
    spread_x, spread_y = (np.diff(np.percentile(values, (10, 90), axis=0), axis=0)[0] for values in (x, y))
    gain = np.clip(spread_y / np.maximum(spread_x, 1), *GAINS)
    evened = gain * x + np.median(y, axis=0) - gain * np.median(x, axis=0)
    return np.abs(evened - y).max(axis=1) < INLIER


def _fit_gain(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Gains [3] by least squares that take colors [n 3] to others, both about their means."""
    centered = x - x.mean(axis=0)
    return np.clip((centered * y).sum(axis=0) / np.maximum((centered**2).sum(axis=0), 1), *GAINS)


def take_colors(target: np.ndarray, prediction: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """A target [t h w 3] uint8 whose bodies, by labels [t h w], have the colors of the first frames of a prediction."""
    mapped = target
    for body, color_map in _find_color_maps(target, prediction, labels):
        if mapped is target:
            mapped = target.copy()
        own = labels == body
        mapped[own] = np.clip(np.rint(_with_one(target[own]) @ color_map), 0, 255).astype(np.uint8)
    return mapped


def _find_color_maps(target: np.ndarray, prediction: np.ndarray, labels: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Bodies that have other colors in the first frames, each with the map [4 3] from their true colors and one."""
    for body in range(labels.max(initial=REST) + 1):
        shows = np.flatnonzero(np.count_nonzero(labels[1:] == body, axis=(1, 2)) >= SHOWN) + 1
        spread = np.unique(np.linspace(0, max(len(shows) - 1, 0), min(SPREAD_FRAMES, len(shows))).round().astype(int))
        for chosen in (spread, [i for i in FIRST_FRAMES if i < len(shows)]):
            frames = shows[chosen]
            color_map = _find_color_map(target[frames], prediction[frames], labels[frames] == body)
            if color_map is not None:
                yield body, color_map
                break


def _find_color_map(target: np.ndarray, prediction: np.ndarray, own: np.ndarray) -> np.ndarray | None:
    """The map [4 3] of a body's colors in frames [n h w 3], by its masks [n h w]; None where there is none, or no body."""
    if np.array_equal(prediction, target):
        return None
    inner = np.stack([cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) for mask in own]) > 0
    true, seen = (np.stack([soften(frame, SOFTNESS) for frame in video]) for video in (target, prediction))
    color_map = _fit_colors(true[inner], seen[inner])
    if color_map is None:
        return None
    spread = np.std(seen[inner].astype(np.float64), axis=0)
    left = _with_one(true[inner]) @ color_map - seen[inner]
    is_textured = np.mean(spread**2) > TEXTURE**2 and np.mean(left**2) < UNEXPLAINED * np.mean(spread**2)
    return color_map if is_textured or _contrast(seen, own) > STANDS_OUT * _contrast(true, own) else None


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

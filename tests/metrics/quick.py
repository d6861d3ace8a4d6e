"""Estimators for tests that need masks and tracks of predictions and not good ones: milliseconds an episode.

Reached from outside the registries, as a user's own would be: QUICK and QUICK_TRACKS name them.
"""

import numpy as np

from xew.metrics.backends import Backend
from xew.metrics.perceptual import SharedFeatures

QUICK = "tests.metrics.quick:MASKER"
QUICK_TRACKS = "tests.metrics.quick:TRACKER"
LARGEST_CHANGE = 24
"""Largest change of a channel at which a pixel still shows what the true one shows."""


def masks_of_unchanged(prediction: np.ndarray, target: np.ndarray, target_mask: np.ndarray) -> np.ndarray:
    """The true mask [t h w] where a prediction [t h w 3] shows what the target [t h w 3] does."""
    change = np.abs(prediction.astype(np.int16) - target).max(axis=-1)
    return target_mask & (change <= LARGEST_CHANGE)


MASKER = Backend(lambda: masks_of_unchanged, None, "the true mask where the pixels are unchanged")


def points_moved_by_change(prediction: np.ndarray, target: np.ndarray, points: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """The true points [t k 2] [pixels], moved right by a tenth of a pixel for each level that a prediction [t h w 3] is off."""
    height, width = target.shape[1:3]
    x, y = (np.clip(np.rint(points[..., i]), 0, side - 1).astype(int) for i, side in enumerate((width, height)))
    frames = np.arange(len(target))[:, None]
    change = np.abs(prediction[frames, y, x].astype(np.float32) - target[frames, y, x]).mean(axis=-1)
    return np.stack([points[..., 0] + 0.1 * change, points[..., 1]], axis=-1).astype(np.float32)


TRACKER = Backend(lambda: points_moved_by_change, None, "the true points, moved where the pixels changed")


def mean_change(
    shared: SharedFeatures,
    prediction: np.ndarray,
    target: np.ndarray,
    robot: np.ndarray | None = None,
    box: object = None,
    blocks: object = None,
) -> tuple[np.ndarray, np.ndarray | None]:
    """For `SharedFeatures.distances`: mean change of a frame's levels, and of the robot's, both [t] float32 in [0, 1]."""
    change = np.abs(prediction.astype(np.float32) - target).mean(axis=-1) / 255
    if robot is None:
        return change.mean(axis=(1, 2)), None
    return change.mean(axis=(1, 2)), np.ma.mean(np.ma.array(change, mask=~robot), axis=(1, 2)).filled(np.nan)

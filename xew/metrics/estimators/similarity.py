"""Similarity of frames: the moment of the true video that a predicted frame shows."""

import threading
import weakref

import cv2
import numpy as np

THUMBNAIL = (40, 30)
"""Width and height to which frames are shrunk to be compared [pixels]."""
CLEARLY = 0.9
"""Factor of the squared difference that another moment must stay under to be preferred to the same one."""
ROUNDING = 0.01
"""Difference [levels squared] that frames which are the same may seem to have: they stay with their own time."""


def find_most_similar(prediction: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The most similar true frame of each predicted frame.

    The frame of the same time is preferred unless another is clearly more similar.

    Args:
        prediction, target: [t h w 3] uint8, predicted and true video of one episode.

    Returns:
        [t] index of the true frame, and [t] root mean square difference of both thumbnails, in levels.
    """
    known = getattr(_last, "pair", None)
    if known is not None and known[0]() is prediction and known[1]() is target:
        return known[2]
    found = _find_most_similar(prediction, target)
    _last.pair = weakref.ref(prediction), weakref.ref(target), found
    return found


def _find_most_similar(prediction: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    predicted, true = (_thumbnails(video) for video in (prediction, target))
    square = np.sum(predicted**2, axis=1)[:, None] + np.sum(true**2, axis=1) - 2 * predicted @ true.T
    square = np.maximum(square / predicted.shape[1], 0)
    rows = np.arange(len(square))
    nearest = np.argmin(square, axis=1)
    chosen = np.where(square[rows, nearest] < CLEARLY * square[rows, rows] - ROUNDING, nearest, rows)
    return chosen, np.sqrt(square[rows, chosen])


_last = threading.local()
"""The last answer of each thread, and thumbnails of its last two videos: masks and tracks ask for the same ones, of one truth
again and again."""


def _thumbnails(video: np.ndarray) -> np.ndarray:
    """[t n] float64."""
    known = getattr(_last, "videos", ())
    small = next((thumbnails for of, thumbnails in known if of() is video), None)
    if small is None:
        frames = [cv2.resize(frame, THUMBNAIL, interpolation=cv2.INTER_AREA) for frame in video]
        small = np.stack(frames).reshape(len(video), -1).astype(np.float64)
    others = [one for one in known if one[0]() is not video]
    _last.videos = (*others[-1:], (weakref.ref(video), small))
    return small

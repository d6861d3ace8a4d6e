"""Conversion between the camera's and the model's frames: pad to the aspect ratio by repeating edges, then resize.

For example, 320x240 becomes 320x256 by eight rows above and below, and then 160x128 by resizing.
"""

from typing import NamedTuple

import cv2
import numpy as np

from xew.episode import HEIGHT, WIDTH

TEMPORAL_FACTOR = 4
"""Number of frames of video in a latent frame; the first latent frame holds one."""


class Padding(NamedTuple):
    """Numbers of rows and columns added before resizing [pixels of the camera]."""

    top: int
    bottom: int
    left: int
    right: int


def padding_to(height: int, width: int) -> Padding:
    """Padding of a camera frame to the aspect ratio of height x width."""
    rows = max(0, round(WIDTH * height / width) - HEIGHT)
    columns = max(0, round(HEIGHT * width / height) - WIDTH)
    return Padding(rows // 2, rows - rows // 2, columns // 2, columns - columns // 2)


def to_model_size(video: np.ndarray, height: int, width: int) -> np.ndarray:
    """Camera frames uint8 [t 240 320 3] -> [t height width 3]."""
    top, bottom, left, right = padding_to(height, width)
    padded = np.pad(video, ((0, 0), (top, bottom), (left, right), (0, 0)), mode="edge")
    if padded.shape[1:3] == (height, width):
        return padded
    return np.stack([cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA) for frame in padded])


def to_camera_size(video: np.ndarray) -> np.ndarray:
    """Model frames uint8 [t h w 3] -> [t 240 320 3]."""
    top, bottom, left, right = padding_to(*video.shape[1:3])
    height, width = HEIGHT + top + bottom, WIDTH + left + right
    if video.shape[1:3] != (height, width):
        video = np.stack([cv2.resize(frame, (width, height), interpolation=cv2.INTER_CUBIC) for frame in video])
    return video[:, top : top + HEIGHT, left : left + WIDTH]

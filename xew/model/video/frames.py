"""Conversion between the camera's and the model's frames: pad to the aspect ratio by repeating edges, then resize.

For example, 320x240 becomes 320x256 by eight rows above and below, and then 160x128 by resizing.
"""

from typing import NamedTuple

import cv2
import numpy as np

from xew.protocol import CAMERA_SIZE

Size = tuple[int, int]
"""Width and height of a camera's picture [pixels]."""
TEMPORAL_FACTOR = 4
"""Number of frames of video in a latent frame; the first latent frame holds one."""


class Padding(NamedTuple):
    """Numbers of rows and columns added before resizing [pixels of the camera]."""

    top: int
    bottom: int
    left: int
    right: int


def picture_size(video: np.ndarray) -> Size:
    """Width and height of a video [t h w 3]."""
    return video.shape[2], video.shape[1]


def padding_to(height: int, width: int, size: Size = CAMERA_SIZE) -> Padding:
    """Padding of a camera frame of a size to the aspect ratio of height x width."""
    rows = max(0, round(size[0] * height / width) - size[1])
    columns = max(0, round(size[1] * width / height) - size[0])
    return Padding(rows // 2, rows - rows // 2, columns // 2, columns - columns // 2)


def to_model_size(video: np.ndarray, height: int, width: int) -> np.ndarray:
    """Camera frames uint8 [t h w 3] -> [t height width 3]."""
    top, bottom, left, right = padding_to(height, width, picture_size(video))
    padded = np.pad(video, ((0, 0), (top, bottom), (left, right), (0, 0)), mode="edge")
    if padded.shape[1:3] == (height, width):
        return padded
    return np.stack([cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA) for frame in padded])


def to_camera_size(video: np.ndarray, size: Size = CAMERA_SIZE) -> np.ndarray:
    """Model frames uint8 [t h w 3] -> frames of the camera's size, [t 240 320 3] for the head camera."""
    top, bottom, left, right = padding_to(video.shape[1], video.shape[2], size)
    height, width = size[1] + top + bottom, size[0] + left + right
    if video.shape[1:3] != (height, width):
        video = np.stack([cv2.resize(frame, (width, height), interpolation=cv2.INTER_CUBIC) for frame in video])
    return video[:, top : top + size[1], left : left + size[0]]

"""Stage 11 of 11: pictures of the report: strips and sheets, uint8 RGB arrays."""

import base64
from collections.abc import Sequence

import cv2
import matplotlib
import numpy as np

from xew.rollout import resize_video

GAP = 4
"""White pixels between the pictures of a sheet."""
DIFFERENCE_FULL = 96
"""Levels of 255 at which the difference picture is darkest."""
FRAME = (208, 215, 222)


def difference_picture(predicted: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Largest channel difference of two uint8 frames [h w 3] as color: white is none, black DIFFERENCE_FULL or more."""
    difference = cv2.absdiff(predicted, observed).max(axis=-1) / DIFFERENCE_FULL
    picture = (matplotlib.colormaps["gist_heat_r"](np.minimum(difference, 1))[..., :3] * 255).astype(np.uint8)
    height, width = picture.shape[:2]
    return cv2.rectangle(picture, (0, 0), (width - 1, height - 1), FRAME, 1)  # else white on white has no edge


def as_graded(video: np.ndarray, truth: np.ndarray, frame_zero: str) -> np.ndarray:
    """A rollout's video [t h w 3] beside its episode's as it was graded: frame by frame, at the episode's size.

    Args:
        video: the rollout's, as it is stored.
        truth: the episode's.
        frame_zero: what the score table says; where it is 'absent' the video begins with frame 1.
    """
    video = resize_video(video, truth.shape[1:3])
    if frame_zero == "absent":
        video = np.concatenate([truth[:1], video])
    return video[: len(truth)]


def strip_times(frame_count: int, count: int = 5) -> list[int]:
    """Frames shown of a video: the given one, the last, and some between."""
    return np.unique(np.linspace(0, frame_count - 1, count).round().astype(int)).tolist()


def strip(observed: np.ndarray, predicted: np.ndarray, times: Sequence[int]) -> np.ndarray:
    """Three rows observed, predicted, difference; one column for each time. Videos [t h w 3] uint8 of the same length."""
    rows = [
        [observed[t] for t in times],
        [predicted[t] for t in times],
        [difference_picture(predicted[t], observed[t]) for t in times],
    ]
    return sheet(rows)


def sheet(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """Pictures [h w 3] of one size as a grid on white."""
    height, width = rows[0][0].shape[:2]
    columns = max(len(row) for row in rows)
    page = np.full((len(rows) * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        for j, picture in enumerate(row):
            top, left = i * (height + GAP), j * (width + GAP)
            page[top : top + height, left : left + width] = picture
    return page


def png(image: np.ndarray) -> bytes:
    """An RGB image [h w 3] uint8 as PNG."""
    done, encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise OSError("OpenCV cannot encode a PNG")
    return encoded.tobytes()


def data_uri(image: bytes) -> str:
    """PNG bytes for the src of an <img> that must open without a network."""
    return "data:image/png;base64," + base64.b64encode(image).decode()

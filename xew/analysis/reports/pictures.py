"""Pictures of a report: strips and sheets of frames, as uint8 RGB arrays."""

import base64
from collections.abc import Sequence

import cv2
import matplotlib
import numpy as np

GAP = 4
"""Width of the gap between the pictures of a sheet [px]."""
DIFFERENCE_FULL = 96
"""Difference, in levels of 255, from which on the difference picture is darkest."""
FRAME = (208, 215, 222)
PNG_COMPRESSION = 9
"""Effort of compressing pictures, 0 to 9: a page holds hundreds of them."""


def difference_picture(predicted: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Largest channel difference of two frames [h w 3] uint8 as a picture [h w 3] uint8.

    White is no difference, black is DIFFERENCE_FULL or more.
    """
    difference = cv2.absdiff(predicted, observed).max(axis=-1) / DIFFERENCE_FULL
    picture = (matplotlib.colormaps["gist_heat_r"](np.minimum(difference, 1))[..., :3] * 255).astype(np.uint8)
    height, width = picture.shape[:2]
    return cv2.rectangle(picture, (0, 0), (width - 1, height - 1), FRAME, 1)  # else white on white has no edge


def strip_times(frame_count: int, count: int = 5) -> list[int]:
    """Numbers of the frames to show of a video: the first, the last, and some between."""
    return np.unique(np.linspace(0, frame_count - 1, count).round().astype(int)).tolist()


def strip(observed: np.ndarray, predicted: np.ndarray, times: Sequence[int]) -> np.ndarray:
    """A picture [h w 3] uint8 with the rows observed, predicted and difference, and a column for each time.

    Both videos are [t h w 3] uint8 of the same length.
    """
    rows = [
        [observed[t] for t in times],
        [predicted[t] for t in times],
        [difference_picture(predicted[t], observed[t]) for t in times],
    ]
    return sheet(rows)


def sheet(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """Rows of pictures [h w 3] uint8 of one size, side by side on a white picture [H W 3] uint8."""
    height, width = rows[0][0].shape[:2]
    columns = max(len(row) for row in rows)
    page = np.full((len(rows) * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        for j, picture in enumerate(row):
            top, left = i * (height + GAP), j * (width + GAP)
            page[top : top + height, left : left + width] = picture
    return page


def encode_png(image: np.ndarray) -> bytes:
    """The PNG file of an RGB image [h w 3] uint8."""
    done, encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])
    if not done:
        raise OSError("OpenCV cannot encode a PNG")
    return encoded.tobytes()


def data_uri(image: bytes) -> str:
    """A PNG file as a data URI, which needs no network."""
    return "data:image/png;base64," + base64.b64encode(image).decode()

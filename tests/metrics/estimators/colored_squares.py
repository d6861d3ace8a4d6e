"""A video in which every point has a color of its own, so that a stand-in tracker can be exact."""

import numpy as np

SIZE = (96, 128)
HALF = 6
"""Squares have sides of 13 pixels, so that a center is the center of a pixel."""
COLORS = np.array([(250, 40, 40), (40, 250, 40), (60, 60, 250)], np.uint8)


def squares() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Video [5 96 128 3], centers [5 4 2] float32, where they are seen [5 4].

    The first point is always seen, the second from frame 1 to 3, the third in frame 0 alone, and the fourth never.
    """
    points = np.array([[[20 + 9 * t, 20 + 3 * t], [100 - 7 * t, 60 + 2 * t], [60, 80], [5, 5]] for t in range(5)], np.float32)
    visible = np.zeros((5, 4), bool)
    visible[:, 0] = visible[1:4, 1] = visible[0, 2] = True
    video = np.full((5, *SIZE, 3), 12, np.uint8)
    for t, k in np.argwhere(visible):
        x, y = points[t, k].astype(int)
        video[t, y - HALF : y + HALF + 1, x - HALF : x + HALF + 1] = COLORS[k]
    return video, points, visible

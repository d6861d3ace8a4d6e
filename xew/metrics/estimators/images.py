"""Operations on single images that the default estimators share: reading between pixels, and softening."""

import cv2
import numpy as np


def sample(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """An image [h w] or [h w c] read at points [a b 2] between its pixels; beyond its border it goes on as it ended."""
    return cv2.remap(image, points[..., 0], points[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def soften(image: np.ndarray, sigma: float) -> np.ndarray:
    """An image [h w c] under a Gaussian blur of this standard deviation [pixels]."""
    return cv2.GaussianBlur(image, (0, 0), sigma)


def equal_frames(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[t] bool, which frames of two videos [t h w 3] are equal. Most that are not differ in their first row."""
    pairs = zip(first, second, strict=True)
    return np.array([np.array_equal(a[0], b[0]) and np.array_equal(a, b) for a, b in pairs], bool)


def is_inside(points: np.ndarray, image: np.ndarray) -> np.ndarray:
    """[...] bool, is each point [... 2] in a pixel of the image?"""
    height, width = image.shape[:2]
    return np.all((points > -0.5) & (points < (width - 0.5, height - 0.5)), axis=-1)

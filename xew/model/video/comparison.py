"""Comparison of two videos, for monitoring training."""

import numpy as np

STRIP_FRAMES = 5
"""Number of frames in a strip."""


def strip(*videos: np.ndarray) -> np.ndarray:
    """Put a few frames of n videos [t h w 3] uint8 side by side, the first video above the others: [n*h k*w 3] uint8."""
    chosen = np.linspace(0, len(videos[0]) - 1, min(STRIP_FRAMES, len(videos[0]))).astype(int)
    return np.concatenate([np.concatenate(list(video[chosen]), axis=1) for video in videos], axis=0)

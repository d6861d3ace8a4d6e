"""Comparison of two videos, for monitoring training."""

import numpy as np

STRIP_FRAMES = 5
"""Number of frames in a strip."""


def strip(truth: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Put a few frames of two videos [t h w 3] uint8 side by side, ground truth above prediction: [2h kw 3] uint8."""
    chosen = np.linspace(0, len(truth) - 1, min(STRIP_FRAMES, len(truth))).astype(int)
    return np.concatenate([np.concatenate(list(video[chosen]), axis=1) for video in (truth, predicted)], axis=0)


def psnr(predicted: np.ndarray, truth: np.ndarray) -> float:
    """Mean PSNR [dB] over frames of two videos [t h w 3] uint8; `xew.metrics.psnr` is the study's metric."""
    error = np.square(predicted.astype(np.float32) - truth).mean(axis=(1, 2, 3))
    return float((10 * np.log10(255**2 / np.maximum(error, 1e-6))).mean())

"""The GPU that the batched estimators use, if there is one: Warp's, whatever JAX computes on."""

from typing import Any

import numpy as np
import warp as wp

from xew.metrics.estimators.adapters import gpu_number


def find_gpu() -> str | None:
    """Warp's name of the calling thread's GPU; None where Warp sees none."""
    wp.config.log_level = wp.LOG_ERROR  # no banner and no line for each module among the progress bars
    gpus = wp.get_cuda_devices()
    return gpus[gpu_number() % len(gpus)].alias if gpus else None


def upload(video: np.ndarray, device: Any) -> Any:
    """A video [t h w 3] uint8 on a device of Warp.

    It waits for what was launched there before, and so is no part of a thread's turn at launching.
    """
    return wp.array(np.ascontiguousarray(video), dtype=wp.uint8, device=device)

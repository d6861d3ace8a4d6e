"""The GPU that the batched estimators use, if there is one: Warp's, whatever JAX computes on."""

import warp as wp

from xew.metrics.estimators.adapters import gpu_number


def find_gpu() -> str | None:
    """Warp's name of the calling thread's GPU; None where Warp sees none."""
    wp.config.log_level = wp.LOG_ERROR  # no banner and no line for each module among the progress bars
    gpus = wp.get_cuda_devices()
    return gpus[gpu_number() % len(gpus)].alias if gpus else None

"""The GPU that the batched estimators use, if there is one: Warp's, whatever JAX computes on."""

import threading
from typing import Any

import numpy as np
import warp as wp

from xew.concurrency import PARSING
from xew.metrics.estimators.adapters import gpu_number

AT_ONCE = 2
"""Number of threads that compute on a device at once: one launches while another waits for its result. What a video needs
there, a gigabyte and more, is then taken twice and not once a thread."""
_turns: dict[str, threading.BoundedSemaphore] = {}


def turn_on(device: Any) -> threading.BoundedSemaphore:
    """What a thread holds while it computes on a device of Warp."""
    return _turns.setdefault(device.alias, threading.BoundedSemaphore(AT_ONCE))


def find_gpu() -> str | None:
    """Warp's name of the calling thread's GPU; None where Warp sees none."""
    wp.config.log_level = wp.LOG_ERROR  # no banner and no line for each module among the progress bars
    with PARSING:  # Warp makes a GPU's context at its first use, and a thread that came second would find it without a stream
        gpus = wp.get_cuda_devices()
        if not gpus:
            return None
        gpu = gpus[gpu_number() % len(gpus)]
        wp.get_stream(gpu)
    return gpu.alias


def upload(video: np.ndarray, device: Any) -> Any:
    """A video [t h w 3] uint8 on a device of Warp.

    It waits for what was launched there before, and so is no part of a thread's turn at launching.
    """
    return wp.array(np.ascontiguousarray(video), dtype=wp.uint8, device=device)


def download(array: Any) -> np.ndarray:
    """An array [...] of Warp as NumPy's, once the device has computed it.

    Not `array.numpy()`, which makes the null stream that of the whole device while it copies: other threads then launch on it,
    and two that copy at once leave it there for good (CUDA error 201 in threads without a context).
    """
    return array.to("cpu").numpy()

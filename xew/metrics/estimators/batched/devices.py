"""The GPU of the batched estimators, if there is one: Warp's, whichever device JAX uses."""

from typing import Any

import warp as wp

from xew.concurrency import PARSING


def find_gpu() -> str | None:
    """Warp's name of the first GPU that this process sees; None where Warp sees none."""
    wp.config.log_level = wp.LOG_ERROR  # no banner and no line for each module among the progress bars
    with PARSING:  # Warp makes a GPU's context at its first use, and a thread that came second would find it without a stream
        gpus = wp.get_cuda_devices()
        if not gpus:
            return None
        wp.get_stream(gpus[0])
    return gpus[0].alias


def download(array: Any) -> Any:
    """An array [...] of Warp as NumPy's, once the device has computed it.

    Not `array.numpy()`, which makes the null stream that of the whole device while it copies.
    """
    return array.to("cpu").numpy()

"""Waiting for a GPU without keeping a core busy. CUDA's own wait spins, and workers need the core."""

import time

import warp as wp

PAUSE = 0.0005
"""Time between two looks [s]."""


def wait_for(device: wp.Device) -> None:
    """Return when all that was launched on the device's stream is done; at once on a CPU, where launches wait themselves."""
    if device.is_cuda:
        event = device.stream.record_event()
        while not event.is_complete:
            time.sleep(PAUSE)

"""Waiting for a GPU without occupying a core; CUDA's own wait spins."""

import time

import warp as wp

PAUSE = 0.0005
"""Time between polls [s]."""


def wait_for(device: wp.Device) -> None:
    """Wait until all launches on the device's stream have finished; on a CPU launches are synchronous."""
    if device.is_cuda:
        event = device.stream.record_event()
        while not event.is_complete:
            time.sleep(PAUSE)

"""Many videos at once: worker threads, what each has for itself, and how far they run ahead.

Threads share compiled programs, and decoding, OpenCV and XLA let go of Python's lock; for many cores there are processes
(`evaluate --processes`).
"""

import math
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from xew.compilation import ALLOCATOR, GIVING_BACK
from xew.concurrency import usable_cores
from xew.config import ConfigError, pick
from xew.metrics.backends import Masker, Tracker
from xew.metrics.estimators.adapters import use_gpu

MOST_WORKERS = {"cpu": 32, "gpu": 12}
"""Largest number of workers of a CPU and of each GPU. At full length each holds an episode, a prediction and their optical
flow, half a gigabyte of the host's memory and as much of a GPU's, and features of the true video
(`perceptual.KEPT_FEATURES`)."""


MEMORY_OF_PROCESS = 9.0
"""Memory of a GPU that a process which grades may come to hold [GB] if it gives none back: with 8 for each of ten processes a
card ran out of it (docs/performance.md)."""


def choose_allocator(processes: int, free: Sequence[float]) -> None:
    """Have processes to come give back a GPU's memory after each use where it is too little for all, unless JAX was told how.

    Args:
        processes: their number, shared out to the GPUs.
        free: memory of each GPU that is free [GB]; nothing where that is not known.
    """
    if not free or math.ceil(processes / len(free)) * MEMORY_OF_PROCESS > min(free):
        os.environ.setdefault(ALLOCATOR, GIVING_BACK)


def reader_count(asked: int) -> int:
    """How many threads list what there is to grade; it asks for no GPU, which a process that only lists leaves to others.

    Args:
        asked: their number; 0 for one for each processor core.

    Raises:
        ConfigError: it is negative.
    """
    if asked < 0:
        raise ConfigError(f"--workers is {asked}, expected a positive number, or 0 for one for each core.")
    return asked or usable_cores()


def worker_count(asked: int) -> int:
    """How many threads grade; 0 asks for one for each processor core. Raises ConfigError for a negative number."""
    cores, devices = reader_count(asked), jax.local_devices()
    most = MOST_WORKERS["cpu"] if jax.default_backend() == "cpu" else MOST_WORKERS["gpu"] * len(devices)
    return asked or max(len(devices), min(cores, most))


class Bench(threading.local):
    """What each worker thread has for itself: a device, and who finds robots and points there."""

    def __init__(
        self,
        masker: Callable[[jax.Device], Masker],
        tracker: Callable[[jax.Device], Tracker],
        devices: Iterator[jax.Device],
    ) -> None:
        self.device = next(devices)
        use_gpu(self.device.local_hardware_id or 0)
        self.masker, self.tracker = masker(self.device), tracker(self.device)


def open_nothing(_: jax.Device) -> Any:
    """Stand in for an estimator that no metric needs."""

    def refuse(*arrays: np.ndarray) -> np.ndarray:
        raise AssertionError("no metric needs this estimator, so none was opened")

    return refuse


E = TypeVar("E", bound=Callable[..., np.ndarray])


def make_opener(
    name: str, registry: Any, open_: Callable[[str, Path | None], E], checkpoint: Path | None
) -> Callable[[jax.Device], E]:
    """Make what opens an estimator for a thread: its own, or, where it has weights, its device's, used in turn."""
    if pick(registry, name, "estimator").needs is None:
        return lambda _: open_(name, checkpoint)
    opened: dict[jax.Device, E] = {}
    opening = threading.Lock()

    def of_device(device: jax.Device) -> E:
        with opening, jax.default_device(device):
            if device not in opened:
                opened[device] = serialize_calls(open_(name, checkpoint))
            return opened[device]

    return of_device


def serialize_calls(estimator: E) -> E:
    """The same estimator for one thread at a time; estimators keep notes of the episode at hand."""
    turn = threading.Lock()

    def call(*arrays: np.ndarray) -> np.ndarray:
        with turn:
            return estimator(*arrays)

    return call  # type: ignore[return-value]

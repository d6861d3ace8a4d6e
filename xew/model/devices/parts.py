"""One process for each GPU, and further processes that read for it.

A GPU would wait for threads that read, because they wait for Python's lock and render one at a time.
"""

import functools
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event
from typing import Any, TypeVar

import cv2
import jax

from xew.concurrency import (
    free_gpu_memory,
    map_in_order,
    map_in_processes,
    map_with_shared_memory,
    queue_to,
    reuse_memory,
    visible_gpus,
)

Item = TypeVar("Item")
Result = TypeVar("Result")

FRAMES_OF_READER = 96
"""Number of frames in flight of a process that reads and renders on a GPU; each takes 7 MB."""
GPU_MEMORY_OF_READER = 1.5
"""GPU memory of a process that reads [GB]: frames in flight, CUDA's own memory of 0.5 GB, and a margin."""
EPISODES_OF_READER = 4
"""Number of episodes for which a process that reads is worth its start of a few seconds."""
RENDERERS = ("xew.sim_warp.rendering.streams",)
"""Modules for rendering, which processes that read need."""


def run_on_gpus(
    opener: Callable[[SimpleQueue, Event], Callable[[Sequence[Item]], object]],
    items: Sequence[Item],
    gpus: Sequence[str],
    done: Callable[[Any], object],
    imported: Sequence[str],
) -> None:
    """Share items among processes, one a GPU. After an error the others end early.

    Args:
        opener: called in each process with a queue for its results, and an event that is set for the process to end early;
            returns the function that works on the process's items.
        items: dealt in turn, so sorted ones are shared evenly.
        gpus: GPUs as CUDA_VISIBLE_DEVICES names them.
        done: called with every result in the queue, in another thread.
        imported: modules that the processes need.
    """
    stop = multiprocessing.get_context("forkserver").Event()

    def run(results: SimpleQueue, number: int) -> None:
        opener_of_part, gpu = functools.partial(opener, results, stop), gpus[number : number + 1]
        try:
            list(map_in_processes(opener_of_part, [items[number :: len(gpus)]], 1, imported, gpu))
        except BaseException:
            stop.set()
            raise

    with queue_to(done) as results:
        list(map_in_order(functools.partial(run, results), range(min(len(gpus), len(items))), len(gpus), stop))


def choose_readers(episodes: int, most: int) -> int:
    """Number of processes, at most `most`, that read for the GPU of this process; 0 for threads, as on a CPU."""
    if jax.default_backend() != "gpu" or not hasattr(os, "memfd_create"):
        return 0
    count = min(most, int(spare_gpu_memory() / GPU_MEMORY_OF_READER))
    return count if count > 1 and episodes >= count * EPISODES_OF_READER else 0


def spare_gpu_memory() -> float:
    """Memory of this process's GPU that stays free when JAX has grown to its limit, by default 75 % of the GPU [GB]."""
    limit = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit", 0)
    return max(0.0, min(free_gpu_memory(visible_gpus()), default=0.0) - limit / 1e9)


def read_ahead(
    read: Callable[[Item], Result],
    items: Sequence[Item],
    threads: int | None = None,
    processes: int = 0,
    imported: Sequence[str] = (),
) -> Iterator[Result]:
    """Results of a function in the order of the items, ahead in threads, by default one a core, or in processes if any."""
    if not processes:
        return map_in_order(read, items, threads)
    return map_with_shared_memory(functools.partial(_open_reader, read), items, processes, (*imported, *RENDERERS))


def _open_reader(read: Callable[[Item], Result]) -> Callable[[Item], Result]:
    from xew.sim_warp.devices.workers import find_device, keep_memory, quiet_warp
    from xew.sim_warp.rendering.streams import default_renderer

    reuse_memory()
    quiet_warp()
    device = find_device(None)
    default_renderer(FRAMES_OF_READER if device.is_cuda else None)
    keep_memory(device)
    cv2.setNumThreads(1)  # processes share the cores
    return read

"""Worker processes: jobs handed to as many processes as a machine has room for.

Reads  jobs and a function of a job; both travel to the workers by pickle
Writes results, as they come

On a GPU, too: what Python does there for a batch takes longer than the device, and several batches in flight keep it busy.
Where there are several GPUs, workers have one each in turn: Warp's default device in a worker is its own.
A worker ignores Ctrl-C (its parent decides) and leaves when its parent is killed, so that nobody writes on unwatched
(`xew.concurrency.open_processes`).
"""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

import warp

from xew.concurrency import open_processes, usable_cores
from xew.config import ConfigError
from xew.episode import EpisodeError

Job = TypeVar("Job")
Result = TypeVar("Result")

IMPORTED = ("xew.sim_warp.production.preloaded",)
"""Modules that workers are forked with."""
MEMORY_PER_WORKER = 9e9
"""Memory of a GPU that a worker takes [bytes]: a batch of 256 worlds, 512 frames in flight and what CUDA itself takes."""
FRAMES_OF_A_RENDERING_WORKER = 192
"""Number of frames in flight of a worker that steps physics on the CPU and has the GPU draw them."""
MEMORY_PER_RENDERING_WORKER = 3e9
"""Memory of a GPU that such a worker takes [bytes]; 14 of them were seen with 1.8e9 each on an H100."""


def find_device(name: str | None) -> warp.Device:
    """The device that a command's --device names, or the one that Warp prefers. Raises ConfigError if it is not there."""
    try:
        return warp.get_device(name)
    except (ValueError, RuntimeError) as error:
        known = ", ".join(device.alias for device in warp.get_devices())
        raise ConfigError(f"--device {name}: not on this machine, which has {known}.") from error


def find_devices(name: str | None) -> list[warp.Device]:
    """The devices that work is shared out to: what --device names, else all GPUs of the first one's kind, else the CPU.

    A GPU of another kind, such as a small one for a display, would get as many workers as the others. Raises as `find_device`.
    """
    gpus = warp.get_cuda_devices() if name is None else []
    return [gpu for gpu in gpus if gpu.name == gpus[0].name] or [find_device(name)]


def worker_count(devices: Sequence[warp.Device], physics: warp.Device | None = None) -> int:
    """How many processes feed some devices by default: one a core, on GPUs one for two cores if their memory has room.

    Args:
        devices: draw the pictures; all of a kind.
        physics: plans and steps, if it is another device; a CPU's physics takes a core a process, and less of the GPU's memory.
    """
    cores = usable_cores()
    if not devices[0].is_cuda:
        return cores
    only_render = physics is not None and not physics.is_cuda
    wanted, memory = (cores, MEMORY_PER_RENDERING_WORKER) if only_render else (cores // 2, MEMORY_PER_WORKER)
    return max(1, min(wanted, sum(int(device.total_memory // memory) for device in devices)))


class Workers:
    """Processes that are started as they are needed and stay until the end of a `with` block.

    Args:
        count: their number.
        devices: that they have as Warp's default, in turn; Warp's own choice where left out.
    """

    def __init__(self, count: int, devices: Sequence[warp.Device] = ()) -> None:
        os.environ.setdefault("OMP_NUM_THREADS", "1")  # a worker is a core; more threads would wait for one another
        self._count = count
        self._pool = open_processes(count, IMPORTED, _begin_worker, own=[device.alias for device in devices])

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def run(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[Result]:
        """Results of `function` on every job, in the order in which they are done.

        Args:
            function: called in a worker.
            jobs: whoever takes results may meanwhile add to a deque, on the left what is to be done next.

        Raises:
            EpisodeError: a worker was killed.
        """
        waiting = jobs if isinstance(jobs, deque) else deque(jobs)
        under_way: set[Future[Result]] = set()
        try:
            while waiting or under_way:
                while waiting and len(under_way) < 2 * self._count:  # one more for each, so that none waits for its next
                    under_way.add(self._pool.submit(function, waiting.popleft()))
                done, under_way = wait(under_way, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
        except BrokenProcessPool as error:
            raise EpisodeError(
                "a worker process was killed, perhaps for want of memory. What is done is kept: give the command again, "
                "with fewer --workers if it happens again."
            ) from error


def _begin_worker(device: str | None = None) -> None:
    """Prepare a worker, whose device has this name for Warp."""
    quiet_warp()
    if device is not None:
        warp.set_device(device)


def quiet_warp() -> None:
    """For commands and their workers: no banner and no line per kernel module among the progress bars."""
    warp.config.log_level = warp.LOG_ERROR

"""Worker processes for jobs, as many as a machine's cores and GPU memory allow.

Jobs and results are pickled. On a GPU several batches in flight keep the device busy, because Python's part of a batch takes
longer than the device's. Several GPUs are assigned to workers in turn, as Warp's default device.
"""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

import warp

from xew.concurrency import KILLED, close_processes, open_processes, usable_cores
from xew.config import ConfigError
from xew.episode import EpisodeError

Job = TypeVar("Job")
Result = TypeVar("Result")

IMPORTED = ("xew.sim_warp.production.preloaded",)
"""Modules that workers for all steps of the production need."""
MEMORY_PER_WORKER = 9e9
"""GPU memory of a worker [bytes]: a batch of 256 worlds, 512 frames in flight and CUDA's own memory."""
FRAMES_OF_A_RENDERING_WORKER = 192
"""Number of frames in flight of a worker that steps physics on the CPU and renders on the GPU."""
MEMORY_PER_RENDERING_WORKER = 3e9
"""GPU memory of such a worker [bytes]; 14 workers on an H100 took 1.8e9 each."""
CORES_PER_GPU = 8
"""Number of cores for each GPU from which physics runs on the CPU. A core plans and steps 5 worlds a second. An H100 steps 43 a
second in batches of 256, must render at the same time, and compiles kernels of planning and physics for minutes."""


def find_device(name: str | None) -> warp.Device:
    """The device that --device names, or Warp's default. Raises ConfigError if it does not exist."""
    try:
        return warp.get_device(name)
    except (ValueError, RuntimeError) as error:
        known = ", ".join(device.alias for device in warp.get_devices())
        raise ConfigError(f"--device {name}: not on this machine, which has {known}.") from error


def find_devices(name: str | None) -> list[warp.Device]:
    """The devices for workers: --device, else all GPUs of the first one's kind, else the CPU. Raises as `find_device`.

    GPUs of another kind, such as a small one for a display, would get as many workers as the others.
    """
    gpus = warp.get_cuda_devices() if name is None else []
    return [gpu for gpu in gpus if gpu.name == gpus[0].name] or [find_device(name)]


def choose_physics(name: str | None, devices: Sequence[warp.Device]) -> warp.Device:
    """The device for planning and physics: cpu, cuda, or by default the CPU if it has enough cores for each GPU.

    Args:
        name: value of --physics.
        devices: devices for rendering.

    Raises:
        ConfigError: physics is to run on a GPU, and there is none.
    """
    on_gpu = devices[0].is_cuda
    if name == "cuda" and not on_gpu:
        raise ConfigError(f"--physics cuda needs a GPU, and the device is {devices[0].alias}; omit it.")
    few_cores = usable_cores() < CORES_PER_GPU * len(devices)
    return devices[0] if on_gpu and (name == "cuda" or (name is None and few_cores)) else find_device("cpu")


def worker_count(devices: Sequence[warp.Device], physics: warp.Device | None = None) -> int:
    """Default number of worker processes: one per core, or on GPUs one per two cores if their memory allows.

    Args:
        devices: devices for rendering, all of one kind.
        physics: another device for planning and physics, if any. CPU physics takes a core per process and less GPU memory.

    Raises:
        ConfigError: a GPU has no memory left.
    """
    cores = usable_cores()
    if not devices[0].is_cuda:
        return cores
    if full := [device.alias for device in devices if not device.total_memory]:  # CUDA cannot even open it
        raise ConfigError(f"{full[0]} has no memory left; end the programs that use it, or name another with --device.")
    only_render = physics is not None and not physics.is_cuda
    wanted, memory = (cores, MEMORY_PER_RENDERING_WORKER) if only_render else (cores // 2, MEMORY_PER_WORKER)
    return max(1, min(wanted, sum(int(device.total_memory // memory) for device in devices)))


class Workers:
    """Processes that start when they are needed and stay until the end of a `with` block.

    Args:
        count: number of processes.
        devices: their default devices, assigned in turn; default: Warp's choice.
        imported: modules that are imported before workers are forked.
    """

    def __init__(self, count: int, devices: Sequence[warp.Device] = (), imported: Sequence[str] = IMPORTED) -> None:
        os.environ.setdefault("OMP_NUM_THREADS", "1")  # one core per worker
        self.count = count
        self._pool = open_processes(count, imported, _begin_worker, own=[device.alias for device in devices])

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *error: object) -> None:
        close_processes(self._pool)

    def start(self, function: Callable[[Job], Result], job: Job) -> Callable[[], Result]:
        """Begin one job; returns the function that waits for its result, and raises as `run`."""
        call = self._pool.submit(function, job)

        def wait_for_result() -> Result:
            with _tell_killed():
                return call.result()

        return wait_for_result

    def run(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[Result]:
        """Results of `function` on every job, in order of completion.

        Args:
            function: called in a worker.
            jobs: jobs; the consumer may add to a deque during the run, on the left for the next job.

        Raises:
            EpisodeError: a worker was killed.
        """
        waiting = jobs if isinstance(jobs, deque) else deque(jobs)
        under_way: set[Future[Result]] = set()
        with _tell_killed():
            while waiting or under_way:
                while waiting and len(under_way) < 2 * self.count:  # one waiting job per worker
                    under_way.add(self._pool.submit(function, waiting.popleft()))
                done, under_way = wait(under_way, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()


@contextmanager
def _tell_killed() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool as error:
        raise EpisodeError(f"{KILLED}, with fewer --workers if it happens again.") from error


def _begin_worker(device: str | None = None) -> None:
    quiet_warp()
    if device is not None:
        warp.set_device(device)
        keep_memory(warp.get_device())


def keep_memory(device: warp.Device) -> None:
    """Let a GPU's pool keep freed memory for the next chunk of frames. By default it is returned and mapped again."""
    if device.is_cuda and device.is_mempool_supported:
        warp.set_mempool_release_threshold(device, 1.0)


def quiet_warp() -> None:
    """Silence Warp's banner and its line per kernel module."""
    warp.config.log_level = warp.LOG_ERROR

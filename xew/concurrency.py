"""Threads and processes: work done ahead and in order, and worker processes that end with their parent."""

import ctypes
import functools
import itertools
import math
import mmap
import multiprocessing
import os
import pickle
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import forkserver
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event as ProcessEvent
from operator import length_hint
from typing import Any, BinaryIO, TypeVar

from xew.names import EpisodeError

Item = TypeVar("Item")
Result = TypeVar("Result")

Event = threading.Event | ProcessEvent
"""Event that is set for running calls to end early."""
KILLED = "a worker process was killed, perhaps for lack of memory. Completed work is stored: run the command again"
"""Message for a worker that the system has killed."""
PARSING = threading.RLock()
"""Lock for everything that parses Python in a thread: reading .npy headers, building kernels. In Python 3.11 two parsers at a
time can raise SystemError (github.com/python/cpython/issues/106905)."""

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Numbers of two of glibc's parameters, by malloc.h."""
MOST_KEPT = 2**31 - 1
"""Largest value of such a parameter [bytes]."""


def reuse_memory() -> None:
    """Let this process keep the memory of arrays that it frees for its next ones, if the C library is glibc.

    By default it returns large ones to the system, which clears every page of the next one. This takes 0.35 s of a core for an
    episode that is read and cut.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, MOST_KEPT)


def usable_cores() -> int:
    """Number of processor cores that this process may use; a cluster job may have fewer than its machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def visible_gpus() -> tuple[str, ...]:
    """NVIDIA's GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, encoding="utf-8", check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return ()
    count = len([line for line in listed.splitlines() if line.startswith("GPU ")])
    limited = os.environ.get("CUDA_VISIBLE_DEVICES")
    return tuple(map(str, range(count))) if limited is None else tuple(part for part in limited.split(",") if part)


def free_gpu_memory(gpus: Sequence[str]) -> tuple[float, ...]:
    """Free memory of each GPU [GB], by nvidia-smi; an empty tuple if nvidia-smi fails."""
    if not gpus:
        return ()
    query = ("nvidia-smi", "--query-gpu=memory.free", "--format=csv,noheader,nounits", "-i", ",".join(gpus))
    try:
        output = subprocess.run(query, capture_output=True, encoding="utf-8", check=True).stdout
        return tuple(float(mebibytes) * 2**20 / 1e9 for mebibytes in output.split())
    except (OSError, subprocess.CalledProcessError, ValueError):
        return ()


def map_in_order(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int | None = None,
    stop: Event | None = None,
) -> Iterator[Result]:
    """Results of a function over items, in their order, computed by threads that are at most a few items ahead.

    If a call raises or the consumer stops, no further call begins, and `stop` is set for running calls to end early.

    Args:
        workers: number of threads; default: the number of cores.
    """
    workers = workers or usable_cores()
    with ThreadPoolExecutor(workers) as pool:
        try:
            yield from _take_in_order((pool.submit(function, item) for item in items), 2 * workers)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            if stop is not None:
                stop.set()


def _take_in_order(calls: Iterable[Future[Result]], ahead: float) -> Iterator[Result]:
    """Results of calls in their order; at most `ahead` calls begin before the first result is taken."""
    waiting: deque[Future[Result]] = deque()
    for call in calls:
        waiting.append(call)
        if len(waiting) > ahead:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def prepare_processes(imported: Sequence[str]) -> None:
    """Start the process that worker processes are forked from, unless it runs; it imports their modules meanwhile."""
    multiprocessing.set_forkserver_preload(list(imported))
    forkserver.ensure_running()


def open_processes(
    count: int,
    imported: Sequence[str],
    begin: Callable[..., object],
    arguments: tuple[Any, ...] = (),
    own: Sequence[Any] = (),
) -> ProcessPoolExecutor:
    """Worker processes that ignore Ctrl-C and exit when their parent exits.

    They are forked from a process that has imported their modules (multiprocessing's forkserver), start in milliseconds, and
    share the memory of these modules.

    Args:
        count: number of processes; each starts when it is first needed.
        imported: modules to import before the first fork. None of them may start a thread, JAX's backend, Warp or CUDA at
            import.
        begin: called with `arguments` in each process before its first task.
        own: resources that processes get in turn, such as GPUs; the last argument of `begin`.
    """
    prepare_processes(imported)
    context = multiprocessing.get_context("forkserver")
    turns = context.SimpleQueue()
    for item in itertools.islice(itertools.cycle(own), max(1, count)):
        turns.put(item)
    return ProcessPoolExecutor(
        max(1, count), context, _begin_process, (dict(os.environ), begin, arguments, turns if own else None)
    )


def close_processes(pool: ProcessPoolExecutor) -> None:
    """End the processes of a pool, and wait until they have.

    A pool that breaks while it starts a process waits for that one forever, because it ends only those that it knew of. So all
    processes of a broken pool are ended here.
    """
    if pool._broken:
        for process in list(pool._processes.values()):
            process.terminate()
    pool.shutdown(cancel_futures=True)


def _begin_process(
    environment: dict[str, str], begin: Callable[..., object], arguments: tuple[Any, ...], turns: "SimpleQueue[Any] | None"
) -> None:
    os.environ.update(environment)  # the forking process may have been started with an earlier environment
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    leave_with_parent(lambda: os._exit(1))
    begin(*arguments, *(() if turns is None else (turns.get(),)))


def map_in_processes(
    opener: Callable[[], Callable[[Item], Result]],
    items: Iterable[Item],
    processes: int,
    imported: Sequence[str] = (),
    gpus: Sequence[str] = (),
    ahead: float = math.inf,
) -> Iterator[Result]:
    """Results of a function over items, in their order, computed by worker processes that exit after the last result.

    Args:
        opener: returns the function; called early in each process. If it raises, the first item calls it again and raises.
        items: items; they, the results and exceptions must support pickle.
        processes: largest number of processes.
        imported: modules that the processes need; see `open_processes`.
        gpus: GPUs as CUDA_VISIBLE_DEVICES names them, one for each process in turn; default: every process sees all.
        ahead: largest number of items that begin before the consumer takes the first result.

    Raises:
        EpisodeError: a process was killed.
    """
    count = min(processes, length_hint(items, processes))
    pool = open_processes(count, imported, _open_function, (opener,), gpus)
    try:
        for _ in range(count):
            pool.submit(_open_early)
        yield from _take_in_order((pool.submit(_call_function, item) for item in items), ahead)
    except BrokenProcessPool as error:
        raise EpisodeError(f"{KILLED}, and end other programs or use fewer processes if it happens again.") from error
    finally:
        close_processes(pool)


@contextmanager
def queue_to(receive: Callable[[Any], object]) -> Iterator["SimpleQueue[Any]"]:
    """Yield a queue for `open_processes`; in another thread, `receive` is called with everything that processes put into it."""
    queue = multiprocessing.get_context("forkserver").SimpleQueue()
    follower = threading.Thread(target=lambda: [receive(item) for item in iter(queue.get, None)])
    follower.start()
    try:
        yield queue
    finally:
        queue.put(None)
        follower.join()


def map_with_shared_memory(
    opener: Callable[[], Callable[[Item], Result]], items: Sequence[Item], processes: int, imported: Sequence[str] = ()
) -> Iterator[Result]:
    """`map_in_processes` for results that hold large arrays: these are written to shared memory, not to a pipe.

    At most two items of each process begin ahead. The memory has no name, so none is left behind when processes are killed.
    It needs Linux.
    """
    memories: deque[BinaryIO] = deque()

    def add_memory() -> Iterator[tuple[str, Item]]:
        for item in items:
            memories.append(os.fdopen(os.memfd_create("result"), "r+b"))
            yield f"/proc/{os.getpid()}/fd/{memories[-1].fileno()}", item

    count = min(processes, len(items))
    try:
        for content, sizes in map_in_processes(
            functools.partial(_open_sharing, opener), add_memory(), count, imported, ahead=2 * count
        ):
            with memories.popleft() as memory:
                shared = memoryview(mmap.mmap(memory.fileno(), 0) if any(sizes) else b"")
            places = itertools.pairwise(itertools.accumulate(sizes, initial=0))
            yield pickle.loads(content, buffers=[shared[start:end] for start, end in places])
    finally:
        for memory in memories:
            memory.close()


def _open_sharing(opener: Callable[[], Callable[[Item], Any]]) -> Callable[[tuple[str, Item]], tuple[bytes, list[int]]]:
    function = opener()

    def call(place: tuple[str, Item]) -> tuple[bytes, list[int]]:
        path, item = place
        buffers: list[pickle.PickleBuffer] = []
        content = pickle.dumps(function(item), protocol=5, buffer_callback=buffers.append)
        arrays = [buffer.raw() for buffer in buffers]
        with open(path, "r+b") as memory:
            memory.writelines(arrays)
        return content, [array.nbytes for array in arrays]

    return call


_opened: list[Callable[[], Any]] = []
"""Cached opener of this process, set by `_open_function`."""


def _open_function(opener: Callable[[], Callable[[Any], Any]], gpu: str | None = None) -> None:
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu  # CUDA reads it once, when this process first uses it
    _opened[:] = [functools.cache(opener)]


def _open_early() -> None:
    _opened[0]()  # an error is raised again by the first item


def _call_function(item: Any) -> Any:
    return _opened[0]()(item)


def leave_with_parent(leave: Callable[[], object]) -> None:
    """Call `leave` in a thread when the process that started this one has ended; does nothing in a main process."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        leave()

    threading.Thread(target=watch, daemon=True).start()

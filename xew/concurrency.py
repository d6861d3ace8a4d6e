"""Threads and processes: work done ahead and in order, and worker processes that end with their parent."""

import functools
import multiprocessing
import os
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import cycle, islice
from multiprocessing.queues import SimpleQueue
from typing import Any, TypeVar

from xew.names import EpisodeError

Item = TypeVar("Item")
Result = TypeVar("Result")

KILLED = "a worker process was killed, perhaps for lack of memory. Completed work is stored: run the command again"
"""Message for a worker that the system has killed."""
PARSING = threading.RLock()
"""Lock for everything that parses Python in a thread: reading .npy headers, building kernels. In Python 3.11 two parsers at a
time can raise SystemError (github.com/python/cpython/issues/106905)."""


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
    stop: threading.Event | None = None,
) -> Iterator[Result]:
    """Results of a function over items, in their order, computed by threads that are at most a few items ahead.

    If a call raises or the consumer stops, no further call begins, and `stop` is set for running calls to end early.

    Args:
        workers: number of threads; default: the number of cores.
    """
    workers = workers or usable_cores()
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Result]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > 2 * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            if stop is not None:
                stop.set()


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
    multiprocessing.set_forkserver_preload(list(imported))
    context = multiprocessing.get_context("forkserver")
    turns = context.SimpleQueue()
    for item in islice(cycle(own), max(1, count)):
        turns.put(item)
    return ProcessPoolExecutor(
        max(1, count), context, _begin_process, (dict(os.environ), begin, arguments, turns if own else None)
    )


def _begin_process(
    environment: dict[str, str], begin: Callable[..., object], arguments: tuple[Any, ...], turns: "SimpleQueue[Any] | None"
) -> None:
    os.environ.update(environment)  # the forking process may have been started with an earlier environment
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    leave_with_parent(lambda: os._exit(1))
    begin(*arguments, *(() if turns is None else (turns.get(),)))


def map_in_processes(
    opener: Callable[[], Callable[[Item], Result]],
    items: Sequence[Item],
    processes: int,
    imported: Sequence[str] = (),
    gpus: Sequence[str] = (),
) -> Iterator[Result]:
    """Results of a function over items, in their order, computed by worker processes that exit after the last result.

    Args:
        opener: returns the function; called early in each process. If it raises, the first item calls it again and raises.
        items: items; they, the results and exceptions must support pickle.
        processes: largest number of processes.
        imported: modules that the processes need; see `open_processes`.
        gpus: GPUs as CUDA_VISIBLE_DEVICES names them, one for each process in turn; default: every process sees all.

    Raises:
        EpisodeError: a process was killed.
    """
    count = min(processes, len(items))
    pool = open_processes(count, imported, _open_function, (opener,), gpus)
    try:
        for _ in range(count):
            pool.submit(_open_early)
        yield from pool.map(_call_function, items)
    except BrokenProcessPool as error:
        raise EpisodeError(f"{KILLED}, and end other programs or use fewer processes if it happens again.") from error
    finally:
        pool.shutdown(cancel_futures=True)


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

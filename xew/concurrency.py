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
from itertools import cycle, islice
from multiprocessing.queues import SimpleQueue
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

PARSING = threading.RLock()
"""Lock for whatever threads do that parses Python: reading .npy headers, building kernels. Python 3.11 counts the depth of all
parsers in one place (github.com/python/cpython/issues/106905), and two at a time end in a SystemError now and then."""


def usable_cores() -> int:
    """Number of processor cores that this process may use: a job of a cluster has fewer than its machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def visible_gpus() -> tuple[str, ...]:
    """NVIDIA's GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return ()
    count = len([line for line in listed.splitlines() if line.startswith("GPU ")])
    limited = os.environ.get("CUDA_VISIBLE_DEVICES")
    return tuple(map(str, range(count))) if limited is None else tuple(part for part in limited.split(",") if part)


def free_gpu_memory(gpus: Sequence[str]) -> tuple[float, ...]:
    """How much memory is free on each of some GPUs [GB], as NVIDIA's tool tells it; nothing where it does not."""
    if not gpus:
        return ()
    query = ("nvidia-smi", "--query-gpu=memory.free", "--format=csv,noheader,nounits", "-i", ",".join(gpus))
    try:
        told = subprocess.run(query, capture_output=True, text=True, check=True).stdout.split()
        return tuple(float(mebibytes) * 2**20 / 1e9 for mebibytes in told)
    except (OSError, subprocess.CalledProcessError, ValueError):
        return ()


def map_in_order(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int | None = None,
    stop: threading.Event | None = None,
) -> Iterator[Result]:
    """Results of a function over items, in their order, computed by threads that are at most a few items ahead.

    Where one raises, or whoever takes the results stops, nothing more is begun, and `stop` is set, so that what is under way
    can end early.

    Args:
        workers: threads; as many as there are cores where left out.
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
    """Processes that ignore Ctrl-C, for the one that started them decides, and that leave with it.

    They are forked from one that has imported what they need (multiprocessing's forkserver): each starts in milliseconds
    instead of importing for seconds, and they share the memory of what was imported.

    Args:
        count: their number; each is started when it is first needed.
        imported: modules to import before forking, where this process has started none yet. None of them may start a thread,
            JAX's backend, Warp or CUDA at import, which no fork survives.
        begin: called with `arguments` in each process before its first task.
        own: what processes have for themselves, in turn, such as a GPU; `begin` has it as its last argument.
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
    os.environ.update(environment)  # as it is now: the process that forks was started with that of an earlier time
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
    """Results of a function over items, in their order, computed by other processes.

    With the last result the processes leave, while this one goes on.

    Args:
        opener: gives the function; called early in each process, and again by its first item where it has raised, so that the
            item gets what it raises.
        items: sent to the processes, as results and exceptions are sent back: all of them can be pickled.
        processes: their number; no more are started than there are items.
        imported: modules that the processes need; see `open_processes`.
        gpus: of which each process sees one, in turn, as CUDA_VISIBLE_DEVICES names them; where left out all see all.
    """
    count = min(processes, len(items))
    pool = open_processes(count, imported, _open_function, (opener,), gpus)
    try:
        for _ in range(count):
            pool.submit(_open_early)
        yield from pool.map(_call_function, items)
    finally:
        pool.shutdown(cancel_futures=True)


_opened: list[Callable[[], Any]] = []
"""Function of this process, once `_open_function` has been called; it is made when it is first asked for."""


def _open_function(opener: Callable[[], Callable[[Any], Any]], gpu: str | None = None) -> None:
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu  # CUDA reads it once, when this process first uses it
    _opened[:] = [functools.cache(opener)]


def _open_early() -> None:
    """Open this process' function; who asks for it next gets what that raises, since nobody reads the result of this call."""
    _opened[0]()


def _call_function(item: Any) -> Any:
    return _opened[0]()(item)


def leave_with_parent(leave: Callable[[], object]) -> None:
    """Have this process leave when the process that started it has ended, so that none works on unwatched.

    A thread of this process calls `leave`. Nothing happens in a process that multiprocessing did not start.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        leave()

    threading.Thread(target=watch, daemon=True).start()

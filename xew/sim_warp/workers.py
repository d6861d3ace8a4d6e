"""Worker processes on a CPU: jobs handed to as many processes as there are cores.

Reads  jobs and a function of a job; both travel to the workers by pickle
Writes results, as they come

A worker ignores Ctrl-C (its parent decides) and leaves when its parent is killed, so that nobody writes on unwatched.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

import warp

from xew.episode import EpisodeError

Job = TypeVar("Job")
Result = TypeVar("Result")


class Workers:
    """Processes that are started as they are needed and stay until the end of a `with` block."""

    def __init__(self, count: int) -> None:
        os.environ.setdefault("OMP_NUM_THREADS", "1")  # a worker is a core; more threads would wait for one another
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(max(1, count), context, initializer=_become_worker)
        self._has_compiled = False

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def run(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[Result]:
        """Results of `function` on every job, in the order in which they are done.

        Raises:
            EpisodeError: a worker was killed.
        """
        # The first of all is done alone, so that Warp compiles its kernels once and not in every worker.
        alone = 0 if self._has_compiled else 1
        try:
            for job in jobs[:alone]:
                yield self._pool.submit(function, job).result()
                self._has_compiled = True
            for future in as_completed([self._pool.submit(function, job) for job in jobs[alone:]]):
                yield future.result()
        except BrokenProcessPool as error:
            raise EpisodeError(
                "a worker process was killed, perhaps for want of memory. What is done is kept: give the command again, "
                "with fewer --workers if it happens again."
            ) from error


def quiet_warp() -> None:
    """For commands and their workers: no banner and no line per kernel module among the progress bars."""
    warp.config.log_level = warp.LOG_ERROR


def _become_worker() -> None:
    quiet_warp()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

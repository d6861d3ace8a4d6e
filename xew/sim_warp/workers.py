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

from xew.episode import EpisodeError

Job = TypeVar("Job")
Result = TypeVar("Result")


def in_processes(function: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Results of `function` on every job, in the order in which they are done.

    Raises:
        EpisodeError: a worker was killed.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # a worker is a core; more threads would wait for one another
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max(1, min(workers, len(jobs))), context, initializer=_become_worker) as pool:
        try:
            # Alone, so that Warp compiles its kernels once and not in every worker.
            yield from (pool.submit(function, job).result() for job in jobs[:1])
            for future in as_completed([pool.submit(function, job) for job in jobs[1:]]):
                yield future.result()
        except BrokenProcessPool as error:
            raise EpisodeError(
                "a worker process was killed, perhaps for want of memory. What is done is kept: give the command again, "
                "with fewer --workers if it happens again."
            ) from error
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _become_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

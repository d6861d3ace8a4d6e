"""Processes that start other processes: how one that was started ends with the one that started it."""

import multiprocessing
import threading
from collections.abc import Callable


def leave_with_parent(leave: Callable[[], object]) -> None:
    """Have this process leave when the process that started it has ended, so that none works on unwatched.

    Args:
        leave: ends this process; a thread of this process calls it. Nothing happens in a process that multiprocessing did
            not start.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        leave()

    threading.Thread(target=watch, daemon=True).start()

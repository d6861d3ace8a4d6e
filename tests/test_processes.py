"""A process that was started ends with the one that started it."""

import multiprocessing
import os
import signal
import threading
import time
from multiprocessing.connection import Connection

from xew.processes import leave_with_parent


def work(told: Connection) -> None:
    leave_with_parent(lambda: os._exit(1))
    told.send(os.getpid())
    time.sleep(60)


def start_work(told: Connection) -> None:
    process = multiprocessing.get_context("spawn").Process(target=work, args=(told,))
    process.start()
    process.join()


def test_a_process_leaves_when_its_parent_is_killed() -> None:
    heard, told = multiprocessing.Pipe(duplex=False)
    parent = multiprocessing.get_context("spawn").Process(target=start_work, args=(told,))
    parent.start()
    child = heard.recv()
    assert parent.pid is not None
    os.kill(parent.pid, signal.SIGKILL)
    parent.join()
    told.close()
    end = time.monotonic() + 20
    while not is_gone(child) and time.monotonic() < end:
        time.sleep(0.05)
    assert is_gone(child)


def is_gone(process: int) -> bool:
    """Has a process that is not ours to wait for ended? What init has not collected yet counts as ended."""
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def test_the_first_process_has_no_parent_to_leave_with() -> None:
    assert multiprocessing.parent_process() is None
    before, left = threading.enumerate(), []
    leave_with_parent(lambda: left.append(True))
    assert threading.enumerate() == before and not left, "nothing watches for a parent that there is not"

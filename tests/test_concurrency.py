"""Work done ahead by threads is in order and ends where something fails; a process ends with the one that started it."""

import functools
import multiprocessing
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

from xew.concurrency import (
    close_processes,
    free_gpu_memory,
    leave_with_parent,
    map_in_order,
    map_in_processes,
    map_with_shared_memory,
    open_processes,
    queue_to,
)
from xew.episode import EpisodeError


def test_free_memory_of_gpus_is_asked_of_nvidias_tool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tool = tmp_path / "nvidia-smi"
    tool.write_text(
        '#!/bin/sh\n[ "$*" = "--query-gpu=memory.free --format=csv,noheader,nounits -i 1,3" ] && echo 80000 && echo 500\n'
    )
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    assert free_gpu_memory(("1", "3")) == pytest.approx((83.886, 0.524), abs=0.001)
    assert free_gpu_memory(("0",)) == (), "the tool knows no such GPU"
    monkeypatch.setenv("PATH", "")
    assert free_gpu_memory(("1", "3")) == ()


def test_results_come_in_order_and_not_too_far_ahead() -> None:
    begun: list[int] = []

    def slow_at_first(number: int) -> int:
        begun.append(number)
        time.sleep(0.02 if number == 0 else 0)
        return 10 * number

    results = map_in_order(slow_at_first, range(100))
    assert next(results) == 0
    assert len(begun) < 100
    assert list(results) == [10 * number for number in range(1, 100)]


def test_failure_ahead_is_raised_where_it_belongs() -> None:
    def fail_at_three(number: int) -> int:
        if number == 3:
            raise ValueError("three")
        return number

    results = map_in_order(fail_at_three, range(9))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)


def test_threads_are_a_few_items_ahead_and_no_more() -> None:
    begun: list[int] = []
    taken = 0

    def items() -> Iterator[int]:
        for i in range(200):
            assert i - taken <= 2 * 3 + 1, "no more is read than is waited for"
            yield i

    def note(i: int) -> int:
        begun.append(i)
        return i * i

    for i, square in enumerate(map_in_order(note, items(), workers=3)):
        taken = i + 1
        assert square == i * i
    assert sorted(begun) == list(range(200))


def test_where_one_fails_nothing_more_is_begun() -> None:
    begun: list[int] = []
    stop = threading.Event()

    def fails(i: int) -> int:
        begun.append(i)
        if i == 3:
            raise ValueError("three")
        assert i < 3 or stop.wait(10), "what is under way learns of it"
        return i

    with pytest.raises(ValueError, match="three"):
        list(map_in_order(fails, range(1000), 2, stop))
    assert len(begun) < 20


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


def open_reader() -> Callable[[str], tuple[str | None, int]]:
    return lambda name: (os.environ.get(name), os.getpid())


def test_processes_have_the_environment_of_now(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though they are forked from a process that was started with an earlier one."""
    found = []
    for text in ("first", "second"):
        monkeypatch.setenv("XEW_TEST", text)
        found += map_in_processes(open_reader, ["XEW_TEST"], 1)
    assert [text for text, _ in found] == ["first", "second"]
    assert len({process for _, process in found} | {os.getpid()}) == 3


def open_slow_reader() -> Callable[[str], tuple[str | None, int]]:
    def read(name: str) -> tuple[str | None, int]:
        time.sleep(0.5)  # so that every process gets some
        return os.environ.get(name), os.getpid()

    return read


def test_processes_have_the_gpus_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    found = dict(map(reversed, map_in_processes(open_slow_reader, ["CUDA_VISIBLE_DEVICES"] * 6, 3, gpus=("4", "7"))))
    assert sorted(found.values()) == ["4", "4", "7"], "each has one, and keeps it"
    assert {gpu for gpu, _ in map_in_processes(open_reader, ["CUDA_VISIBLE_DEVICES"], 1)} == {"4,7"}


def open_square(folder: Path, delay: float = 0) -> Callable[[int], int]:
    """Tell that this process opens, by a file named after it, which may take a while."""
    (folder / str(os.getpid())).touch()
    time.sleep(delay)
    return lambda number: number * number


def wait_for(condition: Callable[[], bool], seconds: float = 60) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    return condition()


def processes_of(folder: Path) -> list[int]:
    return [int(file.name) for file in folder.iterdir()]


def test_processes_open_at_once_and_leave_after_the_last_item(tmp_path: Path) -> None:
    results = map_in_processes(functools.partial(open_square, tmp_path, 0.5), [2, 3, 4], 2)
    assert next(results) == 4
    assert wait_for(lambda: len(processes_of(tmp_path)) == 2), "each opens, also before there is an item for it"
    assert list(results) == [9, 16]
    assert len(processes_of(tmp_path)) == 2 and all(map(is_gone, processes_of(tmp_path)))


def test_no_process_is_left_behind_who_takes_no_more_results(tmp_path: Path) -> None:
    results = map_in_processes(functools.partial(open_square, tmp_path), [2, 3, 4], 2)
    assert next(results) == 4
    results.close()
    assert all(map(is_gone, processes_of(tmp_path)))


def kill_itself(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


def open_killed() -> Callable[[int], int]:
    return kill_itself


def test_a_killed_process_is_told_in_one_line() -> None:
    with pytest.raises(EpisodeError, match=r"^a worker process was killed.* run the command again, and end other programs"):
        list(map_in_processes(open_killed, [1, 2, 3], 2))


def open_nothing() -> Callable[[int], int]:
    raise FileNotFoundError("no weights")


def test_the_first_item_gets_what_the_opener_raises() -> None:
    with pytest.raises(FileNotFoundError, match="no weights"):
        list(map_in_processes(open_nothing, [1, 2, 3], 2))
    assert list(map_in_processes(open_nothing, [], 2)) == []


def open_counter(folder: Path) -> Callable[[int], tuple[int, dict[str, np.ndarray]]]:
    def count(number: int) -> tuple[int, dict[str, np.ndarray]]:
        (folder / str(number)).touch()
        return number, {"a": np.full((3, number), number, np.uint8), "b": np.arange(number, dtype=np.float32)}

    return count


def test_large_results_come_in_order_by_shared_memory(tmp_path: Path) -> None:
    results = map_with_shared_memory(functools.partial(open_counter, tmp_path), range(9), 2)
    for number, (found, arrays) in enumerate(results):
        assert found == number and len(processes_of(tmp_path)) <= number + 6, "at most two items of each process begin ahead"
        np.testing.assert_array_equal(arrays["a"], np.full((3, number), number, np.uint8))
        assert arrays["b"].tolist() == list(range(number)) and arrays["b"].dtype == np.float32
    assert number == 8


def shared_memories() -> list[str]:
    paths = (os.path.realpath(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd"))
    return [path for path in paths if "memfd:result" in path]


def test_no_memory_is_left_behind_who_takes_no_more_results(tmp_path: Path) -> None:
    results = map_with_shared_memory(functools.partial(open_counter, tmp_path), range(1, 9), 2)
    next(results)
    assert len(shared_memories()) >= 2
    results.close()
    assert not shared_memories()


def test_small_results_need_no_shared_memory() -> None:
    found = map_with_shared_memory(open_reader, ["HOME", "PATH"], 1)
    assert [text for text, _ in found] == [os.environ["HOME"], os.environ["PATH"]]


def test_what_processes_put_is_received_until_the_end() -> None:
    received: list[int] = []
    with queue_to(received.append) as queue:
        for number in range(3):
            queue.put(number)
    assert received == [0, 1, 2]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a parameter of glibc's malloc")
def test_memory_of_freed_arrays_is_used_again() -> None:
    program = """
import resource, numpy as np
from xew.concurrency import reuse_memory
reuse_memory()
np.ones(40_000_000, np.uint8)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
np.ones(40_000_000, np.uint8)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
    small_pages = os.environ | {"NUMPY_MADVISE_HUGEPAGE": "0"}
    done = subprocess.run([sys.executable, "-c", program], env=small_pages, capture_output=True, text=True, check=True)
    assert int(done.stdout) < 100, "9,766 pages of 4 kB were cleared before"


def test_a_pool_ends_that_breaks_while_it_starts_a_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process is killed when another has begun and the pool does not know of it yet."""
    pool = open_processes(2, (), os.getpid)
    busy = pool.submit(time.sleep, 600)
    processes, start, reader = pool._processes, pool._spawn_process, pool._call_queue._reader
    ended, known, close = threading.Event(), threading.Event(), reader.close

    def start_unknown() -> None:
        (first,) = processes
        start()
        second = processes.pop(next(pid for pid in processes if pid != first))
        os.kill(first, signal.SIGKILL)
        assert ended.wait(30)
        processes[second.pid] = second
        known.set()

    def close_after_ending() -> None:  # the pool calls it when it has ended the processes that it knows of
        ended.set()
        assert known.wait(30)
        close()

    monkeypatch.setattr(pool, "_spawn_process", start_unknown)
    monkeypatch.setattr(reader, "close", close_after_ending)
    waiting = pool.submit(time.sleep, 600)
    ending = threading.Thread(target=close_processes, args=(pool,), daemon=True)
    ending.start()
    ending.join(30)
    assert not ending.is_alive()
    assert all(isinstance(call.exception(), BrokenProcessPool) for call in (busy, waiting))

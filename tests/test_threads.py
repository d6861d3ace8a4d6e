"""Work done ahead by threads: in order, not too far, and to an end where something fails."""

import threading
import time
from collections.abc import Iterator

import pytest

from xew.threads import map_in_order


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

"""How processes that grade take a GPU's memory: for good where there is room for all of them, else only while they use it."""

import os
from collections.abc import Sequence

import pytest

from xew.compilation import ALLOCATOR, GIVING_BACK
from xew.metrics.grading.workers import choose_allocator


@pytest.mark.parametrize(
    ("processes", "free", "told"),
    [
        (9, (84.0,), None),
        (10, (84.0,), GIVING_BACK),
        (18, (84.0, 84.0), None),
        (9, (84.0, 44.0), GIVING_BACK),  # five on the first, four on the second: there may be five on either
        (1, (8.0,), GIVING_BACK),
        (8, (), GIVING_BACK),
    ],
)
def test_memory_is_given_back_where_there_is_no_room(
    processes: int, free: Sequence[float], told: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(ALLOCATOR, raising=False)
    choose_allocator(processes, free)
    assert os.environ.get(ALLOCATOR) == told
    monkeypatch.setenv(ALLOCATOR, "cuda_async")
    choose_allocator(processes, free)
    assert os.environ[ALLOCATOR] == "cuda_async", "what the user said stays"

"""Noise floors and verdicts on numbers whose answer is known."""

import numpy as np
import pytest

from xew.statistics import noise_floor, verdict


@pytest.mark.parametrize(
    ("difference", "low", "high", "noise", "higher", "expected"),
    [
        (1.0, 0.5, 1.5, 0.0, True, "better"),
        (1.0, 0.5, 1.5, 0.0, False, "worse"),
        (-1.0, -1.5, -0.5, 0.5, False, "better"),
        (1.0, -0.1, 2.0, 0.0, True, "unresolved"),
        (1.0, 0.5, 1.5, 1.0, True, "unresolved"),
        (1.0, np.nan, np.nan, 0.0, True, "unresolved"),
        (1.0, 0.5, 1.5, np.nan, True, "unresolved"),
        (0.0, 0.0, 0.0, 0.0, True, "unresolved"),
    ],
)
def test_verdicts(difference: float, low: float, high: float, noise: float, higher: bool, expected: str) -> None:
    assert verdict(difference, (low, high), noise, higher) == expected


@pytest.mark.parametrize(
    ("truth", "best", "estimated", "floor"),
    [
        (0.9, 1.0, True, 0.1),
        (0.3, 0.0, True, 0.3),
        (0.9, 1.0, False, 0.0),
        (None, 1.0, False, 0.0),
        (None, 1.0, True, np.nan),
        (100.0, None, True, np.nan),
        (100.0, np.inf, True, np.nan),
    ],
)
def test_the_floor_is_what_an_estimator_leaves_of_the_best(
    truth: float | None, best: float | None, estimated: bool, floor: float
) -> None:
    assert noise_floor(truth, best, estimated) == pytest.approx(floor, nan_ok=True)

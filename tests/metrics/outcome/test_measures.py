"""Measures of outcomes against values worked out by hand."""

import numpy as np
import pytest

from xew.metrics.outcome.measures import (
    counterfactual_retrieval,
    hallucinated_success,
    outcome_accuracy,
    progress_error,
    retrieval,
)

NAN = np.float32(np.nan)


def test_progress_error_is_the_absolute_difference() -> None:
    judged, true = np.float32([0.75, 1, 0, NAN]), np.float32([1, 1, 0.5, 1])
    np.testing.assert_array_equal(progress_error(judged, true), np.float32([0.25, 0, 0.5, NAN]))


def test_outcome_accuracy_is_agreement_about_success() -> None:
    judged, true = np.float32([0.97, 0.97, 0.5, 0.5, NAN]), np.float32([1, 0.9, 1, 0, 1])
    np.testing.assert_array_equal(outcome_accuracy(judged, true), np.float32([1, 0, 0, 1, NAN]))
    np.testing.assert_array_equal(outcome_accuracy(judged, true, shown=0.5), np.float32([1, 0, 1, 0, NAN]))


def test_hallucinated_success_is_a_share_of_failures() -> None:
    judged, true = np.float32([0.97, 1, 0.5, 0.1]), np.float32([0.9, 1, 0.5, 0])
    assert float(hallucinated_success(judged, true)) == pytest.approx(1 / 3)
    assert np.isnan(hallucinated_success(judged, np.ones_like(true))), "there is no failure"


@pytest.mark.parametrize(("distances", "value"), [([3, 1, 2], 1), ([3, 2, 1], 0), ([1, 1, 2], 0.5), ([1, 1, 1], 1 / 3)])
def test_retrieval_finds_the_own_truth(distances: list, value: float) -> None:
    assert float(retrieval(np.float32(distances), np.float32([5, 0, 2]))) == pytest.approx(value)


@pytest.mark.parametrize(
    ("distances", "share"),
    [
        ([[0, 1], [1, 0]], 1),
        ([[1, 0], [0, 1]], 0),
        ([[2, 1, 3], [4, 3, 5], [9, 8, 7]], 2 / 3),  # the first is nearest to the second truth
        ([[1, 1], [1, 1]], 1 / 2),  # chance: all are equally near
        ([[0, 0, 1], [5, 0, 5], [1, 1, 1]], (1 / 2 + 1 + 1 / 3) / 3),
        ([[0, NAN], [1, 0]], NAN),
    ],
)
def test_retrieval_shares_ties(distances: list, share: float) -> None:
    assert float(counterfactual_retrieval(np.array(distances, np.float32))) == pytest.approx(share, nan_ok=True)


@pytest.mark.parametrize("wrong", [np.zeros((2, 3), np.float32), np.zeros((2, 2), int), np.zeros(3, np.float32)])
def test_retrieval_refuses_other_arrays(wrong: np.ndarray) -> None:
    with pytest.raises((TypeError, ValueError), match="expected"):
        counterfactual_retrieval(wrong)


@pytest.mark.parametrize("wrong", [np.zeros((2, 2), np.float32), np.zeros(2, int), np.zeros(3, np.float32)])
def test_progress_of_another_kind_is_refused(wrong: np.ndarray) -> None:
    with pytest.raises((TypeError, ValueError), match="expected"):
        progress_error(wrong, np.zeros(2, np.float32) if wrong.ndim == 1 else wrong)

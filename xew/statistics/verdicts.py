"""Noise floors of metrics, and the verdict on a paired difference: better, worse or unresolved.

A metric that needs an estimator does not give even the true video its best score. By how much it misses its best there, on the
mean over the same robots' episodes, is the metric's noise floor, and a difference that is no larger is unresolved, whatever its
interval says. Metrics that compare pixels directly have a floor of 0. An estimated metric whose ground truth was not graded has
no floor (NaN), and nothing is resolved by it.

Corrections for several comparisons (Holm) and tests of equivalence belong here.
"""

import math

BETTER, WORSE, UNRESOLVED = "better", "worse", "unresolved"


def verdict(difference: float, ends: tuple[float, float], floor: float, higher_is_better: bool) -> str:
    """Whether the first of two models is better or worse than the second, by the mean of their paired differences.

    Unresolved is what the interval does not tell from 0, what lies within the noise floor, and what has no interval or floor.

    Args:
        difference: the mean.
        ends: of its interval; NaN where there is none (too few scenes).
        floor: noise floor of the metric; NaN where it is not known.
        higher_is_better: of the metric.
    """
    low, high = ends
    resolved = (low > 0 or high < 0) and abs(difference) > floor
    return UNRESOLVED if not resolved else BETTER if (difference > 0) == higher_is_better else WORSE


def noise_floor(truth: float | None, best: float | None, estimated: bool) -> float:
    """By how much a metric misses its best on the ground truth; NaN where that is not known.

    Args:
        truth: mean score of the true video; None where it was not graded.
        best: the metric's best value; None where it has none.
        estimated: whether the metric needs an estimator.
    """
    if not estimated:
        return 0.0
    if truth is None or best is None or not math.isfinite(best):
        return math.nan
    return abs(truth - best)

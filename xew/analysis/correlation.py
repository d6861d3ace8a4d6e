"""Does distance predict difficulty? Correlation over the five leave-one-embodiment-out (LOEO) folds."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

FOLDS = 5


@dataclass(frozen=True)
class Correlation:
    """Pearson's r with what five points can say about its certainty. Positive means: farther is worse."""

    r: float
    low: float
    """Smallest r when one robot is left out."""
    high: float
    """Largest r when one robot is left out."""
    p_value: float
    """Exact and two-sided: the share of all pairings of distances with scores whose |r| is as large."""

    @property
    def stable(self) -> bool:
        """Does the sign survive leaving out any one robot."""
        return self.low > 0 or self.high < 0


def loeo_correlation(distance: Sequence[float], score: Sequence[float], higher_is_better: bool = False) -> Correlation:
    """Correlate each robot's distance to the other four with its score when it was held out.

    Args:
        distance: five numbers, one a robot.
        score: five numbers in the same order.
        higher_is_better: of the score; its sign is turned, so that a positive r always means that farther is worse.

    Raises:
        ValueError: not five finite numbers each, or one of the two does not vary (also when one robot is left out).
    """
    x, y = (np.asarray(values, np.float64) for values in (distance, score))
    for name, values in (("distance", x), ("score", y)):
        if values.shape != (FOLDS,) or not np.isfinite(values).all():
            raise ValueError(f"{name} is {values.tolist()}, expected {FOLDS} finite numbers, one for each fold.")
        if any(np.ptp(np.delete(values, i)) == 0 for i in range(FOLDS)):
            raise ValueError(f"{name} is {values.tolist()}: without one robot it does not vary, and r is not defined.")
    if higher_is_better:
        y = -y
    r = _pearson(x, y)
    without_one = [_pearson(np.delete(x, i), np.delete(y, i)) for i in range(FOLDS)]
    return Correlation(r, min(without_one), max(without_one), _permutation_p(x, y, r))


def _pearson(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.corrcoef(x, y)[0, 1])


def _permutation_p(x: np.ndarray, y: np.ndarray, r: float) -> float:
    """All 120 orders of the scores are equally likely if distance says nothing. Ties up to rounding count as as large."""
    others = [abs(_pearson(x, y[list(order)])) for order in permutations(range(len(y)))]
    return float(np.mean(np.array(others) >= abs(r) - 1e-12))

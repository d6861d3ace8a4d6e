"""Correlation of distance with difficulty over the five leave-one-embodiment-out (LOEO) folds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata

from xew.statistics import Drawn, every_draw, pearson, permutation_p

FOLDS = 5
ROBOT_DRAWS = every_draw(FOLDS, least=3)
"""All draws of five robots with replacement [2820 5] but those of one or two robots, where r is undefined or always +-1."""


@dataclass(frozen=True)
class Correlation:
    """Pearson's r with what five points can say about its certainty. Positive means: farther is worse."""

    r: float
    low: float
    """Smallest r when one robot is left out."""
    high: float
    """Largest r when one robot is left out."""
    p_value: float
    """Exact and two-sided (`permutation_p`)."""
    spearman: float
    """The same of ranks: it asks for order only. Not in the paper."""
    bootstrap_low: float
    """2.5 % of r over all draws of the robots. Not in the paper."""
    bootstrap_high: float

    @property
    def stable(self) -> bool:
        """Does the sign survive leaving out any one robot."""
        return self.low > 0 or self.high < 0


def loeo_correlation(distance: Sequence[float], score: Sequence[float], higher_is_better: bool = False) -> Correlation:
    """Correlate each robot's distance to the other four with its score when it was held out.

    Args:
        distance: five numbers, one a robot.
        score: five numbers in the same order.
        higher_is_better: of the score; its sign is turned, so a positive r always means that farther is worse.

    Raises:
        ValueError: not five finite numbers each, or one of the two does not vary (also when one robot is left out).
    """
    x, y = _folds(distance, score)
    for name, values in (("distance", x), ("score", y)):
        if any(np.ptp(np.delete(values, i)) == 0 for i in range(FOLDS)):
            raise ValueError(f"{name} is {values.tolist()}: without one robot it does not vary, and r is not defined.")
    if higher_is_better:
        y = -y
    low, high = leave_one_out(x, y)
    spearman = float(pearson(rankdata(x), rankdata(y)))
    return Correlation(float(pearson(x, y)), float(low), float(high), float(permutation_p(x, y)), spearman, *_bootstrap(x, y))


def dof_correlation(dof: Sequence[float], score: Sequence[float], higher_is_better: bool = False) -> float:
    """Pearson's r of the number of joints with the score; positive means that more joints are worse.

    A diagnostic only: without the one robot with another number of joints nothing is left to correlate. Raises ValueError as
    `loeo_correlation`.
    """
    x, y = _folds(dof, score)
    for name, values in (("dof", x), ("score", y)):
        if np.ptp(values) == 0:
            raise ValueError(f"{name} is {values.tolist()}: it does not vary, and r is not defined.")
    return float(pearson(x, -y if higher_is_better else y))


def leave_one_out(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest r over the last axis [... 5] when one of the five is left out."""
    rest = np.array([np.delete(np.arange(FOLDS), i) for i in range(FOLDS)])
    r = pearson(x[..., rest], y[..., rest])
    return r.min(axis=-1), r.max(axis=-1)


def _bootstrap(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Interval of r over all draws of the robots; those in which something does not vary have no r."""
    low, high = Drawn(np.concatenate([pearson(x, y)[None], pearson(x[ROBOT_DRAWS], y[ROBOT_DRAWS])])).interval()
    return max(low, -1.0), min(high, 1.0)


def _folds(distance: Sequence[float], score: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    x, y = (np.asarray(values, np.float64) for values in (distance, score))
    for name, values in (("distance", x), ("score", y)):
        if values.shape != (FOLDS,) or not np.isfinite(values).all():
            raise ValueError(f"{name} is {values.tolist()}, expected {FOLDS} finite numbers, one for each fold.")
    return x, y

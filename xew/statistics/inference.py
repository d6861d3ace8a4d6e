"""Intervals and p-values of drawn numbers, and their correction for several tests.

An interval and a p-value are two readings of the same draws. The share of draws beyond a bound is taken for the tail of a
Student's t with the degrees of freedom that the number has, and not of a normal distribution (the expanded percentile interval
of Hesterberg 2015, "What teachers should know about the bootstrap"), so intervals of few scenes are as wide as they have
to be. Beyond the outermost draws the tail is continued in proportion to the distance from their median.

Where trainings are drawn too, the degrees of freedom are those of Satterthwaite (1946, "An approximate distribution of
estimates of variance components"): the variance between the trainings of a variant is known from the values without each (the
jackknife), and what is left is that of the scenes.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr, ndtri, stdtr, stdtrit

LEVEL = 0.95
"""Share of cases in which an interval holds the true value."""
SIGNIFICANCE = 0.05
"""Largest p of what is called significant."""
TAIL = 0.01
"""Share of the draws on either side beyond which the tail is continued, and not counted."""


class Drawn:
    """The values of a number in bootstrap draws, for its intervals and p-values.

    Args:
        values: [1 + n + k] float64: the number, n draws, and k values without one training each. Draws that are not finite
            (without any episode) are left out.
        freedom: degrees of freedom of the scenes.
        left_out: numbers of trainings of the variants that the last k values are of.
    """

    def __init__(self, values: np.ndarray, freedom: float = np.inf, left_out: Sequence[int] = ()) -> None:
        end = len(values) - sum(left_out)
        drawn = values[1:end]
        self._drawn = np.sort(drawn[np.isfinite(drawn)])
        self.freedom = self._pool_freedom(freedom, values[end:], left_out)

    def _pool_freedom(self, freedom: float, without: np.ndarray, left_out: Sequence[int]) -> float:
        if not left_out or not len(self._drawn):
            return freedom
        counts = np.asarray(left_out)
        starts = np.cumsum(counts) - counts
        deviations = without - np.repeat(np.add.reduceat(without, starts) / counts, counts)
        between = (counts - 1) / counts * np.add.reduceat(np.square(deviations), starts)  # of each variant, the jackknife's
        total = float(self._drawn.var())
        rest = max(total - float(between.sum()), 0.0)
        squares = rest**2 / freedom + float((np.square(between) / (counts - 1)).sum())
        return total**2 / squares if squares > 0 else freedom

    def interval(self, level: float = LEVEL) -> tuple[float, float]:
        """Ends of the interval that holds the true value in the share `level` of cases; with 1, of all that was drawn."""
        if not len(self._drawn):
            return np.nan, np.nan
        if level >= 1:
            return float(self._drawn[0]), float(self._drawn[-1])
        share = (1 + level) / 2
        reach = float(ndtri(share) if np.isinf(self.freedom) else stdtrit(self.freedom, share))
        return self._at_deviate(-reach), self._at_deviate(reach)

    def p_above(self, bound: float) -> float:
        """One-sided p of the number being above a bound; NaN draws alone give 1.

        The lower end of the interval of level 1 - 2 p lies on the bound.
        """
        return self._p(bound, int(np.searchsorted(self._drawn, bound, "right")), 1)

    def p_below(self, bound: float) -> float:
        """One-sided p of the number being below a bound."""
        return self._p(bound, len(self._drawn) - int(np.searchsorted(self._drawn, bound, "left")), -1)

    def _p(self, bound: float, beyond: int, sign: int) -> float:
        """p of the number lying on the side `sign` of a bound, beyond which (or on which) so many draws lie."""
        if not len(self._drawn):
            return 1.0
        share = beyond / len(self._drawn)
        if TAIL <= share <= 1 - TAIL:
            z = -float(ndtri(share))
        else:
            edge = TAIL if share < TAIL else 1 - TAIL
            middle, end = self._quantile(0.5), self._quantile(edge if sign > 0 else 1 - edge)
            if end == middle:
                return 0.0 if sign * bound < sign * middle else 1.0
            z = -float(ndtri(edge)) * (middle - bound) / (middle - end)
        return float(ndtr(-z) if np.isinf(self.freedom) else stdtr(self.freedom, -z))

    def _at_deviate(self, z: float) -> float:
        """Value at a normal deviate of the draws, continued beyond TAIL."""
        share = float(ndtr(z))
        if TAIL <= share <= 1 - TAIL:
            return self._quantile(share)
        edge = TAIL if z < 0 else 1 - TAIL
        middle, end = self._quantile(0.5), self._quantile(edge)
        return middle + (end - middle) * z / float(ndtri(edge))

    def _quantile(self, share: float) -> float:
        place = share * (len(self._drawn) - 1)
        below = int(place)
        above = min(below + 1, len(self._drawn) - 1)
        low, high = float(self._drawn[below]), float(self._drawn[above])
        return low + (high - low) * (place - below)


def holm(p_values: Sequence[float] | np.ndarray) -> np.ndarray:
    """p-values [n] float64, adjusted for being n (Holm 1979, "A simple sequentially rejective multiple test procedure").

    Those at most SIGNIFICANCE are significant with a chance of at most SIGNIFICANCE that any of them is by mistake, however
    the tests depend on one another.
    """
    given = np.asarray(p_values, np.float64)
    order = np.argsort(given, kind="stable")
    steps = np.maximum.accumulate(given[order] * (len(given) - np.arange(len(given))))
    adjusted = np.empty(len(given))
    adjusted[order] = np.minimum(steps, 1)
    return adjusted

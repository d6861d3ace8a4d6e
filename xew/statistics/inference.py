"""Intervals and p-values of drawn numbers, and their correction for several tests.

An interval and a p-value are two readings of the same draws. The share of draws beyond a bound is taken for the tail of a
Student's t with the degrees of freedom that the number has, and not of a normal distribution (the expanded percentile interval
of Hesterberg 2015, "What teachers should know about the bootstrap"), so intervals of few scenes are as wide as they have
to be. Beyond the outermost draws the tail is continued in proportion to the distance from their median.

Where training runs are drawn too, the variances between runs are given, and what is left is that of the scenes. The inverse of
the degrees of freedom is the mean of the parts' inverses, weighted by their variances. Satterthwaite (1946, "An approximate
distribution of estimates of variance components") weights by squared variances, which errs in the far tails that corrections
for several tests ask for, where one part has no more than two or four degrees of freedom.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri, stdtr, stdtrit

LEVEL = 0.95
"""Share of cases in which an interval holds the true value."""
SIGNIFICANCE = 0.05
"""Largest p of what is called significant."""
DRAWS = 9999
"""Number of bootstrap draws. SciPy's default: by chance, an end of an interval is off by 3 % of the mean's standard error."""
SEED = 0
"""Seed of all draws: two tables with as many scenes of each task see the same draws."""
TAIL = 0.01
"""Share of the draws on either side beyond which the tail is continued, and not counted."""


class Component(NamedTuple):
    """A part of a number's variance."""

    variance: float
    freedom: float
    """Degrees of freedom of its estimate."""


class Drawn:
    """The values of a number in bootstrap draws, for its intervals and p-values.

    Args:
        values: [1 + n] float64: the number, and n draws. Draws that are not finite (without any episode) are left out.
        freedom: degrees of freedom of the scenes.
        between: the parts of the variance that are between training runs.
    """

    def __init__(self, values: np.ndarray, freedom: float = np.inf, between: Sequence[Component] = ()) -> None:
        drawn = values[1:]
        self._drawn = np.sort(drawn[np.isfinite(drawn)])
        self.freedom = self._pool_freedom(freedom, between)

    def _pool_freedom(self, freedom: float, between: Sequence[Component]) -> float:
        if not between or not len(self._drawn):
            return freedom
        total = max(float(self._drawn.var()), sum(component.variance for component in between))
        if not total > 0:
            return freedom
        of_runs = [component.variance / total for component in between]
        inverse = (1 - sum(of_runs)) / freedom + sum(share / own for share, (_, own) in zip(of_runs, between, strict=True))
        return 1 / inverse if inverse > 0 else np.inf

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

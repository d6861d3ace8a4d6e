"""Pearson's r over few robots or many bodies: its p and its interval.

Every r has the same p: the share of pairings of distances with scores whose |r| is as large. All pairings are tried where they
are few, else DRAWS of them at random.
"""

from collections.abc import Callable
from functools import lru_cache
from itertools import permutations, product

import numpy as np
from scipy.stats import BootstrapMethod, bootstrap, pearsonr

from xew.statistics.inference import DRAWS, LEVEL, SEED

FEW = 7
"""Largest number of robots of which all pairings are tried; there are 5,040 of seven."""


def pearson(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Pearson's r [...] float64 over the last axis of `x` and `y` [... n]; other axes broadcast.

    NaN where one of the two does not vary.
    """
    x, y = (values - values.mean(axis=-1, keepdims=True) for values in (x, y))
    with np.errstate(invalid="ignore"):
        return (x * y).sum(axis=-1) / np.sqrt((x**2).sum(axis=-1) * (y**2).sum(axis=-1))


def interval_of_r(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Ends of the 95 % interval of r of many pairs [n] float64, which are drawn with replacement (BCa bootstrap)."""
    resampling = BootstrapMethod(n_resamples=DRAWS, method="BCa", rng=np.random.default_rng(SEED))
    low, high = pearsonr(x, y).confidence_interval(LEVEL, method=resampling)
    return float(low), float(high)


def interval_of_difference(first: np.ndarray, second: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Ends of the 95 % interval of r(first, y) - r(second, y), each [n] float64, over draws of triples (BCa bootstrap)."""

    def difference(first: np.ndarray, second: np.ndarray, y: np.ndarray, axis: int = -1) -> np.ndarray:
        return pearson(first, y) - pearson(second, y)

    drawn = bootstrap(
        (first, second, y),
        difference,
        paired=True,
        vectorized=True,
        n_resamples=DRAWS,
        confidence_level=LEVEL,
        rng=np.random.default_rng(SEED),
    )
    return float(drawn.confidence_interval.low), float(drawn.confidence_interval.high)


def partial_r(r: float, with_third: float, between: float) -> float:
    """r of two numbers, given a third: from their r, that of the first with the third, and that of the second with it."""
    return float((r - with_third * between) / np.sqrt((1 - with_third**2) * (1 - between**2)))


@lru_cache(maxsize=4)
def list_orders(count: int) -> np.ndarray:
    """[m n] int, orders of n scores, as they stand first: all if there are at most FEW, else also DRAWS at random."""
    if count <= FEW:
        return np.array(list(permutations(range(count))))
    drawn = np.tile(np.arange(count), (DRAWS, 1))
    return np.concatenate([np.arange(count)[None], np.random.default_rng(SEED).permuted(drawn, axis=1)])


def permutation_p(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Two-sided p of Pearson's r over the last axis [... n].

    All orders of the scores are equally likely if distance says nothing. Ties up to rounding count as as large.
    """
    others = np.abs(pearson(x[..., None, :], y[..., list_orders(y.shape[-1])]))
    return (others >= np.abs(pearson(x, y))[..., None] - 1e-12).mean(axis=-1)


def exact_p(statistic: Callable[[np.ndarray], np.ndarray], scores: np.ndarray) -> float:
    """The same of any statistic of scores [... 5] float64 that are paired with robots."""
    others = np.abs(statistic(scores[list_orders(len(scores))]))
    return float((others >= np.abs(statistic(scores)) - 1e-12).mean())


def every_draw(count: int, least: int) -> np.ndarray:
    """[n count] int, all draws with replacement of `count` units, with at least `least` different units."""
    return np.array([drawn for drawn in product(range(count), repeat=count) if len(set(drawn)) >= least])

"""Bootstrap draws of scenes or tasks, the mean of scores in every draw, and the interval of such means.

The unit that is drawn is by default the scene, a (task, seed). It is drawn with all its models, robots and metrics together,
because they share its layout: every mean of one score table sees the same draws, so that whatever is computed of several means
is paired by scene. An interval then says what other scenes of these tasks would give. Where tasks are drawn instead, with
all their scenes, it says what other tasks would give.

A second level (training seeds, then scenes) is a product of two matrices of `draw_units`, and belongs here.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
import pandas as pd

DRAWS = 9999
"""Number of bootstrap draws. SciPy's default: by chance, an end of an interval is off by 3 % of the mean's standard error."""
LEVEL = 0.95
"""Share of the draws that an interval holds."""
MIN_SCENES = 6
"""Least number of scenes (or of tasks, where tasks are drawn) that have an interval and a verdict.

With six, all differences have one sign by chance in 3 % of cases, with five in 6 %. Percentile intervals of few scenes are too
narrow all the same: where there is no difference, 15 % of six scenes leave out 0, 11 % of ten, 8 % of twenty, 5 % of a hundred
(of two it would be 50 %).
"""
SEED = 0
"""Seed of all draws: two tables of as many scenes see the same draws."""
UNITS = {"scene": ("task", "seed"), "task": ("task",)}
"""Columns that name a unit, by what is drawn."""
COLUMNS_AT_ONCE = 128
"""Number of means that are drawn together, which bounds the memory."""


@dataclass(frozen=True)
class Mean:
    """A mean over episodes, and what it could as well have been."""

    values: np.ndarray
    """[1 + n] float64, the mean itself, then the mean in each of n draws; NaN in a draw without any episode."""
    count: int
    """Number of episodes; 0 where it is not known (printed means)."""
    scenes: int | None
    """Number of scenes or tasks that these episodes are of; None where the values are not drawn over any (printed means)."""

    @property
    def value(self) -> float:
        return float(self.values[0])

    def interval(self, level: float = LEVEL) -> tuple[float, float]:
        """Ends of the interval; NaN where there are fewer than MIN_SCENES scenes."""
        if self.scenes is not None and self.scenes < MIN_SCENES:
            return np.nan, np.nan
        return interval(self.values, level)


class Units:
    """The units of a score table that are drawn, in order, each with a number from 0.

    Args:
        rows: columns task and seed; the whole table, so that all of its means see the same draws.
        kind: what is drawn, a key of UNITS.
    """

    def __init__(self, rows: pd.DataFrame, kind: str = "scene") -> None:
        self.kind = kind
        self._names = list(UNITS[kind])
        self._keys = pd.MultiIndex.from_frame(rows[self._names].drop_duplicates().sort_values(self._names))

    def __len__(self) -> int:
        return len(self._keys)

    def numbers(self, index: pd.MultiIndex) -> np.ndarray:
        """[n] int, the number of the unit of each row of a table's index, which has the levels task and seed."""
        return self._keys.get_indexer(pd.MultiIndex.from_frame(index.to_frame(index=False)[self._names]))


def bootstrap_means(values: np.ndarray, numbers: np.ndarray, unit_count: int) -> Iterator[Mean | None]:
    """The mean of each column of scores, with its value in every bootstrap draw; None for a column without any score.

    A column's result does not depend, to the last bit, on the columns beside it or on the order of the rows.

    Args:
        values: [n c] float, scores of n episodes; NaN where there is none.
        numbers: [n] int, the number of each episode's unit, as `Units.numbers` gives it.
        unit_count: number of units of the whole table. Those without a score in a column are drawn too.
    """
    for first in range(0, values.shape[1], COLUMNS_AT_ONCE):
        yield from _draw_block(values[:, first : first + COLUMNS_AT_ONCE].astype(np.float64), numbers, unit_count)


def _draw_block(values: np.ndarray, numbers: np.ndarray, unit_count: int) -> Iterator[Mean | None]:
    # `scipy.stats.bootstrap` gives the same up to chance, but gathers every drawn score: on two cores, a mean over 500 scenes
    # took it 79 ms (among 128, in batches of 100 draws) to 1.1 s (alone), and this 4 ms. All columns share the draws, and a
    # draw is a row of a matrix.
    held = np.isfinite(values)
    lowest = np.min(values, axis=0, where=held, initial=np.inf)
    lowest = np.where(np.isfinite(lowest), lowest, 0)
    counts, sums = np.zeros((2, unit_count, values.shape[1]))
    np.add.at(counts, numbers, held)
    np.add.at(sums, numbers, _round_for_exact_sums(np.where(held, values - lowest, 0), unit_count * counts.max(axis=0)))
    weights = draw_units(unit_count)
    full = counts[0, 0] if counts.size and np.ptp(counts) == 0 else 0  # then every draw holds as many episodes
    drawn = np.full(counts.shape[1], unit_count * full) if full else weights @ counts
    means = lowest + weights @ sums / np.where(drawn > 0, drawn, np.nan)
    for i in range(values.shape[1]):
        scenes = int((counts[:, i] > 0).sum())
        yield Mean(means[:, i], int(counts[:, i].sum()), scenes) if scenes else None


def _round_for_exact_sums(values: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Round values [n c] >= 0 so that any sum of at most `terms` [c] of a column's values is exact in float64.

    Sums are then the same in any order, so that a mean is the same alone and among others, however matrices are multiplied.
    """
    _, exponent = np.frexp(values.max(axis=0, initial=0) * np.maximum(terms, 1))
    unit = np.ldexp(1.0, exponent - 52)
    return np.round(values / unit) * unit


@lru_cache(maxsize=4)
def draw_units(count: int) -> np.ndarray:
    """[1 + DRAWS count] float64, how often each unit is drawn: once each in the first row, then at random with replacement."""
    drawn = np.random.default_rng(SEED).multinomial(count, np.full(count, 1 / count), DRAWS)
    weights = np.concatenate([np.ones((1, count)), drawn])
    weights.setflags(write=False)
    return weights


def every_draw(count: int, least: int) -> np.ndarray:
    """[n count] int, all draws with replacement of so few units that none need be left to chance.

    Args:
        count: number of units.
        least: least number of different units in a draw.
    """
    return np.array([drawn for drawn in product(range(count), repeat=count) if len(set(drawn)) >= least])


def interval(values: np.ndarray, level: float = LEVEL) -> tuple[float, float]:
    """Ends of the share `level` of drawn values [1 + n]; the first is the point and does not count.

    Values that do not exist (a draw without any episode) are left out.
    """
    low, high = np.nanquantile(values[1:], [(1 - level) / 2, (1 + level) / 2]).tolist()
    return low, high

"""Bootstrap draws of scenes or tasks, and the mean of scores in every draw.

The unit that is drawn is by default the scene, a (task, seed), within its task. It is drawn with all its models, robots and
metrics together, because they share its layout: every mean of one score table sees the same draws, so whatever is computed
of several means is paired by scene. An interval then says what other scenes of these tasks would give. Where tasks are drawn
instead, with all their scenes, it says what other tasks would give.

Of n units of a stratum (a task), n - 1 are drawn and count n / (n - 1) each, so the variance of a mean over the draws has
no bias however few they are (Rao and Wu 1988, "Resampling inference with complex survey data").
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np
import pandas as pd

from xew.protocol import FAULT_STRIDE
from xew.statistics.inference import DRAWS, SEED
from xew.statistics.means import Mean, fixed_mean

UNITS = {"scene": ("task", "seed"), "task": ("task",)}
COLUMNS_AT_ONCE = 128
"""Number of means that are drawn together, which bounds the memory."""


class Units:
    """The units of a score table that are drawn, in order, each with a number from 0.

    Args:
        rows: columns task and seed; the whole table, so all of its means see the same draws.
        kind: what is drawn, a key of UNITS.
    """

    def __init__(self, rows: pd.DataFrame, kind: str = "scene") -> None:
        self.kind = kind
        self._names = list(UNITS[kind])
        self._keys = pd.MultiIndex.from_frame(self._units(rows).drop_duplicates().sort_values(self._names))
        tasks = self._keys.get_level_values("task").to_list() if kind == "scene" else [""] * len(self._keys)
        self.strata = find_strata(tasks)

    def __len__(self) -> int:
        return len(self._keys)

    def numbers(self, index: pd.MultiIndex) -> np.ndarray:
        """[n] int, the number of the unit of each row of a table's index, which has the levels task and seed."""
        return self._keys.get_indexer(pd.MultiIndex.from_frame(self._units(index.to_frame(index=False))))

    def _units(self, rows: pd.DataFrame) -> pd.DataFrame:
        """The names of the units of rows: all commands in a scene, faulty ones too, are drawn with their scene."""
        units = rows[self._names]
        return units.assign(seed=units["seed"] % FAULT_STRIDE) if "seed" in units else units


def find_strata(tasks: Sequence[str]) -> tuple[int, ...]:
    """The stratum that each unit is drawn within, numbered from 0: its task.

    Tasks of one unit have nothing to draw and form one stratum together, or with the smallest other where there is one alone.
    """
    _, codes, sizes = np.unique(np.asarray(tasks, dtype=str), return_inverse=True, return_counts=True)
    alone = sizes == 1
    if alone.sum() == 1 and len(sizes) > 1:
        alone[np.argmin(np.where(alone, np.inf, sizes))] = True
    strata = np.where(alone[codes], -1, codes)
    return tuple(np.unique(strata, return_inverse=True)[1].tolist())


def bootstrap_means(
    values: np.ndarray, numbers: np.ndarray, strata: tuple[int, ...], draws: int = DRAWS
) -> Iterator[Mean | None]:
    """The mean of each column of scores with its value in every bootstrap draw; None for a column without scores.

    A column's result does not depend on other columns or on the order of rows, to the last bit.

    Args:
        values: [n c] float, scores of n episodes; NaN where there is none.
        numbers: [n] int, number of each episode's unit (`Units.numbers`).
        strata: stratum of each unit of the whole table (`Units.strata`).
        draws: number of draws.
    """
    for first in range(0, values.shape[1], COLUMNS_AT_ONCE):
        yield from _draw_block(values[:, first : first + COLUMNS_AT_ONCE].astype(np.float64), numbers, strata, draws)


def _draw_block(values: np.ndarray, numbers: np.ndarray, strata: tuple[int, ...], draws: int) -> Iterator[Mean | None]:
    # `scipy.stats.bootstrap` gives the same up to chance, but gathers every drawn score: on two cores, a mean over 500 scenes
    # took it 79 ms (among 128, in batches of 100 draws) to 1.1 s (alone), and this 4 ms. All columns share the draws, and a
    # draw is a row of a matrix.
    unit_count = len(strata)
    held = np.isfinite(values)
    lowest = np.min(values, axis=0, where=held, initial=np.inf)
    lowest = np.where(np.isfinite(lowest), lowest, 0)
    counts, sums = np.zeros((2, unit_count, values.shape[1]))
    np.add.at(counts, numbers, held)
    np.add.at(sums, numbers, _round_for_exact_sums(np.where(held, values - lowest, 0), unit_count * counts.max(axis=0)))
    full = counts[0, 0] if counts.size and np.ptp(counts) == 0 else 0  # then every draw holds as many episodes
    groups = draw_units(strata, draws)
    total = sum(scale * (weights @ sums[members]) for members, scale, weights in groups)
    drawn = (
        np.full(counts.shape[1], unit_count * full)
        if full
        else sum(scale * (weights @ counts[members]) for members, scale, weights in groups)
    )
    means = lowest + total / np.where(drawn > 0, drawn, np.nan)
    scored = counts > 0
    sizes = (counts.sum(axis=0).astype(int), scored.sum(axis=0), _freedom(scored, strata))
    columns = np.ascontiguousarray(means.T)
    for values_drawn, count, scenes, freedom in zip(columns, *(size.tolist() for size in sizes), strict=True):
        yield fixed_mean(values_drawn, count, scenes, freedom) if scenes else None


def _freedom(scored: np.ndarray, strata: tuple[int, ...]) -> np.ndarray:
    """Degrees of freedom [c] of means over the units that are scored [n c]: one less than the units of each stratum.

    Strata with one scored unit count as one stratum together.
    """
    in_stratum = np.zeros((max(strata) + 1, scored.shape[1]))
    np.add.at(in_stratum, np.asarray(strata), scored)
    alone = (in_stratum == 1).sum(axis=0)
    return np.maximum(np.maximum(in_stratum - 1, 0).sum(axis=0) + np.maximum(alone - 1, 0), 1)


def _round_for_exact_sums(values: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Round values [n c] >= 0 so any sum of at most `terms` [c] of a column's values is exact in float64.

    Sums are then the same in any order, so a mean is the same alone and among others, however matrices are multiplied.
    """
    _, exponent = np.frexp(values.max(axis=0, initial=0) * np.maximum(terms, 1))
    unit = np.ldexp(1.0, exponent - 52)
    return np.round(values / unit) * unit


@lru_cache(maxsize=4)
def draw_units(strata: tuple[int, ...], draws: int = DRAWS) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]:
    """Number of times that each unit is drawn within its stratum: once in the first row, then at random with replacement.

    Returns:
        For each size n of strata: numbers of their units [m] int; weight of a drawn unit [1 + draws 1] float64, 1 and then n /
            (n - 1); and number of draws of it [1 + draws m] float64, n - 1 in total for each stratum.
    """
    rng, codes = np.random.default_rng(SEED), np.asarray(strata)
    sizes = np.bincount(codes)
    drawn = np.ones((1 + draws, len(codes)))
    for stratum, size in enumerate(sizes):
        if size > 1:
            drawn[1:, codes == stratum] = rng.multinomial(size - 1, np.full(size, 1 / size), draws)
    groups = []
    for size in np.unique(sizes):
        members = np.flatnonzero(sizes[codes] == size)
        scale = np.full((1 + draws, 1), size / max(size - 1, 1))
        scale[0] = 1
        weights = np.ascontiguousarray(drawn[:, members])
        for array in (members, scale, weights):
            array.setflags(write=False)
        groups.append((members, scale, weights))
    return tuple(sorted(groups, key=lambda group: group[0][0]))

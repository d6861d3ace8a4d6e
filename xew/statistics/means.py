"""Means of scores, and numbers computed of several means, with their value in every bootstrap draw.

A number of several variants is computed within the training seeds that all of them have; where they have none in common, of all
runs of each. Several seeds are drawn jointly. A single seed carries the spread between runs of other variants (`runs.py`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from xew.statistics.inference import LEVEL, Component, Drawn
from xew.statistics.runs import RunSpread, draw_normals, draw_seeds

MIN_SCENES = 6
"""Least number of scenes (or of tasks, where tasks are drawn) that have an interval and a verdict.

With six, all differences have one sign by chance in 3 % of cases, with five in 6 %.
"""


@dataclass(frozen=True, eq=False)
class Part:
    """A mean over episodes, with its value in every draw of scenes, for each training run."""

    runs: Mapping[int | None, np.ndarray]
    """[1 + n] float64 by training seed: the mean itself and in each of n draws (NaN in a draw without any episode). The key of
    what was not trained (baselines, printed means) is None."""
    count: int
    """Number of episodes; 0 where it is not known (printed means)."""
    scenes: int | None
    """Number of scenes or tasks that these episodes are of; None where the values are not drawn over any (printed means)."""
    freedom: float = np.inf
    """Degrees of freedom of the scenes: scenes less tasks."""
    spread: RunSpread | None = None
    """Spread that a single run carries; None where it stands for itself."""

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(sorted(seed for seed in self.runs if seed is not None))

    def average(self, seeds: Sequence[int]) -> np.ndarray:
        """[1 + n] float64, the mean over some runs in every draw of scenes."""
        chosen = [self.runs[seed] for seed in seeds] or list(self.runs.values())
        return chosen[0] if len(chosen) == 1 else np.stack(chosen).sum(axis=0) / len(chosen)

    def draw(self, seeds: tuple[int, ...]) -> np.ndarray:
        """[1 + n] float64, the mean over some runs in every draw of runs and scenes."""
        if len(seeds) < 2:
            values = self.average(seeds)
            return values * (1 + sum(self.deviations(seeds, len(values) - 1))) if self.spread and seeds else values
        values = np.stack([self.runs[seed] for seed in seeds], axis=1)
        return (values * draw_seeds(seeds, len(values) - 1)).sum(axis=1) / len(seeds)

    def deviations(self, seeds: tuple[int, ...], draws: int) -> tuple[np.ndarray, np.ndarray]:
        """What a single run may deviate by in every draw, as shares [1 + n]: common to all variants of a seed, and its own."""
        if self.spread is None or len(seeds) != 1:
            return np.zeros(1 + draws), np.zeros(1 + draws)
        return self.spread.draw_common(seeds[0], draws), self.spread.draw_own(seeds[0], draws)


def _first(*values: np.ndarray) -> np.ndarray:
    return values[0]


@dataclass(frozen=True, eq=False)
class Mean:
    """A mean over episodes, or a number computed of several, with its value in every bootstrap draw."""

    parts: tuple[Part, ...]
    function: Callable[..., np.ndarray] = _first
    """Maps an array [1 + n] float64 for each part to one such array."""
    bounds: tuple[float, float] = (-np.inf, np.inf)
    """Range of what is possible, which intervals do not leave."""

    @property
    def count(self) -> int:
        return min(part.count for part in self.parts)

    @property
    def scenes(self) -> int | None:
        return min((part.scenes for part in self.parts if part.scenes is not None), default=None)

    @property
    def freedom(self) -> float:
        return min(part.freedom for part in self.parts)

    @property
    def trainings(self) -> int:
        """Least number of training runs that the number rests on; 0 where none is known."""
        return min((len(seeds) for seeds in self.seeds if seeds), default=0)

    @cached_property
    def seeds(self) -> tuple[tuple[int, ...], ...]:
        """Training seeds of each part: those that all trained parts have, or all of each if they share none."""
        of_parts = [set(part.seeds) for part in self.parts if part.seeds]
        shared = tuple(sorted(set.intersection(*of_parts))) if of_parts else ()
        return tuple((shared or part.seeds) if part.seeds else () for part in self.parts)

    @cached_property
    def values(self) -> np.ndarray:
        """[1 + n] float64: the number itself, and its value in each of n draws of training runs and scenes."""
        values = self._compute([part.draw(seeds) for part, seeds in zip(self.parts, self.seeds, strict=True)])
        lacking = sum(variance for _, variance in self._between)
        return values + np.sqrt(lacking) * draw_normals("lacking", len(values) - 1) if lacking > 0 else values

    @property
    def value(self) -> float:
        return float(self.values[0])

    def interval(self, level: float = LEVEL) -> tuple[float, float]:
        """Ends of the interval, within the bounds; NaN where there are fewer than MIN_SCENES scenes."""
        if self.scenes is not None and self.scenes < MIN_SCENES:
            return np.nan, np.nan
        low, high = np.clip(self._drawn.interval(level), *self.bounds)
        return float(low), float(high)

    def p_above(self, bound: float, level: float = LEVEL) -> float:
        """One-sided p of the number being above a bound, see `Drawn.p_above`; 1 where there are fewer than MIN_SCENES scenes.

        With the level 1 it is 0 where all that was drawn lies above the bound, else 1.
        """
        if self.scenes is not None and self.scenes < MIN_SCENES:
            return 1.0
        return float(not self.interval(level)[0] > bound) if level >= 1 else self._drawn.p_above(bound)

    def p_below(self, bound: float, level: float = LEVEL) -> float:
        """One-sided p of the number being below a bound."""
        if self.scenes is not None and self.scenes < MIN_SCENES:
            return 1.0
        return float(not self.interval(level)[1] < bound) if level >= 1 else self._drawn.p_below(bound)

    def within(self, bounds: tuple[float, float]) -> "Mean":
        """The same mean, of a metric with this range."""
        return replace(self, bounds=bounds)

    def of_scenes(self) -> np.ndarray:
        """[1 + n] float64, the number and its value in each draw of scenes alone, of the same runs."""
        return self._compute([part.average(seeds) for part, seeds in zip(self.parts, self.seeds, strict=True)])

    def spread_of_runs(self, count: int) -> list[Component]:
        """Variances of the number if it rested on so many runs of each variant, by the spread that single runs carry.

        The first is common to the variants of a seed, the second of each run.
        """
        return self._spread([seeds[:1] for seeds in self.seeds], count)

    def _spread(self, single: Sequence[tuple[int, ...]], count: int) -> list[Component]:
        """Variances by the spread of those parts for which a seed is given, as means of so many runs."""
        spreads = [part.spread for part, seeds in zip(self.parts, single, strict=True) if seeds and part.spread]
        if not spreads:
            return []
        points = [part.average(seeds) for part, seeds in zip(self.parts, self.seeds, strict=True)]
        freedoms = (min(spread.common_freedom for spread in spreads), min(spread.own_freedom for spread in spreads))
        found = []
        for kind, freedom in enumerate(freedoms):
            drawn = [
                point[0] * (1 + part.deviations(seeds, len(point) - 1)[kind] / np.sqrt(count))
                for part, seeds, point in zip(self.parts, single, points, strict=True)
            ]
            values = self._compute(drawn)[1:]
            finite = values[np.isfinite(values)]
            found.append(Component(float(finite.var()) if len(finite) else 0.0, freedom))
        return found

    @cached_property
    def _drawn(self) -> Drawn:
        single = self._spread([seeds if len(seeds) == 1 else () for seeds in self.seeds], 1)
        return Drawn(self.values, self.freedom, [*single, *(variance for variance, _ in self._between)])

    @cached_property
    def _between(self) -> list[tuple[Component, float]]:
        """The variance between several runs for each set of seeds, and how much of it their draws lack.

        Two or three runs may be alike by luck, so it is no less than that by the spread that single runs carry.
        """
        found = []
        for seeds in sorted({chosen for chosen in self.seeds if len(chosen) > 1}):
            count = len(seeds)
            without = np.array([self._without(seeds, seed) for seed in seeds])
            with np.errstate(invalid="ignore"):  # where a number is not defined without a run
                own = float((count - 1) / count * np.square(without - without.mean()).sum())  # the jackknife
            carried = self._spread([chosen[:1] if chosen == seeds else () for chosen in self.seeds], count)
            least = sum(component.variance for component in carried)
            if own >= least:
                found.append((Component(own, count - 1), 0.0))
            else:
                found.append((Component(least, max(carried, default=Component(0.0, count - 1)).freedom), least - own))
        return found

    def _without(self, seeds: tuple[int, ...], left_out: int) -> float:
        rest = tuple(seed for seed in seeds if seed != left_out)
        chosen = [rest if own == seeds else own for own in self.seeds]
        return float(self._compute([part.average(own) for part, own in zip(self.parts, chosen, strict=True)])[0])

    def _compute(self, values: Sequence[np.ndarray]) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.function(*values)


def fixed_mean(values: np.ndarray, count: int, scenes: int | None, freedom: float = np.inf) -> Mean:
    """A mean of no training run from values [1 + n] float64; arguments as of `Part`."""
    return Mean((Part({None: values}, count, scenes, freedom),))


def combine(function: Callable[..., np.ndarray], *means: Mean) -> Mean:
    """A number computed from several means of one table, draw by draw, within the training seeds that all of them have.

    `function` maps arrays [1 + n] float64, one for each mean, to one such array.
    """
    ends = np.cumsum([0, *(len(mean.parts) for mean in means)])

    def composed(*values: np.ndarray) -> np.ndarray:
        return function(*(mean.function(*values[ends[i] : ends[i + 1]]) for i, mean in enumerate(means)))

    return Mean(tuple(part for mean in means for part in mean.parts), composed)


def pool_runs(means: Mapping[int, Mean], spread: RunSpread | None = None) -> Mean:
    """The mean of a variant over its training runs, equally weighted, from the mean of each by its seed."""
    first = next(iter(means.values())).parts[0]
    runs: dict[int | None, np.ndarray] = {seed: mean.values for seed, mean in means.items()}
    return Mean((Part(runs, first.count, first.scenes, first.freedom, spread),))

"""The summary of a score table: means with intervals by group of robots, and differences between models with a verdict.

`evaluate` writes it next to the scores, and the report on one run makes its tables of it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Protocol, cast

import numpy as np
import pandas as pd

from xew.protocol import BASELINES, CODEC_TRUTH, GROUND_TRUTH
from xew.statistics.bootstrap import Units, bootstrap_means
from xew.statistics.means import Mean, fixed_mean
from xew.statistics.power import drop_powerless, find_power
from xew.statistics.suites import Suited, strict_metrics
from xew.statistics.verdicts import describe_floors, floor_sources, largest_floor, noise_floor, verdict

Column = tuple[str, str, str]
Codecs = Mapping[str, Sequence[str]]
"""Conditions of the truth through the codecs of each model."""
EPISODE = ["task", "seed", "robot"]
MEANS = ["robot", "dimension", "metric", "unit", "model", "condition", "mean", "low", "high", "episodes"]
MEANS += ["truth", "noise", "versus_truth"]
PAIRS = ["robot", "metric", "model", "condition", "other", "other_condition", "difference", "low", "high", "episodes"]
PAIRS += ["noise", "verdict", "decides"]


class Summarized(Suited, Protocol):
    """Properties of a metric that a summary needs."""

    @property
    def dimension(self) -> str:
        """Group of metrics."""

    @property
    def unit(self) -> str:
        """Unit of the score."""

    @property
    def higher_is_better(self) -> bool:
        """Direction of the metric."""

    @property
    def best(self) -> float | None:
        """Best score; None or infinite where there is none."""

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest score that is possible; may be infinite."""

    @property
    def estimated(self) -> bool:
        """Whether it needs an estimator."""

    @property
    def leaves_tasks(self) -> bool:
        """Whether tasks without power leave its mean."""


@dataclass(frozen=True)
class Summary:
    """The means of some models' scores and the differences between them, for each group of robots."""

    means: pd.DataFrame
    """robot dimension metric unit model condition mean low high episodes truth noise versus_truth; `robot` names the group."""
    pairs: pd.DataFrame
    """robot metric model condition other other_condition difference low high episodes noise verdict decides: model minus other.
    `decides` is False for a metric of the suite paper whose counterpart in the suite strict was graded."""
    unit: str
    """Unit that was resampled, a key of UNITS."""
    floors: str
    power: pd.DataFrame
    """Power of each task for each metric (`find_power`); tasks without it are in no mean and no difference."""


def measure_power(rows: pd.DataFrame, metrics: Mapping[str, Summarized]) -> pd.DataFrame:
    """The power of each task for each metric whose mean tasks may leave (`find_power`)."""
    return find_power(rows, {name: m.best for name, m in metrics.items() if m.leaves_tasks and m.best is not None})


def summarize(
    rows: pd.DataFrame,
    metrics: Mapping[str, Summarized],
    groups: Mapping[str, Sequence[str]],
    codecs: Codecs,
    unit: str = "scene",
) -> Summary:
    """Summarize a score table.

    Args:
        rows: model condition task seed robot metric value; the whole table, so all means share their draws.
        metrics: by name, in the order of the means.
        groups: robots that are pooled, by the name of the group.
        codecs: conditions of the truth through each model's codec (`floor_sources`).
        unit: unit to resample, a key of UNITS.
    """
    power, units, replaced = measure_power(rows, metrics), Units(rows, unit), strict_metrics(metrics)
    models = [model for model in rows["model"].unique() if model not in BASELINES]
    rows = drop_powerless(rows, power)
    means: list[tuple[Any, ...]] = []
    pairs: list[tuple[Any, ...]] = []
    for group, robots in groups.items():
        table = _pivot(rows[rows["robot"].isin(robots)], list(metrics))
        columns = _columns(table)
        bootstrapped = dict(zip(columns, _bootstrap(table.to_numpy(), table, units), strict=True))
        floors = {column: _find_floor(column, bootstrapped, codecs, metrics[column[0]]) for column in columns}
        compared = _compare_pairs(table, floors, units, metrics)
        verdicts = {pair[:3]: pair[-1] for pair in compared if pair[3] == GROUND_TRUTH}
        means += [
            (group, *_mean_row(column, bootstrapped, metrics), floors[column], verdicts.get(column, "")) for column in columns
        ]
        pairs += [(group, *pair, pair[0] not in replaced) for pair in compared]
    return Summary(
        pd.DataFrame(means, columns=MEANS), pd.DataFrame(pairs, columns=PAIRS), unit, describe_floors(models, codecs), power
    )


def _pivot(rows: pd.DataFrame, metrics: Sequence[str]) -> pd.DataFrame:
    """A row per episode, a column per (metric, model, condition): metrics in order, models before baselines."""
    table = rows.pivot(index=EPISODE, columns=["metric", "model", "condition"], values="value")
    ranks, places = ({name: rank for rank, name in enumerate(names)} for names in (BASELINES, metrics))
    order = sorted(_columns(table), key=lambda c: (places[c[0]], ranks.get(c[1], -1), c[1:]))
    return table.reindex(columns=pd.MultiIndex.from_tuples(order, names=table.columns.names)) if order else table


def _columns(table: pd.DataFrame) -> list[Column]:
    return cast(list[Column], list(table.columns))


def _bootstrap(values: np.ndarray, table: pd.DataFrame, units: Units) -> list[Mean]:
    """The mean of each column [n c] of some episodes, which are the rows of a table."""
    means = bootstrap_means(values, units.numbers(cast(pd.MultiIndex, table.index)), units.strata)
    return [mean or fixed_mean(np.full(1, np.nan), 0, 0) for mean in means]


def _find_floor(column: Column, means: Mapping[Column, Mean], codecs: Codecs, info: Summarized) -> float:
    """The noise floor of a model in a metric: of the truth through its codec where that was graded, else of the true video.

    The truth through a codec is its own floor.
    """
    metric, model, condition = column
    sources = [(model, condition)] if model == CODEC_TRUTH else floor_sources(model, codecs)
    graded = [means.get((metric, *source)) for source in sources]
    known: list[Mean | None] = [mean for mean in graded if mean] or [means.get((metric, GROUND_TRUTH, ""))]
    return largest_floor(noise_floor(mean.value if mean else None, info.best, info.estimated) for mean in known)


def _mean_row(column: Column, means: Mapping[Column, Mean], metrics: Mapping[str, Summarized]) -> tuple[Any, ...]:
    metric, model, condition = column
    info, mean, truth = metrics[metric], means[column], means.get((metric, GROUND_TRUTH, ""))
    numbers = (mean.value, *mean.within(info.range).interval(), mean.count, truth.value if truth else math.nan)
    return info.dimension, metric, info.unit, model, condition, *numbers


def _compare_pairs(
    table: pd.DataFrame, floors: Mapping[Column, float], units: Units, metrics: Mapping[str, Summarized]
) -> list[tuple[Any, ...]]:
    """The cells of PAIRS from metric to verdict: each model minus each that comes after it."""
    columns = _columns(table)
    pairs = [(i, j) for i, j in combinations(range(len(columns)), 2) if columns[i][0] == columns[j][0]]
    if not pairs:
        return []
    values, (first, second) = table.to_numpy(), zip(*pairs, strict=True)
    rows = []
    for (i, j), mean in zip(pairs, _bootstrap(values[:, first] - values[:, second], table, units), strict=True):
        a, b = columns[i], columns[j]
        floor, ends = largest_floor((floors[a], floors[b])), mean.interval()
        word = verdict(mean.value, ends, floor, metrics[a[0]].higher_is_better)
        rows.append((*a, *b[1:], mean.value, *ends, mean.count, floor, word))
    return rows

"""The tables in the report on one run: its scores as means, intervals and verdicts, robot by robot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import cast

import numpy as np
import pandas as pd

from xew.analysis.scores import COPY, TRUTH, MetricInfo, Scores, measure_power
from xew.protocol import BASELINES, PASTED_RENDER
from xew.sim_warp.robots import ROBOTS
from xew.statistics import (
    MIN_SCENES,
    UNRESOLVED,
    Mean,
    Units,
    bootstrap_means,
    describe_floors,
    describe_parting,
    describe_power,
    drop_powerless,
    find_parting,
    floor_sources,
    largest_floor,
    noise_floor,
    strict_metrics,
    verdict,
)

ROBOT_TITLES = {key: robot.title for key, robot in ROBOTS.items()}


@dataclass(frozen=True)
class Interval:
    """A mean over episodes and its bootstrap interval; the ends are NaN where there are fewer than MIN_SCENES scenes."""

    mean: float
    low: float
    high: float
    count: int


@dataclass(frozen=True)
class Row:
    """One line of a robot's table."""

    model: str
    condition: str
    scores: dict[str, Interval]
    """Mean and interval of each metric."""
    verdicts: dict[str, str]
    """Verdict on each metric against the frozen first frame, paired by episode; empty for baselines."""
    over_pasting: dict[str, str] = field(default_factory=dict)
    """The same against the pasted render; empty where that was not graded, and for baselines."""

    @property
    def title(self) -> str:
        return " · ".join(filter(None, (BASELINES.get(self.model, self.model), self.condition)))


@dataclass(frozen=True)
class RobotTable:
    """The scores of one robot, or of several that are pooled on purpose."""

    title: str
    robots: tuple[str, ...]
    rows: tuple[Row, ...]
    expected: int | None
    """Episodes that the protocol's data hold for a model; None where the data set was not given."""
    notes: str = ""
    """Sentences that say what the noise floors are of, and which tasks left which means."""

    @property
    def counts(self) -> list[int]:
        """Episodes of each model. Metrics that are not defined for some, as of objects where there is none, lack these."""
        return [max(score.count for score in row.scores.values()) for row in self.rows if row.scores]

    @property
    def count(self) -> int:
        """Episodes of the model that has fewest."""
        return min(self.counts, default=0)

    @property
    def complete(self) -> bool:
        return self.expected is None or all(count == self.expected for count in self.counts)


def robot_title(robot: str) -> str:
    """Its name in print; robots of one's own are called by their key."""
    return ROBOT_TITLES.get(robot, robot)


def mean_interval(scores: pd.Series, units: Units | None = None) -> Interval:
    """Mean of episodes' scores and its bootstrap interval; the same at every call.

    Args:
        scores: indexed by task, seed and robot; scenes (task, seed) are drawn, with all robots that they have.
        units: scenes of the whole table; those of the scores where left out.
    """
    mean = _bootstrap(scores, units)
    return Interval(mean.value, *mean.interval(), mean.count)


def verdict_on(
    model: pd.Series, baseline: pd.Series, higher_is_better: bool, floor: float = 0, units: Units | None = None
) -> str:
    """Is a model better than a baseline on the episodes that both have? See `xew.statistics.verdict`.

    Args:
        model, baseline: their scores, indexed by task, seed and robot.
        higher_is_better: of the metric.
        floor: its noise floor; NaN where it is not known.
        units: as of `mean_interval`.
    """
    difference = (model - baseline).dropna()
    if difference.empty:
        return UNRESOLVED
    mean = _bootstrap(difference, units)
    return verdict(mean.value, mean.interval(), floor, higher_is_better)


def _bootstrap(scores: pd.Series, units: Units | None) -> Mean:
    index = cast(pd.MultiIndex, scores.index)
    units = units or Units(index.to_frame(index=False))
    mean = next(bootstrap_means(scores.to_numpy(np.float64)[:, None], units.numbers(index), units.strata))
    assert mean is not None, "no episode"
    return mean


def robot_table(scores: Scores, title: str, robots: Sequence[str], expected: int | None) -> RobotTable:
    """Rows for all models, then for the baselines."""
    power = measure_power(scores.rows, scores.metrics)
    kept = drop_powerless(scores.rows, power)
    rows = kept[kept["robot"].isin(robots)]
    groups = rows.groupby(["model", "condition"], sort=False)
    by_model = {(str(model), str(condition)): group for (model, condition), group in groups}
    ends = [key for name in BASELINES for key in by_model if key[0] == name]
    order = [key for key in by_model if key[0] not in BASELINES] + ends
    units = Units(scores.rows)
    truth, others = by_model.get((TRUTH, "")), [by_model.get((name, "")) for name in (COPY, PASTED_RENDER)]
    truths = {key: [by_model[s] for s in floor_sources(key[0], scores.codecs) if s in by_model] for key in order}
    built = tuple(_row(key, by_model[key], others, truth, truths[key], scores.metrics, units) for key in order)
    models = list(dict.fromkeys(model for model, _ in order if model not in BASELINES))
    notes = describe_floors(models, scores.codecs), describe_power(power, {m.name: m.title for m in scores.metrics})
    return RobotTable(title, tuple(robots), built, expected, " ".join(filter(None, notes)))


def _row(
    key: tuple[str, str],
    group: pd.DataFrame,
    others: Sequence[pd.DataFrame | None],
    truth: pd.DataFrame | None,
    truths: Sequence[pd.DataFrame],
    metrics: Sequence[MetricInfo],
    units: Units,
) -> Row:
    """A row of a table.

    `others` are the rows of the baselines that it is compared with, `truths` those of the truth through its codec, and `truth`
    those of the true video.
    """
    values = {metric.name: _by_episode(group, metric.name) for metric in metrics}
    verdicts: list[dict[str, str]] = [{} for _ in others]
    floors = {metric.name: _pair_floor(truths, truth, metric, units) for metric in metrics} if key[0] not in BASELINES else {}
    for found, other in zip(verdicts, others, strict=True):
        if other is None or not floors:
            continue
        for metric in metrics:
            baseline = _by_episode(other, metric.name)
            floor, own = floors[metric.name], values[metric.name]
            found[metric.name] = verdict_on(own, baseline, metric.higher_is_better, floor, units)
    intervals = {name: mean_interval(series, units) for name, series in values.items() if len(series)}
    return Row(*key, intervals, *verdicts)


def _pair_floor(truths: Sequence[pd.DataFrame], truth: pd.DataFrame | None, metric: MetricInfo, units: Units) -> float:
    """The floor of a difference of a model, whose codec's truth is in `truths`, from the frozen first frame."""
    own = [rows for rows in truths if (rows["metric"] == metric.name).any()]
    return largest_floor(_noise_floor(rows, metric, units) for rows in (*own, truth))


def _noise_floor(truth: pd.DataFrame | None, metric: MetricInfo, units: Units) -> float:
    graded = _by_episode(truth, metric.name) if truth is not None else pd.Series()
    return noise_floor(_bootstrap(graded, units).value if len(graded) else None, metric.best, metric.estimated)


def _by_episode(rows: pd.DataFrame, metric: str) -> pd.Series:
    return rows[rows["metric"] == metric].set_index(["task", "seed", "robot"])["value"]


def finding(held_out: Sequence[RobotTable], seen: Sequence[RobotTable], metrics: Sequence[MetricInfo]) -> list[str]:
    """The result in sentences, one for each held-out robot and model: against a frozen frame, and how far from the truth."""
    compared = [(table, row) for table in held_out for row in table.rows if row.verdicts]
    sentences = []
    for table, row in compared:
        twins = [(other, twin) for other in seen for twin in other.rows if _same_model(twin, row)]
        episodes = f"{table.count} episode{'s' if table.count != 1 else ''}"
        sentences.append(
            f"{table.title} ({episodes}): {row.title} {_compare(row, metrics)}.{_distance_left((table, row), twins, metrics)}"
            f"{_parting(row, metrics)}"
        )
    return sentences or ["No model has been compared with the frozen first frame yet: grade without --no-baselines."]


def _same_model(a: Row, b: Row) -> bool:
    return (a.model, a.condition) == (b.model, b.condition)


def _distance_left(
    own: tuple[RobotTable, Row], seen: Sequence[tuple[RobotTable, Row]], metrics: Sequence[MetricInfo], metric: str = "lpips"
) -> str:
    shares = [progress(table, row, metric) for table, row in (own, *seen)]
    if shares[0] is None:
        return ""
    title = next((info.title for info in metrics if info.name == metric), metric)
    beside = f" (on seen robots {1 - shares[1]:.0%})" if len(shares) > 1 and shares[1] is not None else ""
    return f" In {title} it is at {1 - shares[0]:.0%} of that frame's distance from the truth{beside}."


def progress(table: RobotTable, row: Row, metric: str) -> float | None:
    """0 where the model's mean is the frozen first frame's, 1 where it is the truth's; None where these are not graded."""
    ends = [other.scores.get(metric) for name in (COPY, TRUTH) for other in table.rows if other.model == name]
    own = row.scores.get(metric)
    if own is None or len(ends) < 2 or ends[0] is None or ends[1] is None or ends[0].mean == ends[1].mean:
        return None
    return (own.mean - ends[0].mean) / (ends[1].mean - ends[0].mean)


def _compare(row: Row, metrics: Sequence[MetricInfo]) -> str:
    """What a model beats and what not, by the metrics that decide: of a frozen first frame, and of the pasted render."""
    if all(np.isnan(score.low) for score in row.scores.values()):
        return f"cannot be told from a frozen first frame by fewer than {MIN_SCENES} scenes"
    parts = _compare_with("a frozen first frame", row.verdicts, metrics)
    return "; it ".join([*parts, *_compare_with("the pasted render, which learned nothing,", row.over_pasting, metrics)])


def _compare_with(title: str, verdicts: Mapping[str, str], metrics: Sequence[MetricInfo]) -> list[str]:
    """Phrases on one comparison, of reported metrics that decide: those that are resolved by name, the others by number."""
    shown = strict_metrics({metric.name: metric for metric in metrics})
    deciding = [metric for metric in _reported(metrics) if metric.name not in shown]
    found = {word: [m.title for m in deciding if verdicts.get(m.name) == word] for word in ("better", "worse", "unresolved")}
    phrases = (("better", "beats"), ("worse", "falls behind"))
    parts = [f"{phrase} {title} on {_join(found[word])}" for word, phrase in phrases if found[word]]
    unresolved = found["unresolved"]
    if unresolved and not parts:
        parts.append(f"cannot be told from {title} on any of {len(unresolved)} metrics")
    elif unresolved:
        parts[-1] += f" ({len(unresolved)} not resolved)"
    return parts


def _reported(metrics: Sequence[MetricInfo]) -> Sequence[MetricInfo]:
    """The metrics that sentences name: those that are reported, or all of a table that does not say which are."""
    return [metric for metric in metrics if metric.reported] or metrics


def _parting(row: Row, metrics: Sequence[MetricInfo]) -> str:
    """Sentence on where the suites part against a frozen first frame, or ''; strict decides."""
    named = {metric.name: metric for metric in metrics}
    pairs = find_parting(row.verdicts, {metric.name: metric for metric in _reported(metrics)})
    titled = {named[name].title: word for name, word in row.verdicts.items()}
    text = describe_parting([(named[strict].title, named[paper].title) for strict, paper in pairs], titled)
    return f" The suites part on {text}; strict decides." if pairs else ""


def _join(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def flat_summary(tables: Sequence[RobotTable], metrics: Sequence[MetricInfo]) -> pd.DataFrame:
    """All tables as one tidy frame: robots model condition metric mean low high episodes expected versus_frozen versus_pasted
    decides."""
    shown = strict_metrics({metric.name: metric for metric in metrics})
    return pd.DataFrame(
        {
            "robots": " ".join(table.robots),
            "model": row.model,
            "condition": row.condition,
            "metric": name,
            "mean": score.mean,
            "low": score.low,
            "high": score.high,
            "episodes": score.count,
            "expected": table.expected,
            "versus_frozen": row.verdicts.get(name, ""),
            "versus_pasted": row.over_pasting.get(name, ""),
            "decides": name not in shown,
        }
        for table in tables
        for row in table.rows
        for name, score in row.scores.items()
    )

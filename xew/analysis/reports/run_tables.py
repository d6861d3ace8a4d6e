"""The report on one run: its scores as tables, robot by robot, and its result in sentences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from xew.analysis.scores import COPY, TRUTH, MetricInfo, Scores
from xew.analysis.tables.table import format_share
from xew.protocol import BASELINES, PASTED_RENDER
from xew.statistics import (
    BETTER,
    MIN_SCENES,
    UNRESOLVED,
    WORSE,
    Summary,
    describe_parting,
    describe_power,
    find_parting,
    strict_metrics,
    summarize,
)


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
    verdicts: dict[str, str]
    """Verdict on each metric against the frozen first frame, paired by episode; empty for baselines."""
    over_pasting: dict[str, str] = field(default_factory=dict)
    """The same against the pasted render; empty where that was not graded, and for baselines."""

    @property
    def is_few(self) -> bool:
        """Whether it has too few scenes for an interval of any score."""
        return bool(self.scores) and all(np.isnan(score.low) for score in self.scores.values())

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


def robot_table(scores: Scores, title: str, robots: Sequence[str], expected: int | None) -> RobotTable:
    """Rows for all models, then for the baselines."""
    metrics = {metric.name: metric for metric in scores.metrics}
    summary = summarize(scores.rows, metrics, {title: robots}, scores.codecs)
    own = scores.rows[scores.rows["robot"].isin(robots)]
    summarized = set(zip(summary.means["model"], summary.means["condition"], strict=True))
    keys = own[["model", "condition"]].drop_duplicates().itertuples(index=False, name=None)
    graded = [key for key in keys if key in summarized]
    order = [
        *(key for key in graded if key[0] not in BASELINES),
        *(key for name in BASELINES for key in graded if key[0] == name),
    ]
    known = [name for name in (COPY, PASTED_RENDER) if (name, "") in graded]
    notes = summary.floors, describe_power(summary.power, {m.name: m.title for m in scores.metrics})
    rows = tuple(_row(key, summary, list(metrics), known) for key in order)
    return RobotTable(title, tuple(robots), rows, expected, " ".join(filter(None, notes)))


def _row(key: tuple[str, str], summary: Summary, metrics: Sequence[str], baselines: Sequence[str]) -> Row:
    means, pairs = (t[(t["model"] == key[0]) & (t["condition"] == key[1])] for t in (summary.means, summary.pairs))
    scores = {
        row["metric"]: Interval(row["mean"], row["low"], row["high"], row["episodes"]) for row in means.to_dict("records")
    }
    against: dict[str, dict[str, str]] = {COPY: {}, PASTED_RENDER: {}}
    for name in baselines if key[0] not in BASELINES else ():
        own = pairs[pairs["other"] == name]
        against[name] = dict.fromkeys(metrics, UNRESOLVED) | dict(zip(own["metric"], own["verdict"], strict=True))
    return Row(*key, scores, against[COPY], against[PASTED_RENDER])


def finding(held_out: Sequence[RobotTable], seen: Sequence[RobotTable], metrics: Sequence[MetricInfo]) -> list[str]:
    """The result in sentences, for each held-out robot and model: compared with both baselines, and with the truth."""
    compared = [(table, row) for table in held_out for row in table.rows if row.verdicts]
    sentences = []
    for table, row in compared:
        twins = [
            (other, twin) for other in seen for twin in other.rows if (twin.model, twin.condition) == (row.model, row.condition)
        ]
        episodes = f"{table.count} episode{'s' if table.count != 1 else ''}"
        sentences.append(
            f"{table.title} ({episodes}): {row.title} {_compare(row, metrics)}{_error_left((table, row), twins, metrics)}"
            f"{_parting(row, metrics)}"
        )
    return sentences or ["No model has been compared with the frozen first frame: grade without --no-baselines."]


def _error_left(
    own: tuple[RobotTable, Row], seen: Sequence[tuple[RobotTable, Row]], metrics: Sequence[MetricInfo], metric: str = "lpips"
) -> str:
    shares = [progress(table, row, metric) for table, row in (own, *seen)]
    if shares[0] is None:
        return ""
    title = next((info.title for info in metrics if info.name == metric), metric)
    others = f" ({format_share(1 - shares[1])} on seen robots)" if len(shares) > 1 and shares[1] is not None else ""
    return f" Its {title} error is {format_share(1 - shares[0])} of the frozen first frame's{others}."


def progress(table: RobotTable, row: Row, metric: str) -> float | None:
    """0 where the model's mean is the frozen first frame's, 1 where it is the truth's; None where these are not graded."""
    ends = [other.scores.get(metric) for name in (COPY, TRUTH) for other in table.rows if other.model == name]
    own = row.scores.get(metric)
    if own is None or len(ends) < 2 or ends[0] is None or ends[1] is None or ends[0].mean == ends[1].mean:
        return None
    return (own.mean - ends[0].mean) / (ends[1].mean - ends[0].mean)


def _compare(row: Row, metrics: Sequence[MetricInfo]) -> str:
    """Sentences on a model compared with the frozen first frame and the paste baseline, by the metrics that decide."""
    if row.is_few:
        return f"cannot be compared with the frozen first frame: fewer than {MIN_SCENES} scenes were graded."
    text = f"{_compare_with('the frozen first frame', row.verdicts, metrics)}."
    return text + (f" It {_compare_with('the paste baseline', row.over_pasting, metrics)}." if row.over_pasting else "")


def _compare_with(title: str, verdicts: Mapping[str, str], metrics: Sequence[MetricInfo]) -> str:
    """Predicate on one comparison, of reported metrics that decide: the resolved ones by name, the others by number."""
    replaced = strict_metrics({metric.name: metric for metric in metrics})
    deciding = [metric for metric in _reported(metrics) if metric.name not in replaced]
    titles = {word: [m.title for m in deciding if verdicts.get(m.name) == word] for word in (BETTER, WORSE, UNRESOLVED)}
    parts = [f"{word} on {_join(titles[word])}" for word in (BETTER, WORSE) if titles[word]]
    if not parts:
        return f"differs from {title} on none of {len(titles[UNRESOLVED])} metrics"
    first = parts[0].replace(" on ", f" than {title} on ", 1)
    unresolved = f" ({len(titles[UNRESOLVED])} not resolved)" if titles[UNRESOLVED] else ""
    return f"is {' and '.join([first, *parts[1:]])}{unresolved}"


def _reported(metrics: Sequence[MetricInfo]) -> Sequence[MetricInfo]:
    """The metrics that sentences name: those that are reported, or all of a table that does not say which are."""
    return [metric for metric in metrics if metric.reported] or metrics


def _parting(row: Row, metrics: Sequence[MetricInfo]) -> str:
    """Sentence on metrics whose verdicts differ between the suites, or ''."""
    named = {metric.name: metric for metric in metrics}
    pairs = find_parting(row.verdicts, {metric.name: metric for metric in _reported(metrics)})
    titled = {named[name].title: word for name, word in row.verdicts.items()}
    text = describe_parting([(named[strict].title, named[paper].title) for strict, paper in pairs], titled)
    return f" The suites disagree on {text}; strict decides." if pairs else ""


def _join(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def flat_summary(tables: Sequence[RobotTable], metrics: Sequence[MetricInfo]) -> pd.DataFrame:
    """All tables as one tidy frame: robots model condition metric mean low high episodes expected versus_frozen versus_pasted
    decides."""
    replaced = strict_metrics({metric.name: metric for metric in metrics})
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
            "decides": name not in replaced,
        }
        for table in tables
        for row in table.rows
        for name, score in row.scores.items()
    )

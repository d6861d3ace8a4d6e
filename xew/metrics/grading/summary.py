"""The summary that `evaluate` writes beside scores: means with intervals by robot, and differences of models with a verdict.

Draws, intervals, noise floors and verdicts are those of `xew.statistics`, as in the report. The ground truth that the floor
is of is graded softened, as any prediction is (`jobs.SOFTNESS`).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, cast

import numpy as np
import pandas as pd

from xew.metrics import METRICS
from xew.names import plain_markdown
from xew.protocol import BASELINES, CODEC_TRUTH, COPY_FIRST_FRAME, GROUND_TRUTH
from xew.statistics import (
    DRAWS,
    LEVEL,
    MIN_SCENES,
    UNITS,
    Mean,
    Units,
    bootstrap_means,
    describe_floors,
    describe_parting,
    describe_power,
    drop_powerless,
    find_parting,
    find_power,
    floor_sources,
    largest_floor,
    noise_floor,
    strict_metrics,
    verdict,
)

PAIRS_SHOWN = 6
"""Largest number of pairs of models in the Markdown summary; where there are more, they stand in the file of pairs alone."""


Column = tuple[str, str, str]
"""Metric, model and condition."""
Codecs = Mapping[str, Sequence[str]]
"""Conditions of the truth through the codecs of each model."""


@dataclass(frozen=True)
class Summary:
    """The means of some models' scores and the differences between them, robot by robot."""

    means: pd.DataFrame
    """robot dimension metric unit model condition mean low high episodes truth noise versus_truth."""
    pairs: pd.DataFrame
    """robot metric model condition other other_condition difference low high episodes noise verdict decides: model minus other.
    `decides` is False for a metric of the suite paper beside that of the suite strict which stands in its place."""
    unit: str
    """Unit that was resampled, a key of UNITS."""
    floors: str
    """Sentence that says what the noise floors are of."""
    power: pd.DataFrame
    """Power of each task for each metric (`xew.statistics.find_power`); tasks without it are in no mean and no difference."""


def summarize(rows: pd.DataFrame, unit: str = "scene", robots_first: Sequence[str] = ()) -> Summary:
    """Summarize a score table.

    Args:
        rows: model condition task seed robot metric value; in the attribute `codecs` the truth through whose codec is the noise
            floor of which model (`xew.statistics.floor_sources`).
        unit: what is resampled, a key of UNITS.
        robots_first: robots that come before the others.
    """
    power = find_power(rows, {name: _best(name) for name in rows["metric"].unique() if METRICS[name].leaves_tasks})
    units, codecs = Units(rows, unit), cast(Codecs, rows.attrs.get("codecs", {}))
    # Metrics of the suite paper that are shown beside those of the suite strict, as the report counts them.
    beside = strict_metrics({name: METRICS[name] for name in rows.attrs.get("metrics", rows["metric"].unique())})
    means: list[dict[str, Any]] = []
    pairs: list[dict[str, Any]] = []
    rows = drop_powerless(rows, power)
    for robot in sorted(rows["robot"].unique(), key=lambda robot: (robot not in robots_first, robot)):
        found, compared = _summarize_robot(str(robot), _table(rows[rows["robot"] == robot]), units, codecs, beside)
        means += found
        pairs += compared
    floors = describe_floors([model for model in rows["model"].unique() if model not in BASELINES], codecs)
    return Summary(pd.DataFrame(means, columns=MEANS), pd.DataFrame(pairs, columns=PAIRS), unit, floors, power)


MEANS = ["robot", "dimension", "metric", "unit", "model", "condition", "mean", "low", "high", "episodes"]
MEANS += ["truth", "noise", "versus_truth"]
PAIRS = ["robot", "metric", "model", "condition", "other", "other_condition", "difference", "low", "high", "episodes"]
PAIRS += ["noise", "verdict", "decides"]


def _table(rows: pd.DataFrame) -> pd.DataFrame:
    """One robot's values: a row per (task, seed), a column per (metric, model, condition); NaN where there is none."""
    table = rows.pivot(index=["task", "seed"], columns=["metric", "model", "condition"], values="value")
    ranks = {name: rank for rank, name in enumerate(BASELINES)}
    order = sorted(_columns(table), key=lambda c: (list(METRICS).index(c[0]), ranks.get(c[1], -1), c[1:]))
    return table.reindex(columns=pd.MultiIndex.from_tuples(order, names=table.columns.names))


def _columns(table: pd.DataFrame) -> list[Column]:
    """Metric, model and condition of each column."""
    return cast(list[Column], list(table.columns))


def _bootstrap(values: np.ndarray, table: pd.DataFrame, units: Units) -> list[Mean]:
    """The mean of each column [n c] of a robot's episodes, which are the rows of its table."""
    means = bootstrap_means(values, units.numbers(cast(pd.MultiIndex, table.index)), units.strata)
    return [mean or Mean(np.full(1, np.nan), 0, 0) for mean in means]


def _best(metric: str) -> float:
    low, high = METRICS[metric].range
    return high if METRICS[metric].higher_is_better else low


def _find_floor(column: Column, means: Mapping[Column, Mean], codecs: Codecs) -> float:
    """The noise floor of a model in a metric: of the truth through its codec where that was graded, else of the true video.

    The truth through a codec is its own floor.
    """
    metric, model, condition = column
    sources = [(model, condition)] if model == CODEC_TRUTH else floor_sources(model, codecs)
    graded = [means.get((metric, *source)) for source in sources]
    known: list[Mean | None] = [mean for mean in graded if mean] or [means.get((metric, GROUND_TRUTH, ""))]
    return largest_floor(noise_floor(m.value if m else None, _best(metric), METRICS[metric].estimated) for m in known)


def _summarize_robot(
    robot: str, table: pd.DataFrame, units: Units, codecs: Codecs, beside: Collection[str]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of the means and of the pairs of one robot."""
    means = dict(zip(_columns(table), _bootstrap(table.to_numpy(), table, units), strict=True))
    truths = {metric: means.get((metric, GROUND_TRUTH, "")) for metric, _, _ in means}
    floors = {column: _find_floor(column, means, codecs) for column in means}
    pairs = _compare_pairs(robot, table, floors, units, beside)
    verdicts = {(p["metric"], p["model"], p["condition"]): p["verdict"] for p in pairs if p["other"] == GROUND_TRUTH}
    rows = []
    for (metric, model, condition), mean in means.items():
        truth, (low, high) = truths[metric], mean.interval()
        names = (robot, METRICS[metric].dimension, metric, METRICS[metric].unit, model, condition)
        numbers = (mean.value, low, high, mean.count, truth.value if truth else math.nan)
        versus_truth = verdicts.get((metric, model, condition), "")
        rows.append(dict(zip(MEANS, (*names, *numbers, floors[metric, model, condition], versus_truth), strict=True)))
    return rows, pairs


def _compare_pairs(
    robot: str, table: pd.DataFrame, floors: dict[Column, float], units: Units, beside: Collection[str]
) -> list[dict[str, Any]]:
    """Rows of the pairs of one robot: each model minus each that comes after it."""
    metrics = dict.fromkeys(metric for metric, _, _ in floors)
    columns = [pair for metric in metrics for pair in combinations([c for c in _columns(table) if c[0] == metric], 2)]
    if not columns:
        return []
    place = {column: i for i, column in enumerate(_columns(table))}
    values, ones, others = table.to_numpy(), [place[a] for a, _ in columns], [place[b] for _, b in columns]
    differences = values[:, ones] - values[:, others]
    rows = []
    for (a, b), mean in zip(columns, _bootstrap(differences, table, units), strict=True):
        floor, ends = largest_floor((floors[a], floors[b])), mean.interval()
        found = verdict(mean.value, ends, floor, METRICS[a[0]].higher_is_better)
        decides = a[0] not in beside
        rows.append(dict(zip(PAIRS, (robot, *a, *b[1:], mean.value, *ends, mean.count, floor, found, decides), strict=True)))
    return rows


def to_markdown(summary: Summary, with_pairs: bool = True) -> str:
    """For people: a robot after the other, a line per metric, a column per model; then the differences between models."""
    lines = [
        "# Scores",
        "",
        f"Mean over episodes [{LEVEL:.0%} interval; bootstrap, {DRAWS} draws of the {' and '.join(UNITS[summary.unit])}].",
        f"Fewer than {MIN_SCENES} {summary.unit}s have no interval, and nothing is resolved by them.",
        "Noise: by how much the estimators miss the metric's best on the true video. ~ marks a mean that cannot be told from",
        "the true video's; a difference is unresolved where its interval holds 0 or it is no larger than the noise.",
        "Metrics of the suite strict decide; verdicts of the paper's definitions beside them stand in parentheses.",
        *filter(None, [summary.floors, describe_power(summary.power, {})]),
    ]
    for robot, means in summary.means.groupby("robot", sort=False):
        lines += ["", f"## {robot}", "", *_mean_lines(means)]
        lines += _pair_lines(summary.pairs[summary.pairs["robot"] == robot]) if with_pairs else []
    return "\n".join(lines) + "\n"


def _mean_lines(means: pd.DataFrame) -> list[str]:
    by_metric: dict[str, list[Any]] = {}
    row: Any
    for row in means.itertuples():
        by_metric.setdefault(row.metric, []).append(row)
    models = list(dict.fromkeys(zip(means["model"], means["condition"], strict=True)))
    lines = [f"| metric | {' | '.join(title(model) for model in models)} | noise |", "|---" * (len(models) + 2) + "|"]
    for metric, rows in by_metric.items():
        by_model = {(row.model, row.condition): row for row in rows}
        cells = [_mean_text(by_model.get(model)) for model in models]
        unit = f" [{rows[0].unit}]" if rows[0].unit else ""
        arrow = "↑" if METRICS[metric].higher_is_better else "↓"
        own = [row for row in rows if row.model not in BASELINES]
        noise = dict.fromkeys(_noise_text(row.noise) for row in own or rows)
        lines.append(f"| {metric}{unit} {arrow} | {' | '.join(cells)} | {' or '.join(noise)} |")
    return lines


def _noise_text(noise: float) -> str:
    return "not graded" if math.isnan(noise) else f"{noise:.3g}"


def _mean_text(row: Any) -> str:
    if row is None:
        return ""
    interval = "" if math.isnan(row.low) else f" [{row.low:.4g}, {row.high:.4g}]"
    mark = " ~" if row.versus_truth == "unresolved" and interval else ""
    return f"{row.mean:.4g}{interval}{mark}"


def _pair_lines(pairs: pd.DataFrame) -> list[str]:
    """Differences between models and from the frozen first frame; those from the truth stand as marks in the means."""
    pairs = pairs[(pairs["model"] != COPY_FIRST_FRAME) & (pairs["other"] != GROUND_TRUTH)]
    groups = pairs.groupby(["model", "condition", "other", "other_condition"], sort=False)
    if len(groups) > PAIRS_SHOWN:
        return ["", f"{len(groups)} pairs of models: see the file of pairs."]
    lines = []
    for (model, condition, other, other_condition), found in groups:
        names = f"{title((model, condition))} minus {title((other, other_condition))}"
        lines += ["", f"{names}, paired:", "", "| metric | difference | verdict |", "|---|---|---|"]
        row: Any
        for row in found.itertuples():
            interval = "" if math.isnan(row.low) else f" [{row.low:+.4g}, {row.high:+.4g}]"
            word = row.verdict if row.decides else f"({row.verdict})"
            lines.append(f"| {row.metric} | {row.difference:+.4g}{interval} | {word} |")
        verdicts = dict(zip(found["metric"], found["verdict"], strict=True))
        if parting := find_parting(verdicts, {metric: METRICS[metric] for metric in verdicts}):
            lines += ["", f"The suites part on {describe_parting(parting, verdicts)}; strict decides."]
    return lines


def title(model: tuple[Any, ...]) -> str:
    """A model's name for people, with its condition."""
    return plain_markdown(" · ".join(part for part in model if part).replace("|", "/"))

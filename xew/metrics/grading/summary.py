"""Metrics, what a score table says: means with intervals, and differences between models with a verdict.

Resampling unit: by default the scene, a (task, seed). It is drawn with all its models, robots and metrics together, because
they share its layout: differences are paired. An interval then says what other scenes of these tasks would give. With
`unit="task"` whole tasks are drawn with all their scenes: what other tasks would give.

Noise: metrics that need an estimator do not give even the true video their best score, softened as any prediction is
(jobs.SOFTNESS). By how much they miss it, on the mean over the same robot's episodes, is the noise of the metric, and a
difference that is smaller is unresolved, whatever its interval. Metrics that compare pixels directly have none.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, cast

import numpy as np
import pandas as pd

from xew.metrics import METRICS
from xew.metrics.grade import ESTIMATED

RESAMPLES = 9999
LEVEL = 0.95
COLUMNS_AT_ONCE = 128
"""So many means are resampled together, which bounds the memory."""
FROZEN, TRUTH = "copy_first_frame", "ground_truth"
UNITS = {"scene": ["task", "seed"], "task": ["task"]}
PAIRS_SHOWN = 6
"""More pairs of models than this stand in the file of pairs alone."""


@dataclass(frozen=True)
class Summary:
    """What the scores of some models come to, robot by robot."""

    means: pd.DataFrame
    """robot dimension metric unit model condition mean low high episodes truth noise versus_truth."""
    pairs: pd.DataFrame
    """robot metric model condition other other_condition difference low high episodes noise verdict: model minus other."""
    unit: str
    """What was resampled, a key of UNITS."""


def summarize(rows: pd.DataFrame, unit: str = "scene", robots_first: Sequence[str] = ()) -> Summary:
    """Summarize a score table.

    Args:
        rows: model condition task seed robot metric value.
        unit: what is resampled, a key of UNITS.
        robots_first: robots that come before the others.
    """
    means: list[dict[str, Any]] = []
    pairs: list[dict[str, Any]] = []
    for robot in sorted(rows["robot"].unique(), key=lambda robot: (robot not in robots_first, robot)):
        table = _table(rows[rows["robot"] == robot])
        noise = {str(metric): _noise(table, str(metric)) for metric in table.columns.unique("metric")}
        compared = _pairs(str(robot), table, noise, unit)
        pairs += compared
        means += _means(str(robot), table, noise, unit, compared)
    return Summary(pd.DataFrame(means, columns=MEANS), pd.DataFrame(pairs, columns=PAIRS), unit)


MEANS = ["robot", "dimension", "metric", "unit", "model", "condition", "mean", "low", "high", "episodes"]
MEANS += ["truth", "noise", "versus_truth"]
PAIRS = ["robot", "metric", "model", "condition", "other", "other_condition", "difference", "low", "high", "episodes"]
PAIRS += ["noise", "verdict"]


def _table(rows: pd.DataFrame) -> pd.DataFrame:
    """One robot's values: a row per (task, seed), a column per (metric, model, condition); NaN where there is none."""
    table = rows.pivot(index=["task", "seed"], columns=["metric", "model", "condition"], values="value")
    order = sorted(_columns(table), key=lambda c: (list(METRICS).index(c[0]), c[1] in (FROZEN, TRUTH), c[1:]))
    return table.reindex(columns=pd.MultiIndex.from_tuples(order, names=table.columns.names))


def _columns(table: pd.DataFrame) -> list[tuple[str, str, str]]:
    """Metric, model and condition of each column."""
    return cast(list[tuple[str, str, str]], list(table.columns))


def _noise(table: pd.DataFrame, metric: str) -> float:
    """How far the estimators leave the true video from the metric's best; NaN where the true video was not graded."""
    if METRICS[metric].inputs not in ESTIMATED:
        return 0.0
    low, high = METRICS[metric].range
    return abs(_truth(table, metric) - (high if METRICS[metric].higher_is_better else low))


def _truth(table: pd.DataFrame, metric: str) -> float:
    """The mean that the true video itself is given; NaN where it was not graded."""
    column = (metric, TRUTH, "")
    return float(table[column].mean()) if column in table.columns else math.nan


def _means(
    robot: str, table: pd.DataFrame, noise: dict[str, float], unit: str, pairs: list[dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    verdicts = {(p["metric"], p["model"], p["condition"]): p["verdict"] for p in pairs if p["other"] == TRUTH}
    low, high = bootstrap(table.to_numpy(), _units(table, unit))
    for i, (metric, model, condition) in enumerate(_columns(table)):
        values = table.iloc[:, i]
        yield {
            "robot": robot,
            "dimension": METRICS[metric].dimension,
            "metric": metric,
            "unit": METRICS[metric].unit,
            "model": model,
            "condition": condition,
            "mean": float(values.mean()),
            "low": low[i],
            "high": high[i],
            "episodes": int(values.count()),
            "truth": _truth(table, metric),
            "noise": noise[metric],
            "versus_truth": verdicts.get((metric, model, condition), ""),
        }


def _pairs(robot: str, table: pd.DataFrame, noise: dict[str, float], unit: str) -> list[dict[str, Any]]:
    columns = [pair for metric in noise for pair in combinations([c for c in _columns(table) if c[0] == metric], 2)]
    if not columns:
        return []
    differences = np.stack([(table[a] - table[b]).to_numpy() for a, b in columns], axis=1)
    low, high = bootstrap(differences, _units(table, unit))
    found = []
    for i, (a, b) in enumerate(columns):
        count = int(np.isfinite(differences[:, i]).sum())
        mean = float(np.nanmean(differences[:, i])) if count else math.nan
        found.append(
            dict(zip(PAIRS, (robot, *a, *b[1:], mean, low[i], high[i], count, noise[a[0]]), strict=False))
            | {"verdict": verdict(mean, low[i], high[i], noise[a[0]], METRICS[a[0]].higher_is_better)}
        )
    return found


def verdict(difference: float, low: float, high: float, noise: float, higher_is_better: bool) -> str:
    """Of a mean difference and its interval: better, worse or unresolved.

    Unresolved is what the interval does not tell from 0, what lies within the noise, and what has no interval or noise.
    """
    resolved = (low > 0 or high < 0) and abs(difference) > noise
    return "unresolved" if not resolved else "better" if (difference > 0) == higher_is_better else "worse"


def _units(table: pd.DataFrame, unit: str) -> np.ndarray:
    """[rows] int, the number of the resampling unit that each row belongs to."""
    return table.reset_index()[UNITS[unit]].apply(tuple, axis=1).factorize()[0]


def bootstrap(values: np.ndarray, units: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Percentile intervals at LEVEL of the means of columns whose rows are drawn together, unit by unit.

    The same as `scipy.stats.bootstrap(method="percentile")` column by column up to chance, but all columns share each draw,
    which is then one product of matrices.

    Args:
        values: [n c] float, NaN where a column has no value.
        units: [n] int from 0, rows of one number are drawn together.
        seed: of the draws.

    Returns:
        Lower and upper ends [c]; NaN for a column that has values of one unit only.
    """
    count = int(units.max()) + 1
    draws = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=RESAMPLES).astype(np.float64)
    there = np.isfinite(values)
    sums, counts = (np.zeros((count, values.shape[1])) for _ in range(2))
    np.add.at(sums, units, np.where(there, values, 0))
    np.add.at(counts, units, there)
    ends = np.full((2, values.shape[1]), np.nan)
    enough = np.flatnonzero((counts > 0).sum(axis=0) > 1)
    for columns in (enough[i : i + COLUMNS_AT_ONCE] for i in range(0, len(enough), COLUMNS_AT_ONCE)):
        drawn = draws @ counts[:, columns]
        means = draws @ sums[:, columns] / np.where(drawn > 0, drawn, np.nan)
        ends[:, columns] = np.nanquantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return ends[0], ends[1]


def to_markdown(summary: Summary, with_pairs: bool = True) -> str:
    """For people: a robot after the other, a line per metric, a column per model; then the differences between models."""
    lines = [
        "# Scores",
        "",
        f"Mean over episodes [{LEVEL:.0%} interval; bootstrap, {RESAMPLES} draws of the {' and '.join(UNITS[summary.unit])}].",
        "Noise: by how much the estimators miss the metric's best on the true video. ~ marks a mean that cannot be told from",
        "the true video's; a difference is unresolved where its interval holds 0 or it is no larger than the noise.",
    ]
    for robot, means in summary.means.groupby("robot", sort=False):
        lines += ["", f"## {robot}", "", *_mean_lines(means)]
        lines += _pair_lines(summary.pairs[summary.pairs["robot"] == robot]) if with_pairs else []
    return "\n".join(lines) + "\n"


def _mean_lines(means: pd.DataFrame) -> list[str]:
    models = list(dict.fromkeys(zip(means["model"], means["condition"], strict=True)))
    lines = [f"| metric | {' | '.join(title(model) for model in models)} | noise |", "|---" * (len(models) + 2) + "|"]
    for metric, rows in means.groupby("metric", sort=False):
        by_model = {(row.model, row.condition): row for row in rows.itertuples()}
        cells = [_mean_text(by_model.get(model)) for model in models]
        unit = f" [{rows['unit'].iloc[0]}]" if rows["unit"].iloc[0] else ""
        arrow = "↑" if METRICS[str(metric)].higher_is_better else "↓"
        noise = float(rows["noise"].to_numpy()[0])
        lines.append(
            f"| {metric}{unit} {arrow} | {' | '.join(cells)} | {'not graded' if math.isnan(noise) else f'{noise:.3g}'} |"
        )
    return lines


def _mean_text(row: Any) -> str:
    if row is None:
        return ""
    interval = "" if math.isnan(row.low) else f" [{row.low:.4g}, {row.high:.4g}]"
    mark = " ~" if row.versus_truth == "unresolved" and interval else ""
    return f"{row.mean:.4g}{interval}{mark}"


def _pair_lines(pairs: pd.DataFrame) -> list[str]:
    """Differences between models and from the frozen first frame; those from the truth stand as marks in the means."""
    pairs = pairs[(pairs["model"] != FROZEN) & (pairs["other"] != TRUTH)]
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
            lines.append(f"| {row.metric} | {row.difference:+.4g}{interval} | {row.verdict} |")
    return lines


def title(model: tuple[Any, ...]) -> str:
    """A model's name for people, with its condition."""
    return " · ".join(part for part in model if part).replace("|", "/")

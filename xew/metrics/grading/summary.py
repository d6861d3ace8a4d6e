"""The summary that `evaluate` prints and writes next to its scores, as Markdown.

The ground truth that noise floors are of is graded softened, as any prediction is (`list_jobs.SOFTNESS`).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import pandas as pd

from xew.metrics import METRICS
from xew.names import plain_markdown
from xew.protocol import BASELINES, COPY_FIRST_FRAME, GROUND_TRUTH
from xew.statistics import (
    DRAWS,
    LEVEL,
    MIN_SCENES,
    UNITS,
    Summary,
    describe_parting,
    describe_power,
    find_parting,
    summarize,
)

PAIRS_SHOWN = 6
"""Largest number of pairs of models in the Markdown summary; where there are more, they stand in the file of pairs alone."""


def summarize_robots(rows: pd.DataFrame, unit: str = "scene", robots_first: Sequence[str] = ()) -> Summary:
    """Summarize a score table, each robot by itself.

    Args:
        rows: model condition task seed robot metric value; in the attribute `codecs` the truth through whose codec is the noise
            floor of which model (`xew.statistics.floor_sources`).
        unit: what is resampled, a key of UNITS.
        robots_first: robots that come before the others.
    """
    names = {*rows.attrs.get("metrics", ()), *rows["metric"].unique()}
    robots = sorted(rows["robot"].unique(), key=lambda robot: (robot not in robots_first, robot))
    codecs = cast(Mapping[str, Sequence[str]], rows.attrs.get("codecs", {}))
    metrics = {name: metric for name, metric in METRICS.items() if name in names}
    return summarize(rows, metrics, {str(robot): [robot] for robot in robots}, codecs, unit)


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
        noise = dict.fromkeys("not graded" if math.isnan(row.noise) else f"{row.noise:.3g}" for row in own or rows)
        lines.append(f"| {metric}{unit} {arrow} | {' | '.join(cells)} | {' or '.join(noise)} |")
    return lines


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

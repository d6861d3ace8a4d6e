"""The summary that `evaluate` prints and writes next to its scores, as Markdown."""

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
    Summary,
    describe_parting,
    describe_power,
    find_parting,
    summarize,
)
from xew.statistics.bootstrap import UNITS

PAIRS_SHOWN = 6
"""Largest number of pairs of models in the Markdown summary; more are only in the file of pairs."""


def summarize_robots(rows: pd.DataFrame, unit: str = "scene", robots_first: Sequence[str] = ()) -> Summary:
    """Summarize a score table robot by robot, `robots_first` before the others.

    Args:
        rows: model condition task seed robot metric value; attribute `codecs` as in `xew.statistics.floor_sources`.
        unit: unit to resample, a key of UNITS.
        robots_first: robots at the top.
    """
    names = {*rows.attrs.get("metrics", ()), *rows["metric"].unique()}
    robots = sorted(rows["robot"].unique(), key=lambda robot: (robot not in robots_first, robot))
    codecs = cast(Mapping[str, Sequence[str]], rows.attrs.get("codecs", {}))
    metrics = {name: metric for name, metric in METRICS.items() if name in names}
    return summarize(rows, metrics, {str(robot): [robot] for robot in robots}, codecs, unit)


def to_markdown(summary: Summary, with_pairs: bool = True) -> str:
    """Text for people: for each robot a line per metric and a column per model; then the differences between models."""
    lines = [
        "# Scores",
        "",
        f"Mean over episodes [{LEVEL:.0%} interval; bootstrap, {DRAWS} draws of {' and '.join(UNITS[summary.unit])}].",
        f"With fewer than {MIN_SCENES} {summary.unit}s there are no intervals and no verdicts.",
        "Noise: the estimators' error on the true video. ~ marks a mean that cannot be resolved from the true video's.",
        "A difference is unresolved if its interval contains 0 or if it is no larger than the noise.",
        "Strict metrics decide; verdicts by the paper's definitions are in parentheses.",
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
    low, high = (min(max(end, METRICS[row.metric].range[0]), METRICS[row.metric].range[1]) for end in (row.low, row.high))
    interval = "" if math.isnan(row.low) else f" [{low:.4g}, {high:.4g}]"
    mark = " ~" if row.versus_truth == "unresolved" and interval else ""
    return f"{row.mean:.4g}{interval}{mark}"


def _pair_lines(pairs: pd.DataFrame) -> list[str]:
    """Differences between models and from the frozen first frame; differences from the truth are marks in the means."""
    pairs = pairs[(pairs["model"] != COPY_FIRST_FRAME) & (pairs["other"] != GROUND_TRUTH)]
    groups = pairs.groupby(["model", "condition", "other", "other_condition"], sort=False)
    if len(groups) > PAIRS_SHOWN:
        return ["", f"{len(groups)} pairs of models: see the file *.pairs.csv."]
    lines = []
    for (model, condition, other, other_condition), differences in groups:
        names = f"{title((model, condition))} minus {title((other, other_condition))}"
        lines += ["", f"{names}, paired:", "", "| metric | difference | verdict |", "|---|---|---|"]
        row: Any
        for row in differences.itertuples():
            interval = "" if math.isnan(row.low) else f" [{row.low:+.4g}, {row.high:+.4g}]"
            word = row.verdict if row.decides else f"({row.verdict})"
            lines.append(f"| {row.metric} | {row.difference:+.4g}{interval} | {word} |")
        verdicts = dict(zip(differences["metric"], differences["verdict"], strict=True))
        if parting := find_parting(verdicts, {metric: METRICS[metric] for metric in verdicts}):
            lines += ["", f"The suites disagree on {describe_parting(parting, verdicts)}; strict decides."]
    return lines


def title(model: tuple[Any, ...]) -> str:
    """A model's name for people, with its condition."""
    return plain_markdown(" · ".join(part for part in model if part).replace("|", "/"))


def ranking_to_markdown(ranking: pd.DataFrame) -> str:
    """Text for people of `xew.statistics.rank_policies`: a line per robot and model; empty for an empty table."""
    if ranking.empty:
        return ""
    lines = ["", "## Policy ranking", ""]
    lines += ["Success rates in predicted video against those in the simulator."]
    lines += ["Policies are graded: the expert, then the k-th mildest faulty commands of every scene.", ""]
    lines += ["| robot | model | Pearson's r | Spearman | MMRV | policies | scenes |", "|---|---|---|---|---|---|---|"]
    for (robot, *model), own in ranking.groupby(["robot", "model", "condition"], sort=False):
        cells = [
            ("not defined" if math.isnan(value) else f"{value:.3f}") + ("" if math.isnan(low) else f" [{low:.3f}, {high:.3f}]")
            for value, low, high in own[["value", "low", "high"]].to_numpy(float)
        ]
        counts = own[["policies", "scenes"]].iloc[0]
        lines.append(f"| {robot} | {title(tuple(model))} | {' | '.join(cells)} | {counts['policies']} | {counts['scenes']} |")
    return "\n".join(lines) + "\n"

"""The charts of a study: bars of gains, adaptation against forgetting, distances, error by frame."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from xew.analysis.paper import AXES
from xew.analysis.reports import charts
from xew.analysis.reports.charts import SERIES, SOFT, Chart, Panel, Series
from xew.analysis.scores import COPY, TRUTH, VARIANT, MetricInfo
from xew.analysis.statistics.grades import Grades, PaperGrades, find_variant, paired_means, relative_gain
from xew.analysis.tables.builder import Builder, interval_ends
from xew.analysis.tables.distances import AXIS_TITLES, Distances, unseen_gaps
from xew.analysis.tables.labels import ACTIONS, LADDER, REMEDIES, ROBOT_TITLES, SHORT_ROBOTS
from xew.analysis.tables.table import metric_title
from xew.protocol import BASELINES, FORGETTING_ROBOT, HELD_OUT_ROBOTS, PASTED_RENDER, ROBOT_NAMES, SHOTS, TASK_GROUPS
from xew.statistics import Mean, policy_outcomes

BAR_METRICS = ("lpips", "region_lpips", "mask_iou", "pck")
CURVE_METRIC = "lpips"
OTHER_TASKS = "other tasks"
RATES, RATES_HEIGHT = (-0.04, 1.04), 3.2
"""Ends of axes of success rates, and height of a panel with two of them [inches]."""
MEAN_DISTANCE = "mean distance to the other four"
DASHES: Mapping[str, Literal["--", "-.", ":"]] = {COPY: "--", PASTED_RENDER: "-.", TRUTH: ":"}
ROBOT_COLORS = dict(zip(HELD_OUT_ROBOTS, SERIES, strict=False))


@dataclass(frozen=True)
class GainRows:
    """Rows of a part, whose gain over the row that they start from is drawn."""

    part: str
    title: str
    base: Callable[[str], str]
    """Function from a robot to the row that its gains are measured from."""
    rows: Callable[[str], Mapping[str, str]]
    """Function from a robot to its rows with their labels."""


def _leave_out(base: str, labels: Mapping[str, str]) -> dict[str, str]:
    return {row: label for row, label in labels.items() if row != base}


GAIN_ROWS = (
    GainRows("actions", "against joint pose", lambda _: "joints", lambda _: _leave_out("joints", ACTIONS)),
    GainRows("ladder", "against flow only", lambda _: "none", lambda _: _leave_out("none", LADDER)),
    GainRows("few_shot", "against M = 0", lambda r: f"{r}-0", lambda r: {f"{r}-{shots}": f"M = {shots}" for shots in SHOTS}),
)


def study_charts(builder: Builder, distances: Distances, curves: pd.DataFrame) -> dict[str, Chart]:
    """All charts that have something to draw, by name."""
    made = {f"gains_{gain.part}": gain_chart(builder, gain) for gain in GAIN_ROWS if builder.has_results(gain.part)}
    if builder.has_results("forgetting"):
        made["forgetting"] = forgetting_chart(builder)
    if builder.has_results("remedies"):
        made["remedies"] = remedies_chart(builder)
    by_distance = (distance_chart(builder.ours, distances), gap_chart(builder.ours, distances))
    made |= {chart.name: chart for chart in by_distance if chart}
    for part, labels in (("actions", ACTIONS), ("ladder", LADDER)):
        if builder.has_results(part) and len(curves):
            made[f"frames_{part}"] = frame_chart(curves, part, labels)
    return {name: chart for name, chart in made.items() if chart.panels}


def gain_chart(builder: Builder, gain: GainRows) -> Chart:
    """Relative improvement of each row over the base, a panel for each metric, a bar for each held-out robot."""
    metrics = [metric for metric in BAR_METRICS if metric in builder.ours.metrics]
    data = pd.DataFrame(
        {"metric": metric, "robot": robot, "row": label} | _gain(builder, gain, row, robot, metric)
        for metric in metrics
        for robot in HELD_OUT_ROBOTS
        for row, label in gain.rows(robot).items()
    )

    def draw(axes: Axes, metric: str) -> None:
        labels = list(gain.rows(HELD_OUT_ROBOTS[0]).values())
        groups = []
        for robot in HELD_OUT_ROBOTS:
            chosen = data[(data["metric"] == metric) & (data["robot"] == robot)]
            groups.append((ROBOT_COLORS[robot], chosen[["gain", "low", "high"]].to_numpy(), chosen["paper"].to_numpy()))
        charts.bars(axes, labels, groups, f"better by [%], {gain.title}")

    height = 1.0 + 0.42 * len(gain.rows(HELD_OUT_ROBOTS[0]))
    panels = [Panel(builder.ours.metrics[metric].title, partial(draw, metric=metric), height) for metric in metrics]
    legend = [Series(ROBOT_TITLES[robot], ROBOT_COLORS[robot]) for robot in HELD_OUT_ROBOTS]
    caption = f"Relative improvement {gain.title}; to the right is better. Lines: 95 % intervals, paired by scene and seed."
    if builder.paper:
        legend.append(Series("the paper", charts.INK, "o"))
    return Chart(f"gains_{gain.part}", caption, panels, data, legend)


def forgetting_chart(builder: Builder) -> Chart:
    """LPIPS on the target and on UR5 by the number of demonstrations, a panel for each target."""
    lost = SHORT_ROBOTS[FORGETTING_ROBOT]
    styles: dict[tuple[str, ...], Series] = {
        ("target", "here"): Series("target", SERIES[0]),
        (FORGETTING_ROBOT, "here"): Series(lost, SERIES[1]),
        ("target", "paper"): Series("target, the paper", SERIES[0], "--"),
        (FORGETTING_ROBOT, "paper"): Series(f"{lost}, the paper", SERIES[1], "--"),
    }
    data = pd.DataFrame(_adaptation_rows(builder, {"full": ""}))
    panels = [
        Panel(
            f"Adapted to {ROBOT_TITLES[robot]}",
            partial(_draw_by_shots, data=data[data["target"] == robot], columns=["on", "of"], styles=styles),
        )
        for robot in HELD_OUT_ROBOTS
    ]
    used = set(zip(data["on"], data["of"], strict=True))
    legend = [style for line, style in styles.items() if line in used]
    caption = "What adaptation gains on the target, and what it costs on a robot seen before. Bands: 95 % intervals."
    return Chart("forgetting", caption, panels, data, legend)


def remedies_chart(builder: Builder) -> Chart:
    """LPIPS with and without the remedies by the number of demonstrations: a panel for each target and for UR5 after it."""
    titles = {"full": "all weights", **REMEDIES}
    styles: dict[tuple[str, ...], Series] = {
        (remedy,): Series(title, SERIES[i]) for i, (remedy, title) in enumerate(titles.items())
    }
    data = pd.DataFrame(_adaptation_rows(builder, {"full": "", **{remedy: f"-{remedy}" for remedy in REMEDIES}}))
    data = data[data["of"] == "here"]

    def panel(target: str, on: str) -> Panel:
        title = ROBOT_TITLES[target] if on == "target" else f"{ROBOT_TITLES[on]}, after {SHORT_ROBOTS[target]}"
        chosen = data[(data["target"] == target) & (data["on"] == on)]
        return Panel(title, partial(_draw_by_shots, data=chosen, columns=["remedy"], styles=styles))

    panels = [panel(target, on) for target in HELD_OUT_ROBOTS for on in ("target", FORGETTING_ROBOT)]
    caption = (
        "Adaptation of all weights, with replay and with LoRA: on the new robot, and on one seen before. Bands: 95 % intervals."
    )
    return Chart("remedies", caption, panels, data, list(styles.values()))


def _draw_by_shots(axes: Axes, data: pd.DataFrame, columns: list[str], styles: Mapping[tuple[str, ...], Series]) -> None:
    """Draw LPIPS by the number of demonstrations, a line in the style of each value of some columns."""
    lines = []
    for line, style in styles.items():
        chosen = data[(data[columns] == list(line)).all(axis=1)].dropna(subset="value")
        if len(chosen):
            ends = chosen[["low", "high"]].to_numpy()
            band = None if "paper" in line or np.isnan(ends).any() else ends
            lines.append((style, chosen["shots"].to_numpy(), chosen["value"].to_numpy(), band))
    charts.lines(axes, lines, "demonstrations of each task, M", "LPIPS ↓")
    axes.set_xticks((0, *SHOTS))
    axes.set_ylim(bottom=0)


def _adaptation_rows(builder: Builder, remedies: Mapping[str, str]) -> Iterator[dict[str, object]]:
    """LPIPS before and after each adaptation, on its target and on UR5; `remedies` maps remedies to endings of rows."""
    sources: list[tuple[str, Grades]] = [("here", builder.ours)]
    if builder.paper and set(remedies) == {"full"}:
        sources.append(("paper", builder.paper))
    for target, shots, (remedy, ending) in product(HELD_OUT_ROBOTS, (0, *SHOTS), remedies.items()):
        after = f"{target}-{shots}{ending if shots else ''}"
        places = {
            "target": ("few_shot", after, target),
            FORGETTING_ROBOT: ("forgetting", after if shots else "none", FORGETTING_ROBOT),
        }
        for (on, place), (source, grades) in product(places.items(), sources):
            value, low, high = _mean_and_ends(grades.mean(*place, "lpips"), grades.level)
            row = {"target": target, "remedy": remedy, "shots": shots, "on": on, "of": source}
            yield row | {"value": value, "low": low, "high": high}


def distance_chart(grades: Grades, distances: Distances, metric: str = "lpips") -> Chart | None:
    """A metric by distance, a panel for each axis; None where a fold is missing."""
    means = [grades.mean("loeo", f"loeo_{robot}", robot, metric) if metric in grades.metrics else None for robot in ROBOT_NAMES]
    scores = [mean.value for mean in means if mean is not None]
    if len(scores) < len(ROBOT_NAMES):
        return None
    caption = (
        "Each robot held out in turn. Thick: the line through all five. Thin: the lines without one robot, which show how far "
        "one point carries."
    )
    return _by_distance("distance", caption, distances, distances.axes, metric, scores, metric_title(grades.metrics[metric]))


def gap_chart(grades: Grades, distances: Distances, metric: str = "lpips") -> Chart | None:
    """The gap of each robot in a metric by the paper's two distances; None where a fold is missing."""
    gaps = unseen_gaps(grades, metric)
    if gaps is None:
        return None
    caption = (
        "The gap of each robot: by how much the fold that never saw it is worse on it than those that did. Lines as before. "
        "Ours, and exploratory."
    )
    percent = [100 * gap.value for gap in gaps]
    return _by_distance("distance_gap", caption, distances, AXES, metric, percent, f"gap in {grades.metrics[metric].title} [%]")


def _by_distance(
    name: str, caption: str, distances: Distances, axes: Sequence[str], metric: str, values: Sequence[float], title: str
) -> Chart:
    """Values of the five robots by their distances, a panel for each axis."""
    robots, scores = [ROBOT_TITLES[robot] for robot in ROBOT_NAMES], np.array(values)
    panels = [
        Panel(
            AXIS_TITLES[axis],
            partial(
                charts.scatter, distance=distances.of(axis), score=scores, robots=robots, xlabel=MEAN_DISTANCE, ylabel=title
            ),
        )
        for axis in axes
    ]
    data = pd.DataFrame({"robot": ROBOT_NAMES, metric: scores} | {axis: distances.of(axis) for axis in axes})
    return Chart(name, caption, panels, data)


def frame_chart(curves: pd.DataFrame, part: str, labels: Mapping[str, str]) -> Chart:
    """Mean LPIPS by frame on each held-out robot, a line for each row of a part; bands hold the middle half of the episodes."""
    names = {find_variant(part, row).name: label for row, label in labels.items()}
    chosen = curves[(curves["metric"] == CURVE_METRIC) & curves["robot"].isin(HELD_OUT_ROBOTS)]
    own = chosen[chosen[VARIANT].isin(names)].assign(row=lambda rows: rows[VARIANT].map(names))
    baselines = chosen[chosen["model"].isin([COPY, PASTED_RENDER])].assign(row=lambda rows: rows["model"].map(BASELINES))
    colors = charts.color_of(list(names.values()))
    styles = [Series(label, colors[label]) for label in names.values() if label in set(own["row"])]
    caption = "LPIPS by frame, mean over episodes; bands hold the middle half of them."
    return _chart_by_frame(
        f"frames_{part}", caption, pd.concat([own, baselines]), styles, {CURVE_METRIC: "LPIPS ↓"}, HELD_OUT_ROBOTS
    )


def run_chart(curves: pd.DataFrame, metrics: Sequence[MetricInfo], robots: Sequence[str]) -> Chart:
    """Error of one run by frame, a panel for each metric that has curves and robot; lines are means, bands the middle half."""
    robots = [robot for robot in robots if (curves["robot"] == robot).any()]
    shown = curves[curves["robot"].isin(robots) & curves["metric"].isin([metric.name for metric in metrics])]
    # The truth's PSNR is a cap, not a measurement, and would squeeze everything else flat.
    shown = shown[~((shown["model"] == TRUTH) & (shown["metric"] == "psnr"))]
    shown = shown[~shown["model"].isin(set(BASELINES) - set(DASHES))]
    shown = shown.assign(row=[_run_title(*key) for key in zip(shown["model"], shown["condition"], strict=True)])
    own = [row for row in dict.fromkeys(shown["row"]) if row not in BASELINES.values()]
    styles = [Series(label, color) for label, color in charts.color_of(own).items()]
    caption = "Mean over episodes frame by frame; bands hold the middle half of the episodes."
    titles = {metric.name: metric_title(metric) for metric in metrics}
    chart = _chart_by_frame("curves", caption, shown, styles, titles, robots)
    return replace(chart, columns=len(robots))


def ranking_chart(rows: pd.DataFrame, groups: Mapping[str, Sequence[str]]) -> Chart:
    """Judged against true success rates of policies, a point for each policy and group of tasks; baselines are left out.

    Args:
        rows: of a score table.
        groups: robots that are pooled in a panel, by its title.
    """
    outcomes = policy_outcomes(rows[~rows["model"].isin(BASELINES)])
    group_of = {task: group for group, tasks in TASK_GROUPS.items() for task in tasks}
    outcomes = outcomes.assign(tasks=[group_of.get(task, OTHER_TASKS) for task in outcomes["task"]])
    pooled = pd.concat([outcomes[outcomes["robot"].isin(own)].assign(robots=title) for title, own in groups.items()])
    by_policy = pooled.groupby(["robots", "model", "condition", "tasks", "policy"], sort=False)
    data = by_policy.agg(true=("true", "mean"), judged=("judged", "mean"), episodes=("true", "size")).reset_index()
    colors = charts.color_of([*TASK_GROUPS, OTHER_TASKS])

    def draw(axes: Axes, points: pd.DataFrame) -> None:
        axes.plot([0, 1], [0, 1], color=SOFT, linewidth=0.8)
        for tasks, own in points.groupby("tasks", sort=False):
            axes.scatter(own["true"], own["judged"], s=24, facecolors="none", edgecolors=colors[str(tasks)])
        axes.set(xlim=RATES, ylim=RATES, xlabel="success rate in the simulator", ylabel="judged in predicted video")

    several = len(data[["model", "condition"]].drop_duplicates()) > 1
    panels = [
        Panel(" · ".join(map(str, names if several else names[:1])), partial(draw, points=points), RATES_HEIGHT)
        for names, points in data.groupby(["robots", "model", "condition"], sort=False)
    ]
    legend = [Series(tasks, color, "o") for tasks, color in colors.items() if (data["tasks"] == tasks).any()]
    caption = "A point is a graded policy in one group of tasks. On the line, the judged rate is the true one."
    return Chart("policies", caption, panels, data, legend, columns=len(groups))


def _chart_by_frame(
    name: str, caption: str, rows: pd.DataFrame, styles: Sequence[Series], titles: Mapping[str, str], robots: Sequence[str]
) -> Chart:
    """Means by frame with bands of the middle half of the episodes, a panel for each metric and robot.

    `rows` has the label of the line in its column `row`; baselines are drawn after `styles`.
    """
    grouped = rows.groupby(["metric", "robot", "row", "frame"], sort=False, observed=True)["value"]
    data = pd.DataFrame({"mean": grouped.mean(), "low": grouped.quantile(0.25), "high": grouped.quantile(0.75)}).reset_index()
    drawn = set(data["row"])
    styles = [*styles, *(Series(BASELINES[key], SOFT, dash) for key, dash in DASHES.items() if BASELINES[key] in drawn)]

    def draw(axes: Axes, metric: str, robot: str) -> None:
        lines = []
        for style in styles:
            line = data[(data["metric"] == metric) & (data["robot"] == robot) & (data["row"] == style.label)]
            line = line.sort_values("frame")  # the first episode may lack early frames
            if len(line):
                band = line[["low", "high"]].to_numpy() if style.color != SOFT else None
                lines.append((style, line["frame"].to_numpy(), line["mean"].to_numpy(), band))
        charts.lines(axes, lines, "frame", titles[metric])

    graded = set(zip(data["metric"], data["robot"], strict=True))
    panels = [
        Panel(ROBOT_TITLES.get(robot, robot), partial(draw, metric=metric, robot=robot))
        for metric, robot in product(titles, robots)
        if (metric, robot) in graded
    ]
    return Chart(name, caption, panels, data, styles)


def _run_title(model: str, condition: str) -> str:
    return BASELINES.get(model) or " · ".join(filter(None, (model, condition)))


def _gain(builder: Builder, gain: GainRows, row: str, robot: str, metric: str) -> dict[str, float]:
    base = gain.base(robot)
    values = _relative_gain(builder.ours, gain.part, row, base, robot, metric)
    printed = _relative_gain(builder.paper, gain.part, row, base, robot, metric) if builder.paper else values * np.nan
    return {"gain": values[0], "low": values[1], "high": values[2], "paper": printed[0]}


def _relative_gain(grades: Grades | PaperGrades, part: str, row: str, base: str, robot: str, metric: str) -> np.ndarray:
    """Gain over the base and the ends of its interval [3] float64 [%]; NaN where one of the two is missing."""
    pair = paired_means(grades, part, row, base, robot, metric)
    if pair is None:
        return np.full(3, np.nan)
    gain = relative_gain(*pair, grades.metrics[metric])
    return 100 * np.array([gain.value, *gain.interval(grades.level)])


def _mean_and_ends(mean: Mean | None, level: float) -> tuple[float, float, float]:
    if mean is None:
        return np.nan, np.nan, np.nan
    return mean.value, *interval_ends(mean, level)

"""Charts of the tables in `xew.analysis.beyond`."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from xew.analysis.beyond import Motions, OverBodies, Shifts, motion_frame, scaling_frame, shifts_frame
from xew.analysis.beyond.scaling import ALONE, GROUPS, PASTED, WITH_ROBOTS
from xew.analysis.reports import charts
from xew.analysis.reports.charts import PANEL, SERIES, SOFT, Chart, Panel, Series
from xew.analysis.statistics.grades import SEEN
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.distances import AXIS_TITLES
from xew.analysis.tables.labels import ACTIONS, GROUP_TITLES, HELD_OUT_TITLES
from xew.analysis.tables.table import format_signed, metric_title
from xew.protocol import MOTIONS

METRIC = "lpips"
KINDS = {kind: Series(kind, color) for kind, color in zip((WITH_ROBOTS, ALONE), SERIES, strict=False)}
SHIFTS_OF_A_PANEL = 14
"""Number of bars for which a panel of the usual height has enough space."""
UNLEARNED = Series(PASTED, SOFT, "-.")
"""Line there of what learned nothing."""
MOTION_COLORS = dict(zip(MOTIONS, SERIES, strict=False))


def charts_beyond(
    builder: Builder,
    difficulty: Mapping[str, OverBodies],
    gaps: Mapping[str, OverBodies],
    motions: Motions | None,
    shifts: Shifts | None = None,
) -> dict[str, Chart]:
    """The charts by name, as far as there is something to draw; `difficulty` and `gaps` by metric."""
    if METRIC not in builder.ours.metrics:
        return {}
    made = {"motion": motion_chart(motions)} if motions and METRIC in motions.metrics else {}
    made |= {"shifts": shifts_chart(shifts)} if shifts else {}
    if builder.has_results("scaling"):
        made["scaling"] = scaling_chart(builder)
    metric = builder.ours.metrics[METRIC]
    if difficulty[METRIC].correlations:
        caption = "One model on bodies that it has never seen, a point each; r with its 95 % interval over bodies."
        made["bodies"] = chart_of_bodies("bodies", caption, difficulty[METRIC], "robots", metric_title(metric))
    if gaps[METRIC].correlations:
        caption = (
            "By how much each body is rendered worse by a model that never saw it than by one that did, a point each; r with "
            "its 95 % interval over bodies."
        )
        made["halves"] = chart_of_bodies("halves", caption, gaps[METRIC], "bodies", f"gap in {metric.title} [%]")
    return made


def scaling_chart(builder: Builder) -> Chart:
    """LPIPS by the number of training bodies, a panel for each group of robots that no model has seen, on one scale."""
    data = scaling_frame(builder, METRIC)
    counts = sorted(int(count) for count in data["bodies"].dropna().unique())
    ends = data[["value", "low", "high"]].to_numpy(np.float64)
    margin = 0.05 * (np.nanmax(ends) - np.nanmin(ends))

    def draw(axes: Axes, robots: str) -> None:
        lines = []
        for kind, style in KINDS.items():
            chosen = data[(data["robots"] == robots) & (data["trained_on"] == kind)].sort_values("bodies")
            if len(chosen):
                band = chosen[["low", "high"]].to_numpy() if chosen["low"].notna().all() else None
                lines.append((style, _positions(chosen["bodies"]), chosen["value"].to_numpy(), band))
        charts.lines(axes, lines, "bodies in training, K", metric_title(builder.ours.metrics[METRIC]))
        for value in data[(data["robots"] == robots) & (data["trained_on"] == PASTED)]["value"]:
            axes.axhline(value, color=UNLEARNED.color, linestyle=UNLEARNED.dash, linewidth=1.5)
        axes.set_xticks(_positions(counts), [str(count) for count in counts])
        axes.set_ylim(np.nanmin(ends) - margin, np.nanmax(ends) + margin)

    panels = [Panel(title, partial(draw, robots=robots)) for robots, title in GROUPS.items() if robots in set(data["robots"])]
    caption = "What more bodies in training are worth, at equal numbers of steps. Bands: 95 % intervals."
    used = [style for kind, style in (*KINDS.items(), (PASTED, UNLEARNED)) if kind in set(data["trained_on"])]
    return Chart("scaling", caption, panels, data, used)


def _positions(counts: Sequence[int] | pd.Series) -> np.ndarray:
    """Places [n] of numbers of bodies on the axis: powers of four lie at equal distances, and 0 one step before 1."""
    return np.array([np.log(count) / np.log(4) if count else -1.0 for count in counts])


def motion_chart(motions: Motions) -> Chart:
    """LPIPS of each action representation in shared and in own motion, a panel for robots seen and for each held out."""
    data, metric = motion_frame(motions, METRIC), motions.metrics[METRIC]
    longest = float(np.nanmax(data[["value", "high"]].to_numpy(np.float64)))

    def draw(axes: Axes, robots: str) -> None:
        groups = []
        for motion, color in MOTION_COLORS.items():
            chosen = data[(data["robots"] == robots) & (data["motion"] == motion)]
            groups.append((color, chosen[["value", "low", "high"]].to_numpy(), np.full(len(chosen), np.nan)))
        charts.bars(axes, list(ACTIONS.values()), groups, metric_title(metric))
        axes.set_xlim(0, 1.05 * longest)

    titles = {robots: "Training robots" if robots == SEEN else HELD_OUT_TITLES[robots] for robots in GROUP_TITLES}
    panels = [Panel(title, partial(draw, robots=robots)) for robots, title in titles.items()]
    caption = "Shared motion, in which all robots follow one tool path, and own motion. Lines: 95 % intervals."
    legend = [Series(f"{motion} motion", color) for motion, color in MOTION_COLORS.items()]
    return Chart("motion", caption, panels, data, legend)


def shifts_chart(shifts: Shifts) -> Chart:
    """Costs in LPIPS of unseen robots and of changed scenes, as bars of each model."""
    data, metric = shifts_frame(shifts, METRIC), shifts.metrics[METRIC]
    colors = dict(zip(data["trained_with"].unique(), SERIES, strict=False))

    def draw(axes: Axes) -> None:
        costs = [(color, data.loc[data["trained_with"] == own, ["value", "low", "high"]]) for own, color in colors.items()]
        groups = [(color, values.to_numpy(), np.full(len(values), np.nan)) for color, values in costs]
        charts.bars(axes, list(shifts.cases.values()), groups, metric.title)

    caption = (
        "What an unseen robot, and each change of the scene on training robots, adds to the same model's LPIPS on training "
        "robots in unchanged scenes, by the changes in its training. Lines: 95 % intervals."
    )
    legend = [Series(changes, color) for changes, color in colors.items()]
    height = PANEL[1] * (0.3 + len(data) / SHIFTS_OF_A_PANEL)
    return Chart("shifts", caption, [Panel(f"Added {metric.title}", draw, height)], data, legend)


def chart_of_bodies(name: str, caption: str, difficulty: OverBodies, trained: str, title: str) -> Chart:
    """A number of each body by its distance, a panel for each kind of distance.

    `trained` says of what the training was, `title` what the number is.
    """
    errors, heading = difficulty.values, f"mean distance to the training {trained}"

    def draw(axes: Axes, axis: str) -> None:
        result = difficulty.correlations[axis]
        charts.points(axes, errors[axis].to_numpy(np.float64), errors["value"].to_numpy(np.float64), heading, title)
        text = f"r = {format_signed(result.r)} ({format_signed(result.low)} to {format_signed(result.high)})"
        axes.text(0.02, 0.98, text, transform=axes.transAxes, va="top", fontsize=8)

    panels = [Panel(AXIS_TITLES[axis], partial(draw, axis=axis)) for axis in difficulty.correlations]
    return Chart(name, caption, panels, errors.reset_index())

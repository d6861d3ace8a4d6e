"""Charts of what procedural bodies answer: the gap by number of training bodies, error by distance, the gap by distance."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from xew.analysis.beyond import OverBodies, scaling_frame
from xew.analysis.beyond.scaling import ALONE, GROUPS, WITH_ROBOTS
from xew.analysis.reports import charts
from xew.analysis.reports.charts import SERIES, Chart, Panel, Series
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.distances import AXIS_TITLES, format_signed
from xew.analysis.tables.table import metric_title

METRIC = "lpips"
"""Metric that the charts draw, the paper's primary outcome."""
KINDS = {kind: Series(kind, color) for kind, color in zip((WITH_ROBOTS, ALONE), SERIES, strict=False)}
"""Lines of the chart of scaling, by what a model was trained on."""


def body_charts(builder: Builder, difficulty: Mapping[str, OverBodies], gaps: Mapping[str, OverBodies]) -> dict[str, Chart]:
    """The charts by name, as far as there is something to draw; `difficulty` and `gaps` by metric."""
    if METRIC not in builder.ours.metrics:
        return {}
    made = {}
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
    """LPIPS by the number of training bodies, a panel for each group of robots that no model has seen."""
    data = scaling_frame(builder, METRIC)

    def draw(axes: Axes, robots: str) -> None:
        lines = []
        for kind, style in KINDS.items():
            chosen = data[(data["robots"] == robots) & (data["trained_on"] == kind)].sort_values("bodies")
            if len(chosen):
                band = chosen[["low", "high"]].to_numpy() if chosen["low"].notna().all() else None
                lines.append((style, _positions(chosen["bodies"]), chosen["value"].to_numpy(), band))
        charts.lines(axes, lines, "bodies in training, K", metric_title(builder.ours.metrics[METRIC]))
        counts = sorted(data["bodies"].unique())
        axes.set_xticks(_positions(counts), [str(count) for count in counts])

    panels = [Panel(title, partial(draw, robots=robots)) for robots, title in GROUPS.items() if robots in set(data["robots"])]
    caption = "What more bodies in training are worth, at equal numbers of steps. Bands: 95 % intervals over scenes."
    used = [style for kind, style in KINDS.items() if kind in set(data["trained_on"])]
    return Chart("scaling", caption, panels, data, used)


def _positions(counts: Sequence[int] | pd.Series) -> np.ndarray:
    """Places [n] of numbers of bodies on the axis: powers of four lie at equal distances, and 0 one step before 1."""
    return np.array([np.log(count) / np.log(4) if count else -1.0 for count in counts])


def chart_of_bodies(name: str, caption: str, difficulty: OverBodies, trained: str, title: str) -> Chart:
    """A number of each body by its distance, a panel for each kind of distance.

    `trained` says of what the training was, `title` what the number is.
    """
    errors, heading = difficulty.values, f"mean distance to the {trained} of the training"

    def draw(axes: Axes, axis: str) -> None:
        result = difficulty.correlations[axis]
        charts.points(axes, errors[axis].to_numpy(np.float64), errors["value"].to_numpy(np.float64), heading, title)
        text = f"r = {format_signed(result.r)} ({format_signed(result.low)} to {format_signed(result.high)})"
        axes.text(0.02, 0.98, text, transform=axes.transAxes, va="top", fontsize=8)

    panels = [Panel(AXIS_TITLES[axis], partial(draw, axis=axis)) for axis in difficulty.correlations]
    return Chart(name, caption, panels, errors.reset_index())

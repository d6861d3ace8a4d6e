"""Charts of a report: panels with one legend, and their numbers.

On the page each panel is its own SVG, which takes its colors from the page. For Markdown and LaTeX all panels are one PNG and
one PDF.
"""

import io
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib
import numpy as np
import pandas as pd
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from xew.names import csv_text

LONGEST_BAR = 300.0
"""Length at which bars end: a gain [%] over a score of almost nothing would leave no length to the others."""
INK, SOFT, LINE, GROUND = "#1f2328", "#57606a", "#d0d7de", "#ffffff"
SERIES = ("#1f6feb", "#c2410c", "#15803d", "#7e22ce", "#a16207", "#0e7490")
"""Colors of series in order; baselines are SOFT. In dark mode the page has a lighter one for each."""
THEME = {INK: "ink", SOFT: "soft", LINE: "line", GROUND: "page"} | {color: f"c{i}" for i, color in enumerate(SERIES)}
"""Variable of the page's style for each color."""
PANEL = (3.5, 2.5)
"""Width and height of a panel [inches]."""
ONE_HEIGHT = 0.1
"""Least difference in height between the labels of two points, as a part of all heights in a panel."""
ROUNDS = 20
"""Number of times that words which overlap move apart; each time they may come to overlap others."""
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "text.parse_math": False,  # names may have dollar signs
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": SOFT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINE,
    "grid.linewidth": 0.6,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "pdf.fonttype": 42,
}


@dataclass(frozen=True)
class Series:
    """How a series is drawn, and its line in the legend."""

    label: str
    color: str
    dash: Literal["-", "--", "-.", ":", "o"] = "-"
    """Style of the line; 'o' is a hollow mark."""


@dataclass(frozen=True)
class Panel:
    """One plot."""

    title: str
    draw: Callable[[Axes], None]
    height: float = PANEL[1]
    """Height [inches]."""


@dataclass(frozen=True)
class Chart:
    """Panels with one legend."""

    name: str
    caption: str
    panels: Sequence[Panel]
    data: pd.DataFrame
    legend: Sequence[Series] = ()
    columns: int = 2


def panel_svg(chart: Chart, panel: Panel) -> str:
    """One panel as an <svg> element that takes its colors from the page."""
    with matplotlib.rc_context({**STYLE, "svg.hashsalt": f"{chart.name} {panel.title}"}):
        figure = Figure(figsize=(PANEL[0], panel.height), layout="constrained")
        axes = figure.subplots()
        panel.draw(axes)
        axes.set_title(panel.title)
        text = io.StringIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    svg = text.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    svg = re.sub(r'<g id="[^"]*">', "<g>", svg)  # the same in every panel; nothing refers to them
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg))
    for color in THEME:
        svg = svg.replace(color, themed_color(color))
    return svg.replace("<svg ", '<svg aria-hidden="true" ', 1)


def themed_color(color: str) -> str:
    """The variable of the page's style that stands for a color."""
    return f"var(--{THEME[color]})"


def chart_files(chart: Chart) -> dict[str, bytes]:
    """Files <name>.png, <name>.pdf and <name>.csv of a chart; the last one only where it has no panel."""
    numbers = {f"{chart.name}.csv": csv_text(chart.data).encode()}
    if not chart.panels:
        return numbers
    columns = min(chart.columns, len(chart.panels))
    rows = -(-len(chart.panels) // columns)
    size = PANEL[0] * columns, max(panel.height for panel in chart.panels) * rows + 0.5
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        for i, panel in enumerate(chart.panels):
            axes = figure.add_subplot(rows, columns, i + 1)
            panel.draw(axes)
            axes.set_title(panel.title)
        handles = [_handle(series) for series in chart.legend]
        if handles:
            figure.legend(handles=handles, loc="outside upper center", ncols=min(4, len(handles)), frameon=False)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # every file would lay it out again
        png, pdf = io.BytesIO(), io.BytesIO()
        figure.savefig(png, format="png", dpi=160)
        figure.savefig(pdf, format="pdf", metadata={"CreationDate": None})
    return {f"{chart.name}.png": png.getvalue(), f"{chart.name}.pdf": pdf.getvalue(), **numbers}


def _handle(series: Series) -> Line2D:
    if series.dash == "o":
        return Line2D([], [], color=series.color, marker="o", fillstyle="none", linestyle="", label=series.label)
    return Line2D([], [], color=series.color, linestyle=series.dash, linewidth=2, label=series.label)


def bars(axes: Axes, labels: Sequence[str], groups: Sequence[tuple[str, np.ndarray, np.ndarray]], unit: str) -> None:
    """Draw horizontal bars with whiskers, one of each group for each label, and the paper's values as rings.

    A group is its color, values with interval ends [n 3] and the paper's values [n]: NaN if unknown, infinite for a gain over
    zero.
    """
    height = 0.8 / len(groups)
    for g, (color, values, paper) in enumerate(groups):
        y = np.arange(len(labels)) + (g - (len(groups) - 1) / 2) * height
        finite = np.where(np.isfinite(values[:, 0]), values[:, 0], 0.0)
        length = np.clip(finite, -LONGEST_BAR, LONGEST_BAR)
        axes.barh(y, length, height * 0.9, color=color)
        known = ~np.isnan(values[:, 1]) & (length == finite)
        ends = np.clip(values[known, 1:], -LONGEST_BAR, LONGEST_BAR)
        axes.hlines(y[known], ends[:, 0], ends[:, 1], color=INK, linewidth=1)
        axes.plot(paper, y, "o", color=INK, fillstyle="none", markersize=4, markeredgewidth=1)
        for at, value, end in zip(y, values[:, 0], length, strict=True):
            if not np.isfinite(value):
                axes.text(0, at, " not run" if np.isnan(value) else " over zero", va="center", color=SOFT, fontsize=7)
            elif value != end:
                axes.text(end / 2, at, f"{value:,.0f}", va="center", ha="center", color=GROUND, fontsize=7)
    axes.axvline(0, color=SOFT, linewidth=0.8)
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel(unit)


def scatter(axes: Axes, distance: np.ndarray, score: np.ndarray, robots: Sequence[str], xlabel: str, ylabel: str) -> None:
    """Draw scores [n] by distances [n] of n robots: points, the line through all, and thin lines without one of them."""
    ends = np.array([distance.min(), distance.max()])
    for left_out in range(len(robots)):
        rest = np.delete(np.arange(len(robots)), left_out)
        axes.plot(ends, np.polyval(np.polyfit(distance[rest], score[rest], 1), ends), color=SOFT, linewidth=0.8)
    axes.plot(ends, np.polyval(np.polyfit(distance, score, 1), ends), color=SERIES[0], linewidth=2)
    axes.scatter(distance, score, color=INK, s=24, zorder=3)
    heights = _spread(score, ONE_HEIGHT * np.ptp(score))
    for x, y, robot in zip(distance, heights, robots, strict=True):
        # Words stand towards the middle, so none leaves the panel.
        side, shift = ("right", -7) if x > ends.mean() else ("left", 7)
        text = axes.annotate(robot, (x, y), xytext=(shift, 0), textcoords="offset points", ha=side, va="center")
        text.set_path_effects([patheffects.withStroke(linewidth=3, foreground=GROUND)])
    axes.locator_params(axis="x", nbins=5)  # more run into one another where they have three decimals
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)


def _spread(heights: np.ndarray, least: float) -> np.ndarray:
    """Heights [n] of words, moved by as little as keeps them `least` apart, in the same order."""
    order, spread = np.argsort(heights, kind="stable"), heights.astype(float)
    for _ in range(ROUNDS):
        for below, above in itertools.pairwise(order):
            apart = max(0.0, least - (spread[above] - spread[below])) / 2
            spread[below] -= apart
            spread[above] += apart
    return spread


def points(axes: Axes, x: np.ndarray, y: np.ndarray, xlabel: str, ylabel: str) -> None:
    """Draw many points x [n], y [n] without names, and the line through all."""
    ends = np.array([x.min(), x.max()])
    axes.plot(ends, np.polyval(np.polyfit(x, y, 1), ends), color=SERIES[0], linewidth=2)
    axes.scatter(x, y, color=INK, s=14, alpha=0.7, linewidths=0, zorder=3)
    axes.locator_params(axis="x", nbins=5)
    axes.set_ylim(top=y.max() + 0.2 * np.ptp(y))  # room for a line of text
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)


def lines(
    axes: Axes, series: Sequence[tuple[Series, np.ndarray, np.ndarray, np.ndarray | None]], xlabel: str, ylabel: str
) -> None:
    """Draw lines with bands: for each its style, x [n], y [n] and the band's ends [n 2] or None."""
    for style, x, y, band in series:
        if band is not None:
            axes.fill_between(x, band[:, 0], band[:, 1], color=style.color, alpha=0.15, linewidth=0)
        marker = "o" if len(x) < 6 else None
        axes.plot(x, y, style.dash, color=style.color, linewidth=1.8, marker=marker, markersize=4)
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)


def color_of(names: Sequence[str]) -> Mapping[str, str]:
    """A color for each name, in order."""
    return {name: SERIES[i % len(SERIES)] for i, name in enumerate(names)}

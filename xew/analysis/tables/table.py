"""A table as plain data, and how its numbers and heads are written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from xew.analysis.scores import MetricInfo
from xew.protocol import DIMENSION_TITLES
from xew.statistics import MIN_SCENES

MARKS = (
    "▲ better, ▼ worse, ≈ not resolved: the interval of the paired difference contains 0, the difference is inside the noise "
    f"floor, the floor is unknown, or there are fewer than {MIN_SCENES} scenes. A mark in parentheses is the verdict by the "
    "paper's definition where the strict metric, which decides, has another"
)
"""Explanation of the marks behind values; captions name the row that a value is compared with."""


@dataclass(frozen=True)
class TableCell:
    """One value of a table, as text and as numbers."""

    text: str = "–"
    """Value as text, '–' where nothing was measured."""
    interval: str = ""
    published: str = ""
    verdict: str = ""
    """Verdict on the difference from the row that the caption names: better, worse or unresolved; '' where there is none."""
    parting: str = ""
    """Verdict by the paper's definition where that of the suite strict, which decides, is another one; else ''."""
    best: bool = False
    value: float = np.nan
    low: float = np.nan
    high: float = np.nan
    printed: float = np.nan
    episodes: int = 0


@dataclass(frozen=True)
class Column:
    """The head of a column of values."""

    title: str
    group: str = ""


@dataclass(frozen=True)
class TableRow:
    """A row of labels and values."""

    labels: tuple[str, ...]
    """Labels, one for each stub of the table."""
    cells: tuple[TableCell, ...]
    baseline: bool = False


@dataclass(frozen=True)
class TableSection:
    """Rows under one heading, such as those of one robot."""

    title: str
    rows: tuple[TableRow, ...]
    note: str = ""


@dataclass(frozen=True)
class Table:
    """A table as any of the output formats shows it."""

    name: str
    title: str
    caption: str
    stubs: tuple[str, ...]
    columns: tuple[Column, ...]
    sections: tuple[TableSection, ...]

    @property
    def complete(self) -> bool:
        """Whether no section lacks anything."""
        return not any(section.note for section in self.sections)


def parting_note(sections: Sequence[TableSection]) -> str:
    """Sentence that explains the marks in parentheses of a table with these sections; '' where it has none."""
    parts = any(cell.parting for section in sections for row in section.rows for cell in row.cells)
    return "In parentheses: the verdict by the paper's definition where the strict metric has another." if parts else ""


def format_number(value: float, metric: MetricInfo) -> str:
    """A value with its significant digits: 0.01 dB, 0.1 px, else 0.001."""
    return f"{value:.{ {'dB': 2, 'px': 1}.get(metric.unit, 3) }f}"


def format_plain(value: float) -> str:
    """Text such as '−0.812'."""
    return f"{value:z.3f}".replace("-", "−")


def format_signed(value: float) -> str:
    """Text such as '+0.812'."""
    return f"{value:+z.3f}".replace("-", "−")


def format_p(p_value: float) -> str:
    """Text such as 'p = 0.031' or 'p < 0.001'."""
    return f"p = {p_value:.3f}" if p_value >= 0.001 else "p < 0.001"


def format_share(value: float) -> str:
    """Text such as '8.5 %' or '31 %'."""
    digits = 1 if abs(value) < 0.0995 else 0
    return f"{100 * value:z.{digits}f}\u00a0%".replace("-", "−")


def format_change(share: float) -> str:
    """Text such as '+31 %'."""
    return f"{100 * share:+z.0f}\u00a0%".replace("-", "−")


def metric_title(metric: MetricInfo) -> str:
    """Head such as 'PSNR [dB] ↑', whose arrow points to better."""
    unit = f" [{metric.unit}]" if metric.unit else ""
    return f"{metric.title}{unit} {'↑' if metric.higher_is_better else '↓'}"


def metric_columns(metrics: Mapping[str, MetricInfo], names: Sequence[str]) -> tuple[Column, ...]:
    """A column for each metric, under the title of its dimension."""
    infos = [metrics[name] for name in names]
    return tuple(Column(metric_title(info), DIMENSION_TITLES.get(info.dimension, info.dimension)) for info in infos)


def format_interval(ends: tuple[float, float], metric: MetricInfo) -> str:
    """Text such as '0.12–0.15'; '' where there is no interval, or none at these digits."""
    if np.isnan(ends[0]):
        return ""
    first, last = (format_number(end, metric) for end in ends)
    return "" if first == last else f"{first}–{last}"

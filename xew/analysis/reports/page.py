"""The report's HTML, from the templates next to this file, which escape every value except markup from these functions."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from xew.analysis.reports import pictures
from xew.analysis.reports.answer import Answer
from xew.analysis.reports.charts import Chart, panel_svg, themed_color
from xew.analysis.reports.study_strips import Strip
from xew.analysis.tables.findings import Finding
from xew.analysis.tables.table import Column, Table, TableRow

MOST_COLUMNS = 10
"""Largest number of columns of values side by side on a page of 1400 pixels, unless one group has more."""
TEMPLATES = Environment(
    loader=PackageLoader("xew.analysis.reports"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=StrictUndefined,
)


def page(title: str, finding: Sequence[str], parts: Sequence[Markup], footer: str, first: Answer | None = None) -> str:
    """The whole page: the first screen, the results as a list, then the sections."""
    figures = []
    if first and first.strip:
        figures.append(strip(first.strip))
    if first and first.chart:
        figures.append(chart(first.chart))
    values = {"title": title, "answer": first and first.sentence, "figures": figures, "finding": finding}
    return TEMPLATES.get_template("page.html").render(**values, parts=parts, footer=footer)


def section(title: str, *parts: Markup) -> Markup:
    """A section with a heading that links can name."""
    return _render("text.html", "section", title, anchor(title), parts)


def anchor(title: str) -> str:
    """The name by which a link finds a section: letters, figures and hyphens."""
    return "-".join("".join(c if c.isalnum() else " " for c in title.lower()).split())


def contents(titles: Sequence[str]) -> Markup:
    """Links to the page's sections."""
    return _render("text.html", "contents", {title: anchor(title) for title in titles})


def details(title: str, *parts: Markup) -> Markup:
    """Parts that stay folded until they are asked for."""
    return _render("text.html", "details", title, parts)


def paragraph(text: str) -> Markup:
    return _render("text.html", "paragraph", text)


def link(text: str, target: str) -> Markup:
    """A paragraph that leads to a file next to the page."""
    return _render("text.html", "link", text, target)


def note(text: str) -> Markup:
    """A paragraph that warns."""
    return _render("text.html", "note", text)


def definitions(pairs: Mapping[str, str]) -> Markup:
    """Names and what they mean."""
    return _render("text.html", "definitions", pairs)


def table(table: Table) -> Markup:
    """A table with its caption; one too wide for the page goes on below, cut between groups of columns."""
    sections = [(one, [(row, list(_labels(one.rows, i))) for i, row in enumerate(one.rows)]) for one in table.sections]
    return _render("table.html", "table", table, _bands(table.columns), sections)


@dataclass(frozen=True)
class _Band:
    """Columns of a table that are side by side."""

    first: int
    columns: tuple[Column, ...]

    @property
    def end(self) -> int:
        return self.first + len(self.columns)

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Titles over the columns, each with how many it stands over; none where no column has one."""
        grouped = [(title, len(list(members))) for title, members in groupby(self.columns, key=lambda column: column.group)]
        return grouped if any(title for title, _ in grouped) else []


def _bands(columns: Sequence[Column]) -> list[_Band]:
    """Whole groups of columns, as many a band as MOST_COLUMNS allow."""
    bands = [_Band(0, ())]
    for _, members in groupby(columns, key=lambda column: column.group):
        group, last = tuple(members), bands[-1]
        if last.columns and len(last.columns) + len(group) > MOST_COLUMNS:
            bands.append(_Band(last.end, group))
        else:
            bands[-1] = _Band(last.first, (*last.columns, *group))
    return bands


@dataclass(frozen=True)
class _Label:
    """The label of a row, or of several rows that share it."""

    text: str
    leads: bool
    rows: int = 0
    """Number of rows that it stands for; 0 for a label that belongs to its row alone."""


def _labels(rows: Sequence[TableRow], index: int) -> Iterator[_Label]:
    """The labels that stand in a row; all but the last stand once for all following rows that share them."""
    labels = rows[index].labels
    for place, label in enumerate(labels):
        if place == len(labels) - 1:
            yield _Label(label, place == 0)
        elif not index or rows[index - 1].labels[place] != label:
            same = next((i for i, row in enumerate(rows[index:]) if row.labels[place] != label), len(rows) - index)
            yield _Label(label, place == 0, same)


def chart(chart: Chart) -> Markup:
    """A chart with its legend; panels are side by side or stacked."""
    panels = [Markup(panel_svg(chart, panel)) for panel in chart.panels]
    kinds = {"-": "line", "--": "dashed", "-.": "dashdot", ":": "dotted", "o": "ring"}
    legend = [{"label": one.label, "kind": kinds[one.dash], "color": themed_color(one.color)} for one in chart.legend]
    return _render("figures.html", "chart", chart, panels, legend)


def labeled_picture(source: str, caption: str, columns: Sequence[str], rows: Sequence[str], title: str = "") -> Markup:
    """A data URI's picture with labels of its columns above and of its rows at the left; the title is bold."""
    return _render("figures.html", "labeled_picture", source, title, caption, columns, rows)


def strip(shown: Strip) -> Markup:
    """A sheet of frames with its labels and its caption."""
    return labeled_picture(pictures.data_uri(shown.image), shown.caption, shown.columns, shown.rows)


def claims(findings: Sequence[Finding], papers: Sequence[Finding] | None, by_paper: Sequence[Finding] | None = None) -> Markup:
    """Each claim with its answer here and, where given, on the paper's own figures and by the paper's definitions."""
    return _render("claims.html", "claims", findings, papers, by_paper or findings)


def _render(template: str, macro: str, *values: Any) -> Markup:
    return getattr(TEMPLATES.get_template(template).module, macro)(*values)

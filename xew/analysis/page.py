"""Stage 11 of 11: what the report says as HTML and as Markdown. Text in, text out; `report` reads and writes files."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from pathlib import Path
from string import Template

from xew.analysis.scores import COPY, TRUTH, MetricInfo
from xew.analysis.summary import METRIC_TITLES, Interval, RobotTable, Row

FOLDER = Path(__file__).parent
SOFT = ' class="soft"'


@dataclass(frozen=True)
class Compared:
    """A value, the one that the paper prints, and whether they agree; the latter two where there is something to compare."""

    ours: str
    published: str = ""
    agrees: bool | None = None


@dataclass(frozen=True)
class ComparedTable:
    """Values beside the paper's."""

    groups: Sequence[tuple[str, int]]
    """Titles over several columns, without the first column; may be empty."""
    heads: Sequence[str]
    rows: Mapping[str, Sequence[Compared]]
    """By the text of the first column."""


def page(title: str, finding: Sequence[str], sections: Sequence[str], footer: str) -> str:
    """The whole page, which refers to nothing outside itself."""
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in finding)
    return Template((FOLDER / "page.html").read_text()).substitute(
        title=escape(title),
        style=(FOLDER / "page.css").read_text(),
        finding=f'<ul class="finding">{items}</ul>',
        body="\n".join(sections),
        footer=footer,
    )


def section(title: str, *parts: str) -> str:
    return "\n".join((f"<section>\n<h2>{escape(title)}</h2>", *parts, "</section>"))


def paragraph(text: str, soft: bool = False) -> str:
    return f"<p{SOFT if soft else ''}>{escape(text)}</p>"


def note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def score_table(table: RobotTable, metrics: Sequence[MetricInfo]) -> str:
    """One robot's scores: metrics by dimension across, models down, intervals under the means."""
    shown = [metric for metric in metrics if any(metric.name in row.scores for row in table.rows)]
    groups = [(dimension, len(list(members))) for dimension, members in groupby(shown, key=lambda metric: metric.dimension)]
    dimensions = "".join(f'<th colspan="{count}">{escape(dimension)}</th>' for dimension, count in groups)
    heads = "".join(f"<th>{_head(metric)}</th>" for metric in shown)
    rows = "\n".join(_table_row(row, shown) for row in table.rows)
    return (
        f"<h3>{escape(table.title)}</h3>\n{_count_note(table)}\n"
        f'<div class="wide"><table><thead><tr class="dimension"><th></th>{dimensions}</tr>\n'
        f"<tr><th>model</th>{heads}</tr></thead>\n"
        f"<tbody>\n{rows}\n</tbody></table></div>"
    )


def _count_note(table: RobotTable) -> str:
    counts = sorted({score.count for row in table.rows for score in row.scores.values()})
    found = " to ".join(str(count) for count in dict.fromkeys((counts[0], counts[-1]))) if counts else "0"
    if table.expected is None:
        return paragraph(f"{found} episodes.", soft=True)
    if table.complete:
        return paragraph(f"{found} of {table.expected} test episodes.", soft=True)
    return note(f"Incomplete: {found} of {table.expected} test episodes are scored.")


def _head(metric: MetricInfo) -> str:
    word = "higher is better" if metric.higher_is_better else "lower is better"
    return f'<span title="{word}: {escape(metric.reference)}">{escape(metric_title(metric))}</span>'


def metric_title(metric: MetricInfo) -> str:
    """Such as 'PSNR [dB] ↑': the arrow points to better."""
    unit = f" [{metric.unit}]" if metric.unit else ""
    return f"{METRIC_TITLES.get(metric.name, metric.name)}{unit} {'↑' if metric.higher_is_better else '↓'}"


def _table_row(row: Row, metrics: Sequence[MetricInfo]) -> str:
    kind = ' class="baseline"' if row.model in (COPY, TRUTH) else ""
    cells = "".join(_cell(row, metric) for metric in metrics)
    return f"<tr{kind}><td>{escape(row.title)}</td>{cells}</tr>"


def _cell(row: Row, metric: MetricInfo) -> str:
    score = row.scores.get(metric.name)
    if score is None:
        return "<td>–</td>"
    if row.model == TRUTH and metric.name == "psnr":
        return '<td><span class="mean" title="all frames are equal to the truth">exact</span></td>'
    interval = "" if point_only(score) else f'<span class="interval">{interval_text(score, metric)}</span>'
    return (
        f'<td class="{row.verdicts.get(metric.name, "")}"><span class="mean">{number(score.mean, metric)}</span>{interval}</td>'
    )


def number(value: float, metric: MetricInfo) -> str:
    """Digits that mean something: 0.01 dB, 0.1 px, else 0.001."""
    return f"{value:.{ {'dB': 2, 'px': 1}.get(metric.unit, 3) }f}"


def point_only(score: Interval) -> bool:
    """Is there no interval to show: one episode, or all episodes equal."""
    return math.isnan(score.low) or score.low == score.high


def interval_text(score: Interval, metric: MetricInfo) -> str:
    return f"{number(score.low, metric)}–{number(score.high, metric)}"


def compared_table(table: ComparedTable) -> str:
    """Ours large, the paper's small below it, marked where the two agree or differ."""
    groups = "".join(f'<th colspan="{count}">{escape(title)}</th>' for title, count in table.groups)
    above = f'<tr class="dimension"><th></th>{groups}</tr>' if groups else ""
    heads = "".join(f"<th>{escape(head)}</th>" for head in table.heads)
    rows = "\n".join(
        f"<tr><td>{escape(title)}</td>{''.join(map(_compared_cell, cells))}</tr>" for title, cells in table.rows.items()
    )
    return f'<div class="wide"><table><thead>{above}<tr>{heads}</tr></thead>\n<tbody>\n{rows}\n</tbody></table></div>'


def _compared_cell(cell: Compared) -> str:
    kind = "" if cell.agrees is None else ' class="agrees"' if cell.agrees else ' class="differs"'
    published = f'<span class="interval">paper {escape(cell.published)}</span>' if cell.published else ""
    return f'<td{kind}><span class="mean">{escape(cell.ours)}</span>{published}</td>'


def labelled_picture(source: str, caption: str, columns: Sequence[str], rows: Sequence[str]) -> str:
    """A sheet of pictures with the names of its columns above and of its rows at the left. The caption is HTML."""
    heads = "".join(f"<span>{escape(name)}</span>" for name in columns)
    sides = "".join(f"<span>{escape(name)}</span>" for name in rows)
    text = escape(f"{', '.join(rows)} by {', '.join(columns)}")
    return (
        f'<figure><figcaption>{caption}</figcaption><div class="grid"><div class="columns">{heads}</div>'
        f'<div class="rows">{sides}</div><img src="{source}" alt="{text}"></div></figure>'
    )


def picture(source: str, caption: str, text: str) -> str:
    """A figure; the caption is HTML, the text is for those who cannot see it."""
    return f'<figure><figcaption>{caption}</figcaption><img src="{source}" alt="{escape(text)}"></figure>'


def definitions(pairs: Mapping[str, str]) -> str:
    items = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in pairs.items())
    return f"<dl>{items}</dl>"


def markdown_table(table: RobotTable, metrics: Sequence[MetricInfo]) -> str:
    """The same table for report.md: mean [interval], and better, worse or unresolved against the frozen first frame."""
    shown = [metric for metric in metrics if any(metric.name in row.scores for row in table.rows)]
    heads = [
        f"{METRIC_TITLES.get(m.name, m.name)}{f' [{m.unit}]' if m.unit else ''} {'↑' if m.higher_is_better else '↓'}"
        for m in shown
    ]
    lines = [f"| model | {' | '.join(heads)} |", f"|---|{'---:|' * len(shown)}"]
    lines += [f"| {row.title} | {' | '.join(_markdown_cell(row, metric) for metric in shown)} |" for row in table.rows]
    return "\n".join(lines)


def _markdown_cell(row: Row, metric: MetricInfo) -> str:
    score = row.scores.get(metric.name)
    if score is None:
        return "–"
    if row.model == TRUTH and metric.name == "psnr":
        return "exact"
    interval = "" if point_only(score) else f" [{interval_text(score, metric)}]"
    return number(score.mean, metric) + interval + (f" {row.verdicts[metric.name]}" if row.verdicts.get(metric.name) else "")


def compared_markdown(table: ComparedTable) -> str:
    """The same for report.md: ours (the paper's) and whether they agree."""
    over = ["", *(title for title, count in table.groups for _ in range(count))] if table.groups else [""] * len(table.heads)
    heads = [": ".join(filter(None, pair)) for pair in zip(over, table.heads, strict=True)]
    lines = [f"| {' | '.join(heads)} |", f"|---|{'---:|' * (len(heads) - 1)}"]
    lines += [f"| {title} | {' | '.join(map(_compared_text, cells))} |" for title, cells in table.rows.items()]
    return "\n".join(lines)


def _compared_text(cell: Compared) -> str:
    mark = "" if cell.agrees is None else " ✓" if cell.agrees else " ✗"
    return cell.ours + (f" (paper {cell.published})" if cell.published else "") + mark

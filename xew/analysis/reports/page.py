"""Stage 11 of 11: what the report says as HTML. Text in, text out; `report` reads and writes files."""

from collections.abc import Mapping, Sequence
from html import escape
from itertools import groupby
from pathlib import Path
from string import Template

from xew.analysis.reports.charts import Chart, Series, panel_svg, themed
from xew.analysis.tables.findings import Answer, Finding
from xew.analysis.tables.layouts import Block, Cell, Table
from xew.analysis.tables.layouts import Row as TableRow

FOLDER = Path(__file__).parent
SOFT = ' class="soft"'


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
    return "\n".join((f'<section id="{anchor(title)}">\n<h2>{escape(title)}</h2>', *parts, "</section>"))


def anchor(title: str) -> str:
    """What a link to a section is named: letters, figures and hyphens."""
    return "-".join("".join(c if c.isalnum() else " " for c in title.lower()).split())


def contents(titles: Sequence[str]) -> str:
    """Links to the page's sections."""
    links = "".join(f'<a href="#{anchor(title)}">{escape(title)}</a>' for title in titles)
    return f"<nav>{links}</nav>"


def folded(title: str, *parts: str) -> str:
    """Hidden until asked for."""
    return "\n".join((f"<details><summary>{escape(title)}</summary>", *parts, "</details>"))


def paragraph(text: str, soft: bool = False) -> str:
    return f"<p{SOFT if soft else ''}>{escape(text)}</p>"


def note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def table(shown: Table) -> str:
    """Ours large, its interval and the paper's value small below it; what a block lacks stands above its rows."""
    groups = [(title, len(list(members))) for title, members in groupby(shown.columns, key=lambda column: column.group)]
    above = ""
    if any(title for title, _ in groups):
        titles = "".join(f'<th colspan="{count}">{_unbroken(title)}</th>' for title, count in groups)
        above = f'<tr class="dimension">{"<th></th>" * len(shown.stubs)}{titles}</tr>'
    heads = "".join(f'<th class="stub{" lead" * (not i)}">{escape(stub)}</th>' for i, stub in enumerate(shown.stubs))
    heads += "".join(f"<th>{_unbroken(column.title)}</th>" for column in shown.columns)
    width = len(shown.stubs) + len(shown.columns)
    blocks = "\n".join(_block(block, width) for block in shown.blocks)
    return (
        f"<h3>{escape(shown.title)}</h3>\n{paragraph(shown.caption, soft=True) if shown.caption else ''}\n"
        f'<div class="wide" tabindex="0"><table><thead>{above}<tr>{heads}</tr></thead>\n{blocks}</table></div>'
    )


def _unbroken(title: str) -> str:
    """The arrow stays with its word."""
    return escape(title).replace(" ↑", "&nbsp;↑").replace(" ↓", "&nbsp;↓")


def _block(block: Block, width: int) -> str:
    title = f'<tr class="block"><th colspan="{width}"><span>{escape(block.title)}</span></th></tr>' if block.title else ""
    lacks = f'<tr class="lacks"><td colspan="{width}"><span>{escape(block.note)}</span></td></tr>' if block.note else ""
    return f"<tbody>{title}{lacks}{''.join(_block_row(block, i) for i in range(len(block.rows)))}</tbody>"


def _block_row(block: Block, index: int) -> str:
    row = block.rows[index]
    stubs = [_stub(block.rows, index, place) for place in range(len(row.labels))]
    cells = "".join(map(_value_cell, row.cells))
    kind = ' class="baseline"' if row.baseline else ""
    return f"<tr{kind}>{''.join(stubs)}{cells}</tr>"


def _stub(rows: Sequence[TableRow], index: int, place: int) -> str:
    """A row's label, once for all rows in a row that share it."""
    label = rows[index].labels[place]
    text = _unbroken(label)
    kind = "" if place else " lead"
    if place == len(rows[index].labels) - 1:
        return f'<th class="stub{kind}">{text}</th>'
    if index and rows[index - 1].labels[place] == label:
        return ""
    same = next((i for i, row in enumerate(rows[index:]) if row.labels[place] != label), len(rows) - index)
    return f'<th class="stub{kind}" rowspan="{same}">{text}</th>'


def _value_cell(cell: Cell) -> str:
    marks = [cell.verdict, "best" * cell.best, {None: "", True: "agrees", False: "differs"}[cell.agrees]]
    kinds = " ".join(filter(None, marks))
    below = f'<span class="interval">{escape(cell.interval)}</span>' if cell.interval else ""
    below += f'<span class="paper">{escape(cell.published)}</span>' if cell.published else ""
    kind = f' class="{kinds}"' if kinds else ""
    return f'<td{kind}><span class="mean">{escape(cell.text)}</span>{below}</td>'


def chart(shown: Chart) -> str:
    """A chart with its legend; panels stand beside or below one another, as there is room."""
    legend = "".join(f"<span>{_swatch(series)}{escape(series.label)}</span>" for series in shown.legend)
    panels = "".join(f'<div class="panel">{panel_svg(shown, panel)}</div>' for panel in shown.panels)
    numbers = f'<span class="soft">Numbers: figures/{escape(shown.name)}.csv</span>'
    return (
        f'<figure class="chart"><figcaption>{escape(shown.caption)} {numbers}</figcaption>'
        f'<div class="legend">{legend}</div><div class="panels">{panels}</div></figure>'
    )


def _swatch(series: Series) -> str:
    kind = {"-": "line", "--": "dashed", ":": "dotted", "o": "ring"}[series.dash]
    return f'<i class="{kind}" style="border-color: {themed(series.color)}"></i>'


def claims(findings: Sequence[Finding], papers: Sequence[Finding] | None) -> str:
    """Each claim with its verdict here and, where given, on the paper's own figures; open for all numbers."""
    items = []
    for i, finding in enumerate(findings):
        sides = [("here", finding)] + ([("the paper's own figures", papers[i])] if papers else [])
        answers = "".join(_claim_side(title, side) for title, side in sides)
        claim = finding.claim
        items.append(
            f'<article class="claim"><div><p><b>{escape(claim.says)}</b> <span class="soft">{escape(claim.where)}</span></p>'
            f'<p class="soft">{escape(claim.test)}</p></div>{answers}</article>'
        )
    return f'<div class="claims{"" if papers else " alone"}">{"".join(items)}</div>'


def _claim_side(title: str, finding: Finding) -> str:
    kind = finding.verdict.replace(" ", "-")
    pill = f'<span class="pill {kind}">{escape(finding.verdict)}</span> <span class="soft">{escape(title)}</span>'
    if finding.missing:
        return f'<div><p>{pill}</p><p class="soft">missing: {escape(finding.missing)}</p></div>'
    doubtful = [answer for answer in finding.answers if answer.verdict != "holds"]
    if len(finding.answers) <= 4:
        return f"<div><p>{pill}</p>{_answers(finding.answers)}</div>"
    all_of_them = f"<details><summary>{escape(finding.span())}</summary>{_answers(finding.answers)}</details>"
    return f"<div><p>{pill}</p>{_answers(doubtful[:4])}{all_of_them}</div>"


def _answers(answers: Sequence[Answer]) -> str:
    items = "".join(
        f'<li class="{answer.verdict}">{escape(answer.label)} <span>{escape(answer.numbers)}</span></li>' for answer in answers
    )
    return f"<ul>{items}</ul>" if answers else ""


def labeled_picture(source: str, caption: str, columns: Sequence[str], rows: Sequence[str]) -> str:
    """A sheet of pictures with the names of its columns above and of its rows at the left. The caption is HTML."""
    heads = "".join(f"<span>{escape(name)}</span>" for name in columns)
    sides = "".join(f"<span>{escape(name)}</span>" for name in rows)
    text = escape(f"{', '.join(rows)} by {', '.join(columns)}")
    return (
        f'<figure><figcaption>{caption}</figcaption><div class="grid"><div class="columns">{heads}</div>'
        f'<div class="rows">{sides}</div><img src="{source}" alt="{text}"></div></figure>'
    )


def definitions(pairs: Mapping[str, str]) -> str:
    items = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in pairs.items())
    return f"<dl>{items}</dl>"

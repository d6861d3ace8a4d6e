"""A `Table` as Markdown, LaTeX (booktabs) and CSV. HTML is in `page`."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby

import pandas as pd

from xew.analysis.tables.findings import Finding
from xew.analysis.tables.table import Table, TableCell, TableRow
from xew.names import plain_markdown

MARK = {"better": "▲", "worse": "▼", "unresolved": "≈", "": ""}
"""Mark of a verdict; that of the paper's definition, where it parts from the suite strict, stands in parentheses."""
LATEX_MARK = {"better": r"\blacktriangle", "worse": r"\blacktriangledown", "unresolved": r"\approx", "": ""}
LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "↑": r"$\uparrow$", "↓": r"$\downarrow$", "−": "$-$", "–": "--",
    "³": "$^3$", "ρ": r"$\rho$", "≈": r"$\approx$", "▲": r"$\blacktriangle$", "▼": r"$\blacktriangledown$", "…": r"\dots{}",
    "·": r"$\cdot$", "×": r"$\times$", "±": r"$\pm$", "✓": r"$\checkmark$", "✗": r"$\times$", "\u00a0": "~",
    "<": "$<$", ">": "$>$",
}  # fmt: skip
"""Replacements for characters that LaTeX reads otherwise, or does not have."""


def column_heads(table: Table) -> list[str]:
    """Heads of all columns, each on one line, such as 'Visual quality: PSNR [dB] ↑'."""
    return [*table.stubs, *(": ".join(filter(None, (column.group, column.title))) for column in table.columns)]


def markdown(table: Table) -> str:
    """A table as Markdown, with cells such as '0.12 [0.10–0.14] ▲ (paper 0.11)'."""
    width = len(table.stubs) + len(table.columns)
    lines = [_markdown_line(column_heads(table)), f"|{'---|' * len(table.stubs)}{'---:|' * len(table.columns)}"]
    for section in table.sections:
        above = [f"**{section.title}**"] * bool(section.title) + [f"*{section.note}*"] * bool(section.note)
        lines += [_markdown_line([text, *[""] * (width - 1)]) for text in above]
        lines += [_markdown_line([*row.labels, *map(_markdown_cell, row.cells)]) for row in section.rows]
    return "\n".join(lines)


def _markdown_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(map(plain_markdown, cells))} |"


def _markdown_cell(cell: TableCell) -> str:
    text = f"**{cell.text}**" if cell.best else cell.text
    interval = f"[{cell.interval}]" if cell.interval else ""
    paper = f"(paper {cell.published})" if cell.published else ""
    return " ".join(filter(None, (text, interval, _mark(cell), paper)))


def _mark(cell: TableCell) -> str:
    return f"({MARK[cell.parting]})" if cell.parting else MARK[cell.verdict]


def latex(table: Table) -> str:
    """A table for the packages booktabs, amssymb and adjustbox, scaled down where it is wider than the page.

    The interval and the paper's value stand small below each number.
    """
    stubs, width = len(table.stubs), len(table.stubs) + len(table.columns)
    lines = [
        r"% \usepackage{booktabs,amssymb,adjustbox}",
        r"\begin{table*}[t]",
        r"\centering\footnotesize\setlength{\tabcolsep}{4pt}",
        r"\begin{adjustbox}{max width=\textwidth}",
        rf"\begin{{tabular}}{{@{{}}{'l' * stubs}{'c' * len(table.columns)}@{{}}}}",
        r"\toprule",
        *_latex_groups(table),
        _latex_line([*map(_escape, table.stubs), *(_escape(column.title) for column in table.columns)]),
        r"\midrule",
    ]
    for i, section in enumerate(table.sections):
        lines += [r"\addlinespace"] if i else []
        if section.title:
            lines.append(rf"\multicolumn{{{width}}}{{@{{}}l}}{{\textit{{{_escape(section.title)}}}}} \\")
        for row, above in zip(section.rows, (None, *section.rows), strict=False):
            lines += _latex_rows(row, above)
    # Notes are too long for a row: they would stretch the table.
    notes = [": ".join(filter(None, (section.title, section.note))) for section in table.sections if section.note]
    caption = rf"\textbf{{{_escape(table.title)}.}} {_escape(' '.join([table.caption, *notes]))}"
    lines += [r"\bottomrule", r"\end{tabular}", r"\end{adjustbox}"]
    lines += [rf"\caption{{{caption}}}", rf"\label{{tab:{table.name}}}", r"\end{table*}", ""]
    return "\n".join(lines)


def _latex_groups(table: Table) -> Iterator[str]:
    if not any(column.group for column in table.columns):
        return
    cells, rules, at = [""] * len(table.stubs), [], len(table.stubs) + 1
    for title, members in groupby(table.columns, key=lambda column: column.group):
        count = len(list(members))
        cells.append(rf"\multicolumn{{{count}}}{{c}}{{{_escape(title)}}}")
        rules += [rf"\cmidrule(lr){{{at}-{at + count - 1}}}"] if title else []
        at += count
    yield _latex_line(cells)
    yield "".join(rules)


def _latex_rows(row: TableRow, above: TableRow | None) -> Iterator[str]:
    """Lines of a row; a label that the row above has, too, is left out, except for the last label."""
    same = [bool(above and above.labels[i] == label and label != row.labels[-1]) for i, label in enumerate(row.labels)]
    labels = ["" if repeated else _escape(label) for label, repeated in zip(row.labels, same, strict=True)]
    yield _latex_line([*labels, *map(_latex_cell, row.cells)])
    intervals = [f"[{cell.interval}]" if cell.interval else "" for cell in row.cells]
    papers = [f"({cell.published})" if cell.published else "" for cell in row.cells]
    for below in filter(any, (intervals, papers)):
        small = (rf"{{\tiny {_escape(text)}}}" if text else "" for text in below)
        yield _latex_line([*[""] * len(row.labels), *small])


def _latex_cell(cell: TableCell) -> str:
    text = _escape(cell.text)
    mark = f"({LATEX_MARK[cell.parting]})" if cell.parting else LATEX_MARK[cell.verdict]
    return (rf"\textbf{{{text}}}" if cell.best else text) + (f"$^{{{mark}}}$" if mark else "")


def _latex_line(cells: Iterable[str]) -> str:
    line = " & ".join(cells) + r" \\"
    return f"{{}}{line}" if line.startswith(("[", "*")) else line  # after a line break these would be its options


def _escape(text: str) -> str:
    """Text with LaTeX's special characters replaced, also the two hyphens of an option, which it would draw as a dash."""
    return "-{}-".join("".join(LATEX.get(character, character) for character in part) for part in text.split("--"))


def table_frame(table: Table) -> pd.DataFrame:
    """A tidy frame, one row per cell: table block note row column text value low high verdict parting paper episodes."""
    columns = column_heads(table)[len(table.stubs) :]
    return pd.DataFrame(
        {
            "table": table.name,
            "block": section.title,
            "note": section.note,
            "row": ", ".join(row.labels),
            "column": column,
            "text": cell.text,
            "value": cell.value,
            "low": cell.low,
            "high": cell.high,
            "verdict": cell.verdict,
            "parting": cell.parting,
            "paper": cell.printed,
            "episodes": cell.episodes,
        }
        for section in table.sections
        for row in section.rows
        for column, cell in zip(columns, row.cells, strict=True)
    )


def tables_frame(tables: Sequence[Table]) -> pd.DataFrame:
    """The frames of all tables, one below the other."""
    return pd.concat([table_frame(table) for table in tables], ignore_index=True)


def findings_markdown(findings: Sequence[Finding], papers: Sequence[Finding] = (), by_paper: Sequence[Finding] = ()) -> str:
    """A Markdown table of claims: test, both answers with numbers, and where given the answers by the paper's definitions and
    on the paper's own figures."""
    columns = _other_answers({"by the paper's definitions": by_paper, "the paper's own figures": papers}, len(findings))
    heads = ["claim", "test", "verdict", "asked alone", "pasted render", "numbers", *columns[0]]
    lines = [_markdown_line(heads), "|---" * len(heads) + "|"]
    for finding, last in zip(findings, columns[1:], strict=True):
        numbers = "; ".join(one.text for one in finding.comparisons) or f"missing: {finding.missing}"
        claim, basis = finding.claim, f" ({finding.basis})" if finding.basis else ""
        cells = [f"{claim.says} ({claim.where})", claim.test, f"**{finding.in_family}**{basis}", finding.answer]
        cells += [finding.pasting or "–", numbers, *last]
        lines.append(_markdown_line(cells))
    return "\n".join(lines)


def _other_answers(others: Mapping[str, Sequence[Finding]], count: int) -> list[list[str]]:
    """Heads, and then answers to each of so many claims, of other sources that are given."""
    given = {title: found for title, found in others.items() if found}
    return [list(given), *([found[i].in_family for found in given.values()] for i in range(count))]


def findings_latex(findings: Sequence[Finding], papers: Sequence[Finding] = (), by_paper: Sequence[Finding] = ()) -> str:
    """A LaTeX table of claims: test, both answers, and where given those by the paper's definitions and on its figures."""
    columns = _other_answers({"by paper's": by_paper, "paper": papers}, len(findings))
    rows = [
        _latex_line(map(_escape, (f.claim.says, f.claim.test, f.in_family, f.answer, f.pasting or "–", *last)))
        for f, last in zip(findings, columns[1:], strict=True)
    ]
    return "\n".join(
        [
            r"% \usepackage{booktabs,amssymb}",
            r"\begin{table*}[t]",
            r"\centering\footnotesize",
            rf"\begin{{tabular}}{{@{{}}p{{0.32\textwidth}}p{{0.32\textwidth}}lll{'l' * len(columns[0])}@{{}}}}",
            r"\toprule",
            _latex_line(["claim", "test", "verdict", "alone", "pasting", *columns[0]]),
            r"\midrule",
            *rows,
            r"\bottomrule",
            r"\end{tabular}",
            rf"\caption{{\textbf{{Findings.}} Each claim as inequalities; {_escape(_findings_caption(findings))}}}",
            r"\label{tab:findings}",
            r"\end{table*}",
            "",
        ]
    )


def _findings_caption(findings: Sequence[Finding]) -> str:
    """Text that says what corrections are made, and whose results these are."""
    bases = ", ".join(dict.fromkeys(finding.basis for finding in findings if finding.basis))
    text = "Verdicts are corrected by Holm's method for the comparisons of a claim and for all claims; alone, for its own only."
    return f"{text} Results rest on {bases}." if bases else text

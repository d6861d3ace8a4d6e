"""The report on the paper's own figures, which are checked against each other; `report --paper` writes it.

The paper's distance table is rebuilt from its scores and distances, the percentages of its text from its tables, and its
claims are asked of its own figures. One question is ours: what comes out if workspaces are compared in the frame of the arm's
base, as the text says that they were.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from xew.analysis.correlation import Correlation
from xew.analysis.distances.workspaces import Frame
from xew.analysis.paper import (
    AXES,
    PAPER_TITLES,
    Paper,
)
from xew.analysis.reports import page
from xew.analysis.reports.charts import Chart, chart_files
from xew.analysis.reports.study import Report
from xew.analysis.reports.study_charts import distance_chart
from xew.analysis.statistics.grades import PaperGrades
from xew.analysis.statistics.recompute import (
    RecomputedChange,
    RecomputedFigure,
    rebuild,
    recompute_changes,
    recompute_mean_distances,
)
from xew.analysis.tables import formats
from xew.analysis.tables.distances import Distances, distance_tables, format_signed, printed_distances
from xew.analysis.tables.findings import FAILS, HOLDS, UNMEASURED, UNRESOLVED, Finding, ask, findings_frame
from xew.analysis.tables.layouts import build_tables
from xew.analysis.tables.paper import (
    PrintedBuilder,
    base_table,
    certainty_table,
    change_table,
    claims_table,
    correlation_table,
    describe_change,
    format_percent,
    frame_distances,
    frame_results,
    frame_table,
    robot_table,
)
from xew.analysis.tables.table import Table
from xew.names import csv_text
from xew.protocol import ROBOT_NAMES

TITLE = "The paper's figures, rebuilt from one another"
OWN_FRAMES: tuple[Frame, ...] = ("arm_base", "arm_alone")
"""Frames of workspaces whose distances the paper does not print."""
PRIMARY = "lpips"
"""Primary outcome of the paper, which calls all others exploratory."""
CLAIMS_TEXT = (
    "Each claim of the paper as an inequality, asked of its own printed figures: it holds where all that prints the same lies "
    "on its side. Gaps of unseen robots are unresolved, because it prints no model that saw them, and so is what rests on five "
    "robots alone. The last ones, “ours”, ask more than the paper claims. The paper prints no intervals, so a claim that holds "
    "here holds for its episodes; whether it would for others its figures cannot say."
)
SCORES_TEXT = (
    "As printed. Marks are of the printed digits: better or worse whatever the unprinted ones. The paper gives no intervals, "
    "so they say nothing of chance."
)


@dataclass(frozen=True)
class Content:
    """Everything that the page and the Markdown show."""

    sentences: Sequence[str]
    claims: Sequence[Finding]
    shown: Mapping[str, Sequence[Table]]
    """Tables by section."""
    folded: Sequence[Table]
    """Tables of scores, folded away."""
    chart: Chart


def build(paper: Paper, footer: str) -> Report:
    """The page, Markdown, LaTeX and CSV of all tables, and every recomputed figure as a tidy frame.

    Args:
        paper: its figures.
        footer: text of the footer, versions.
    """
    cells, means, changes = rebuild(paper), recompute_mean_distances(paper), recompute_changes(paper)
    results = {(metric, axis): paper.correlation(metric, axis) for metric in paper.metrics for axis in AXES}
    frames = frame_distances()
    by_frame = {frame: frame_results(paper, frames[frame]) for frame in OWN_FRAMES}
    grades = PaperGrades(paper, paper.infos)
    claims = ask(grades)
    chart = distance_chart(grades, _add_own_frames(printed_distances(paper), frames), PRIMARY)
    assert chart is not None  # all folds are printed
    content = Content(
        finding(cells, results, changes, by_frame, claims),
        claims,
        {
            "Does distance predict difficulty?": [correlation_table(paper, cells), certainty_table(paper, cells, results)],
            "Which frame workspaces are in": [frame_table(paper, frames), base_table(paper, frames)],
            "Percentages of the text": [change_table(changes)],
            "The robots": [robot_table(paper, means)],
        },
        [*build_tables(PrintedBuilder(grades, None)), *distance_tables(printed_distances(paper))[-1:]],
        chart,
    )
    summary = _frame([*cells, *means], changes, by_frame)
    return Report(_write_html(content, paper, footer), _write_markdown(content), summary, dict(_files(content)))


def finding(
    cells: Sequence[RecomputedFigure],
    results: Mapping[tuple[str, str], Correlation],
    changes: Sequence[RecomputedChange],
    by_frame: Mapping[Frame, Mapping[str, Correlation]],
    claims: Sequence[Finding],
) -> list[str]:
    """The results in sentences."""
    return [
        *_rebuilt_sentences(cells, changes),
        *(_correlation_sentence(axis, results[PRIMARY, axis]) for axis in AXES),
        *_certainty_sentences(results),
        *_frame_sentences(results, by_frame),
        _claims_sentence(claims),
    ]


def _rebuilt_sentences(cells: Sequence[RecomputedFigure], changes: Sequence[RecomputedChange]) -> Iterator[str]:
    outside = [f"{_name_correlation(cell.metric, cell.axis)} {cell.quantity}" for cell in cells if not cell.agrees]
    furthest = max(abs(cell.ours - cell.published) for cell in cells)
    word = f"{len(cells) - len(outside)} of {len(cells)} printed figures come out within what rounding of the inputs allows"
    yield f"{word} (largest difference {furthest:.3f}){': not ' + ', '.join(outside) if outside else ''}."
    wrong = [f"{format_percent(change.change.percent, 0)} ({change.change.source})" for change in changes if not change.agrees]
    follow = f"{len(changes) - len(wrong)} of {len(changes)} percentages of the text follow from the tables"
    yield f"{follow}{': not ' + ', '.join(wrong) if wrong else ''}."


def _certainty_sentences(results: Mapping[tuple[str, str], Correlation]) -> Iterator[str]:
    stable = {axis: [result.stable for (_, of), result in results.items() if of == axis] for axis in AXES}
    counts = " and ".join(f"{sum(stable[axis])} of {len(stable[axis])} metrics against {axis} distance" for axis in AXES)
    yield f"The sign is stable for {counts}."
    key = min(results, key=lambda key: results[key].p_value)
    smallest = f"{results[key].p_value:.3f} ({_name_correlation(*key)})"
    yield f"The smallest p of all {len(results)} is {smallest}, before any correction."


def _frame_sentences(
    results: Mapping[tuple[str, str], Correlation], by_frame: Mapping[Frame, Mapping[str, Correlation]]
) -> Iterator[str]:
    """Sentences on how the frame of workspaces changes the primary outcome, and the others."""
    starts: dict[Frame, str] = {
        "arm_base": "By kinematic distance as the text defines it, in the arm's base frame (our clouds, its scores)",
        "arm_alone": "By workspaces of the arm alone, in that frame (ours)",
    }
    for frame, start in starts.items():
        found, primary = by_frame[frame], by_frame[frame][PRIMARY]
        turned = [PAPER_TITLES[name] for name, one in found.items() if one.r * results[name, "kinematic"].r < 0]
        yield (
            f"{start}, {PAPER_TITLES[PRIMARY]} has r = {format_signed(primary.r)}, p = {primary.p_value:.3f}; its sign "
            f"{_stability_phrase(primary)}. Against the printed figures r turns its sign for "
            f"{', '.join(turned) or 'no metric'}."
        )


def _claims_sentence(claims: Sequence[Finding]) -> str:
    own = [one for one in claims if one.claim.where == "ours" and one.answer != UNMEASURED]
    papers = [one for one in claims if one.claim.where != "ours"]
    return f"On its own figures, of the paper's {_count_answers(papers)}; of stricter ones of ours, {_count_answers(own)}."


def _count_answers(claims: Sequence[Finding]) -> str:
    """Text such as '25 claims: hold 15, fail 0, not to be told by its figures 10'."""
    counts = [sum(one.answer == word for one in claims) for word in (HOLDS, FAILS, UNRESOLVED)]
    return f"{len(claims)} claims: hold {counts[0]}, fail {counts[1]}, not to be told by its figures {counts[2]}"


def _correlation_sentence(axis: str, result: Correlation) -> str:
    return (
        f"{PAPER_TITLES[PRIMARY]} against {axis} distance: r = {format_signed(result.r)}, p = {result.p_value:.3f}; its sign "
        f"{_stability_phrase(result)}."
    )


def _stability_phrase(result: Correlation) -> str:
    word = "survives" if result.stable else "does not survive"
    return f"{word} leaving out any one robot ({format_signed(result.low)} to {format_signed(result.high)})"


def _name_correlation(metric: str, axis: str) -> str:
    return f"{PAPER_TITLES[metric]} by {axis}"


def _add_own_frames(distances: Distances, frames: Mapping[Frame, np.ndarray]) -> Distances:
    """The printed distances, and our own [s 5] in other frames."""
    own = [pd.DataFrame({"robot": ROBOT_NAMES, "feature": frame, "value": frames[frame].mean(axis=0)}) for frame in OWN_FRAMES]
    return replace(distances, robots=pd.concat([distances.robots, *own], ignore_index=True))


# --- Formats.


def _write_html(content: Content, paper: Paper, footer: str) -> str:
    sections = {"Claims": page.section("Claims", page.paragraph(CLAIMS_TEXT), page.claims(content.claims, None))}
    for number, (title, shown) in enumerate(content.shown.items()):
        chart = [page.chart(content.chart)] if number == 0 else []
        sections[title] = page.section(title, *chart, *map(page.table, shown))
    folded = [page.details(table.title, page.table(table)) for table in content.folded]
    sections["The scores"] = page.section("The scores", page.paragraph(SCORES_TEXT), *folded)
    sources = {"paper": paper.title, **paper.tables, **{part: rows.source for part, rows in paper.parts.items()}}
    sources = {name.replace("_", " "): text for name, text in sources.items()}
    sections["Sources"] = page.section("Sources", page.definitions(sources))
    return page.page(TITLE, content.sentences, [page.contents(list(sections)), *sections.values()], footer)


def _write_markdown(content: Content) -> str:
    lines = [f"# {TITLE}", "", *(f"- {sentence}" for sentence in content.sentences)]
    lines += ["", "## Claims", "", CLAIMS_TEXT, "", formats.markdown(claims_table(content.claims))]
    for number, (title, shown) in enumerate(content.shown.items()):
        lines += ["", f"## {title}"]
        lines += ["", f"![{content.chart.caption}](figures/{content.chart.name}.png)"] if number == 0 else []
        lines += _markdown_tables(shown)
    return "\n".join([*lines, "", "## The scores", "", SCORES_TEXT, *_markdown_tables(content.folded)]) + "\n"


def _markdown_tables(shown: Sequence[Table]) -> Iterator[str]:
    for table in shown:
        yield from ("", f"### {table.title}", "", table.caption, "", formats.markdown(table))


def _files(content: Content) -> Iterator[tuple[str, bytes]]:
    """Tables as LaTeX and CSV, the chart as PNG, PDF and CSV, claims as CSV."""
    for table in [*(table for shown in content.shown.values() for table in shown), *content.folded]:
        yield f"tables/{table.name}.tex", formats.latex(table).encode()
        yield f"tables/{table.name}.csv", csv_text(formats.table_frame(table)).encode()
    for name, data in chart_files(content.chart).items():
        yield f"figures/{name}", data
    yield "findings.csv", csv_text(findings_frame(content.claims, "paper")).encode()


def _frame(
    cells: Sequence[RecomputedFigure], changes: Sequence[RecomputedChange], by_frame: Mapping[Frame, Mapping[str, Correlation]]
) -> pd.DataFrame:
    """Columns: row axis quantity published ours least most agrees; blank where the paper prints nothing."""
    names = ("published", "ours", "least", "most", "agrees")
    rows = [
        {"row": cell.metric, "axis": cell.axis, "quantity": cell.quantity} | {name: getattr(cell, name) for name in names}
        for cell in cells
    ]
    rows += [
        {"row": describe_change(found.change), "axis": found.change.source, "quantity": "percent"}
        | {"published": found.change.percent, "ours": found.ours, "least": found.least, "most": found.most}
        | {"agrees": found.agrees}
        for found in changes
    ]
    rows += [
        {"row": metric, "axis": frame, "quantity": quantity, "ours": getattr(result, quantity)}
        for frame, results in by_frame.items()
        for metric, result in results.items()
        for quantity in ("r", "low", "high", "p_value")
    ]
    return pd.DataFrame(rows)

"""The report of `report --paper`: the paper's tables, and its claims tested on its own figures."""

from collections.abc import Mapping
from dataclasses import replace

from xew.analysis.correlation import Correlation
from xew.analysis.paper import AXES, PAPER_TITLES, Paper
from xew.analysis.reports import page
from xew.analysis.reports.study import Content, Report, write_report
from xew.analysis.reports.study_charts import distance_chart
from xew.analysis.statistics.grades import PaperGrades
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.distances import certainty_table, correlation_table, distance_tables, printed_distances
from xew.analysis.tables.findings import FAILS, HOLDS, UNMEASURED, UNRESOLVED, Finding, ask
from xew.analysis.tables.layouts import build_tables, count_table
from xew.analysis.tables.table import TableCell, format_p, format_signed

TITLE = "The paper's figures, rebuilt from one another"
PRIMARY = "lpips"
"""Primary outcome of the paper, which calls all others exploratory."""
CLAIMS_TEXT = (
    "Each claim of the paper is tested on its own printed figures. It holds if all values that print the same lie on its side. "
    "Gaps of unseen robots are unresolved, because no model that saw them is printed, and so are claims that rest on five "
    "robots. Claims marked “ours” are stricter than the paper's. The paper prints no intervals, so an answer is about its own "
    "episodes only."
)


class PrintedBuilder(Builder):
    """Makes tables of the paper alone, its means with all the digits that it prints."""

    def cell(self, part: str, row: str, robots: str, metric: str, base: str = "") -> TableCell:
        assert isinstance(self.ours, PaperGrades)
        cell = super().cell(part, row, robots, metric, base)
        return replace(cell, text=self.ours.print(part, row, robots, metric) or cell.text)


def build(paper: Paper, footer: str) -> Report:
    """The report on the paper's figures."""
    grades, known = PaperGrades(paper, paper.infos), printed_distances(paper)
    builder, findings = PrintedBuilder(grades, None), ask(grades)
    tables = [*build_tables(builder), count_table(builder), *distance_tables(known)]
    tables += [correlation_table(grades, known, paper), certainty_table(grades, known, paper)]
    chart = distance_chart(grades, known, PRIMARY)
    assert chart is not None  # all folds are printed
    content = Content(
        TITLE,
        None,
        [*describe_correlations(paper), describe_claims(findings)],
        {"paper": findings},
        CLAIMS_TEXT,
        {table.name: table for table in tables},
        {chart.name: chart},
    )
    sources = {"paper": paper.title, **paper.tables, **{part: rows.source for part, rows in paper.parts.items()}}
    sources = {name.replace("_", " "): text for name, text in sources.items()}
    return write_report(content, {"Sources": page.section("Sources", page.definitions(sources))}, footer)


def describe_correlations(paper: Paper) -> list[str]:
    """Sentences on the primary outcome against each distance, and on how certain all correlations are."""
    results = {(metric, axis): paper.correlation(metric, axis) for metric in paper.metrics for axis in AXES}
    sentences = [_correlation_sentence(axis, results[PRIMARY, axis]) for axis in AXES]
    stable = {axis: [result.stable for (_, of), result in results.items() if of == axis] for axis in AXES}
    counts = " and ".join(f"{sum(stable[axis])} of {len(stable[axis])} metrics against {axis} distance" for axis in AXES)
    return [*sentences, f"The sign is stable for {counts}.", _smallest_p_sentence(results)]


def _correlation_sentence(axis: str, result: Correlation) -> str:
    return (
        f"{PAPER_TITLES[PRIMARY]} against {axis} distance: r = {format_signed(result.r)}, {format_p(result.p_value)}; its sign "
        f"{describe_stability(result)}."
    )


def describe_stability(result: Correlation) -> str:
    """Phrase on whether a sign survives leaving out any one robot."""
    word = "survives" if result.stable else "does not survive"
    return f"{word} leaving out any one robot ({format_signed(result.low)} to {format_signed(result.high)})"


def _smallest_p_sentence(results: Mapping[tuple[str, str], Correlation]) -> str:
    metric, axis = min(results, key=lambda key: results[key].p_value)
    smallest = f"{results[metric, axis].p_value:.3f} ({PAPER_TITLES[metric]} by {axis})"
    return f"The smallest p of all {len(results)} is {smallest}, before any correction."


def describe_claims(findings: list[Finding]) -> str:
    """Sentence on how many claims hold, fail and are unresolved."""
    own = [one for one in findings if one.claim.where == "ours" and one.answer != UNMEASURED]
    papers = [one for one in findings if one.claim.where != "ours"]
    return f"On its own figures, of the paper's {_count_answers(papers)}; of stricter ones of ours, {_count_answers(own)}."


def _count_answers(findings: list[Finding]) -> str:
    """Text such as '25 claims: hold 15, fail 0, unresolved by its figures 10'."""
    counts = [sum(one.answer == word for one in findings) for word in (HOLDS, FAILS, UNRESOLVED)]
    return f"{len(findings)} claims: hold {counts[0]}, fail {counts[1]}, unresolved by its figures {counts[2]}"

"""The report of a study, from a score table with the column `variant`: results, claims, and a section for each question."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import pandas as pd
from markupsafe import Markup

from xew.analysis.beyond import (
    Motions,
    Shifts,
    difficulty_table,
    errors_table,
    find_difficulty,
    find_gaps,
    find_unseen_errors,
    gaps_table,
    halves_table,
    motion_table,
    scaling_table,
    shifts_table,
)
from xew.analysis.paper import AXES, read_paper
from xew.analysis.reports import page
from xew.analysis.reports.answer import Answer, answer, answer_strip, study_contests
from xew.analysis.reports.charts import Chart, chart_files
from xew.analysis.reports.study_beyond import charts_beyond
from xew.analysis.reports.study_charts import study_charts
from xew.analysis.reports.study_strips import Strip, find_videos, median_episodes, study_strips
from xew.analysis.reports.study_text import curves_note, missing_note, part_notes, study_sentences, trainings_note
from xew.analysis.scores import Scores, find_missing_scores
from xew.analysis.statistics.grades import PaperGrades, StudyGrades
from xew.analysis.statistics.suites import StrictGrades
from xew.analysis.tables import formats
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.distances import (
    Distances,
    certainty_table,
    correlation_table,
    distance_tables,
    gap_correlation_tables,
    own_correlation_tables,
    printed_distances,
    read_distances,
)
from xew.analysis.tables.findings import Finding, ask, findings_frame
from xew.analysis.tables.layouts import build_tables, count_table
from xew.analysis.tables.outside import outside_tables
from xew.analysis.tables.table import MARKS, Table, parting_note
from xew.names import csv_text, plain_markdown
from xew.protocol import PAPER_PARTS
from xew.statistics import Units

TITLE = "Can the model render a robot that it has never seen?"
PART_TITLES = {
    "fixed": "Seen and unseen robots",
    "actions": "Action representation",
    "ladder": "Conditioning on the robot's appearance",
    "few_shot": "Few-shot adaptation and forgetting",
    "loeo": "Does distance predict difficulty?",
    "baselines": "Other world models",
    "scaling": "More bodies in training",
    "bodies": "Distance and difficulty over many bodies",
    "halves": "Distance and the gap of unseen bodies",
    "motion": "Shared and own motion",
    "shifts": "A new robot or a new lamp",
    "outside": "Outside the protocol",
}
SECTIONS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]] = {
    "fixed": ((), ("gap",), ()),
    "actions": (("gains_actions",), ("actions",), ("actions_full",)),
    "ladder": (("gains_ladder",), ("ladder",), ("ladder_full",)),
    "few_shot": (("forgetting", "remedies", "gains_few_shot"), ("few_shot",), ("few_shot_full", "forgetting_full")),
    "loeo": (
        ("distance", "distance_gap"),
        ("correlations", "gap_correlations", "correlations_own", "loeo_full"),
        ("certainty", "distances", "features", "matrices"),
    ),
    "baselines": ((), ("baselines",), ()),
    "scaling": (("scaling",), ("scaling",), ()),
    "bodies": (("bodies",), ("bodies",), ()),
    "halves": (("halves",), ("halves_scores", "halves", "halves_errors"), ()),
    "motion": (("motion",), ("motion",), ()),
    "shifts": (("shifts",), ("shifts",), ()),
    "outside": ((), ("outside",), ()),
}
"""Content of each part's section: charts, tables that stand open, and tables that are folded away."""
METHOD = "How it was measured"
HERE, BY_PAPER, PRINTED = "here", "here, paper's definitions", "paper"
"""Sources of answers to claims: the scores by the suite strict, the scores by the paper's definitions, the paper's figures."""
CLAIMS_TEXT = (
    "Each claim of the paper is tested as inequalities, on this study and on the paper's printed figures. A claim holds if "
    "all numbers lie on its side of the bound, and fails if one lies on the other side, at 5 % after Holm's correction for the "
    "numbers of the claim and for all claims. Otherwise it is unresolved. “Asked alone” leaves out the second correction. "
    "Claims of equality are equivalences: two one-sided tests with the margins in the claim. Strict metrics decide; answers by "
    "the paper's definitions are shown where they differ. Claims about conditioning also say whether the models beat the paste "
    "baseline. Claims marked “ours” are stricter than the paper's."
)
FRAME_CHARTS = {"actions": "frames_actions", "ladder": "frames_ladder"}


@dataclass(frozen=True)
class Report:
    """Everything that is written into a report's folder."""

    html: str
    markdown: str
    summary: pd.DataFrame
    files: Mapping[str, bytes]


@dataclass(frozen=True)
class Others:
    """Score tables that a study's is compared with."""

    motion: Scores | None = None
    """The same study in the other kind of motion."""
    shifted: Sequence[Scores] = ()
    """The models of the part `shifts` on changed scenes, one table for each change and model."""


@dataclass(frozen=True)
class Content:
    """Everything that the page and the Markdown show."""

    title: str
    first: Answer | None
    sentences: Sequence[str]
    findings: Mapping[str, Sequence[Finding]]
    """Answers to the claims by what they were asked of: HERE, BY_PAPER and PRINTED; the first decides. Empty where none was."""
    claims_text: str
    tables: Mapping[str, Table]
    charts: Mapping[str, Chart]
    strips: Mapping[str, Strip] = field(default_factory=dict)
    notes: Sequence[str] = ()
    missing: pd.DataFrame = field(default_factory=pd.DataFrame)
    trainings: str = ""

    @property
    def deciding(self) -> Sequence[Finding]:
        """The answers that decide."""
        return next(iter(self.findings.values()), ())


def build(
    scores: Scores,
    data: Path | None,
    rollouts: Sequence[Path],
    distances: Path | None,
    footer: str,
    others: Others | None = None,
) -> Report:
    """Make the report of a study.

    Args:
        scores: with the column `variant`.
        data, rollouts: for pictures; trees of rollouts are named after their variants, or are folders of such trees.
        distances: folder of the distance command; None for the paper's printed distances.
        footer: text of the footer.
        others: tables to compare with.

    Raises:
        ConfigError: a named file cannot be read, or other tables do not compare.
    """
    others = others or Others()
    paper = read_paper()
    known = read_distances(distances) if distances else printed_distances(paper)
    videos = find_videos(rollouts) if data and rollouts else {}
    strips = study_strips(scores, data, videos) if data else {}
    axes, spreads = ({axis: known.of(axis, column) for axis in AXES} for column in ("value", "spread"))
    grades = StudyGrades(scores.rows, scores.metrics, axes, known.measured, spreads, codecs=scores.codecs)
    printed = PaperGrades(paper, scores.metrics)
    planned = scores.attributes.get("study", {}).get("variants", {})
    builder = Builder(grades, printed, {name: counts["expected"] for name, counts in planned.items()})
    note, difficulty, gaps = trainings_note(grades), find_difficulty(grades, known), find_gaps(grades, known)
    tables = _make_tables(builder, scores, known, (note, grades.notes))
    over_bodies = ((difficulty_table, difficulty), (gaps_table, gaps), (errors_table, find_unseen_errors(gaps)))
    tables += filter(None, (make(found, grades.metrics) for make, found in over_bodies))
    motions = Motions(scores, others.motion) if others.motion else None
    shifts = Shifts(scores, others.shifted) if others.shifted else None
    shifts = shifts if shifts and shifts.models else None
    tables += [*([motion_table(motions)] if motions else []), *([shifts_table(shifts)] if shifts else [])]
    # A study that has none of the paper's parts is asked none of its claims.
    of_paper = any(builder.has_results(part) for part in PAPER_PARTS)
    findings, by_paper, by_print = (ask(g) if of_paper else [] for g in (StrictGrades(grades), grades, printed))
    missing = find_missing_scores(scores.rows)
    contests = list(study_contests(grades))
    shown = median_episodes({robot: variant for robot, variant, _ in contests}, scores.rows, data, videos) if data else {}
    content = Content(
        TITLE,
        answer([contest for *_, contest in contests], answer_strip(shown, scores.frame_zero)),
        study_sentences(
            grades, known, tuple(found.get("lpips") for _, found in over_bodies), motions, shifts, findings, by_paper
        ),
        {HERE: findings, BY_PAPER: by_paper, PRINTED: by_print} if of_paper else {},
        CLAIMS_TEXT,
        {table.name: table for table in tables},
        study_charts(builder, known, scores.curves) | charts_beyond(builder, difficulty, gaps, motions, shifts),
        strips,
        [*part_notes(builder, scores), *missing_note(missing), *curves_note(scores)],
        missing,
        note,
    )
    return write_report(content, {METHOD: _method_section(content, scores)}, footer)


def write_report(content: Content, endings: Mapping[str, Markup], footer: str) -> Report:
    """A report of a study's tables; `endings` are the last sections of the page by title."""
    html = _write_html(content, endings, footer)
    frame = formats.tables_frame(list(content.tables.values()))
    return Report(html, _write_markdown(content), frame, dict(_files(content)))


def _make_tables(builder: Builder, scores: Scores, known: Distances, notes: Sequence[str]) -> list[Table]:
    """Tables of a study in one kind of motion, without those of single bodies; `notes` are put behind captions of scores."""
    grades, paper = builder.ours, read_paper()
    scored = [*build_tables(builder), *outside_tables(builder, scores.rows)]
    if builder.has_results("scaling"):
        scored.append(scaling_table(builder))
    if builder.has_results("halves"):
        scored.append(halves_table(builder))
    captions = [(table.caption, parting_note(table.sections), *notes) for table in scored]
    tables = [replace(t, caption=" ".join(filter(None, texts))) for t, texts in zip(scored, captions, strict=True)]
    tables += [count_table(builder), *distance_tables(known)]
    if builder.has_results("loeo"):
        tables += [correlation_table(grades, known, paper), *own_correlation_tables(grades, known)]
        tables += [*gap_correlation_tables(grades, known), certainty_table(grades, known, paper)]
    return tables


def _write_html(content: Content, endings: Mapping[str, Markup], footer: str) -> str:
    sections = {"Claims": _claims_section(content)} if content.findings else {}
    sections |= {PART_TITLES[part]: text for part in SECTIONS if (text := _part_section(content, part))}
    sections |= endings
    head = [page.contents(list(sections)), *map(page.note, content.notes)]
    return page.page(content.title, content.sentences, [*head, *sections.values()], footer, content.first)


def _claims_section(content: Content) -> Markup:
    paragraphs = [page.paragraph(text) for text in (content.claims_text, content.trainings) if text]
    printed, by_paper = _other_answers(content)
    claims = page.claims(content.deciding, printed or None, by_paper or None)
    return page.section("Claims", *paragraphs, claims)


def _part_section(content: Content, part: str) -> Markup | None:
    charts, shown, folded = SECTIONS[part]
    if not any(name in content.tables for name in shown):
        return None
    parts = [page.chart(content.charts[name]) for name in charts if name in content.charts]
    parts += [page.table(content.tables[name]) for name in shown if name in content.tables]
    if part in content.strips:
        parts.append(page.strip(content.strips[part]))
    if FRAME_CHARTS.get(part) in content.charts:
        parts.append(page.chart(content.charts[FRAME_CHARTS[part]]))
    hidden = [content.tables[name] for name in folded if name in content.tables]
    if hidden:
        parts.append(page.details("; ".join(table.title for table in hidden), *map(page.table, hidden)))
    return page.section(PART_TITLES[part], *parts)


def _method_section(content: Content, scores: Scores) -> Markup:
    made = {"scenes graded": str(len(Units(scores.rows))), **scores.measured_by}
    definitions = {metric.title: metric.reference for metric in scores.metrics}
    return page.section(
        METHOD,
        page.paragraph(
            f"Means over episodes with 95 % bootstrap intervals. {content.trainings} Scenes (seeds) are resampled within their "
            "tasks, the same for every model and robot, so all comparisons are paired. Marks compare a value with the row in "
            f"the caption: {MARKS}. “True video, graded” has the estimators' error, the noise floor. The paper's values come "
            "from its own renders and a model of five billion weights; they are shown where its protocol is the same."
        ),
        page.table(content.tables["counts"]),
        page.definitions(definitions),
        page.definitions(made),
    )


def _write_markdown(content: Content) -> str:
    lines = [
        f"# {content.title}",
        "",
        *([content.first.sentence, ""] if content.first else []),
        *([f"![{content.first.chart.caption}](figures/answer.png)", ""] if content.first and content.first.chart else []),
        *(f"- {plain_markdown(sentence)}" for sentence in content.sentences),
        "",
        *(f"> {note}\n" for note in content.notes),
    ]
    if content.findings:
        claims = formats.findings_markdown(content.deciding, *_other_answers(content))
        lines += ["## Claims", "", content.trainings, "", claims]
    for part, (charts, shown, folded) in SECTIONS.items():
        if not any(name in content.tables for name in shown):
            continue
        lines += ["", f"## {PART_TITLES[part]}"]
        for name in (*charts, *([FRAME_CHARTS[part]] if part in FRAME_CHARTS else [])):
            if name in content.charts:
                lines += ["", f"![{content.charts[name].caption}](figures/{name}.png)"]
        if part in content.strips:
            lines += ["", f"![{content.strips[part].labeled_caption}](figures/strip_{part}.png)"]
        for name in (*shown, *folded):
            if name in content.tables:
                table = content.tables[name]
                lines += ["", f"### {table.title}", "", table.caption, "", formats.markdown(table)]
    counts = content.tables["counts"]
    lines += ["", "## How it was measured", "", f"{MARKS[0].upper()}{MARKS[1:]}.", "", formats.markdown(counts)]
    return "\n".join(lines) + "\n"


def _files(content: Content) -> Iterator[tuple[str, bytes]]:
    """Tables as LaTeX and CSV, charts as PNG, PDF and CSV, strips as PNG, findings as CSV and LaTeX."""
    for name, table in content.tables.items():
        yield f"tables/{name}.tex", formats.latex(table).encode()
        yield f"tables/{name}.csv", csv_text(formats.table_frame(table)).encode()
    first = [content.first.chart] if content.first and content.first.chart else []
    for chart in (*first, *content.charts.values()):
        for name, data in chart_files(chart).items():
            yield f"figures/{name}", data
    for part, strip in content.strips.items():
        yield f"figures/strip_{part}.png", strip.image
    if len(content.missing):
        yield "missing.csv", csv_text(content.missing).encode()
    if content.findings:
        together = pd.concat([findings_frame(found, of) for of, found in content.findings.items()])
        yield "findings.csv", csv_text(together).encode()
        yield "tables/findings.tex", formats.findings_latex(content.deciding, *_other_answers(content)).encode()


def _other_answers(content: Content) -> tuple[Sequence[Finding], Sequence[Finding]]:
    """Answers on the paper's figures and by the paper's definitions, as far as they stand next to those that decide."""
    others = dict(list(content.findings.items())[1:])
    return others.get(PRINTED, ()), others.get(BY_PAPER, ())

"""The report of a study, from a score table with the column `variant`; `report` reads and writes files.

What came out stands first, then the claims with their answers, then a section for each question of the paper: chart, the
main table, what it looks like, and all metrics folded away.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from markupsafe import Markup

from xew.analysis.beyond import Difficulty, Motions, difficulty_table, find_difficulty, motion_table, scaling_table
from xew.analysis.paper import AXES, read_paper
from xew.analysis.reports import page, pictures
from xew.analysis.reports.charts import Chart, chart_files
from xew.analysis.reports.study_beyond import body_charts
from xew.analysis.reports.study_charts import study_charts
from xew.analysis.reports.study_strips import Strip, study_strips
from xew.analysis.scores import Scores, describe_scores, find_missing_scores
from xew.analysis.statistics.grades import BODIES, Grades, PaperGrades, StudyGrades, relative_gain
from xew.analysis.statistics.suites import StrictGrades
from xew.analysis.statistics.summary import ROBOT_TITLES
from xew.analysis.tables import formats
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.comparisons import OTHER_ROBOTS, NotMeasuredError, Reader
from xew.analysis.tables.distances import (
    Distances,
    certainty_table,
    correlate,
    correlation_table,
    distance_tables,
    format_signed,
    own_correlation_tables,
    printed_distances,
    read_distances,
)
from xew.analysis.tables.findings import BEATS, FAILS, HOLDS, UNMEASURED, UNRESOLVED, Finding, ask, findings_frame
from xew.analysis.tables.labels import ACTIONS, LADDER, SHORT_ROBOTS
from xew.analysis.tables.layouts import build_tables, count_table
from xew.analysis.tables.outside import outside_tables
from xew.analysis.tables.table import MARKS, Table, parting_note
from xew.names import csv_text, plain_markdown
from xew.protocol import BODY_SCALES, FORGETTING_ROBOT, HELD_OUT_ROBOTS, PAPER_PARTS, PARTS
from xew.statistics import strict_metrics

TITLE = "Can the model render a robot that it has never seen?"
PART_TITLES = {
    "fixed": "Seen and unseen robots",
    "actions": "How it is told to move",
    "ladder": "What it is told of the robot's looks",
    "few_shot": "Adaptation, and what it costs",
    "loeo": "Does distance predict difficulty?",
    "baselines": "Other world models",
    "scaling": "More bodies in training",
    "bodies": "Distance and difficulty over many bodies",
    "motion": "Shared and own motion",
    "outside": "Outside the protocol",
}
SECTIONS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]] = {
    "fixed": ((), ("gap",), ()),
    "actions": (("gains_actions",), ("actions",), ("actions_full",)),
    "ladder": (("gains_ladder",), ("ladder",), ("ladder_full",)),
    "few_shot": (("forgetting", "gains_few_shot"), ("few_shot",), ("few_shot_full", "forgetting_full")),
    "loeo": (
        ("distance",),
        ("correlations", "correlations_own", "loeo_full"),
        ("certainty", "distances", "features", "matrices"),
    ),
    "baselines": ((), ("baselines",), ()),
    "scaling": (("scaling",), ("scaling",), ()),
    "bodies": (("bodies",), ("bodies",), ()),
    "motion": ((), ("motion",), ()),
    "outside": ((), ("outside",), ()),
}
"""Content of each part's section: charts, tables that stand open, and tables that are folded away."""
FRAME_CHARTS = {"actions": "frames_actions", "ladder": "frames_ladder"}


@dataclass(frozen=True)
class Report:
    """Everything that is written into a report's folder."""

    html: str
    markdown: str
    summary: pd.DataFrame
    files: Mapping[str, bytes]
    """Further files by path relative to the folder."""


@dataclass(frozen=True)
class Content:
    """Everything that the page and the Markdown show."""

    sentences: Sequence[str]
    findings: Sequence[Finding]
    """Answers to the claims, by the suite strict."""
    by_paper: Sequence[Finding]
    """Answers by the paper's definitions; the same where no metric of the suite strict was graded."""
    printed: Sequence[Finding]
    """Answers to the same claims on the paper's own figures."""
    tables: Mapping[str, Table]
    charts: Mapping[str, Chart]
    strips: Mapping[str, Strip]
    lacks: Sequence[str]
    """Notes on what is not there."""
    missing: pd.DataFrame
    """Scores that other models have."""
    trainings: str
    """Sentence that says whether intervals are of one training or of several."""


def build(
    scores: Scores,
    data: Path | None,
    rollouts: Sequence[Path],
    distances: Path | None,
    footer: str,
    other_motion: Scores | None = None,
) -> Report:
    """Make the report of a study.

    Args:
        scores: with the column `variant`.
        data: the data set, for pictures.
        rollouts: trees of rollouts named after their variants, or folders that hold such trees; for pictures.
        distances: folder of the command of distances; the paper's printed ones where None.
        footer: text of the footer, versions.
        other_motion: scores of the same study in the other kind of motion, if there are any.

    Raises:
        ConfigError: a file that was named cannot be read, or both studies are of one kind of motion.
    """
    paper = read_paper()
    known = read_distances(distances) if distances else printed_distances(paper)
    strips = study_strips(scores, data, rollouts) if data and rollouts else {}
    axes, spreads = ({axis: known.of(axis, column) for axis in AXES} for column in ("value", "spread"))
    grades = StudyGrades(scores.rows, scores.metrics, axes, known.measured, spreads, codecs=scores.codecs)
    printed = PaperGrades(paper, scores.metrics)
    planned = scores.attributes.get("study", {}).get("variants", {})
    builder = Builder(grades, printed, {name: counts["expected"] for name, counts in planned.items()})
    note, difficulty = trainings_note(grades), find_difficulty(grades, known)
    tables = _make_tables(builder, scores, known, difficulty, (note, grades.notes))
    if other_motion:
        tables.append(motion_table(Motions(scores, other_motion)))
    # A study that has none of the paper's parts is asked none of its claims.
    of_paper = any(builder.has_results(part) for part in PAPER_PARTS)
    findings, by_paper, by_print = (ask(g) if of_paper else [] for g in (StrictGrades(grades), grades, printed))
    missing = find_missing_scores(scores.rows)
    content = Content(
        _sentences(grades, known, difficulty.get("lpips"), findings, by_paper),
        findings,
        by_paper,
        by_print,
        {table.name: table for table in tables},
        study_charts(builder, known, scores.curves) | body_charts(builder, difficulty),
        strips,
        [*_missing_notes(builder, scores), *missing_note(missing)],
        missing,
        note,
    )
    html = _write_html(content, scores, footer)
    return Report(html, _write_markdown(content), formats.tables_frame(tables), dict(_files(content)))


def _make_tables(
    builder: Builder, scores: Scores, known: Distances, difficulty: Mapping[str, Difficulty], notes: Sequence[str]
) -> list[Table]:
    """All tables of a study in one kind of motion; `notes` are put behind the captions of those of scores."""
    grades, paper = builder.ours, read_paper()
    scored = [*build_tables(builder), *outside_tables(builder, scores.rows)]
    if builder.has_results("scaling"):
        scored.append(scaling_table(builder))
    captions = [(table.caption, parting_note(table.sections), *notes) for table in scored]
    tables = [replace(t, caption=" ".join(filter(None, texts))) for t, texts in zip(scored, captions, strict=True)]
    tables += [count_table(builder), *distance_tables(known)]
    if builder.has_results("loeo"):
        tables += [correlation_table(grades, known, paper), *own_correlation_tables(grades, known)]
        tables.append(certainty_table(grades, known, paper))
    if correlated := difficulty_table(difficulty, grades.metrics):
        tables.append(correlated)
    return tables


def trainings_note(grades: StudyGrades) -> str:
    """Sentence that says what the intervals of a study's tables are over: of this training, or of several."""
    counts = {name: grades.trainings(name) for name in grades.variants}
    several = {name: count for name, count in counts.items() if count > 1}
    if not several:
        return "Every interval is of this training: one of each model, over scenes." if counts else ""
    if len(set(counts.values())) == 1:
        return f"Intervals are over {next(iter(counts.values()))} trainings of each model, and over scenes."
    named = ", ".join(f"{name} ({count})" for name, count in several.items())
    rest = ", ".join(name for name in counts if name not in several)
    ending = f"; those of {rest} are of this training" if rest else ""
    return f"Intervals are over scenes and the trainings of {named}{ending}."


def _sentences(
    grades: StudyGrades,
    distances: Distances,
    difficulty: Difficulty | None,
    findings: Sequence[Finding],
    by_paper: Sequence[Finding],
) -> list[str]:
    """The results in sentences, one for each question that was asked."""
    asked = [
        *_gap_sentence(grades),
        *_best_sentences(grades),
        *_adaptation_sentences(grades),
        *_distance_sentence(grades, distances),
        *_scaling_sentence(grades),
        *_bodies_sentence(difficulty),
    ]
    return [
        *([_answer_sentence(findings)] if findings else []),
        *pasting_sentence(findings),
        *parting_sentence(findings, by_paper, bool(strict_metrics(grades.metrics))),
        *asked,
    ]


def pasting_sentence(findings: Sequence[Finding]) -> Iterator[str]:
    """Sentence on how many claims about a rung or a stream speak of models that beat the pasted render."""
    counts = {answer: [f.claim.name for f in findings if f.pasting == text] for answer, text in BEATS.items()}
    asked = sum(len(names) for answer, names in counts.items() if answer != UNMEASURED)
    if asked:
        yield (
            f"Of {asked} claims about what a model is told, in {len(counts[HOLDS]) or 'none'} all models that it speaks for "
            f"beat the pasted render, which learned nothing; in {len(counts[FAILS]) or 'none'} one is worse than that, and "
            f"{len(counts[UNRESOLVED]) or 'none'} cannot be told."
        )
    elif counts[UNMEASURED]:
        yield "Whether models beat the pasted render, which learned nothing, cannot be told: it was not graded."


def find_parting_claims(findings: Sequence[Finding], by_paper: Sequence[Finding]) -> list[tuple[Finding, Finding]]:
    """Claims of which the two suites give another answer, with that of strict and that of the paper's definitions."""
    return [(ours, other) for ours, other in zip(findings, by_paper, strict=True) if ours.answer != other.answer]


def parting_sentence(findings: Sequence[Finding], by_paper: Sequence[Finding], graded: bool) -> Iterator[str]:
    """Sentence on the claims on which the suites part; none where no claim could be asked.

    Args:
        findings: by the suite strict.
        by_paper: by the paper's definitions.
        graded: whether any metric of the suite strict was graded that stands in the place of one of the paper's.
    """
    if all(finding.answer == UNMEASURED for finding in findings):
        return
    if not graded:
        yield "The suite strict was not graded: all answers are by the paper's definitions."
        return
    parts = [
        f"{ours.claim.says.strip('… ').rstrip('.')} (strict: {ours.answer}, paper: {other.answer})"
        for ours, other in find_parting_claims(findings, by_paper)
    ]
    others = f"By the paper's definitions others would be: {'; '.join(parts)}." if parts else ""
    yield f"The suite strict decides these answers. {others or 'By the definitions of the paper each claim has the same.'}"


def _answer_sentence(findings: Sequence[Finding]) -> str:
    claims = [finding for finding in findings if finding.claim.where != "ours"]
    counts = {word: sum(finding.answer == word for finding in claims) for word in (HOLDS, FAILS, UNRESOLVED, UNMEASURED)}
    measured = len(claims) - counts[UNMEASURED]
    if not measured:
        return f"None of {len(claims)} claims of the paper could be asked of what was graded here."
    asked = "all" if measured == len(claims) else str(measured)
    verbs = {HOLDS: ("holds", "hold"), FAILS: ("fails", "fail"), UNRESOLVED: ("is unresolved", "are unresolved")}
    parts = [f"{counts[word] or 'none'} {verbs[word][counts[word] > 1]}" for word in verbs]
    text = f"Of {len(claims)} claims of the paper {asked} could be asked here: {', '.join(parts)}."
    failed = [finding.claim.says.strip("… ").rstrip(".") for finding in claims if finding.answer == FAILS]
    return text + (f" What fails: {'; '.join(failed)}." if failed else "")


def _gap_sentence(grades: Grades) -> Iterator[str]:
    reader, parts = Reader(grades), []
    for robot in HELD_OUT_ROBOTS if reader.mean_of_seen(HELD_OUT_ROBOTS[0], "lpips") else ():
        try:
            gap = reader.unseen_gap(robot, "lpips")
        except NotMeasuredError:
            continue
        if OTHER_ROBOTS not in gap.doubt:
            ends = " to ".join(_format_change(end) for end in gap.number.interval(grades.level) if not np.isnan(end))
            parts.append(f"{_format_change(gap.number.value)} on {ROBOT_TITLES[robot]}" + (f" ({ends})" if ends else ""))
    if parts:
        yield f"A model that never saw the robot has another LPIPS on it than models that did: {' and '.join(parts)}."


def _best_sentences(grades: Grades) -> Iterator[str]:
    """Sentences on which action representation and which condition on looks help most."""
    for part, base, labels in (("actions", "joints", ACTIONS), ("ladder", "none", LADDER)):
        found = []
        for robot in HELD_OUT_ROBOTS:
            gains = {row: _gain(grades, part, row, base, robot) for row in labels if row != base}
            known = {row: gain for row, gain in gains.items() if gain is not None}
            if known:
                best = max(known, key=lambda row: known[row])
                label = labels[best].removeprefix("+ ").lower()
                found.append(f"{label} on {SHORT_ROBOTS[robot]} ({_format_change(known[best])})")
        if found:
            yield f"Against {labels[base].lower()}, LPIPS improves most with {' and '.join(found)}."


def _adaptation_sentences(grades: Grades) -> Iterator[str]:
    for robot in HELD_OUT_ROBOTS:
        gain = _gain(grades, "few_shot", f"{robot}-1", f"{robot}-0", robot)
        loss = _gain(grades, "forgetting", f"{robot}-1", "none", FORGETTING_ROBOT)
        if gain is not None and loss is not None:
            yield (
                f"One demonstration of each task changes LPIPS by {_format_change(-gain)} on {ROBOT_TITLES[robot]}, and by "
                f"{_format_change(-loss)} on {ROBOT_TITLES[FORGETTING_ROBOT]}, which the model had been trained on."
            )


def _distance_sentence(grades: Grades, distances: Distances) -> Iterator[str]:
    found = correlate(grades, distances)
    parts = [
        f"r = {format_signed(found['lpips', axis].r)} with {axis} distance (p = {found['lpips', axis].p_value:.3f}, "
        f"{'stable' if found['lpips', axis].stable else 'unstable'} sign)"
        for axis in AXES
        if ("lpips", axis) in found
    ]
    if parts:
        yield f"Over the five robots, each held out in turn, LPIPS goes with distance: {'; '.join(parts)}."


def _scaling_sentence(grades: Grades) -> Iterator[str]:
    """What the largest number of bodies beside the three robots is worth, on each held-out robot and on unseen bodies."""
    rows = [f"scaling_seen_bodies_{count}" for count in BODY_SCALES]
    known = [row for row in rows if _gain(grades, "scaling", row, "scaling_seen", BODIES) is not None]
    if known:
        targets = {**{robot: SHORT_ROBOTS[robot] for robot in HELD_OUT_ROBOTS}, BODIES: "unseen bodies"}
        gains = {name: _gain(grades, "scaling", known[-1], "scaling_seen", robots) for robots, name in targets.items()}
        parts = [f"{_format_change(-gain)} on {name}" for name, gain in gains.items() if gain is not None]
        count = known[-1].rpartition("_")[2]
        yield f"Training on {count} bodies beside the three robots changes LPIPS by {', '.join(parts)}."


def _bodies_sentence(difficulty: Difficulty | None) -> Iterator[str]:
    """How LPIPS on bodies of the distance family goes with each of the paper's distances, and with the frozen frame's."""
    if difficulty is None:
        return
    errors = difficulty.errors
    parts = [
        f"with {axis} distance at r = {format_signed(result.r)} ({format_signed(result.low)} to {format_signed(result.high)}, "
        f"p = {result.p_value:.4f})"
        for axis, result in difficulty.correlations.items()
        if axis in AXES
    ]
    if parts:
        frozen = float(errors["value"].corr(errors["frozen"]))
        last = "" if np.isnan(frozen) else f", and with that of the frozen first frame at r = {format_signed(frozen)}"
        yield f"Over {len(errors)} bodies that one model has never seen, its LPIPS correlates {', '.join(parts)}{last}."


def _format_change(share: float) -> str:
    return f"{100 * share:+z.0f}\u00a0%".replace("-", "−")


def _gain(grades: Grades, part: str, row: str, base: str, robot: str) -> float | None:
    if "lpips" not in grades.metrics:
        return None
    after, before = (grades.mean(part, key, robot, "lpips", shared=True) for key in (row, base))
    return relative_gain(after, before, grades.metrics["lpips"]).value if after and before else None


def _missing_notes(builder: Builder, scores: Scores) -> Iterator[str]:
    absent = [part.replace("_", " ") for part in PAPER_PARTS if not builder.has_results(part)]
    if len(absent) == len(PAPER_PARTS):
        yield "No part of the paper was run in this study."
    elif absent:
        yield f"Not run in this study: {', '.join(absent)}."
    unknown = set(scores.rows["variant"]) - {variant.name for variants in PARTS.values() for variant in variants} - {""}
    if unknown:
        yield f"Graded, but in no table of the protocol: {', '.join(sorted(unknown))}."


def missing_note(missing: pd.DataFrame) -> list[str]:
    """A note on scores that other models have and one lacks; none where nothing is missing."""
    if missing.empty:
        return []
    return [
        f"{len(missing)} scores are missing that other models have; comparisons leave these cells out for all. They are in "
        f"missing.csv: {describe_scores(missing, 3)}."
    ]


def _write_html(content: Content, scores: Scores, footer: str) -> str:
    """The page."""
    sections = {"Claims": _claims_section(content)} if content.findings else {}
    sections |= {PART_TITLES[part]: text for part in SECTIONS if (text := _part_section(content, part))}
    sections["How it was measured"] = _method_section(content, scores)
    head = [page.contents(list(sections)), *map(page.note, content.lacks)]
    return page.page(TITLE, content.sentences, [*head, *sections.values()], footer)


def _claims_section(content: Content) -> Markup:
    text = (
        "Each claim of the paper as inequalities, asked of this study and of the paper's own printed figures. It holds where "
        "every number lies on its side of the bound, and fails where one lies on the other side, each at 5 % after Holm's "
        "correction for the comparisons of the claim (for the paper: with all that prints the same); anything else is "
        "unresolved. “Among all claims” corrects once more, for all of them. That something saturates or is alike is an "
        "equivalence: two one-sided tests with the margins that the claim names. Metrics of the suite strict decide, in which "
        "what is lost is an error; where the paper's definitions give another answer, it stands beside. Claims about what a "
        "model is told also say whether these models beat the first frame with the robot's render pasted in. The last ones, "
        "“ours”, ask more than the paper claims."
    )
    return page.section(
        "Claims",
        page.paragraph(text),
        page.paragraph(content.trainings),
        page.claims(content.findings, content.printed, content.by_paper),
    )


def _part_section(content: Content, part: str) -> Markup | None:
    charts, shown, folded = SECTIONS[part]
    if not any(name in content.tables for name in shown):
        return None
    parts = [page.chart(content.charts[name]) for name in charts if name in content.charts]
    parts += [page.table(content.tables[name]) for name in shown if name in content.tables]
    if part in content.strips:
        strip = content.strips[part]
        source = pictures.data_uri(strip.image)
        parts.append(page.labeled_picture(source, strip.caption, strip.columns, strip.rows))
    if FRAME_CHARTS.get(part) in content.charts:
        parts.append(page.chart(content.charts[FRAME_CHARTS[part]]))
    hidden = [content.tables[name] for name in folded if name in content.tables]
    if hidden:
        parts.append(page.details("; ".join(table.title for table in hidden), *map(page.table, hidden)))
    return page.section(PART_TITLES[part], *parts)


def _method_section(content: Content, scores: Scores) -> Markup:
    made = {"scenes graded": str(len(scores.rows[["task", "seed"]].drop_duplicates())), **scores.measured_by}
    definitions = {metric.title: metric.reference for metric in scores.metrics}
    return page.section(
        "How it was measured",
        page.paragraph(
            f"Means over episodes with 95 % bootstrap intervals. {content.trainings} Scenes (seeds) are resampled within their "
            "tasks, the same ones for every model and robot, so that all comparisons are paired. Behind a value, against the "
            "row that the caption names: "
            f"{MARKS}. “True video, graded” is the truth in the model's place: what it lacks is the estimators' own error, "
            "the noise floor. The paper's values are of its own renders and a model of five billion weights; they stand "
            "beside ours where its protocol is the same."
        ),
        page.table(content.tables["counts"]),
        page.definitions(definitions),
        page.definitions(made),
    )


def _write_markdown(content: Content) -> str:
    lines = [
        f"# {TITLE}",
        "",
        *(f"- {plain_markdown(sentence)}" for sentence in content.sentences),
        "",
        *(f"> {note}\n" for note in content.lacks),
    ]
    if content.findings:
        claims = formats.findings_markdown(content.findings, content.printed, content.by_paper)
        lines += ["## Claims", "", content.trainings, "", claims]
    for part, (charts, shown, folded) in SECTIONS.items():
        if not any(name in content.tables for name in shown):
            continue
        lines += ["", f"## {PART_TITLES[part]}"]
        for name in (*charts, *([FRAME_CHARTS[part]] if part in FRAME_CHARTS else [])):
            if name in content.charts:
                lines += ["", f"![{content.charts[name].caption}](figures/{name}.png)"]
        if part in content.strips:
            lines += ["", f"![{content.strips[part].caption}](figures/strip_{part}.png)"]
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
    for chart in content.charts.values():
        for name, data in chart_files(chart).items():
            yield f"figures/{name}", data
    for part, strip in content.strips.items():
        yield f"figures/strip_{part}.png", strip.image
    if len(content.missing):
        yield "missing.csv", csv_text(content.missing).encode()
    if content.findings:
        sources = {"here": content.findings, "here, paper's definitions": content.by_paper, "paper": content.printed}
        together = pd.concat([findings_frame(found, of) for of, found in sources.items()])
        yield "findings.csv", csv_text(together).encode()
        yield "tables/findings.tex", formats.findings_latex(content.findings, content.printed, content.by_paper).encode()

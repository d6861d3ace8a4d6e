"""What came out of a study, in sentences, with notes on what its intervals are over and on what is missing."""

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from xew.analysis.beyond import Motions, OverBodies
from xew.analysis.paper import AXES
from xew.analysis.scores import Scores, describe_scores
from xew.analysis.statistics.grades import BODIES, Grades, StudyGrades, relative_gain
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.comparisons import OTHER_ROBOTS, NotMeasuredError, Reader
from xew.analysis.tables.distances import Distances, correlate, format_signed
from xew.analysis.tables.findings import BEATS, FAILS, HOLDS, UNMEASURED, UNRESOLVED, Finding
from xew.analysis.tables.labels import ACTIONS, LADDER, REMEDIES, ROBOT_TITLES, SHORT_ROBOTS
from xew.protocol import BODY_SCALES, FORGETTING_ROBOT, HELD_OUT_ROBOTS, PAPER_PARTS, PARTS
from xew.statistics import strict_metrics


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


def study_sentences(
    grades: StudyGrades,
    distances: Distances,
    over_bodies: tuple[OverBodies | None, OverBodies | None],
    motions: Motions | None,
    findings: Sequence[Finding],
    by_paper: Sequence[Finding],
) -> list[str]:
    """The results in sentences, one for each question that was asked; `over_bodies` are errors and gaps in LPIPS."""
    errors, gaps = over_bodies
    asked = [
        *_gap_sentence(grades),
        *_best_sentences(grades),
        *_adaptation_sentences(grades),
        *_distance_sentence(grades, distances),
        *_scaling_sentence(grades),
        *_bodies_sentence(errors),
        *_halves_sentence(gaps),
        *_motion_sentences(motions),
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
        changes = {}
        for remedy, title in REMEDIES.items():
            gain = _gain(grades, "few_shot", f"{robot}-1-{remedy}", f"{robot}-0", robot)
            loss = _gain(grades, "forgetting", f"{robot}-1-{remedy}", "none", FORGETTING_ROBOT)
            if gain is not None and loss is not None:
                changes[title] = f"by {_format_change(-gain)} and {_format_change(-loss)}"
        if changes:
            parts = ", ".join(f"{title} {change}" for title, change in changes.items())
            yield f"The same demonstrations of {ROBOT_TITLES[robot]} change both, {parts}."


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


def _bodies_sentence(difficulty: OverBodies | None) -> Iterator[str]:
    """How LPIPS on bodies of the wide family goes with each of the paper's distances, and with the frozen frame's."""
    if difficulty is None:
        return
    errors, parts = difficulty.values, _correlations(difficulty)
    if parts:
        frozen = float(errors["value"].corr(errors["frozen"]))
        last = "" if np.isnan(frozen) else f", and with that of the frozen first frame at r = {format_signed(frozen)}"
        yield f"Over {len(errors)} bodies that one model has never seen, its LPIPS correlates {', '.join(parts)}{last}."


def _halves_sentence(gaps: OverBodies | None) -> Iterator[str]:
    """How the gap in LPIPS of bodies that one model saw and another did not goes with each of the paper's distances."""
    if gaps is None:
        return
    shares, parts = gaps.values["value"] / 100, _correlations(gaps)
    if parts:
        yield (
            f"Over {len(shares)} bodies, a model that never saw the body has another LPIPS on it than one that did: "
            f"{_format_change(shares.mean())} on average, {_format_change(shares.min())} to {_format_change(shares.max())}. "
            f"This gap correlates {', '.join(parts)}."
        )


def _motion_sentences(motions: Motions | None) -> Iterator[str]:
    """How each action representation's LPIPS differs in own motion from that in shared motion, on each held-out robot."""
    if motions is None:
        return
    for robot in HELD_OUT_ROBOTS:
        changes = {title: motions.change(action, robot, "lpips") for action, title in ACTIONS.items()}
        parts = [
            f"{_format_change(change.value)} ({' to '.join(map(_format_change, change.interval()))}) with {title.lower()}"
            for title, change in changes.items()
            if change
        ]
        if parts:
            yield f"Where each robot moves in its own way, LPIPS on {ROBOT_TITLES[robot]} differs by {', '.join(parts)}."


def _correlations(difficulty: OverBodies) -> list[str]:
    """Correlations over bodies with each of the paper's distances, in words."""
    return [
        f"with {axis} distance at r = {format_signed(result.r)} ({format_signed(result.low)} to {format_signed(result.high)}, "
        f"p = {result.p_value:.4f})"
        for axis, result in difficulty.correlations.items()
        if axis in AXES
    ]


def _format_change(share: float) -> str:
    return f"{100 * share:+z.0f}\u00a0%".replace("-", "−")


def _gain(grades: Grades, part: str, row: str, base: str, robot: str) -> float | None:
    if "lpips" not in grades.metrics:
        return None
    after, before = (grades.mean(part, key, robot, "lpips", shared=True) for key in (row, base))
    return relative_gain(after, before, grades.metrics["lpips"]).value if after and before else None


def part_notes(builder: Builder, scores: Scores) -> Iterator[str]:
    """Notes on parts of the paper that were not run, and on what was graded beside the protocol."""
    absent = [part.replace("_", " ") for part in PAPER_PARTS if not builder.has_results(part)]
    if len(absent) == len(PAPER_PARTS):
        yield "No part of the paper was run in this study."
    elif absent:
        yield f"Not run in this study: {', '.join(absent)}."
    unknown = set(scores.rows["variant"]) - {variant.name for variants in PARTS.values() for variant in variants} - {""}
    if unknown:
        yield f"Graded, but in no table of the protocol: {', '.join(sorted(unknown))}."


def curves_note(scores: Scores) -> list[str]:
    """A note on missing scores by frame; none where they are there."""
    if not scores.curves.empty:
        return []
    return ["No chart of the error by frame: the file of curves (*.curves.parquet) is missing; evaluate writes it."]


def missing_note(missing: pd.DataFrame) -> list[str]:
    """A note on scores that other models have and one lacks; none where nothing is missing."""
    if missing.empty:
        return []
    return [
        f"{len(missing)} scores are missing that other models have; comparisons leave these cells out for all. They are in "
        f"missing.csv: {describe_scores(missing, 3)}."
    ]

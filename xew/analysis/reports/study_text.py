"""Sentences of a study's report: its results, what its intervals cover, and what is missing."""

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from xew.analysis.beyond import Motions, OverBodies, Shifts
from xew.analysis.beyond.shifts import MODELS
from xew.analysis.paper import AXES
from xew.analysis.scores import Scores, describe_scores
from xew.analysis.statistics.grades import BODIES, Grades, StudyGrades, paired_means, relative_gain
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.comparisons import OTHER_ROBOTS, NotMeasuredError, Reader
from xew.analysis.tables.distances import Distances, correlate
from xew.analysis.tables.findings import BEATS, FAILS, HOLDS, UNMEASURED, UNRESOLVED, Finding
from xew.analysis.tables.labels import ACTIONS, LADDER, REMEDIES, ROBOT_TITLES, SHORT_ROBOTS
from xew.analysis.tables.table import format_change, format_p, format_signed
from xew.protocol import BODY_SCALES, FORGETTING_ROBOT, HELD_OUT_ROBOTS, PAPER_PARTS, PARTS
from xew.statistics import ASSUMED_SPREAD, LEVEL, Mean, interval_of_difference, strict_metrics


def trainings_note(grades: StudyGrades) -> str:
    """Sentence that says which training runs a study's intervals cover, and what spread those of a single run carry."""
    counts = {name: grades.trainings(name) for name in grades.variants}
    if not counts:
        return ""
    if max(counts.values()) == 1:
        return f"Each model was trained once; intervals carry an assumed spread between training runs of {ASSUMED_SPREAD:.0%}."
    paired = "Differences are taken within the training seeds that both models have."
    if len(set(counts.values())) == 1:
        times = next(iter(counts.values()))
        return f"Each model was trained {times} times; intervals cover training runs and scenes. {paired}"
    named = ", ".join(f"{name} ({count})" for name, count in counts.items() if count > 1)
    rest = ""
    if min(counts.values()) == 1:
        rest = " The other models were trained once; their intervals carry the spread between these runs."
    return f"Intervals cover scenes and the training runs of {named}.{rest} {paired}"


def study_sentences(
    grades: StudyGrades,
    distances: Distances,
    over_bodies: Sequence[OverBodies | None],
    motions: Motions | None,
    shifts: Shifts | None,
    findings: Sequence[Finding],
    by_paper: Sequence[Finding],
) -> list[str]:
    """The results in sentences, one for each question that was asked.

    `over_bodies` are in LPIPS: errors of one model, gaps of halves, and errors of their models on bodies that they never saw.
    """
    errors, gaps, unseen = over_bodies
    return [
        *([_answer_sentence(findings)] if findings else []),
        *pasting_sentence(findings),
        *parting_sentence(findings, by_paper, bool(strict_metrics(grades.metrics))),
        *_gap_sentences(grades),
        *_best_sentences(grades),
        *_adaptation_sentences(grades),
        *_distance_sentences(grades, distances),
        *_scaling_sentence(grades),
        *_bodies_sentence(errors),
        *_halves_sentence(gaps, unseen),
        *_motion_sentences(motions),
        *_shifts_sentences(shifts),
    ]


def pasting_sentence(findings: Sequence[Finding]) -> Iterator[str]:
    """Sentence on how many claims about conditioning concern models that beat the paste baseline."""
    counts = {answer: sum(finding.pasting == text for finding in findings) for answer, text in BEATS.items()}
    asked = sum(counts.values()) - counts[UNMEASURED]
    if asked == 1:
        answer = next(answer for answer in (HOLDS, FAILS, UNRESOLVED) if counts[answer])
        ends = {
            HOLDS: "all of its models are better than the paste baseline",
            FAILS: "at least one of its models is worse than the paste baseline",
            UNRESOLVED: "the comparison of its models with the paste baseline is unresolved",
        }
        yield f"One claim concerns conditioning; {ends[answer]}."
    elif asked:
        ends = {
            HOLDS: "all models of {} are better than the paste baseline",
            FAILS: "{} include at least one model that is worse than the paste baseline",
            UNRESOLVED: "the comparison with the paste baseline is unresolved for {}",
        }
        parts = [
            text.format("all" if counts[answer] == asked else counts[answer]) for answer, text in ends.items() if counts[answer]
        ]
        yield f"{asked} claims concern conditioning: {'; '.join(parts)}."
    elif counts[UNMEASURED]:
        yield "The pasted render was not graded, so no model is compared with the paste baseline."


def find_parting_claims(findings: Sequence[Finding], by_paper: Sequence[Finding]) -> list[tuple[Finding, Finding]]:
    """Claims with two different answers: by the strict metrics, and by the paper's definitions."""
    return [(ours, other) for ours, other in zip(findings, by_paper, strict=True) if ours.in_family != other.in_family]


def parting_sentence(findings: Sequence[Finding], by_paper: Sequence[Finding], graded: bool) -> Iterator[str]:
    """Sentence on the claims that strict metrics and the paper's definitions answer differently.

    None where no claim could be tested; `graded` says whether any strict metric replaces one of the paper's.
    """
    if all(finding.answer == UNMEASURED for finding in findings):
        return
    if not graded:
        yield "No strict metric was graded, so all answers use the paper's metric definitions."
        return
    parts = [
        f"{_claim_text(ours)} (strict: {ours.in_family}, paper: {other.in_family})"
        for ours, other in find_parting_claims(findings, by_paper)
    ]
    others = f"differ for: {'; '.join(parts)}" if parts else "give the same answers"
    yield f"Strict metrics decide these answers. The paper's definitions {others}."


def _claim_text(finding: Finding) -> str:
    return finding.claim.says.rstrip(".")


def _answer_sentence(findings: Sequence[Finding]) -> str:
    claims = [finding for finding in findings if finding.claim.where != "ours"]
    tested = [finding for finding in claims if finding.answer != UNMEASURED]
    if not tested:
        return f"The scores answer none of the paper's {len(claims)} claims."
    held, failed = ([finding for finding in tested if finding.in_family == answer] for answer in (HOLDS, FAILS))
    rest = "; the others are unresolved" if len(held) + len(failed) < len(tested) else ""
    scope = f"All {len(claims)}" if len(tested) == len(claims) else f"{len(tested)} of the {len(claims)}"
    text = f"{scope} claims of the paper were tested. {len(held) or 'None'} held and {len(failed) or 'none'} failed{rest}."
    return text + (f" Failed: {'; '.join(map(_claim_text, failed))}." if failed else "")


def _gap_sentences(grades: Grades) -> Iterator[str]:
    reader = Reader(grades)
    for robot in HELD_OUT_ROBOTS if reader.mean_of_seen(HELD_OUT_ROBOTS[0], "lpips") else ():
        try:
            gap = reader.unseen_gap(robot, "lpips")
        except NotMeasuredError:
            continue
        if OTHER_ROBOTS not in gap.doubt:
            yield (
                f"On {ROBOT_TITLES[robot]}, LPIPS is {_format_more(gap.number.value)}{_format_ends(gap.number, grades.level)} "
                "for a model that never saw the robot than for models that did."
            )


def _best_sentences(grades: Grades) -> Iterator[str]:
    for part, base, labels in (("actions", "joints", ACTIONS), ("ladder", "none", LADDER)):
        parts = []
        for robot in HELD_OUT_ROBOTS:
            gains = {row: _gain(grades, part, row, base, robot) for row in labels if row != base}
            known = {row: gain for row, gain in gains.items() if gain is not None}
            if known:
                best = max(known, key=lambda row: known[row])
                label = labels[best].removeprefix("+ ").lower()
                parts.append(f"with {label} on {SHORT_ROBOTS[robot]} ({format_change(known[best])})")
        if parts:
            yield f"Compared with {labels[base].lower()}, LPIPS improves most {' and '.join(parts)}."


def _adaptation_sentences(grades: Grades) -> Iterator[str]:
    for robot in HELD_OUT_ROBOTS:
        for remedy, title in {"": "", **REMEDIES}.items():
            ending = f"-{remedy}" if remedy else ""
            gain = _gain(grades, "few_shot", f"{robot}-1{ending}", f"{robot}-0", robot)
            loss = _gain(grades, "forgetting", f"{robot}-1{ending}", "none", FORGETTING_ROBOT)
            if gain is not None and loss is not None:
                yield (
                    f"Adaptation {title and f'{title} '}to one demonstration of each task changes LPIPS by "
                    f"{format_change(-gain)} on the target, {ROBOT_TITLES[robot]}, and by {format_change(-loss)} on the "
                    f"training robot {ROBOT_TITLES[FORGETTING_ROBOT]}."
                )


def _distance_sentences(grades: Grades, distances: Distances) -> Iterator[str]:
    results = correlate(grades, distances)
    for axis in AXES:
        if result := results.get(("lpips", axis)):
            yield (
                f"Over the five leave-one-out folds, LPIPS correlates with {axis} distance at r = {format_signed(result.r)} "
                f"({format_p(result.p_value)}); its sign is {'stable' if result.stable else 'unstable'}."
            )


def _scaling_sentence(grades: Grades) -> Iterator[str]:
    rows = [f"scaling_seen_bodies_{count}" for count in BODY_SCALES]
    known = [row for row in rows if _gain(grades, "scaling", row, "scaling_seen", BODIES) is not None]
    if known:
        targets = {**{robot: SHORT_ROBOTS[robot] for robot in HELD_OUT_ROBOTS}, BODIES: "unseen bodies"}
        gains = {name: _gain(grades, "scaling", known[-1], "scaling_seen", robots) for robots, name in targets.items()}
        parts = [f"{format_change(-gain)} on {name}" for name, gain in gains.items() if gain is not None]
        count = known[-1].rpartition("_")[2]
        yield f"Adding {count} bodies to the three training robots changes LPIPS by {', '.join(parts)}."


def _bodies_sentence(difficulty: OverBodies | None) -> Iterator[str]:
    parts = _correlations(difficulty) if difficulty else []
    if difficulty and parts:
        errors = difficulty.values
        frozen = float(errors["value"].corr(errors["frozen"]))
        last = (
            "" if np.isnan(frozen) else f" Its correlation with LPIPS of the frozen first frame is r = {format_signed(frozen)}."
        )
        yield f"On {len(errors)} bodies that one model has never seen, its LPIPS correlates {' and '.join(parts)}.{last}"


def _halves_sentence(gaps: OverBodies | None, unseen: OverBodies | None) -> Iterator[str]:
    parts = _correlations(gaps) if gaps else []
    if gaps and parts:
        shares = gaps.values["value"] / 100
        yield (
            f"Over {len(shares)} bodies, LPIPS is {_format_more(shares.mean())} on average for a model that never saw the body "
            f"than for one that did ({format_change(shares.min())} to {format_change(shares.max())}). "
            f"This gap correlates {' and '.join(parts)}."
        )
        yield from _looks_or_kinematics(gaps)
    if errors := _correlations(unseen) if unseen else []:
        yield f"LPIPS itself, of the model that never saw the body, correlates {' and '.join(errors)}."


def _looks_or_kinematics(gaps: OverBodies) -> Iterator[str]:
    """Whether the gap of bodies goes more with kinematic or with appearance distance."""
    if {"kinematic", "appearance"} <= set(gaps.correlations):
        difference = gaps.correlations["kinematic"].r - gaps.correlations["appearance"].r
        columns = (gaps.values[name].to_numpy(np.float64) for name in ("kinematic", "appearance", "value"))
        low, high = interval_of_difference(*columns)
        kind = "kinematics, not looks" if low > 0 else "looks, not kinematics" if high < 0 else ""
        answer = f"the gap goes with {kind}" if kind else "which of the two the gap goes with is not resolved"
        yield (
            f"The r of kinematic distance minus that of appearance distance is {format_signed(difference)} "
            f"({format_signed(low)} to {format_signed(high)}): {answer}."
        )


def _motion_sentences(motions: Motions | None) -> Iterator[str]:
    if motions is None:
        return
    for robot in HELD_OUT_ROBOTS:
        changes = {title: motions.change(action, robot, "lpips") for action, title in ACTIONS.items()}
        parts = [
            f"{format_change(change.value)}{_format_ends(change)} with {title.lower()}"
            for title, change in changes.items()
            if change
        ]
        if parts:
            yield f"From shared to own motion, LPIPS on {ROBOT_TITLES[robot]} changes by {', '.join(parts)}."


def _shifts_sentences(shifts: Shifts | None) -> Iterator[str]:
    if shifts is None:
        return
    for model in shifts.models:
        costs = {robot: shifts.cost(model, robot, "lpips") for robot in HELD_OUT_ROBOTS}
        added = [f"{cost.value:.3f} on {SHORT_ROBOTS[robot]}" for robot, cost in costs.items() if cost]
        compared = shifts.compare_changes(model, "lpips")
        named = {"more": "Changes that add more", "less": "Changes that add less", "unresolved": "Not resolved"}
        lists = [f"{title}: {_list_changes(compared[word])}." for word, title in named.items() if compared[word]]
        if added:
            yield f"Trained with {MODELS[model]}, a new robot adds {' and '.join(added)} to LPIPS. {' '.join(lists)}"


def _list_changes(changes: Sequence[str]) -> str:
    """Text such as 'light 1, 2; table 3'."""
    pairs = [change.partition(":")[::2] for change in changes]
    levels = {factor: ", ".join(level for other, level in pairs if other == factor) for factor, _ in pairs}
    return "; ".join(f"{factor} {own}" for factor, own in levels.items())


def _correlations(difficulty: OverBodies) -> list[str]:
    return [
        f"with {axis} distance at r = {format_signed(result.r)} ({format_signed(result.low)} to {format_signed(result.high)}, "
        f"{format_p(result.p_value)})"
        for axis, result in difficulty.correlations.items()
        if axis in AXES
    ]


def _format_ends(number: Mean, level: float = LEVEL) -> str:
    """Text such as ' (+25 % to +30 %)'; '' where there is no interval."""
    ends = [format_change(end) for end in number.interval(level) if not np.isnan(end)]
    return f" ({' to '.join(ends)})" if ends else ""


def _format_more(share: float) -> str:
    return f"{format_change(abs(share)).lstrip('+')} {'higher' if share >= 0 else 'lower'}"


def _gain(grades: Grades, part: str, row: str, base: str, robot: str) -> float | None:
    pair = paired_means(grades, part, row, base, robot, "lpips") if "lpips" in grades.metrics else None
    return relative_gain(*pair, grades.metrics["lpips"]).value if pair else None


def part_notes(builder: Builder, scores: Scores) -> Iterator[str]:
    """Notes on parts of the paper that were not run, and on variants outside the protocol."""
    absent = [part.replace("_", " ") for part in PAPER_PARTS if not builder.has_results(part)]
    if len(absent) == len(PAPER_PARTS):
        yield "No part of the paper was run in this study."
    elif absent:
        yield f"Not run in this study: {', '.join(absent)}."
    unknown = set(scores.rows["variant"]) - {variant.name for variants in PARTS.values() for variant in variants} - {""}
    if unknown:
        yield f"Graded, but not in the protocol's tables: {', '.join(sorted(unknown))}."


def curves_note(scores: Scores) -> list[str]:
    """A note on missing scores by frame; none where they are there."""
    if not scores.curves.empty:
        return []
    return ["The chart of the error by frame needs the file *.curves.parquet, which is missing; evaluate writes it."]


def missing_note(missing: pd.DataFrame) -> list[str]:
    """A note on scores that some models lack; none where nothing is missing."""
    if missing.empty:
        return []
    return [
        f"{len(missing)} scores are missing for some models; comparisons leave out these episodes for all models. missing.csv "
        f"lists them: {describe_scores(missing, 3)}."
    ]

"""The answers to claims, for a study or for the paper's printed figures.

Every comparison has two p-values, of the claim and of its opposite, corrected by Holm's method within the claim. A claim holds
if all its comparisons hold, fails if one opposite is significant, and is unresolved otherwise or where there is a doubt (noise
floor, no gap, five robots, few scenes). The answer that reports quote corrects for all claims too. For printed figures p is 0
or 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from xew.analysis.statistics.grades import Grades
from xew.analysis.tables.claims import CLAIMS
from xew.analysis.tables.comparisons import Claim, Comparison, NotMeasuredError, Reader
from xew.analysis.tables.table import format_plain, format_share
from xew.statistics import SIGNIFICANCE, holm

HOLDS, FAILS, UNRESOLVED, UNMEASURED = "holds", "fails", "unresolved", "not measured"
BEATS = {HOLDS: "beats pasting", FAILS: "does not beat pasting", UNRESOLVED: "unresolved against pasting"}
BEATS[UNMEASURED] = "pasting was not graded"
"""Texts of the answers to whether what a claim speaks of beats the pasted render: worse by one comparison is “does not”."""


@dataclass(frozen=True)
class AnsweredComparison:
    """A comparison of a claim with its numbers and its answer."""

    label: str
    numbers: str
    """Value and interval as text, with any doubt."""
    value: float
    low: float
    high: float
    answer: str
    p_holds: float = np.nan
    """p of what is claimed, corrected for the comparisons of the claim; 1 where there is a doubt."""
    p_fails: float = np.nan
    trainings: int = 0
    """Least number of trainings that it rests on; 0 where none is known (the paper)."""

    @property
    def text(self) -> str:
        """Label and numbers."""
        return f"{self.label} {self.numbers}"


@dataclass(frozen=True)
class Finding:
    """The answer to one claim on one study's scores."""

    claim: Claim
    answer: str
    comparisons: tuple[AnsweredComparison, ...]
    missing: str = ""
    in_family: str = UNMEASURED
    """Answer where all claims that were measured count as one family of tests: the one that reports quote."""
    over_pasting: tuple[AnsweredComparison, ...] = ()
    """Gains over the pasted render of the models of which the claim says something good; empty where there is none, or where
    the render was not graded."""
    pasting: str = ""
    """Whether all of these beat the pasted render, one of BEATS; '' where the claim speaks of no rung or stream."""

    @property
    def p_holds(self) -> float:
        """p of the claim: the largest of its comparisons'."""
        return max((one.p_holds for one in self.comparisons), default=1.0)

    @property
    def p_fails(self) -> float:
        """p of its opposite: the smallest of its comparisons'."""
        return min((one.p_fails for one in self.comparisons), default=1.0)

    @property
    def basis(self) -> str:
        """Text such as '2 training runs', which the result rests on; '' for the paper."""
        least = min((one.trainings for one in self.comparisons if one.trainings), default=0)
        return "" if not least else "one training run" if least == 1 else f"{least} training runs"

    def span(self) -> str:
        """Text with the smallest and the largest number."""
        numbers = sorted(self.comparisons, key=lambda one: one.value)
        first, last = (one.numbers.partition(" [")[0] for one in (numbers[0], numbers[-1]))
        return f"{len(numbers)} comparisons, {first} to {last}"


def ask(grades: Grades, claims: Sequence[Claim] | None = None) -> list[Finding]:
    """The answer to each claim, alone and among all."""
    reader = Reader(grades)
    found = [_ask_claim(claim, reader) for claim in (CLAIMS if claims is None else claims)]
    measured = [finding for finding in found if finding.answer != UNMEASURED]
    corrected = zip(holm([f.p_holds for f in measured]), holm([f.p_fails for f in measured]), strict=True)
    in_family = [_answer(float(claim), float(opposite)) for claim, opposite in corrected]
    known = iter(in_family)
    return [finding if finding.answer == UNMEASURED else replace(finding, in_family=next(known)) for finding in found]


def _ask_claim(claim: Claim, reader: Reader) -> Finding:
    level = reader.grades.level
    try:
        asked = list(claim.comparisons(reader))
    except NotMeasuredError as missing:
        return Finding(claim, UNMEASURED, (), str(missing))
    comparisons = _answer_all(asked, level)
    over, pasting = _ask_pasting(asked, reader)
    return Finding(claim, _answer_of(comparisons), comparisons, over_pasting=over, pasting=pasting)


def _ask_pasting(asked: Sequence[Comparison], reader: Reader) -> tuple[tuple[AnsweredComparison, ...], str]:
    """Whether the models that comparisons speak of beat the pasted render: by the same tests, corrected among themselves."""
    subjects = dict.fromkeys(comparison.subject for comparison in asked if comparison.subject)
    if not subjects:
        return (), ""
    try:
        over = _answer_all([reader.over_pasting(subject) for subject in subjects], reader.grades.level)
    except NotMeasuredError:
        return (), BEATS[UNMEASURED]
    return over, BEATS[_answer_of(over)]


def _answer_all(asked: Sequence[Comparison], level: float) -> tuple[AnsweredComparison, ...]:
    p_values = np.array([comparison.p_values(level) for comparison in asked])
    claims, opposites = holm(p_values[:, 0]), holm(p_values[:, 1])
    return tuple(_answer_comparison(*each, level) for each in zip(asked, claims, opposites, strict=True))


def _answer_of(comparisons: Sequence[AnsweredComparison]) -> str:
    """The answer to a claim from those to its comparisons: it fails with one of them, and holds with all."""
    answers = {one.answer for one in comparisons}
    return next(answer for answer in (FAILS, UNRESOLVED, HOLDS) if answer in answers)


def _answer(p_holds: float, p_fails: float) -> str:
    return HOLDS if p_holds <= SIGNIFICANCE else FAILS if p_fails <= SIGNIFICANCE else UNRESOLVED


def _answer_comparison(comparison: Comparison, p_holds: float, p_fails: float, level: float) -> AnsweredComparison:
    number, doubt = comparison.number, f" ({comparison.doubt})" if comparison.doubt else ""
    value, (low, high) = number.value, number.interval(level)
    if comparison.doubt:
        p_holds = p_fails = 1.0
    show = format_share if comparison.percent else format_plain
    ends = "" if low == high or np.isnan(low) else f" [{show(low)}, {show(high)}]"
    numbers, answer = f"{show(value)}{ends}{doubt}", _answer(p_holds, p_fails)
    return AnsweredComparison(
        comparison.label, numbers, value, low, high, answer, float(p_holds), float(p_fails), number.trainings
    )


def findings_frame(findings: Sequence[Finding], of: str) -> pd.DataFrame:
    """A tidy frame of claims, one row per comparison.

    Columns: of claim where says test verdict verdict_in_family pasting comparison value low high answer p_holds p_fails
    trainings. `verdict` answers the claim, `verdict_in_family` the claim among all, `answer` the comparison; `of` names the
    source.
    """
    columns = ["of", "claim", "where", "says", "test", "verdict", "verdict_in_family", "pasting", "comparison", "value", "low"]
    columns += ["high", "answer", "p_holds", "p_fails", "trainings"]
    rows = [
        (of, f.claim.name, f.claim.where, f.claim.says, f.claim.test, f.answer, f.in_family, f.pasting, a.label, a.value, a.low,
         a.high, a.answer, a.p_holds, a.p_fails, a.trainings)
        for f in findings
        for a in (
            *(f.comparisons or (AnsweredComparison(f.missing, "", np.nan, np.nan, np.nan, UNMEASURED),)),
            *(replace(one, label=f"over pasting: {one.label}") for one in f.over_pasting),
        )
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=columns)

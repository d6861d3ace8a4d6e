"""The answers to claims: each claim's inequalities, asked of the numbers of a study or of the paper.

A claim holds where every comparison lies on its side of the bound with its whole interval, it fails where one lies on the
other side with its whole interval, and it is unresolved in between: also where a difference is inside the noise floor, where
a share is asked of a gap that may not be there, or where there are fewer than MIN_SCENES scenes. Asked of the paper's own
figures, the interval is what prints the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from xew.analysis.statistics.grades import Grades
from xew.analysis.tables.claims import CLAIMS
from xew.analysis.tables.comparisons import Claim, Comparison, NotMeasuredError, Reader
from xew.statistics import interval

HOLDS, FAILS, UNRESOLVED, UNMEASURED = "holds", "fails", "unresolved", "not measured"
"""The answers to a claim."""


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
    """One of HOLDS, FAILS and UNRESOLVED."""

    @property
    def text(self) -> str:
        """Label and numbers."""
        return f"{self.label} {self.numbers}"


@dataclass(frozen=True)
class Finding:
    """The answer to one claim on one study's scores."""

    claim: Claim
    answer: str
    """One of HOLDS, FAILS, UNRESOLVED and UNMEASURED."""
    comparisons: tuple[AnsweredComparison, ...]
    """Comparisons of the claim; empty where something was not measured."""
    missing: str = ""
    """Name of what was not measured, if anything."""

    def span(self) -> str:
        """Text with the smallest and the largest number."""
        numbers = sorted(self.comparisons, key=lambda one: one.value)
        first, last = (one.numbers.partition(" [")[0] for one in (numbers[0], numbers[-1]))
        return f"{len(numbers)} comparisons, {first} to {last}"


def ask(grades: Grades, claims: Sequence[Claim] | None = None) -> list[Finding]:
    """The answer to each claim."""
    reader = Reader(grades)
    return [_ask_claim(claim, reader) for claim in (CLAIMS if claims is None else claims)]


def _ask_claim(claim: Claim, reader: Reader) -> Finding:
    try:
        comparisons = tuple(_answer_comparison(comparison, reader.grades.level) for comparison in claim.comparisons(reader))
    except NotMeasuredError as missing:
        return Finding(claim, UNMEASURED, (), str(missing))
    answers = {one.answer for one in comparisons}
    return Finding(claim, next(answer for answer in (FAILS, UNRESOLVED, HOLDS) if answer in answers), comparisons)


def _answer_comparison(comparison: Comparison, level: float) -> AnsweredComparison:
    value, (low, high) = float(comparison.values[0]), interval(comparison.values, level)
    answer = UNRESOLVED
    if not comparison.doubt:
        if comparison.above < low and high < comparison.below:
            answer = HOLDS
        elif high <= comparison.above or low >= comparison.below:
            answer = FAILS
    show = _format_share if comparison.percent else _format_plain
    ends = "" if low == high or comparison.doubt.startswith("fewer") else f" [{show(low)}, {show(high)}]"
    doubt = f" ({comparison.doubt})" if comparison.doubt else ""
    return AnsweredComparison(comparison.label, f"{show(value)}{ends}{doubt}", value, low, high, answer)


def _format_share(value: float) -> str:
    digits = 1 if abs(value) < 0.0995 else 0
    return f"{100 * value:z.{digits}f}\u00a0%".replace("-", "−")


def _format_plain(value: float) -> str:
    return f"{value:z.3f}".replace("-", "−")


def findings_frame(findings: Sequence[Finding], of: str) -> pd.DataFrame:
    """A tidy frame of claims, one row per comparison: of claim where says test verdict comparison value low high answer.

    `verdict` is the answer to the claim, `answer` that of the comparison; `of` says whose numbers they are.
    """
    columns = ["of", "claim", "where", "says", "test", "verdict", "comparison", "value", "low", "high", "answer"]
    rows = [
        (of, f.claim.name, f.claim.where, f.claim.says, f.claim.test, f.answer, a.label, a.value, a.low, a.high, a.answer)
        for f in findings
        for a in f.comparisons or (AnsweredComparison(f.missing, "", np.nan, np.nan, np.nan, UNMEASURED),)
    ]
    return pd.DataFrame(rows, columns=columns)

"""Suites of metrics: which of them decides verdicts.

Both suites are graded and shown. A metric of the suite strict that stands in the place of one of the suite paper (its
counterpart) decides, and the other shows what the paper's definition gives. Metrics of both suites decide for themselves, as do
those of a table that lacks their counterparts.
"""

from collections.abc import Iterable, Mapping
from typing import Protocol


class Suited(Protocol):
    """What a registry or a score table says of a metric's place in its suite."""

    @property
    def counterpart(self) -> str:
        """Name of the metric of the suite paper in whose place it stands in the suite strict; '' where there is none."""


def strict_metrics(metrics: Mapping[str, Suited]) -> dict[str, str]:
    """The metric that decides in place of each metric of the suite paper, of those that are there."""
    return {info.counterpart: name for name, info in metrics.items() if info.counterpart in metrics}


def find_parting(verdicts: Mapping[str, str], metrics: Mapping[str, Suited]) -> list[tuple[str, str]]:
    """Names of the strict metric and of its counterpart where their verdicts on one comparison differ."""
    pairs = ((strict, paper) for paper, strict in strict_metrics(metrics).items())
    return [pair for pair in pairs if set(pair) <= verdicts.keys() and verdicts[pair[0]] != verdicts[pair[1]]]


def describe_parting(pairs: Iterable[tuple[str, str]], verdicts: Mapping[str, str]) -> str:
    """Text such as 'pck_strict (better) and pck (worse)'; '' where nothing parts."""
    return "; ".join(f"{strict} ({verdicts[strict]}) and {paper} ({verdicts[paper]})" for strict, paper in pairs)

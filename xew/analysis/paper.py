"""The paper's own numbers, and what this package makes of them: its distance table, rebuilt cell by cell.

The figures lie in `paper.json` with the table that each is from. They are printed with three decimals, so a recomputed
value may differ from the printed one by what that rounding allows; `rebuild` says how much that is.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np

from xew.analysis.correlation import (
    FOLDS,
    Correlation,
    dof_correlation,
    leave_one_out,
    loeo_correlation,
    pearson,
    permutation_p,
)
from xew.analysis.distance import mean_distances
from xew.config import parse

PAPER = Path(__file__).with_name("paper.json")
AXES = ("appearance", "kinematic")


@dataclass(frozen=True)
class PublishedRobot:
    """A robot's features and its mean distance to the other four."""

    dof: int
    links: int
    reach: float
    """Metres."""
    volume: float
    """Of the hull of what it reaches, cubic metres."""
    kinematic: float
    """Metres."""
    appearance: float


@dataclass(frozen=True)
class PublishedCorrelation:
    """Pearson's r of a distance with a metric over the five folds, and its leave-one-out range."""

    r: float
    low: float
    high: float
    p_value: float | None = None
    """Printed for LPIPS only."""


@dataclass(frozen=True)
class PublishedMetric:
    """A metric of the leave-one-embodiment-out study."""

    higher_is_better: bool
    scores: Mapping[str, float]
    """By held-out robot."""
    appearance: PublishedCorrelation
    kinematic: PublishedCorrelation
    dof_r: float


@dataclass(frozen=True)
class Paper:
    """What the paper prints on distances between robots and on how well they predict errors."""

    title: str
    tables: Mapping[str, str]
    """Where each block of figures is from."""
    half_digit: float
    """Half a unit of the last printed decimal."""
    robots: Mapping[str, PublishedRobot]
    distances: Mapping[str, Sequence[Sequence[float]]]
    """By axis: symmetric matrix in the order of `robots`."""
    metrics: Mapping[str, PublishedMetric]

    def axis(self, name: str) -> np.ndarray:
        """A feature of all robots, such as 'appearance' or 'dof' [5]."""
        return np.array([getattr(robot, name) for robot in self.robots.values()], np.float64)

    def scores(self, metric: str) -> np.ndarray:
        """A metric's scores in the order of `robots` [5]."""
        return np.array([self.metrics[metric].scores[robot] for robot in self.robots])

    def correlation(self, metric: str, axis: str) -> Correlation:
        """What this package computes from the printed scores and distances."""
        return loeo_correlation(self.axis(axis).tolist(), self.scores(metric).tolist(), self.metrics[metric].higher_is_better)


@dataclass(frozen=True)
class Cell:
    """One figure of the distance table."""

    metric: str
    axis: str
    """'appearance', 'kinematic' or 'dof'."""
    quantity: str
    """'r', 'low', 'high' (of the leave-one-out range) or 'p_value'."""
    published: float
    ours: float
    """From the printed inputs as they are."""
    least: float
    """Smallest value found with inputs that print as the paper's do, ..."""
    most: float
    """... and the largest."""
    half_digit: float

    @property
    def agrees(self) -> bool:
        """Could unrounded inputs have given a value that prints as the published one?"""
        return self.least - self.half_digit <= self.published <= self.most + self.half_digit


@cache
def read_paper() -> Paper:
    """The figures that come with the package."""
    return parse(Paper, json.loads(PAPER.read_text()), str(PAPER))


def rebuild(paper: Paper) -> list[Cell]:
    """Every figure of the paper's distance table and its two p, recomputed from the paper's scores and distances."""
    return [cell for metric in paper.metrics for cell in _metric_cells(paper, metric)]


def mean_distance_cells(paper: Paper) -> list[Cell]:
    """Each robot's mean distance to the other four, from the printed matrices; `metric` holds the robot."""
    half = paper.half_digit
    return [
        # Four entries of a row, each off by at most half a digit: so is their mean.
        Cell(robot, axis, "mean", getattr(paper.robots[robot], axis), mean, mean - half, mean + half, half)
        for axis in AXES
        for robot, mean in zip(paper.robots, mean_distances(paper.distances[axis]).tolist(), strict=True)
    ]


def _metric_cells(paper: Paper, name: str) -> Iterator[Cell]:
    metric, half = paper.metrics[name], paper.half_digit
    for axis in AXES:
        published, ours = getattr(metric, axis), paper.correlation(name, axis)
        x, y = _corners(paper.axis(axis), half), _corners(paper.scores(name), half)
        for quantity, values in _statistics(x[:, None], y[None], metric.higher_is_better).items():
            if getattr(published, quantity) is not None:
                ends = float(values.min()), float(values.max())
                yield Cell(name, axis, quantity, getattr(published, quantity), getattr(ours, quantity), *ends, half)
    sign = -1 if metric.higher_is_better else 1
    values = sign * pearson(paper.axis("dof"), _corners(paper.scores(name), half))
    dof_r = dof_correlation(paper.axis("dof").tolist(), paper.scores(name).tolist(), metric.higher_is_better)
    yield Cell(name, "dof", "r", metric.dof_r, dof_r, float(values.min()), float(values.max()), half)


def _corners(values: np.ndarray, half_digit: float) -> np.ndarray:
    """The printed values and all that round to them at the ends of their ranges: [33 5] of [5]."""
    return values + half_digit * np.array([(0,) * FOLDS, *product((-1, 1), repeat=FOLDS)])


def _statistics(x: np.ndarray, y: np.ndarray, higher_is_better: bool) -> dict[str, np.ndarray]:
    """What the paper prints of a metric and an axis, over the last axis of both."""
    y = -y if higher_is_better else y
    low, high = leave_one_out(x, y)
    return {"r": pearson(x, y), "low": low, "high": high, "p_value": permutation_p(x, y)}

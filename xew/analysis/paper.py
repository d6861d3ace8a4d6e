"""The paper's own numbers, and what this package makes of them: its distance table and its percentages, recomputed.

The figures lie in `paper.json` with the table that each is from:

    robots      robot -> dof, links, reach, volume and the mean distances to the other four
    distances   axis -> symmetric matrix in the order of `robots`
    metrics     metric -> title, dimension, unit, direction and the printed correlations with distance
    parts       part -> rows: key -> robot -> metric -> value, where `robot` may be 'seen', the pooled training robots
        actions     by action representation: joints, ray_map, mask, optical_flow
        ladder      by condition: none, reference_image, nine_views, articulation_clip, robot_render
        loeo        by split: loeo_<held-out robot>
        few_shot    <target>-<episodes a task>, and 'reference' for the seen robots before adaptation
        forgetting  the same keys, graded on UR5; 'none' is before adaptation
        baselines   by model: irasim, ctrl_world, enerverse_ac, reference
    changes     percentages that the text prints, each with the two values that it compares

They are printed with few decimals, so a recomputed value may differ from the printed one by what that rounding allows;
`rebuild` and `recompute_changes` say how much that is.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import product
from pathlib import Path
from typing import Literal

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
from xew.analysis.scores import MetricInfo
from xew.config import parse

PAPER = Path(__file__).with_name("paper.json")
AXES = ("appearance", "kinematic")


@dataclass(frozen=True)
class PublishedRobot:
    """A robot's features and its mean distance to the other four."""

    dof: int
    links: int
    reach: float
    """Meters."""
    volume: float
    """Of the hull of what it reaches, cubic meters."""
    kinematic: float
    """Meters."""
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
    """A metric and how its scores in the leave-one-embodiment-out study go with distance."""

    title: str
    """As the paper's tables name it."""
    dimension: str
    unit: str
    higher_is_better: bool
    appearance: PublishedCorrelation
    kinematic: PublishedCorrelation
    dof_r: float


@dataclass(frozen=True)
class PublishedPart:
    """The absolute scores of one comparison: means over episodes."""

    source: str
    rows: Mapping[str, Mapping[str, Mapping[str, float]]]
    """By key (see above), robot or 'seen', and metric."""
    half_digits: Mapping[str, float] = field(default_factory=dict)
    """Half a unit of the last printed decimal of metrics where it is not that of the paper's other tables."""


@dataclass(frozen=True)
class PublishedChange:
    """A percentage of the text: by how much a score changes from one row to another, of the value before."""

    source: str
    """The section that prints it."""
    metric: str
    before: str
    """part/key/robot of the value before, ..."""
    after: str
    """... and of the value after."""
    percent: float
    word: Literal["rounded", "about", "less than"] = "rounded"
    """'about': the text rounds to tens ("roughly", "nearly"). 'less than': the change is smaller than that."""
    toward: str | None = None
    """part/key/robot of a goal: then `percent` is the share of the way from `before` to it."""


@dataclass(frozen=True)
class Paper:
    """What the paper prints."""

    title: str
    tables: Mapping[str, str]
    """Where each block of figures is from."""
    half_digit: float
    """Half a unit of the last printed decimal."""
    robots: Mapping[str, PublishedRobot]
    distances: Mapping[str, Sequence[Sequence[float]]]
    """By axis: symmetric matrix in the order of `robots`."""
    metrics: Mapping[str, PublishedMetric]
    parts: Mapping[str, PublishedPart]
    changes: Sequence[PublishedChange]

    @property
    def infos(self) -> tuple[MetricInfo, ...]:
        """The metrics as a score table describes them, in the paper's order."""
        return tuple(
            MetricInfo(name, metric.dimension, metric.unit, metric.higher_is_better, None, None, self.title, metric.title)
            for name, metric in self.metrics.items()
        )

    def axis(self, name: str) -> np.ndarray:
        """A feature of all robots, such as 'appearance' or 'dof' [5]."""
        return np.array([getattr(robot, name) for robot in self.robots.values()], np.float64)

    def scores(self, metric: str) -> np.ndarray:
        """A metric's scores of held-out robots (LOEO) in the order of `robots` [5]."""
        return np.array([self.parts["loeo"].rows[f"loeo_{robot}"][robot][metric] for robot in self.robots])

    def score(self, part: str, key: str, robot: str, metric: str) -> float | None:
        """A printed score; None where the paper prints none."""
        rows = self.parts[part].rows if part in self.parts else {}
        return rows.get(key, {}).get(robot, {}).get(metric)

    def half_digit_of(self, part: str, metric: str) -> float:
        """Half a unit of the last printed decimal of a metric in a part."""
        return self.parts[part].half_digits.get(metric, self.half_digit)

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


@dataclass(frozen=True)
class RecomputedChange:
    """A percentage of the text and what the printed scores give for it."""

    change: PublishedChange
    ours: float
    """From the printed scores as they are [%]."""
    least: float
    """Smallest value found with scores that print as the paper's do [%], ..."""
    most: float
    """... and the largest."""

    @property
    def agrees(self) -> bool:
        """Could unrounded scores have given what the text says?"""
        if self.change.word == "less than":
            return min(abs(self.least), abs(self.most)) < abs(self.change.percent) or self.least < 0 < self.most
        half = {"rounded": 0.5, "about": 5.0}[self.change.word]
        return self.least - half <= self.change.percent <= self.most + half


@cache
def read_paper() -> Paper:
    """The figures that come with the package."""
    return parse(Paper, json.loads(PAPER.read_text()), str(PAPER))


PAPER_TITLES = {name: metric.title for name, metric in read_paper().metrics.items()}
"""Titles of the paper's metrics, in its order."""


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


def recompute_changes(paper: Paper) -> list[RecomputedChange]:
    """Every percentage of the text, recomputed from the scores that the tables print."""
    return [_recomputed(paper, change) for change in paper.changes]


def _recomputed(paper: Paper, change: PublishedChange) -> RecomputedChange:
    places = [place.split("/") for place in (change.before, change.after, change.toward) if place is not None]
    values = np.array([paper.parts[part].rows[key][robot][change.metric] for part, key, robot in places])
    halves = [paper.half_digit_of(part, change.metric) for part, *_ in places]
    signs = np.array(list(product((0, -1, 1), repeat=len(places))))
    before, after, *goal = (values + halves * signs).T
    percent = 100 * (after - before) / (goal[0] - before if goal else before)
    return RecomputedChange(change, float(percent[0]), float(percent.min()), float(percent.max()))


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

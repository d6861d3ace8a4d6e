"""The paper's distance table and the percentages of its text, recomputed from its printed scores and distances.

Printed figures have few decimals, so a recomputed value may differ from the printed one by what that rounding allows;
`rebuild` and `recompute_changes` say how much that is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from xew.analysis.correlation import FOLDS, dof_correlation, leave_one_out
from xew.analysis.paper import AXES, Paper, PublishedChange
from xew.statistics import pearson, permutation_p


@dataclass(frozen=True)
class RecomputedFigure:
    """A figure of the distance table, as printed and as recomputed."""

    metric: str
    axis: str
    """One of 'appearance', 'kinematic' and 'dof'."""
    quantity: str
    """One of 'r', 'low', 'high' (of the leave-one-out range), 'p_value' and 'mean'."""
    published: float
    ours: float
    """Value from the printed inputs as they are."""
    least: float
    """Smallest value found with inputs that print as the paper's do."""
    most: float
    """Largest value found with such inputs."""
    half_digit: float
    """Half a unit of the last printed decimal."""

    @property
    def agrees(self) -> bool:
        """Whether unrounded inputs could have given a value that prints as the published one."""
        return self.least - self.half_digit <= self.published <= self.most + self.half_digit


@dataclass(frozen=True)
class RecomputedChange:
    """A percentage of the text, and the value that the printed scores give for it."""

    change: PublishedChange
    ours: float
    """Value from the printed scores as they are [%]."""
    least: float
    """Smallest value found with scores that print as the paper's do [%]."""
    most: float
    """Largest value found with such scores [%]."""

    @property
    def agrees(self) -> bool:
        """Whether unrounded scores could have given what the text says."""
        if self.change.word == "less than":
            return min(abs(self.least), abs(self.most)) < abs(self.change.percent) or self.least < 0 < self.most
        half = {"rounded": 0.5, "about": 5.0}[self.change.word]
        return self.least - half <= self.change.percent <= self.most + half


def rebuild(paper: Paper) -> list[RecomputedFigure]:
    """Every figure of the paper's distance table and its two p, recomputed from the paper's scores and distances."""
    return [figure for metric in paper.metrics for figure in _recompute_metric(paper, metric)]


def recompute_mean_distances(paper: Paper) -> list[RecomputedFigure]:
    """Each robot's mean distance to the other four, from the printed matrices; `metric` holds the robot."""
    half = paper.half_digit
    return [
        # Four entries of a row, each off by at most half a digit: so is their mean.
        RecomputedFigure(robot, axis, "mean", getattr(paper.robots[robot], axis), mean, mean - half, mean + half, half)
        for axis in AXES
        for robot, mean in zip(paper.robots, mean_distances(paper.distances[axis]).tolist(), strict=True)
    ]


def recompute_changes(paper: Paper) -> list[RecomputedChange]:
    """Every percentage of the text, recomputed from the scores that the tables print."""
    return [_recompute_change(paper, change) for change in paper.changes]


def mean_distances(matrix: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    """Each robot's mean distance to the others [... n], from symmetric matrices [... n n] with a zero diagonal."""
    matrix = np.asarray(matrix, np.float64)
    return matrix.sum(axis=-1) / (matrix.shape[-1] - 1)


def _recompute_change(paper: Paper, change: PublishedChange) -> RecomputedChange:
    places = [place.split("/") for place in (change.before, change.after, change.toward) if place is not None]
    values = np.array([paper.parts[part].rows[key][robot][change.metric] for part, key, robot in places])
    halves = [paper.half_digit_of(part, change.metric) for part, *_ in places]
    signs = np.array(list(product((0, -1, 1), repeat=len(places))))
    before, after, *goal = (values + halves * signs).T
    percent = 100 * (after - before) / (goal[0] - before if goal else before)
    return RecomputedChange(change, float(percent[0]), float(percent.min()), float(percent.max()))


def _recompute_metric(paper: Paper, name: str) -> Iterator[RecomputedFigure]:
    metric, half = paper.metrics[name], paper.half_digit
    for axis in AXES:
        published, ours = getattr(metric, axis), paper.correlation(name, axis)
        x, y = _unrounded_corners(paper.axis(axis), half), _unrounded_corners(paper.scores(name), half)
        for quantity, values in _printed_statistics(x[:, None], y[None], metric.higher_is_better).items():
            if getattr(published, quantity) is not None:
                ends = float(values.min()), float(values.max())
                yield RecomputedFigure(name, axis, quantity, getattr(published, quantity), getattr(ours, quantity), *ends, half)
    sign = -1 if metric.higher_is_better else 1
    values = sign * pearson(paper.axis("dof"), _unrounded_corners(paper.scores(name), half))
    dof_r = dof_correlation(paper.axis("dof").tolist(), paper.scores(name).tolist(), metric.higher_is_better)
    yield RecomputedFigure(name, "dof", "r", metric.dof_r, dof_r, float(values.min()), float(values.max()), half)


def _unrounded_corners(values: np.ndarray, half_digit: float) -> np.ndarray:
    """Printed values [5], then every combination of the ends of what rounds to them: [33 5]."""
    return values + half_digit * np.array([(0,) * FOLDS, *product((-1, 1), repeat=FOLDS)])


def _printed_statistics(x: np.ndarray, y: np.ndarray, higher_is_better: bool) -> dict[str, np.ndarray]:
    """Statistics that the paper prints of distances x [... 5] and scores y [... 5], over the last axis of both."""
    y = -y if higher_is_better else y
    low, high = leave_one_out(x, y)
    return {"r": pearson(x, y), "low": low, "high": high, "p_value": permutation_p(x, y)}

"""Error of one model on many bodies that it has never seen, against their distance from the robots in training.

Each body is a point, graded on the same scenes. The frozen first frame, a no-learning baseline, shows the difficulty of a
body's pictures; the partial correlation removes it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from xew.analysis.paper import AXES, PAPER_TITLES
from xew.analysis.scores import COPY, MetricInfo
from xew.analysis.statistics.grades import StudyGrades
from xew.analysis.tables.distances import AXIS_TITLES, Distances
from xew.analysis.tables.labels import PAPER_METRICS
from xew.analysis.tables.table import Column, Table, TableCell, TableRow, TableSection, format_signed
from xew.protocol import DISTANCE_BODIES, PARTS, SPLITS
from xew.statistics import holm, interval_of_r, partial_r, pearson, permutation_p

VARIANT = PARTS["bodies"][0]
"""The model whose errors are correlated."""
LEAST_BODIES = 8


@dataclass(frozen=True)
class BodyCorrelation:
    """Pearson's r of distance with error over bodies. Positive: farther is worse."""

    r: float
    low: float
    """Lower end of its 95 % interval over bodies (bootstrap, BCa)."""
    high: float
    p_value: float
    """Two-sided (`permutation_p`); of the paper's two kinds of distance corrected by Holm for both."""
    frozen: float
    """Pearson's r of distance with the error of the frozen first frame; NaN where that was not graded or does not vary."""
    partial: float
    """Partial correlation of distance with error, given the error of the frozen first frame; NaN where that is not known."""
    bodies: int


@dataclass(frozen=True)
class OverBodies:
    """One metric over the bodies of the wide family."""

    values: pd.DataFrame
    """Table of `body_errors`, or of `halves.body_gaps`."""
    correlations: Mapping[str, BodyCorrelation]
    """Correlations by kind of distance; none where bodies are too few."""


def find_difficulty(grades: StudyGrades, distances: Distances) -> dict[str, OverBodies]:
    """Correlation of each reported metric with distance over bodies, by the metric's key."""
    found = {}
    for name, metric in grades.metrics.items():
        if name in PAPER_METRICS or metric.reported:
            errors = body_errors(grades, distances, name)
            found[name] = OverBodies(errors, correlate_bodies(errors, metric.higher_is_better))
    return found


def body_errors(grades: StudyGrades, distances: Distances, metric: str) -> pd.DataFrame:
    """Mean error of the model on each body of the wide family (`value`), of the frozen first frame (`frozen`), and
    distances.

    Distances are means over the training robots, one column for each kind. Bodies without a score or a distance are left out.
    """
    by_axis = mean_distances(distances, DISTANCE_BODIES, SPLITS[VARIANT.split].train_robots)
    rows = {}
    for body in by_axis.index:
        own, frozen = (grades.variant_mean(name, (body,), metric) for name in (VARIANT.name, COPY))
        if own is not None:
            rows[body] = {"value": own.value, "frozen": frozen.value if frozen else np.nan}
    return pd.DataFrame.from_dict(rows, orient="index", columns=["value", "frozen"]).join(by_axis, how="inner")


def mean_distances(distances: Distances, bodies: Sequence[str], trained: Sequence[str]) -> pd.DataFrame:
    """Mean distance of each body to the robots that a model was trained on: by body, a column for each kind of distance."""
    pairs = distances.pairs
    both = pd.concat([pairs, pairs.rename(columns={"robot": "other", "other": "robot"})])  # each is listed once
    chosen = both[both["robot"].isin(bodies) & both["other"].isin(trained)]
    by_axis = chosen.pivot_table(index="robot", columns="axis", values="value", aggfunc="mean").rename_axis("body")
    return by_axis[[axis for axis in AXIS_TITLES if axis in by_axis]]


def correlate_bodies(errors: pd.DataFrame, higher_is_better: bool) -> dict[str, BodyCorrelation]:
    """Correlations of errors with distances, by kind of distance; none for fewer than LEAST_BODIES bodies or constant
    errors.

    A positive r always means that a farther body is worse.
    """
    sign = -1.0 if higher_is_better else 1.0
    score, frozen = (sign * errors[name].to_numpy(np.float64) for name in ("value", "frozen"))
    if len(errors) < LEAST_BODIES or np.ptp(score) == 0:
        return {}
    distances = {axis: errors[axis].to_numpy(np.float64) for axis in AXIS_TITLES if axis in errors}
    found = {axis: _correlate(distance, score, frozen) for axis, distance in distances.items() if np.ptp(distance) > 0}
    asked = [axis for axis in found if axis in AXES]
    adjusted = dict(zip(asked, holm([found[axis].p_value for axis in asked]), strict=True))
    return {axis: replace(result, p_value=float(adjusted.get(axis, result.p_value))) for axis, result in found.items()}


def _correlate(distance: np.ndarray, score: np.ndarray, frozen: np.ndarray) -> BodyCorrelation:
    """Correlation of n distances with n scores and those of the frozen first frame, each [n] float64."""
    r, with_frozen, between = (float(pearson(*pair)) for pair in ((distance, score), (distance, frozen), (score, frozen)))
    p, partial = float(permutation_p(distance, score)), partial_r(r, with_frozen, between)
    return BodyCorrelation(r, *interval_of_r(distance, score), p, with_frozen, partial, len(score))


def difficulty_table(found: Mapping[str, OverBodies], metrics: Mapping[str, MetricInfo]) -> Table | None:
    """Correlation of each metric with each kind of distance over bodies; None if there are too few bodies."""
    return bodies_table(
        found,
        metrics,
        "bodies",
        "Error on {} bodies against their distance",
        "Pearson's r of a body's mean distance to the training robots with the model's score on it, with its 95 % "
        "interval over bodies. Positive: farther is worse.",
    )


def bodies_table(
    found: Mapping[str, OverBodies], metrics: Mapping[str, MetricInfo], name: str, title: str, caption: str
) -> Table | None:
    """Table of the correlations of each metric with each kind of distance; None if there are too few bodies.

    `{}` in the title is the number of bodies; the caption says what r correlates.
    """
    axes = [axis for axis in AXIS_TITLES if any(axis in one.correlations for one in found.values())]
    if not axes:
        return None
    rows = []
    for metric, one in found.items():
        cells = [cell for axis in axes for cell in _cells(one.correlations.get(axis))]
        rows.append(TableRow((PAPER_TITLES.get(metric, metrics[metric].title),), tuple(cells)))
    count = max(result.bodies for one in found.values() for result in one.correlations.values())
    heads = ("r", "p", "frozen", "partial")
    return Table(
        name,
        title.format(count),
        f"{caption} p is by permutation, corrected by Holm for the paper's two kinds of distance; LPIPS by these is the "
        "primary outcome, all else exploratory. Frozen: r of the same distance with the score of the frozen first frame, which "
        "learned nothing. Partial: r given the frozen frame's score.",
        ("metric",),
        tuple(Column(head, AXIS_TITLES[axis]) for axis in axes for head in heads),
        (TableSection("", tuple(rows)),),
    )


def _cells(result: BodyCorrelation | None) -> Sequence[TableCell]:
    """The cells of one correlation: r with its interval, p, and the two that the frozen first frame gives."""
    if result is None:
        return (TableCell(),) * 4
    ends = f"{format_signed(result.low)} to {format_signed(result.high)}"
    whole = TableCell(format_signed(result.r), ends, value=result.r, low=result.low, high=result.high, episodes=result.bodies)
    rest = (TableCell() if np.isnan(v) else TableCell(format_signed(v), value=v) for v in (result.frozen, result.partial))
    return (whole, TableCell(f"{result.p_value:.4f}", value=result.p_value), *rest)

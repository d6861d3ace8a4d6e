"""The gap of many bodies between a model that trained on the body and one that did not.

Two models each train on one half of the bodies and are graded on both, so a body's own difficulty cancels.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from xew.analysis.beyond.difficulty import OverBodies, bodies_table, correlate_bodies, mean_distances
from xew.analysis.scores import COPY, MetricInfo
from xew.analysis.statistics.grades import StudyGrades, relative_loss
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.distances import Distances
from xew.analysis.tables.labels import PAPER_METRICS
from xew.analysis.tables.table import Table, TableRow, TableSection, metric_columns
from xew.protocol import PARTS, SPLITS

PART = "halves"
TITLES = ("Even bodies", "Odd bodies")
"""Titles of the training bodies of the two models."""


def find_gaps(grades: StudyGrades, distances: Distances) -> dict[str, OverBodies]:
    """The gap of each body in each reported metric and its correlation with distance, by the metric's key."""
    found = {}
    for name, metric in grades.metrics.items():
        if name in PAPER_METRICS or metric.reported:
            gaps = body_gaps(grades, distances, name)
            found[name] = OverBodies(gaps, correlate_bodies(gaps, higher_is_better=False))
    return found


def body_gaps(grades: StudyGrades, distances: Distances, metric: str) -> pd.DataFrame:
    """Relative loss of the model that never saw a body against the model that did, on the same episodes.

    One of the two models may be better on all bodies, which raises the gaps of one half and lowers the other's. Giving both
    halves the same mean removes this effect.

    Returns:
        Table by body: value (gap in percent), unseen and frozen (errors of the model that never saw the body and of the frozen
            first frame; all three are worse if larger), and mean distances to the bodies in training.
    """
    info = grades.metrics[metric]
    found = []
    for unseen, seen in (PARTS[PART], PARTS[PART][::-1]):
        split, rows = SPLITS[unseen.split], {}
        by_axis = mean_distances(distances, split.held_out_robots, split.train_robots)
        for body in by_axis.index:
            after, before = (grades.variant_mean(model.name, (body,), metric, PART) for model in (unseen, seen))
            frozen = grades.variant_mean(COPY, (body,), metric)
            if after is not None and before is not None:
                gap = 100 * relative_loss(after, before, info).value
                sign = -1 if info.higher_is_better else 1
                rows[body] = {"value": gap, "unseen": sign * after.value, "frozen": sign * frozen.value if frozen else np.nan}
        columns = ["value", "unseen", "frozen"]
        found.append(pd.DataFrame.from_dict(rows, orient="index", columns=columns).join(by_axis, how="inner"))
    halves, leveled = [half for half in found if len(half)] or found, ["value", "unseen"]
    level = np.mean([half[leveled].mean() for half in halves], axis=0)
    for half in halves:
        half[leveled] += level - half[leveled].mean()
    return pd.concat(halves).rename_axis("body")


def find_unseen_errors(gaps: Mapping[str, OverBodies]) -> dict[str, OverBodies]:
    """As `find_gaps`, with the error of the model that never saw a body instead of the gap."""
    errors = {name: one.values.assign(value=one.values["unseen"]) for name, one in gaps.items()}
    return {name: OverBodies(values, correlate_bodies(values, higher_is_better=False)) for name, values in errors.items()}


def halves_table(builder: Builder) -> Table:
    """Mean scores on each half of the bodies, of the model that trained on it and of the one that did not."""
    metrics, sections = builder.reported, []
    for title, seen, unseen in zip(TITLES, PARTS[PART], PARTS[PART][::-1], strict=True):
        bodies = SPLITS[seen.split].train_robots
        models = {"trained on them": seen, "never saw them": unseen}
        rows = [
            TableRow((label,), tuple(builder.variant_cell(model.name, bodies, metric) for metric in metrics))
            for label, model in models.items()
        ]
        sections.append(TableSection(title, (*rows, *builder.baselines(bodies, metrics))))
    return Table(
        "halves_scores",
        "Bodies in training and not",
        "Two models, each trained on one half of the bodies and graded on both.",
        ("model",),
        metric_columns(builder.ours.metrics, metrics),
        tuple(sections),
    )


def gaps_table(found: Mapping[str, OverBodies], metrics: Mapping[str, MetricInfo]) -> Table | None:
    """Correlation of the gap in each metric with each kind of distance; None if there are too few bodies."""
    return bodies_table(
        found,
        metrics,
        PART,
        "The gap of {} bodies against their distance",
        "Gap: loss of a model that never saw the body against one that did, on the same episodes, in percent of the latter's "
        "score. Both halves have the same mean gap, which removes a general difference of the two models. Pearson's r of the "
        "gap with the body's mean distance to the first model's training bodies, with its 95 % interval over bodies. Positive: "
        "farther bodies have a larger gap.",
    )


def errors_table(found: Mapping[str, OverBodies], metrics: Mapping[str, MetricInfo]) -> Table | None:
    """Correlation of the error of the model that never saw a body with distance; None if there are too few bodies."""
    return bodies_table(
        found,
        metrics,
        "halves_errors",
        "Error on {} bodies of the model that never saw them, against their distance",
        "Pearson's r of the model's error on a body with the body's mean distance to the model's training bodies, with its "
        "95 % interval over bodies. Both halves have the same mean error. Positive: farther is worse.",
    )

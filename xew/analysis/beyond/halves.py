"""The gap of many bodies: each is rendered by a model that trained on it and by one that did not.

The folds of the paper give a gap for each of five robots. Here two models share out the bodies: each trains on one half and is
graded on both. What makes a body hard for whoever renders it cancels; what is left is the price of never having seen it.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from xew.analysis.beyond.difficulty import OverBodies, bodies_table, correlate_bodies, mean_distances
from xew.analysis.scores import COPY, MetricInfo
from xew.analysis.statistics.grades import StudyGrades, relative_loss
from xew.analysis.tables.distances import Distances
from xew.analysis.tables.labels import PAPER_METRICS
from xew.analysis.tables.table import Table
from xew.protocol import PARTS, SPLITS

PART = "halves"


def find_gaps(grades: StudyGrades, distances: Distances) -> dict[str, OverBodies]:
    """The gap of each body in each reported metric, and how it goes with distance, by the metric's key."""
    found = {}
    for name, metric in grades.metrics.items():
        if name in PAPER_METRICS or metric.reported:
            gaps = body_gaps(grades, distances, name)
            found[name] = OverBodies(gaps, correlate_bodies(gaps, higher_is_better=False))
    return found


def body_gaps(grades: StudyGrades, distances: Distances, metric: str) -> pd.DataFrame:
    """By how much each body is rendered worse by the model that never saw it.

    The two models are trainings of their own, one of which may be better on all bodies: that raises the gaps of one half and
    lowers those of the other. It is taken out by giving both halves the same mean.

    Args:
        grades: of the study.
        distances: that were measured with these bodies.
        metric: its key.

    Returns:
        Table by body with the columns value (gap over the episodes that both models have, in percent of the score of the model
        that saw it; positive is worse whatever the metric), frozen (error of the frozen first frame, turned so that more is
        worse) and one for each kind of distance: the mean over the bodies of the training that did not have it. Bodies that
        lack a score or a distance are left out.
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
                rows[body] = {"value": gap, "frozen": sign * frozen.value if frozen else np.nan}
        found.append(pd.DataFrame.from_dict(rows, orient="index", columns=["value", "frozen"]).join(by_axis, how="inner"))
    halves = [half for half in found if len(half)] or found
    level = np.mean([half["value"].mean() for half in halves])
    return pd.concat([half.assign(value=half["value"] - half["value"].mean() + level) for half in halves]).rename_axis("body")


def gaps_table(found: Mapping[str, OverBodies], metrics: Mapping[str, MetricInfo]) -> Table | None:
    """Correlation of the gap in each metric with each kind of distance; None where bodies are too few.

    Args:
        found: of `find_gaps`.
        metrics: of the study, by key.
    """
    return bodies_table(
        found,
        metrics,
        PART,
        "The gap of {} bodies against their distance",
        "By how much a body is rendered worse by a model that never saw it than by one that did, on the same episodes, in "
        "percent of the latter's score; what makes a body hard for both cancels. That one of the two models may be better on "
        "all bodies is taken out: both halves have the same mean gap. Pearson's r of this gap with the body's mean distance to "
        "the bodies that the first model was trained on, with its 95 % interval over bodies. Positive: what is farther has a "
        "larger gap.",
    )

"""Scores of two studies that differ only in the kind of motion: shared tool paths, or each robot's own motion."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from xew.analysis.scores import TRAINING, TRUTH, VARIANT, MetricInfo, Scores, name_graded
from xew.analysis.statistics.grades import StudyGrades, pooled
from xew.analysis.tables.builder import interval_ends, mean_cell
from xew.analysis.tables.labels import ACTIONS, GROUP_TITLES
from xew.analysis.tables.table import Column, Table, TableCell, TableRow, TableSection, metric_title
from xew.config import ConfigError
from xew.protocol import BASELINES, COPY_FIRST_FRAME, MOTIONS, OWN_MOTION, PASTED_RENDER, SHARED_MOTION, reference
from xew.statistics import LEVEL, Mean, combine, noise_floor, strict_metrics, verdict

METRICS = ("lpips", "mask_iou", "pck")
"""Metrics of the table; a strict metric replaces the paper's."""
UNLEARNED = {name: BASELINES[name] for name in (COPY_FIRST_FRAME, PASTED_RENDER)}
"""Titles of the no-learning baselines, which show the difficulty of each kind of motion."""
CELL = ["task", "seed", "robot"]


class Motions:
    """Both studies as one table over their common episodes, so differences are paired by scene.

    Raises ConfigError if both have the same kind of motion or were graded by different protocols.
    """

    def __init__(self, scores: Scores, other: Scores) -> None:
        found = {table.motion: table for table in (scores, other)}
        if set(found) != set(MOTIONS):
            raise ConfigError(
                f"scores of {scores.motion} and of {other.motion} motion are compared; expected one table of each kind."
            )
        if (one := scores.attributes["protocol"]) != (two := other.attributes["protocol"]):
            raise ConfigError(f"the tables of both motions were graded by protocols {one} and {two}; grade one of them again.")
        shared = found[SHARED_MOTION].rows[CELL].drop_duplicates().merge(found[OWN_MOTION].rows[CELL].drop_duplicates())
        rows = [_name_motion(table.rows, motion).merge(shared, on=CELL) for motion, table in found.items()]
        infos = {metric.name: metric for metric in scores.metrics}
        self.metrics: Mapping[str, MetricInfo] = {m.name: infos[m.name] for m in other.metrics if m.name in infos}
        axes: Mapping[str, np.ndarray] = {}
        self._grades = StudyGrades(pd.concat(rows, ignore_index=True), tuple(self.metrics.values()), axes)

    def mean(self, motion: str, row: str, robots: str, metric: str) -> Mean | None:
        """Mean score on the robots of a key of GROUP_TITLES in one of MOTIONS; None if it was not graded.

        `row` is an action representation, or a key of UNLEARNED.
        """
        name = row if row in UNLEARNED else reference(action=row).name
        return self._grades.variant_mean(_named(name, motion), pooled(reference(), robots), metric)

    def change(self, action: str, robots: str, metric: str) -> Mean | None:
        """Relative change of an action representation's score from shared to own motion; None if one was not graded."""
        shared, own = (self.mean(motion, action, robots, metric) for motion in (SHARED_MOTION, OWN_MOTION))
        return combine(lambda after, before: after / before - 1, own, shared) if own and shared else None

    def floor(self, robots: str, metric: str) -> float:
        """The larger of both noise floors; NaN if one is not known."""
        info, names = self.metrics[metric], self._grades.codec_truths or [_named(TRUTH, motion) for motion in MOTIONS]
        truths = [self._grades.variant_mean(name, pooled(reference(), robots), metric) for name in names]
        return float(np.max([noise_floor(mean.value if mean else None, info.best, info.estimated) for mean in truths]))


def motion_table(motions: Motions) -> Table:
    """Each action representation in shared and in own motion, on robots seen and unseen."""
    strict = strict_metrics(motions.metrics)
    shown = [name for metric in METRICS if (name := strict.get(metric, metric)) in motions.metrics]

    def row(name: str, robots: str) -> TableRow:
        return TableRow((titles[name],), tuple(c for metric in shown for c in _cells(motions, name, robots, metric)))

    titles = ACTIONS | UNLEARNED
    sections = [TableSection(title, tuple(row(name, robots) for name in titles)) for robots, title in GROUP_TITLES.items()]
    return Table(
        "motion",
        "Action representation in shared and in own motion",
        "Shared: all robots follow one tool path, so only the body is new. Own: each robot moves by its own planner. Each kind "
        "has its own models, graded on the same scenes; the last two rows are no-learning baselines. Marks: own compared with "
        "shared.",
        ("action representation",),
        tuple(Column(motion, metric_title(motions.metrics[metric])) for metric in shown for motion in MOTIONS),
        tuple(sections),
    )


def motion_frame(motions: Motions, metric: str) -> pd.DataFrame:
    """Means of a metric: table robots (key of GROUP_TITLES), action, motion, value, low, high; NaN if not graded."""
    rows = []
    for robots in GROUP_TITLES:
        for action in ACTIONS:
            for motion in MOTIONS:
                mean = motions.mean(motion, action, robots, metric)
                rows.append((robots, action, motion, *((mean.value, *interval_ends(mean, LEVEL)) if mean else (np.nan,) * 3)))
    return pd.DataFrame(rows, columns=["robots", "action", "motion", "value", "low", "high"])


def _cells(motions: Motions, row: str, robots: str, metric: str) -> Sequence[TableCell]:
    info = motions.metrics[metric]
    means = [motions.mean(motion, row, robots, metric) for motion in (SHARED_MOTION, OWN_MOTION)]
    shared, own = (mean_cell(mean, info, LEVEL) if mean else TableCell() for mean in means)
    if means[0] is None or means[1] is None:
        return shared, own
    difference = combine(np.subtract, means[1], means[0])
    mark = verdict(difference.value, difference.interval(), motions.floor(robots, metric), info.higher_is_better)
    return shared, replace(own, verdict=mark)


def _named(name: str, motion: str) -> str:
    return f"{name} {motion}"


def _name_motion(rows: pd.DataFrame, motion: str) -> pd.DataFrame:
    """Rows of a study whose variants and baselines are named by the motion, too."""
    names = [_named(name, motion) for name in name_graded(rows)]
    return rows.assign(**{VARIANT: names, TRAINING: rows.get(TRAINING, 0)})

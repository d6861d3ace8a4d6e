"""Scores of one model on changed scenes and on unseen robots: whether a new robot or a new lamp costs more."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from xew.analysis.scores import COMPARABLE, TRAINING, TRUTH, VARIANT, MetricInfo, Scores
from xew.analysis.statistics.grades import StudyGrades, pooled
from xew.analysis.tables.builder import interval_ends, mean_cell
from xew.analysis.tables.labels import ROBOT_TITLES
from xew.analysis.tables.table import Column, Table, TableCell, TableRow, TableSection, metric_title
from xew.config import ConfigError
from xew.protocol import BASELINES, FACTORS, PARTS
from xew.statistics import LEVEL, Mean, combine, noise_floor, strict_metrics, verdict

METRICS = ("lpips", "mask_iou", "pck", "trajectory_error")
"""Metrics of the table; a strict metric replaces the paper's."""
MODEL = PARTS["shifts"][0]
"""The variant that is graded on changed scenes."""
SEEN = pooled(MODEL, "seen")
SCENE, CELL = ["task", "seed"], ["task", "seed", "robot"]


class Shifts:
    """The model's scores with each change on its training robots, and without one on all robots, over common scenes.

    Only its first training run is graded on changed scenes, so intervals are over scenes.
    Raises ConfigError if a table has no change, two have the same, or they were graded differently.
    """

    def __init__(self, scores: Scores, shifted: Sequence[Scores]) -> None:
        tables = {table.change: table for table in shifted}
        if len(tables) < len(shifted) or "" in tables or scores.change:
            found = ", ".join(table.change or "no change" for table in (scores, *shifted))
            raise ConfigError(
                f"the tables of changed scenes have {found}; expected one without a change, and one of each change."
            )
        for key in (key for key in COMPARABLE if key != "change"):
            if any(table.attributes.get(key) != scores.attributes.get(key) for table in shifted):
                raise ConfigError(f"the tables of changed scenes differ in {key} from the unchanged; grade them alike.")
        self.changes = sorted(tables, key=lambda change: (FACTORS.index(change.partition(":")[0]), change))
        self.metrics: Mapping[str, MetricInfo] = {metric.name: metric for metric in scores.metrics}
        own = _first_training(scores.rows[(scores.rows[VARIANT] == MODEL.name) | (scores.rows["model"] == TRUTH)])
        rows = {change: table.rows[~table.rows["model"].isin(list(BASELINES))] for change, table in tables.items()}
        common = own[own[VARIANT] == MODEL.name][CELL].drop_duplicates()
        common = common[common["robot"].isin(SEEN)]
        for changed in rows.values():
            common = common.merge(changed[CELL].drop_duplicates())
        parts = [own.merge(common[SCENE].drop_duplicates(), on=SCENE)]
        parts += [part.merge(common, on=CELL).assign(**{VARIANT: _named(change)}) for change, part in rows.items()]
        merged = pd.concat(parts, ignore_index=True).assign(**{TRAINING: 0})
        self._grades = StudyGrades(merged, tuple(scores.metrics), {}, assumed_spread=0.0)
        self.scenes = len(common[SCENE].drop_duplicates())

    def mean(self, case: str, metric: str) -> Mean | None:
        """Mean score of a case: a change on the training robots, an unseen robot, or empty for the training robots."""
        if case in self.changes:
            return self._grades.variant_mean(_named(case), SEEN, metric)
        return self._grades.variant_mean(MODEL.name, (case,) if case else SEEN, metric)

    def cost(self, case: str, metric: str) -> Mean | None:
        """Difference of a case from the training robots in unchanged scenes, paired by scene; None if one was not graded."""
        means = self.mean(case, metric), self.mean("", metric)
        return combine(np.subtract, means[0], means[1]) if means[0] and means[1] else None

    @property
    def cases(self) -> dict[str, str]:
        """Titles of all cases that are compared with the training robots in unchanged scenes."""
        robots = {robot: f"{ROBOT_TITLES[robot]}, never seen" for robot in MODEL.held_out_robots}
        return robots | {change: change.replace(":", ", level ") for change in self.changes}

    def floor(self, metric: str) -> float:
        """Noise floor of a metric on the training robots; NaN if it is not known."""
        info, truth = self.metrics[metric], self._grades.variant_mean(TRUTH, SEEN, metric)
        return noise_floor(truth.value if truth else None, info.best, info.estimated)


def shifts_table(shifts: Shifts) -> Table:
    """Unseen robots and all changes, with marks for differences from the training robots in unchanged scenes."""
    strict = strict_metrics(shifts.metrics)
    shown = [name for metric in METRICS if (name := strict.get(metric, metric)) in shifts.metrics]

    def row(case: str, title: str) -> TableRow:
        return TableRow((title,), tuple(_cell(shifts, case, metric) for metric in shown))

    titles = shifts.cases
    sections = [TableSection("Training robots, unchanged scenes", (row("", "nothing is new"),))]
    sections.append(
        TableSection("A new robot", tuple(row(case, titles[case]) for case in titles if case not in shifts.changes))
    )
    for factor in FACTORS:
        rows = tuple(row(change, titles[change]) for change in shifts.changes if change.startswith(f"{factor}:"))
        sections += [TableSection(f"Training robots, {factor} changed", rows)] if rows else []
    return Table(
        "shifts",
        "What costs more: a new robot or a new lamp",
        f"One training run on {shifts.scenes} scenes that all rows share. Marks: compared with the first row, paired by scene.",
        ("what is new",),
        tuple(Column(metric_title(shifts.metrics[metric])) for metric in shown),
        tuple(sections),
    )


def shifts_frame(shifts: Shifts, metric: str) -> pd.DataFrame:
    """Costs by a metric: table case, title, value, low, high; NaN if not graded."""
    costs = [(case, title, shifts.cost(case, metric)) for case, title in shifts.cases.items()]
    rows = [
        (case, title, *((cost.value, *interval_ends(cost, LEVEL)) if cost else (np.nan,) * 3)) for case, title, cost in costs
    ]
    return pd.DataFrame(rows, columns=["case", "title", "value", "low", "high"])


def _cell(shifts: Shifts, case: str, metric: str) -> TableCell:
    info, mean, cost = shifts.metrics[metric], shifts.mean(case, metric), shifts.cost(case, metric)
    if mean is None or cost is None:
        return TableCell()
    mark = verdict(cost.value, cost.interval(), shifts.floor(metric), info.higher_is_better) if case else ""
    return replace(mean_cell(mean, info, LEVEL), verdict=mark)


def _first_training(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of the first training run of each variant."""
    if TRAINING not in rows:
        return rows
    return rows[rows[TRAINING] == rows.groupby(VARIANT)[TRAINING].transform("min")]


def _named(change: str) -> str:
    return f"{MODEL.name} {change}"

"""Scores of models on changed scenes and on unseen robots: whether a new robot or a new lamp costs more, and the remedy."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd

from xew.analysis.scores import COMPARABLE, TRAINING, TRUTH, VARIANT, MetricInfo, Scores
from xew.analysis.statistics.grades import StudyGrades, pooled
from xew.analysis.tables.builder import interval_ends, mean_cell
from xew.analysis.tables.labels import ROBOT_TITLES
from xew.analysis.tables.table import Column, Table, TableCell, TableRow, TableSection, metric_title
from xew.config import ConfigError
from xew.protocol import FACTORS, PARTS
from xew.statistics import LEVEL, Mean, Units, combine, noise_floor, strict_metrics, verdict

METRICS = ("lpips", "mask_iou", "pck", "trajectory_error")
"""Metrics of the table; a strict metric replaces the paper's."""
MODELS = {variant.name: f"{variant.change or 'no'} changes" for variant in PARTS["shifts"]}
"""The variants that are graded on changed scenes, and the changes that each was trained with."""
ROBOTS = PARTS["shifts"][0]
"""The variant whose robots are those of all."""
SEEN = pooled(ROBOTS, "seen")
SCENE, CELL = ["task", "seed"], ["task", "seed", "robot"]


class Shifts:
    """Scores of MODELS with each change on their training robots, and without one on all robots, over common scenes.

    Only the first training run of each is graded on changed scenes, so intervals are over scenes.
    Raises ConfigError if a table has no change, two have the same of one model, or they were graded differently.
    """

    def __init__(self, scores: Scores, shifted: Sequence[Scores]) -> None:
        pairs = [(model, table.change) for table in shifted for model, _ in table.models]
        graded = {model for model, _ in pairs}  # a run's rollouts have its name as their model
        if unknown := sorted(graded - set(MODELS)):
            raise ConfigError(f"the tables of changed scenes are of {', '.join(unknown)}; expected {' or '.join(MODELS)}.")
        if len(set(pairs)) < len(pairs) or not all(table.change for table in shifted) or scores.change:
            found = ", ".join(table.change or "no change" for table in (scores, *shifted))
            raise ConfigError(
                f"the tables of changed scenes have {found}; expected one without a change, and one of each change and model."
            )
        for key in (key for key in COMPARABLE if key != "change"):
            if any(table.attributes.get(key) != scores.attributes.get(key) for table in shifted):
                raise ConfigError(f"the tables of changed scenes differ in {key} from the unchanged; grade them alike.")
        self.metrics: Mapping[str, MetricInfo] = {metric.name: metric for metric in scores.metrics}
        self.models = [name for name in MODELS if name in graded.intersection(scores.rows[VARIANT])]
        own = _first_training(scores.rows[scores.rows[VARIANT].isin(self.models) | (scores.rows["model"] == TRUTH)])
        changed = pd.concat([table.rows.assign(change=table.change) for table in shifted])
        changed = changed[changed["model"].isin(self.models)]
        changed = changed.assign(**{VARIANT: changed["model"] + " " + changed["change"]})
        self.changes = sorted(set(changed["change"]), key=lambda change: (FACTORS.index(change.partition(":")[0]), change))
        common = own.loc[own["robot"].isin(SEEN), CELL].drop_duplicates()
        for _, rows in [*own[own[VARIANT] != ""].groupby(VARIANT), *changed.groupby(VARIANT)]:
            common = common.merge(rows[CELL].drop_duplicates())
        parts = [own.merge(common[SCENE].drop_duplicates(), on=SCENE), changed.merge(common, on=CELL)]
        merged = pd.concat(parts, ignore_index=True).assign(**{TRAINING: 0})
        self._grades = StudyGrades(merged, tuple(scores.metrics), {}, assumed_spread=0.0)
        self.scenes = len(Units(common))

    def mean(self, model: str, case: str, metric: str) -> Mean | None:
        """Mean score in a case: a change on its training robots, an unseen robot, or empty for the training robots."""
        if case in self.changes:
            return self._grades.variant_mean(f"{model} {case}", SEEN, metric)
        return self._grades.variant_mean(model, (case,) if case else SEEN, metric)

    def cost(self, model: str, case: str, metric: str) -> Mean | None:
        """Difference of a case from the training robots in unchanged scenes, paired by scene; None if one was not graded."""
        means = self.mean(model, case, metric), self.mean(model, "", metric)
        return combine(np.subtract, means[0], means[1]) if means[0] and means[1] else None

    def compare_changes(self, model: str, metric: str) -> dict[str, list[str]]:
        """Changes by whether they cost a model more or less than every unseen robot does, or neither is resolved.

        Keys are more, less and unresolved. A change costs more or less if the interval of the difference of its cost from that
        of each unseen robot lies on one side of 0.
        """
        found: dict[str, list[str]] = {"more": [], "less": [], "unresolved": []}
        robots = [cost for robot in ROBOTS.held_out_robots if (cost := self.cost(model, robot, metric))]
        sign = -1 if self.metrics[metric].higher_is_better else 1
        for change in self.changes:
            if robots and (cost := self.cost(model, change, metric)):
                ends = sign * np.array([combine(np.subtract, cost, robot).interval() for robot in robots])
                found["more" if (ends > 0).all() else "less" if (ends < 0).all() else "unresolved"].append(change)
        return found

    @property
    def cases(self) -> dict[str, str]:
        """Titles of all cases that are compared with the training robots in unchanged scenes."""
        robots = {robot: f"{ROBOT_TITLES[robot]}, never seen" for robot in ROBOTS.held_out_robots}
        return robots | {change: change.replace(":", ", level ") for change in self.changes}

    def floor(self, metric: str) -> float:
        """Noise floor of a metric on the training robots; NaN if it is not known."""
        info, truth = self.metrics[metric], self._grades.variant_mean(TRUTH, SEEN, metric)
        return noise_floor(truth.value if truth else None, info.best, info.estimated)


def shifts_table(shifts: Shifts) -> Table:
    """Unseen robots and all changes by model, with marks for differences from the training robots in unchanged scenes."""
    strict = strict_metrics(shifts.metrics)
    shown = [name for metric in METRICS if (name := strict.get(metric, metric)) in shifts.metrics]

    titles = {"": "nothing is new"} | shifts.cases

    def section(title: str, cases: Iterable[str]) -> TableSection:
        rows = [(case, model) for case in cases for model in shifts.models]
        cells = [tuple(_cell(shifts, *row, metric) for metric in shown) for row in rows]
        labels = [(titles[case], MODELS[model]) for case, model in rows]
        return TableSection(title, tuple(map(TableRow, labels, cells)))

    sections = [section("Training robots, unchanged scenes", [""]), section("A new robot", ROBOTS.held_out_robots)]
    for factor in FACTORS:
        changes = [change for change in shifts.changes if change.startswith(f"{factor}:")]
        sections += [section(f"Training robots, {factor} changed", changes)] if changes else []
    return Table(
        "shifts",
        "What costs more: a new robot or a new lamp",
        f"One training run of each model on {shifts.scenes} scenes that all rows share. Marks: compared with the same model "
        "where nothing is new, paired by scene. Models have no marks against each other, which would need more training runs.",
        ("what is new", "trained with"),
        tuple(Column(metric_title(shifts.metrics[metric])) for metric in shown),
        tuple(sections),
    )


def shifts_frame(shifts: Shifts, metric: str) -> pd.DataFrame:
    """Costs by a metric: table trained_with, case, title, value, low, high; NaN if not graded."""
    rows = []
    for model, (case, title) in product(shifts.models, shifts.cases.items()):
        cost = shifts.cost(model, case, metric)
        ends = (cost.value, *interval_ends(cost, LEVEL)) if cost else (np.nan,) * 3
        rows.append((MODELS[model], case, title, *ends))
    return pd.DataFrame(rows, columns=["trained_with", "case", "title", "value", "low", "high"])


def _cell(shifts: Shifts, case: str, model: str, metric: str) -> TableCell:
    info, mean, cost = shifts.metrics[metric], shifts.mean(model, case, metric), shifts.cost(model, case, metric)
    if mean is None or cost is None:
        return TableCell()
    mark = verdict(cost.value, cost.interval(), shifts.floor(metric), info.higher_is_better) if case else ""
    return replace(mean_cell(mean, info, LEVEL), verdict=mark)


def _first_training(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of the first training run of each variant."""
    if TRAINING not in rows:
        return rows
    return rows[rows[TRAINING] == rows.groupby(VARIANT)[TRAINING].transform("min")]

"""The matrix of predictors made on purpose: what every metric says of each, and whether it puts them in the right order.

Reads  episodes of a data set
Writes rows (task seed robot case metric value), and Markdown tables of them
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lab.calibration.predictors import PREDICTORS, Material, predict, render_material
from xew.episode import Record, read_pixels
from xew.metrics import METRICS
from xew.metrics.backends import Masker, Tracker
from xew.metrics.episode_cache import EpisodeCache
from xew.metrics.grade import Comparison, grade, input_kind
from xew.metrics.grading.settings import WITHOUT_OUTCOME
from xew.metrics.truth import Truth, read_truth

STEPS: tuple[tuple[str, ...], ...] = (
    ("truth",),
    ("codec",),
    ("2 frames late",),
    ("8 frames late",),
    ("other robot", "frozen", "shuffled"),
    ("gray",),
)
"""Predictors from right to wrong; predictors of one step are not compared with each other."""
MILD = (
    "grain",
    "brighter",
    "darker",
    "tinted",
    "robot recolored",
    "object recolored",
    "flicker",
    "jitter",
    "ghost",
    "every 5th blank",
    "grippers open",
    "fails at the end",
)
"""Predictors whose robot moves as it should: each is better than a frozen video."""
FURTHER = (
    *((case, "frozen") for case in MILD),
    ("brighter", "every 5th blank"),
    ("2 frames late", "8 frames early"),
    ("object recolored", "object erased"),
    ("robot recolored", "other robot"),
)
"""Further pairs as a person would order them, the better one first."""
OF_OBJECTS = (("object at rest", "object erased"), ("fails at the end", "object at rest"))
"""Further pairs of metrics of objects."""
OWN_PAIRS: dict[str, tuple[tuple[str, str], ...]] = {
    "flicker": (("codec", "flicker"), ("brighter", "flicker"), ("codec", "jitter"), ("codec", "every 5th blank")),
    "flicker_robot": (("codec", "flicker"), ("brighter", "flicker"), ("codec", "jitter")),
    "ghosts": (("codec", "ghost"), ("codec", "every 5th blank"), ("8 frames late", "frozen")),
    "gripper_error": (("codec", "grippers open"), ("codec", "2 frames late")),
    "final_object_error": (("codec", "fails at the end"), ("codec", "object at rest"), ("2 frames late", "8 frames late")),
    "onset_shift": (("codec", "2 frames late"), ("codec", "8 frames early"), ("8 frames late", "object at rest")),
    "keypoint_error_found": (("truth", "codec"), ("codec", "2 frames late"), ("robot recolored", "2 frames late")),
    "coverage_strict": (("codec", "2 frames late"), ("robot recolored", "other robot")),
    "trajectory_error_found": (("codec", "2 frames late"), ("object recolored", "2 frames late")),
    "object_coverage_strict": (("object recolored", "object at rest"), ("object at rest", "object erased")),
}
"""Pairs that a metric of one fault is made for, the better one first."""

Episode = tuple[Path, Record]
Row = dict[str, Any]


def grade_predictors(
    folder: Path,
    record: Record,
    other: Path | None,
    masker: Masker,
    tracker: Tracker,
    metrics: Sequence[str] = WITHOUT_OUTCOME,
    cases: Sequence[str] = tuple(PREDICTORS),
) -> list[Row]:
    """Rows of one episode: the value of each metric for each predictor, NaN where it has none.

    Args:
        folder, record: the episode.
        other: the folder of the same seed with another robot, if there is one.
        masker, tracker: estimators.
        metrics: names of METRICS.
        cases: names of PREDICTORS.
    """
    truth = read_truth(folder, record.frame_count, {input_kind(name) for name in metrics} | {"bodies"})
    other_robot = None if other is None else _cut(read_pixels(other, "rgb"), truth)
    rendered = render_material(folder, cases)
    material = Material(truth.rgb, other_robot, robot=truth.labels == 0, objects=truth.labels > 0, **rendered)
    key = {"task": record.task, "seed": record.seed, "robot": record.robot}
    return [key | row for row in grade_material(material, truth, masker, tracker, metrics, cases)]


def grade_material(
    material: Material,
    truth: Truth,
    masker: Masker,
    tracker: Tracker,
    metrics: Sequence[str] = WITHOUT_OUTCOME,
    cases: Sequence[str] = tuple(PREDICTORS),
) -> list[Row]:
    """Rows (case metric value) of all predictors that can be made of the material; the truth is graded as by `evaluate`."""
    rows: list[Row] = []
    episode = EpisodeCache(truth)
    for case in cases:
        video = predict(case, material)
        if video is None:
            continue
        graded, softened = (truth.rgb, video) if case == "truth" else (video, None)
        values = grade(Comparison(graded, episode, masker, tracker, softened), metrics).values
        rows += [{"case": case, "metric": name, "value": value} for name, value in values.items()]
    return rows


def _cut(video: np.ndarray, truth: Truth) -> np.ndarray:
    """A video [t h w 3] with as many frames as the truth, the last repeated."""
    return video[np.minimum(np.arange(len(truth.rgb)), len(video) - 1)]


def matrix(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean value of each metric (rows) for each predictor (columns), both in their own order."""
    table = rows.groupby(["metric", "case"])["value"].mean().unstack()
    cases = [case for case in PREDICTORS if case in table.columns]
    return table.loc[[name for name in METRICS if name in table.index], cases]


def order_violations(table: pd.DataFrame) -> dict[str, list[tuple[str, str]]]:
    """Pairs of predictors that a metric does not put in order, the one that should be better first, by metric.

    Args:
        table: values by metric (rows) and predictor (columns), as `matrix` gives them.
    """
    violations = {}
    for name in table.index:
        metric = METRICS[str(name)]
        sign = 1 if metric.higher_is_better else -1
        value = sign * table.loc[name]
        pairs = dict.fromkeys([*expected_order(metric.dimension == "objects"), *OWN_PAIRS.get(str(name), ())])
        violations[str(name)] = [(a, b) for a, b in pairs if {a, b} <= set(table.columns) and not value[a] > value[b]]
    return violations


def expected_order(objects: bool) -> list[tuple[str, str]]:
    """Pairs of predictors, the better one first: those of following steps, and the further ones.

    Of metrics of objects the other robot is left out: it moves them as the first one does.
    """
    pairs = [(a, b) for better, worse in itertools.pairwise(STEPS) for a in better for b in worse] + list(FURTHER)
    return [pair for pair in pairs if "other robot" not in pair] + list(OF_OBJECTS) if objects else pairs


def to_markdown(table: pd.DataFrame) -> str:
    """The matrix, and for each metric its suites and the pairs that it does not put in order."""
    wrong = order_violations(table)
    lines = [["metric", "suites", *map(str, table.columns), "not in order"], ["---"] * (len(table.columns) + 3)]
    for name in map(str, table.index):
        values = ["-" if np.isnan(value) else f"{value:.3g}" for value in table.loc[name].to_numpy(float)]
        pairs = "; ".join(f"{a}, {b}" for a, b in wrong[name])
        lines.append([name, ", ".join(METRICS[name].suites), *values, pairs])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)

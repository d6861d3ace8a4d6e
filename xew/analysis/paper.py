"""The paper's own numbers: scores, distances, correlations and the percentages of its text, as it prints them.

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

`lab/paper_figures` rebuilds the correlations and percentages from the scores and distances.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np

from xew.analysis.correlation import Correlation, loeo_correlation
from xew.analysis.scores import MetricInfo
from xew.config import parse
from xew.files import read_json

PAPER = Path(__file__).with_name("paper.json")
AXES = ("appearance", "kinematic")


@dataclass(frozen=True)
class PublishedRobot:
    """A robot's features and its mean distance to the other four."""

    dof: int
    links: int
    reach: float
    """Largest reach of a link [m]."""
    volume: float
    """Volume of the convex hull of the workspace [m³]."""
    kinematic: float
    """Mean kinematic distance [m]."""
    appearance: float


@dataclass(frozen=True)
class PublishedCorrelation:
    """Pearson's r of a distance with a metric over the five folds, and its leave-one-out range."""

    r: float
    low: float
    high: float
    p_value: float | None = None
    """Exact p, which is printed for LPIPS only."""


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
    """Scores by key (see above), robot or 'seen', and metric."""
    half_digits: Mapping[str, float] = field(default_factory=dict)
    """Half a unit of the last printed decimal of metrics where it is not that of the paper's other tables."""


@dataclass(frozen=True)
class PublishedChange:
    """A percentage of the text: the change of a score from one row to another, as a share of the value before."""

    source: str
    metric: str
    before: str
    """Place (part/key/robot) of the value before."""
    after: str
    """Place of the value after."""
    percent: float
    word: Literal["rounded", "about", "less than"] = "rounded"
    """Exactness of the text. 'about': it rounds to tens ("roughly", "nearly"). 'less than': the change is smaller."""
    toward: str | None = None
    """Place of a goal, if any: then `percent` is the share of the way from `before` to it."""


@dataclass(frozen=True)
class Paper:
    """All figures that the paper prints and that we use."""

    title: str
    tables: Mapping[str, str]
    half_digit: float
    robots: Mapping[str, PublishedRobot]
    distances: Mapping[str, Sequence[Sequence[float]]]
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
        """A feature of all robots, such as 'appearance' or 'dof': [5] float64 in the order of `robots`."""
        return np.array([getattr(robot, name) for robot in self.robots.values()], np.float64)

    def scores(self, metric: str) -> np.ndarray:
        """A metric's scores of held-out robots (LOEO): [5] float64 in the order of `robots`."""
        return np.array([self.parts["loeo"].rows[f"loeo_{robot}"][robot][metric] for robot in self.robots])

    def score(self, part: str, key: str, robot: str, metric: str) -> float | None:
        """A printed score; None where the paper prints none."""
        rows = self.parts[part].rows if part in self.parts else {}
        return rows.get(key, {}).get(robot, {}).get(metric)

    def half_digit_of(self, part: str, metric: str) -> float:
        """Half a unit of the last printed decimal of a metric in a part."""
        return self.parts[part].half_digits.get(metric, self.half_digit)

    def correlation(self, metric: str, axis: str) -> Correlation:
        """Correlation of a metric with an axis, computed here from the printed scores and distances."""
        return loeo_correlation(self.axis(axis).tolist(), self.scores(metric).tolist(), self.metrics[metric].higher_is_better)


@cache
def read_paper() -> Paper:
    """The figures that come with the package."""
    return parse(Paper, read_json(PAPER), str(PAPER))


PAPER_TITLES = {name: metric.title for name, metric in read_paper().metrics.items()}

"""A study's means by strict metrics, at the addresses of the paper's metrics.

Claims name metrics of the paper. `StrictGrades` answers with the strict metric that replaces each of them, if it was graded.
"""

from collections.abc import Mapping

import numpy as np

from xew.analysis.scores import MetricInfo
from xew.analysis.statistics.grades import Grades
from xew.statistics import Mean, strict_metrics


class StrictGrades:
    """The means of a study, by the metrics that decide."""

    def __init__(self, grades: Grades) -> None:
        self._grades, self._strict = grades, strict_metrics(grades.metrics)
        self.level, self.own_distances = grades.level, grades.own_distances

    @property
    def metrics(self) -> Mapping[str, MetricInfo]:
        """What the table says of the metric that decides, by the name of the paper's."""
        known = self._grades.metrics
        return {name: known[self._strict.get(name, name)] for name in known}

    def mean(self, part: str, row: str, robots: str, metric: str, shared: bool = False) -> Mean | None:
        return self._grades.mean(part, row, robots, self._strict.get(metric, metric), shared)

    def against(self, part: str, row: str, baseline: str, robots: str, metric: str) -> tuple[Mean, Mean] | None:
        return self._grades.against(part, row, baseline, robots, self._strict.get(metric, metric))

    def floor(self, robots: str, metric: str, *rows: tuple[str, str]) -> float:
        return self._grades.floor(robots, self._strict.get(metric, metric), *rows)

    def axis(self, name: str) -> np.ndarray:
        """Mean distances of the robots, [5] float64 or a row of them for each of `Mean.values`."""
        return self._grades.axis(name)

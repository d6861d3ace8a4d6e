"""What claims are made of: numbers with bounds, and the reader that computes them from a study's means."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from xew.analysis.paper import PAPER_TITLES
from xew.analysis.statistics.grades import SEEN, Grades, relative_gain
from xew.analysis.tables.labels import SHORT_ROBOTS
from xew.protocol import ROBOT_NAMES
from xew.statistics import MIN_SCENES, Mean, interval


class NotMeasuredError(Exception):
    """A claim needs a mean that was not measured."""


@dataclass(frozen=True)
class Comparison:
    """One number that a claim bounds."""

    label: str
    values: np.ndarray
    """[1 + n] the number, then what else it could have been."""
    above: float = -np.inf
    below: float = np.inf
    percent: bool = True
    """Shown as a percentage, else with three decimals."""
    doubt: str = ""
    """Why it cannot be resolved whatever the interval says."""


@dataclass(frozen=True)
class Claim:
    """What is said, and what would have to be true."""

    name: str
    where: str
    """The paper's section, or 'ours' for a stricter question that it does not answer."""
    says: str
    test: str
    comparisons: Callable[["Reader"], Iterator[Comparison]]


class Reader:
    """What claims read of a study: means that must be there, and comparisons of them."""

    def __init__(self, grades: Grades) -> None:
        self.grades = grades

    def mean(self, part: str, row: str, robots: str, metric: str) -> Mean:
        mean = self.grades.mean(part, row, robots, metric, shared=True) if metric in self.grades.metrics else None
        if mean is None:
            name = SHORT_ROBOTS.get(robots, "seen robots")
            raise NotMeasuredError(f"{PAPER_TITLES[metric]} of {row.replace('_', ' ')} ({part.replace('_', ' ')}) on {name}")
        return mean

    def gain(
        self, part: str, after: str, before: str, robots: str, metric: str, above: float = -np.inf, below: float = np.inf
    ) -> Comparison:
        """By which share of the value before one row is better than another."""
        new, old = self.mean(part, after, robots, metric), self.mean(part, before, robots, metric)
        label = f"{SHORT_ROBOTS.get(robots, 'seen')} {PAPER_TITLES[metric]}"
        # Where a bound from above is asked for, smallness is the claim, and the floor does not speak against it.
        doubt = self._doubt((new, old), robots, metric) if above > -np.inf else self._doubt_of_few((new, old))
        return Comparison(label, relative_gain(new, old, self.grades.metrics[metric]).values, above, below, doubt=doubt)

    def worse_than_seen(
        self, part: str, row: str, robots: str, metric: str, above: float = 0, below: float = np.inf
    ) -> Comparison:
        """By which share of its score on seen robots a row is worse on another robot."""
        new, old = self.mean(part, row, robots, metric), self.mean(part, row, SEEN, metric)
        label = f"{SHORT_ROBOTS[robots]} {PAPER_TITLES[metric]}"
        values = -relative_gain(new, old, self.grades.metrics[metric]).values
        return Comparison(label, values, above, below, doubt=self._doubt((new, old), robots, metric))

    def share(self, start: Mean, after: Mean, end: Mean, metric: str) -> tuple[np.ndarray, str]:
        """Which share of the way from a start to a better end has been gone [1 + n], and why that is no answer, or ''.

        Without such a way there is no share: were the end worse than the start, who does worse would seem to get there.
        """
        way = (end.values - start.values) * (1 if self.grades.metrics[metric].higher_is_better else -1)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (after.values - start.values) / (end.values - start.values)
        no_way = "" if interval(way, self.grades.level)[0] > 0 else "no gap to close"
        return share, self._doubt_of_few((start, after, end)) or no_way

    def closed_share(
        self, part: str, after: str, before: str, robots: str, metric: str, goal: tuple[str, str]
    ) -> tuple[np.ndarray, str]:
        """`share` of the way from a row to the goal (part, row of the seen robots) that another row has gone."""
        old, new = self.mean(part, before, robots, metric), self.mean(part, after, robots, metric)
        return self.share(old, new, self.mean(*goal, SEEN, metric), metric)

    def loeo(self, metric: str) -> np.ndarray:
        """How bad each held-out robot is [1 + n 5]: higher is worse."""
        means = [self.mean("loeo", f"loeo_{robot}", robot, metric) for robot in ROBOT_NAMES]
        sign = -1 if self.grades.metrics[metric].higher_is_better else 1
        return sign * np.stack([mean.values for mean in means], axis=1)

    def doubt_of_few_scenes(self, part: str, row: str, robots: str, metric: str) -> str:
        return self._doubt_of_few((self.mean(part, row, robots, metric),))

    def _doubt_of_few(self, means: Sequence[Mean]) -> str:
        few = any(mean.scenes is not None and mean.scenes < MIN_SCENES for mean in means)
        return f"fewer than {MIN_SCENES} scenes" if few else ""

    def _doubt(self, means: tuple[Mean, Mean], robots: str, metric: str) -> str:
        floor = self.grades.floor(robots, metric)
        inside = floor > 0 and abs(means[0].value - means[1].value) <= floor
        unknown = "no noise floor: the true video was not graded" if np.isnan(floor) else ""
        return self._doubt_of_few(means) or unknown or (f"inside the noise floor of {floor:.3g}" if inside else "")

"""Parts of claims: numbers with bounds, and the reader that computes them from a study's means."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from xew.analysis.paper import PAPER_TITLES
from xew.analysis.statistics.grades import SEEN, Grades, relative_gain
from xew.analysis.tables.labels import SHORT_ROBOTS
from xew.protocol import ROBOT_NAMES
from xew.statistics import MIN_SCENES, Mean, interval


class NotMeasuredError(Exception):
    """Raised where a claim needs a mean that was not measured."""


@dataclass(frozen=True)
class Comparison:
    """One number that a claim bounds."""

    label: str
    values: np.ndarray
    """[1 + n] float64: the number, then its values in n bootstrap draws."""
    above: float = -np.inf
    """Bound that the number has to lie above."""
    below: float = np.inf
    """Bound that the number has to lie below."""
    percent: bool = True
    """Whether it is printed as a percentage, else with three decimals."""
    doubt: str = ""
    """Reason why it cannot be resolved whatever the interval says, or ''."""


@dataclass(frozen=True)
class Claim:
    """A claim in words, and the comparisons that test it."""

    name: str
    where: str
    """Section of the paper, or 'ours' for a stricter question that it does not answer."""
    says: str
    """Claim in words."""
    test: str
    """Test in words."""
    comparisons: Callable[["Reader"], Iterator[Comparison]]


class Reader:
    """Computes comparisons from the means of a study; a mean that was not measured raises NotMeasuredError."""

    def __init__(self, grades: Grades) -> None:
        self.grades = grades

    def mean(self, part: str, row: str, robots: str, metric: str) -> Mean:
        """The mean at an address, over the cells that all rows of the part have."""
        mean = self.grades.mean(part, row, robots, metric, shared=True) if metric in self.grades.metrics else None
        if mean is None:
            name = SHORT_ROBOTS.get(robots, "seen robots")
            raise NotMeasuredError(f"{PAPER_TITLES[metric]} of {row.replace('_', ' ')} ({part.replace('_', ' ')}) on {name}")
        return mean

    def gain(
        self, part: str, after: str, before: str, robots: str, metric: str, above: float = -np.inf, below: float = np.inf
    ) -> Comparison:
        """The gain of one row over another, as a share of the value before; positive is better."""
        new, old = self.mean(part, after, robots, metric), self.mean(part, before, robots, metric)
        label = f"{SHORT_ROBOTS.get(robots, 'seen')} {PAPER_TITLES[metric]}"
        # Where a bound from above is asked for, smallness is the claim, and the floor does not speak against it.
        doubt = self._doubt((new, old), robots, metric) if above > -np.inf else self._doubt_of_few((new, old))
        return Comparison(label, relative_gain(new, old, self.grades.metrics[metric]).values, above, below, doubt=doubt)

    def worse_than_seen(
        self, part: str, row: str, robots: str, metric: str, above: float = 0, below: float = np.inf
    ) -> Comparison:
        """The loss of a row on another robot, as a share of its score on seen robots; positive is worse."""
        new, old = self.mean(part, row, robots, metric), self.mean(part, row, SEEN, metric)
        label = f"{SHORT_ROBOTS[robots]} {PAPER_TITLES[metric]}"
        values = -relative_gain(new, old, self.grades.metrics[metric]).values
        return Comparison(label, values, above, below, doubt=self._doubt((new, old), robots, metric))

    def share(self, start: Mean, after: Mean, end: Mean, metric: str) -> tuple[np.ndarray, str]:
        """The share of the gap from a start to a better end that is closed [1 + n] float64, and a doubt about it, or ''.

        Without such a gap there is no share: if the end were worse than the start, a worse score would seem to close it.
        """
        gap = (end.values - start.values) * (1 if self.grades.metrics[metric].higher_is_better else -1)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (after.values - start.values) / (end.values - start.values)
        no_gap = "" if interval(gap, self.grades.level)[0] > 0 else "no gap to close"
        return share, self._doubt_of_few((start, after, end)) or no_gap

    def closed_share(
        self, part: str, after: str, before: str, robots: str, metric: str, goal: tuple[str, str]
    ) -> tuple[np.ndarray, str]:
        """`share` [1 + n] of the gap from a row to the goal (part and row, on seen robots) that another row closes."""
        old, new = self.mean(part, before, robots, metric), self.mean(part, after, robots, metric)
        return self.share(old, new, self.mean(*goal, SEEN, metric), metric)

    def loeo(self, metric: str) -> np.ndarray:
        """Scores of each robot when it was held out [1 + n 5] float64, with the sign turned so that higher is worse."""
        means = [self.mean("loeo", f"loeo_{robot}", robot, metric) for robot in ROBOT_NAMES]
        sign = -1 if self.grades.metrics[metric].higher_is_better else 1
        return sign * np.stack([mean.values for mean in means], axis=1)

    def doubt_of_few_scenes(self, part: str, row: str, robots: str, metric: str) -> str:
        """Text that says that a mean rests on too few scenes, or ''."""
        return self._doubt_of_few((self.mean(part, row, robots, metric),))

    def _doubt_of_few(self, means: Sequence[Mean]) -> str:
        few = any(mean.scenes is not None and mean.scenes < MIN_SCENES for mean in means)
        return f"fewer than {MIN_SCENES} scenes" if few else ""

    def _doubt(self, means: tuple[Mean, Mean], robots: str, metric: str) -> str:
        floor = self.grades.floor(robots, metric)
        inside = floor > 0 and abs(means[0].value - means[1].value) <= floor
        unknown = "no noise floor: the true video was not graded" if np.isnan(floor) else ""
        return self._doubt_of_few(means) or unknown or (f"inside the noise floor of {floor:.3g}" if inside else "")

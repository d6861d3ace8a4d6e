"""Parts of claims: numbers with bounds, and the reader that computes them from a study's means."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from xew.analysis.paper import PAPER_TITLES
from xew.analysis.statistics.grades import SEEN, Grades, average, mean_of_folds_that_saw, relative_gain, relative_loss
from xew.analysis.tables.labels import SHORT_ROBOTS
from xew.protocol import BASELINES, HELD_OUT_ROBOTS, PASTED_RENDER, ROBOT_NAMES, SEEN_ROBOTS
from xew.statistics import MIN_SCENES, SIGNIFICANCE, Mean, combine, exact_p, largest_floor

OTHER_ROBOTS = "measured on other robots: no model that saw this one was graded"
"""Doubt about a gap measured on other robots, which may be easier or harder to render."""
FEW_ROBOTS = "five robots: descriptive"
"""Doubt about a correlation that another pairing of distances with scores gives as well."""


class NotMeasuredError(Exception):
    """Raised where a claim needs a mean that was not measured."""


@dataclass(frozen=True)
class Comparison:
    """One number that a claim bounds."""

    label: str
    number: Mean
    above: float = -np.inf
    below: float = np.inf
    percent: bool = True
    """Whether it is printed as a percentage, else with three decimals."""
    doubt: str = ""
    """Reason why it is unresolved for any interval, or ''."""
    subject: tuple[str, str, str, str] | None = None
    """Part, row, robot and metric of the model of which something good is said, and which should therefore beat pasting."""
    exact: tuple[float, float] = (0.0, 0.0)
    """Exact p of the claim and of its opposite over pairings of robots, which have to be small too; 0 where none is asked."""

    def p_values(self, level: float) -> tuple[float, float]:
        """The p of the claim and of its opposite, to compare with SIGNIFICANCE.

        For one bound both are twice the one-sided p. Two bounds are an equivalence: the larger p of two one-sided tests
        (Schuirmann 1987, "A comparison of the two one-sided tests procedure and the power approach").
        """
        sides = [(self.number.p_above, self.above), (self.number.p_below, self.below)]
        asked = [test(bound, level) for test, bound in sides if np.isfinite(bound)]
        others = [
            test(bound, level)
            for test, bound in ((self.number.p_below, self.above), (self.number.p_above, self.below))
            if np.isfinite(bound)
        ]
        claim = asked[0] * 2 if len(asked) == 1 else max(asked)
        return min(max(claim, self.exact[0]), 1.0), min(max(2 * min(others), self.exact[1]), 1.0)


@dataclass(frozen=True)
class Claim:
    """A claim in words, and the comparisons that test it."""

    name: str
    where: str
    """Section of the paper, or 'ours' for a stricter question that it does not answer."""
    says: str
    test: str
    comparisons: Callable[["Reader"], Iterator[Comparison]]


class Reader:
    """Computes comparisons from the means of a study; a mean that was not measured raises NotMeasuredError."""

    def __init__(self, grades: Grades) -> None:
        self.grades = grades
        self._seen: dict[tuple[str, str], Mean | None] = {}

    def mean(self, part: str, row: str, robots: str, metric: str) -> Mean:
        """The mean at an address, over the cells that all rows of the part have."""
        mean = self.grades.mean(part, row, robots, metric, shared=True) if metric in self.grades.metrics else None
        if mean is None:
            name = SHORT_ROBOTS.get(robots, "seen robots")
            raise NotMeasuredError(f"{self.title(metric)} of {row.replace('_', ' ')} ({part.replace('_', ' ')}) on {name}")
        return mean

    def gain(
        self, part: str, after: str, before: str, robots: str, metric: str, above: float = -np.inf, below: float = np.inf
    ) -> Comparison:
        """The relative gain of one row over another; positive is better."""
        new, old = self.mean(part, after, robots, metric), self.mean(part, before, robots, metric)
        label = f"{SHORT_ROBOTS.get(robots, 'seen')} {self.title(metric)}"
        # Where a bound from above is asked for, smallness is the claim, and the floor does not speak against it.
        rows = (part, after), (part, before)
        doubt = self._doubt_of_few((new, old)) if below < np.inf else self._doubt((new, old), robots, metric, *rows)
        subject = (part, after, robots, metric) if robots in HELD_OUT_ROBOTS else None
        gain = relative_gain(new, old, self.grades.metrics[metric])
        return Comparison(label, gain, above, below, doubt=doubt, subject=subject)

    def over_pasting(self, subject: tuple[str, str, str, str]) -> Comparison:
        """Gain of a model over the paste baseline on the same episodes, for a part, row, robot and metric; positive is
        better.
        """
        part, row, robot, metric = subject
        found = self.grades.against(part, row, PASTED_RENDER, robot, metric)
        if found is None:
            raise NotMeasuredError(f"{BASELINES[PASTED_RENDER]} on {SHORT_ROBOTS[robot]}")
        floor = largest_floor((self.grades.floor(robot, metric, (part, row)), self.grades.floor(robot, metric)))
        label = f"{row.replace('_', ' ')}, {SHORT_ROBOTS[robot]} {self.title(metric)}"
        gain = relative_gain(*found, self.grades.metrics[metric])
        return Comparison(label, gain, above=0, doubt=self._doubt_of_floor(found, floor))

    def title(self, metric: str) -> str:
        """Title of the metric that stands for a metric of the paper: its own, or that of the suite strict."""
        info = self.grades.metrics.get(metric)
        return info.title if info and info.name != metric else PAPER_TITLES[metric]

    def mean_of_seen(self, robot: str, metric: str) -> Mean | None:
        """Mean on a robot over the leave-one-embodiment-out folds that saw it; None where none was graded."""
        if (robot, metric) not in self._seen:
            self._seen[robot, metric] = mean_of_folds_that_saw(self.grades, robot, metric)
        return self._seen[robot, metric]

    def unseen_gap(self, robot: str, metric: str) -> Comparison:
        """The relative loss of the fold that did not see a robot against those that did, on the same episodes.

        Without these folds it is the loss of the reference model against seen robots, in doubt.
        """
        saw, fold = self.mean_of_seen(robot, metric), f"loeo_{robot}"
        if saw is None or self.grades.mean("loeo", fold, robot, metric) is None:
            return self.worse_than_seen("fixed", "fixed", robot, metric)
        label = f"{SHORT_ROBOTS[robot]} {self.title(metric)}"
        unseen = self.mean("loeo", fold, robot, metric)
        doubt = self._doubt((unseen, saw), robot, metric, ("loeo", fold))
        return Comparison(label, relative_loss(unseen, saw, self.grades.metrics[metric]), above=0, doubt=doubt)

    def worse_than_seen(self, part: str, row: str, robot: str, metric: str, above: float = 0) -> Comparison:
        """The loss of a row on an unseen robot against its expected score had it seen the robot; positive is worse.

        The expectation is its score on seen robots, scaled by the robot's difficulty for the folds that saw it. Without these
        folds it is the score on seen robots, in doubt.
        """
        new, old = self.mean(part, row, robot, metric), self.mean(part, row, SEEN, metric)
        label = f"{SHORT_ROBOTS[robot]} {self.title(metric)}"
        saw = [self.mean_of_seen(name, metric) for name in (robot, *SEEN_ROBOTS)]
        known = [mean for mean in saw if mean is not None]
        if len(known) < len(saw):
            doubt = self._doubt((new, old), robot, metric, (part, row)) or OTHER_ROBOTS
            return Comparison(label, relative_loss(new, old, self.grades.metrics[metric]), above, doubt=doubt)
        expected = combine(lambda score, own, *others: score * own / average(*others), old, *known)
        doubt = self._doubt((new, expected), robot, metric, (part, row))
        return Comparison(label, relative_loss(new, expected, self.grades.metrics[metric]), above, doubt=doubt)

    def share(self, start: Mean, after: Mean, end: Mean, metric: str) -> tuple[Mean, str]:
        """The closed share of the gap from a start to a better end, and a doubt about it, or ''; without a gap there is no
        share.
        """
        sign = 1 if self.grades.metrics[metric].higher_is_better else -1
        gap = combine(lambda new, old: sign * (new - old), end, start)
        share = combine(lambda old, new, goal: (new - old) / (goal - old), start, after, end)
        no_gap = "" if 2 * gap.p_above(0, self.grades.level) <= SIGNIFICANCE else "no gap to close"
        return share, self._doubt_of_few((start, after, end)) or no_gap

    def closed_share(
        self, part: str, after: str, before: str, robot: str, metric: str, goal: tuple[str, str]
    ) -> tuple[Mean, str]:
        """`share` of the gap between a row and the folds that saw the robot; without them, to a goal on seen robots, in
        doubt.
        """
        old, new = self.mean(part, before, robot, metric), self.mean(part, after, robot, metric)
        saw = self.mean_of_seen(robot, metric)
        share, doubt = self.share(old, new, saw or self.mean(*goal, SEEN, metric), metric)
        return share, doubt or ("" if saw else OTHER_ROBOTS)

    def correlation(
        self, label: str, metric: str, statistic: Callable[..., np.ndarray], axes: Sequence[str], above: float = 0
    ) -> Comparison:
        """A statistic of the five folds, with its exact p over all pairings of robots.

        `statistic` maps the distances on each of `axes` and the scores, all [... 5] float64, to [...].
        """
        means = [self.mean("loeo", f"loeo_{robot}", robot, metric) for robot in ROBOT_NAMES]
        sign = -1 if self.grades.metrics[metric].higher_is_better else 1  # higher is worse
        distances = [self.grades.axis(axis) for axis in axes]
        number = combine(lambda *scores: statistic(*distances, sign * np.stack(scores, axis=-1)), *means)
        number = number.within((-len(axes), len(axes)))  # of one r, or of the difference of two
        points = [np.atleast_2d(axis)[0] for axis in distances]
        scores = sign * np.array([mean.value for mean in means])
        p = exact_p(lambda paired: statistic(*points, paired), scores)
        few = self._doubt_of_few(means) or (f"{FEW_ROBOTS}, exact p = {p:.3f}" if p > SIGNIFICANCE else "")
        exact = (p, 1.0) if number.value > 0 else (1.0, p)
        return Comparison(label, number, above, percent=False, doubt=few, exact=exact)

    def _doubt_of_few(self, means: Sequence[Mean]) -> str:
        few = any(mean.scenes is not None and mean.scenes < MIN_SCENES for mean in means)
        return f"fewer than {MIN_SCENES} scenes" if few else ""

    def _doubt(self, means: tuple[Mean, Mean], robots: str, metric: str, *rows: tuple[str, str]) -> str:
        return self._doubt_of_floor(means, self.grades.floor(robots, metric, *rows))

    def _doubt_of_floor(self, means: tuple[Mean, Mean], floor: float) -> str:
        inside = floor > 0 and abs(means[0].value - means[1].value) <= floor
        unknown = "no noise floor: the true video was not graded" if np.isnan(floor) else ""
        return self._doubt_of_few(means) or unknown or (f"inside the noise floor of {floor:.3g}" if inside else "")

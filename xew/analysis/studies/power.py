"""How many training runs, scenes and bodies the claims need, estimated from the scores of an earlier study.

The effects are taken as observed there. The variance of a number has a part of the scenes, which falls with their number, and a
part of the training runs (`Mean.spread_of_runs`), which falls with theirs. Studies are then drawn and asked as `findings.ask`
does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import norm, t

from xew.analysis.paper import AXES, read_paper
from xew.analysis.scores import read_scores
from xew.analysis.statistics.grades import StudyGrades, average
from xew.analysis.statistics.suites import StrictGrades
from xew.analysis.tables.claims import CLAIMS
from xew.analysis.tables.comparisons import Comparison, NotMeasuredError, Reader
from xew.config import ConfigError
from xew.protocol import ROBOT_NAMES, TASK_COUNT, TEST_SEEDS_PER_TASK
from xew.statistics import SIGNIFICANCE, combine, holm

RUNS = (1, 3, 5, 8, 12)
"""Numbers of training runs of each variant that are tried."""
BODIES = (32, 64, 128)
"""Numbers of bodies that are tried for claims about distance."""
ENOUGH = 0.8
"""Probability of a verdict that counts as enough."""
STUDIES = 300
"""Number of studies that are drawn for each design."""
DRAWS = 999
"""Number of bootstrap draws; variances need fewer than the tails of intervals."""


@dataclass(frozen=True)
class Asked:
    """One number of a claim, with what its uncertainty is made of."""

    value: float
    bounds: tuple[float, float]
    """The claim is that it lies above the first and below the second."""
    doubtful: bool
    """Whether more data of the same kind do not resolve it."""
    of_scenes: float
    """Variance between scenes, with as many as were graded."""
    of_runs: float
    """Variance between single training runs of one seed."""
    freedom: tuple[float, float]
    """Degrees of freedom of both."""

    def draw_p(self, rng: np.random.Generator, more: float, runs: int) -> np.ndarray:
        """[STUDIES 2] p of the claim and of its opposite in studies with `more` times as many scenes and so many runs."""
        if self.doubtful:
            return np.ones((STUDIES, 2))
        scenes, trainings = self.of_scenes / more, self.of_runs / runs
        variance, own = max(scenes + trainings, 1e-12), runs - 1 if runs > 1 else self.freedom[1]
        inverse = (scenes / (more * self.freedom[0]) + trainings / own) / variance  # of the degrees of freedom
        freedom = 1 / max(inverse, 1e-9)
        found = self.value + np.sqrt(variance) * rng.standard_normal(STUDIES)
        error = np.sqrt(variance * rng.chisquare(freedom, STUDIES) / freedom)
        above, below = ((sign * (found - bound)) / error for sign, bound in zip((1, -1), self.bounds, strict=True))
        tails = [np.stack([t.sf(z, freedom), t.sf(-z, freedom)]) for z in (above, below) if np.isfinite(z).all()]
        claim = tails[0][0] * 2 if len(tails) == 1 else np.maximum(tails[0][0], tails[1][0])
        opposite = 2 * np.min([tail[1] for tail in tails], axis=0)
        return np.minimum(np.stack([claim, opposite], axis=1), 1)


def format_power(path: Path) -> str:
    """Text on the probability of a verdict for each claim by scenes and runs, and on bodies. Raises ConfigError."""
    scores = read_scores(path)
    if not scores.of_study:
        raise ConfigError(f"{path} is not of a study; expected a study's scores.parquet, with the column `variant`.")
    paper = read_paper()
    axes = {axis: np.array([getattr(paper.robots[robot], axis) for robot in ROBOT_NAMES]) for axis in AXES}
    grades = StudyGrades(scores.rows, scores.metrics, axes, draws=DRAWS, codecs=scores.codecs)
    reader = Reader(StrictGrades(grades))
    asked = _list_claims(reader)
    if not asked:
        raise ConfigError(f"{path} has no scores that a claim asks for, so it says nothing about the data that claims need.")
    count, most = grades.scenes, TASK_COUNT * TEST_SEEDS_PER_TASK
    lines = [
        f"power: probability of a verdict on each claim, if effects and spreads are as in {path}",
        f"{'training runs of each variant':<36}" + "".join(f"{runs:>6}" for runs in RUNS),
    ]
    for scenes in dict.fromkeys((count, max(count, most))):
        designs = [_draw_designs(asked, scenes / count, runs) for runs in RUNS]
        lines.append(f"{scenes} scenes")
        lines += [f"  {name:<34}" + "".join(f"{each[name]:>6.2f}" for each in designs) for name in asked]
        lines.append(f"  {f'expected of {len(asked)} claims':<34}" + "".join(f"{sum(each.values()):>6.1f}" for each in designs))
        lines.append(_name_needs(list(asked), designs))
    return "\n".join([*lines, "claims about distance: five robots decide none at any number of runs", *_format_bodies(reader)])


def _list_claims(reader: Reader) -> dict[str, list[Asked]]:
    """The numbers of the paper's claims that scenes and runs can answer and that were graded, by the claim's name."""
    found = {}
    for claim in CLAIMS:
        try:
            asked = list(claim.comparisons(reader)) if claim.where != "ours" else []
        except NotMeasuredError:
            continue
        if asked and all(one.exact == (0.0, 0.0) and one.number.scenes for one in asked):
            found[claim.name] = [_take_apart(one) for one in asked]
    return found


def _take_apart(comparison: Comparison) -> Asked:
    number = comparison.number
    of_runs = number.spread_of_runs(1)
    return Asked(
        number.value,
        (comparison.above, comparison.below),
        bool(comparison.doubt),
        float(np.nanvar(number.of_scenes()[1:])),
        of_runs[1].variance if of_runs else 0.0,
        (number.freedom, of_runs[1].freedom if of_runs else np.inf),
    )


def _draw_designs(asked: dict[str, list[Asked]], more: float, runs: int) -> dict[str, float]:
    """Probability of a verdict on each claim, asked alone."""
    rng, found = np.random.default_rng(0), {}
    for name, numbers in asked.items():
        p_values = np.stack([one.draw_p(rng, more, runs) for one in numbers], axis=1)  # [study number side]
        corrected = np.array([[holm(study[:, 0]).max(), holm(study[:, 1]).min()] for study in p_values])
        found[name] = float((corrected.min(axis=1) <= SIGNIFICANCE).mean())
    return found


def _name_needs(names: Sequence[str], designs: Sequence[dict[str, float]]) -> str:
    needs: dict[str, list[str]] = {}
    for name in names:
        enough = next((str(runs) for runs, each in zip(RUNS, designs, strict=True) if each[name] >= ENOUGH), "")
        needs.setdefault(enough, []).append(name)
    parts = [f"{runs} runs: {', '.join(found)}" for runs in map(str, RUNS) if (found := needs.get(runs))]
    parts += [f"more than {RUNS[-1]}, or not by runs: {', '.join(needs[''])}"] if "" in needs else []
    return f"  for a probability of {ENOUGH:.0%}: {'; '.join(parts)}"


def _format_bodies(reader: Reader) -> list[str]:
    reliability = find_reliability(reader)
    lines = [f"{'bodies, each with and without it in training':<46}" + "".join(f"{count:>6}" for count in BODIES)]
    one = [power_of_r(0.5, count, reliability) for count in BODIES]
    two = [power_of_two(0.6, 0.2, count, reliability) for count in BODIES]
    for title, power in (("r = 0.5 with one of two distances", one), ("r = 0.6 with one distance, 0.2 with the other", two)):
        lines.append(f"  {title:<44}" + "".join(f"{value:>6.2f}" for value in power))
    return [
        *lines,
        f"  with a reliability of a body's gap of {reliability:.2f}, by the gaps of the five robots and the spread of runs",
    ]


def find_reliability(reader: Reader) -> float:
    """The share of the variance of bodies' gaps in LPIPS that is not luck, with one model that saw a body and one that did not.

    The robots' gaps show how much gaps differ. Luck of a model that is the same on all bodies does not count: of a run, it is
    the part in which it is better on one robot than on the others. 0.9 where a fold was not graded.
    """
    try:
        gaps = [_take_apart(reader.unseen_gap(robot, "lpips")) for robot in ROBOT_NAMES]
        means = [reader.mean("loeo", f"loeo_{ROBOT_NAMES[0]}", robot, "lpips") for robot in ROBOT_NAMES]
    except NotMeasuredError:
        return 0.9
    noise = float(np.mean([gap.of_scenes + gap.of_runs for gap in gaps]))
    differ = max(float(np.var([gap.value for gap in gaps], ddof=1)) - noise, 0.0)
    shares = [combine(lambda own, *all_robots: own / average(*all_robots), mean, *means) for mean in means]
    luck = 2 * float(np.mean([sum(part.variance for part in share.spread_of_runs(1)[1:]) for share in shares]))
    return float(np.clip(differ / (differ + luck), 0.1, 1.0)) if differ + luck > 0 else 0.9


def power_of_r(r: float, bodies: int, reliability: float) -> float:
    """Probability that Pearson's r over bodies is significant, by Fisher's z, after Holm's correction for two distances."""
    z = np.arctanh(r * np.sqrt(reliability)) * np.sqrt(bodies - 3)
    return float(norm.sf(norm.isf(SIGNIFICANCE / 4) - z))


def power_of_two(first: float, second: float, bodies: int, reliability: float) -> float:
    """Probability that the r of two distances, which do not depend on one another, differ significantly."""
    ahead = np.subtract(*np.arctanh(np.array([first, second]) * np.sqrt(reliability)))
    return float(norm.sf(norm.isf(SIGNIFICANCE / 2) - ahead * np.sqrt((bodies - 3) / 2)))

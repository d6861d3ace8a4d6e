"""How often claims are answered where there is nothing to find: studies whose variants are all equal.

    python -m lab.null [--studies 400 --scenes 36]

Every study has the scores of one model under all names. A claim that variants differ is then false whichever way it is
answered; one that a difference is large is false only where it "holds", one that it is small only where it "fails". The rates
are to be at most 5 % each. The command prints the table of docs/report.md: studies with one run of each variant, several, or
any mix of both, whose runs differ by 2 and by 5 %.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import pandas as pd
import tyro

from xew.analysis.paper import AXES, Paper, read_paper
from xew.analysis.statistics.grades import StudyGrades
from xew.analysis.tables.claims import CLAIMS
from xew.analysis.tables.comparisons import Claim
from xew.analysis.tables.findings import FAILS, HOLDS, UNMEASURED, ask
from xew.config import user_errors
from xew.protocol import PAPER_PARTS, PARTS, ROBOT_NAMES, TEST_SEED_START, reference
from xew.statistics import Mean, bootstrap_means, combine

METRICS = ("lpips", "mask_iou", "boundary_f1", "region_lpips", "pck", "trajectory_error")
"""Metrics that the paper's claims ask for."""
TRUE_OF_EQUALS = {"views saturate": HOLDS} | dict.fromkeys(
    ("flow gains much", "adaptation pays", "catastrophic forgetting", "systems degrade much"), FAILS
)
"""Answers that are right where all variants are equal; of the other claims neither is."""
ANCHORS = tuple(reference(embodiment=name).name for name in ("none", "nine_views", "robot_render"))
"""Variants of which our study has several runs."""
SPREADS = (0.02, 0.05)
"""Standard deviations between runs, as shares of a score; our runs differ by 0.5 to 6.5 % in LPIPS."""
HEAD = """\
| studies | false "holds" if asked alone, mean (largest of a claim) | false "fails" | any false verdict among all claims |
|---|---|---|---|"""
TASKS = 6
"""Number of tasks that scenes are of."""
HARDNESS, NOISE = 0.15, 0.04
"""Standard deviations, as shares of a score: between scenes, the same for all models, and what is left."""
ROBOTS_DIFFER = 0.3
"""Standard deviation of the logarithm of how hard robots are, where they are not equally hard."""


@dataclass(frozen=True)
class Null:
    """A kind of study in which there is nothing to find."""

    title: str
    runs: tuple[int, ...] = (1,)
    """Numbers of training runs of the variants, given to them in turn."""
    repeated: int = 1
    """Number of runs of the variants of ANCHORS, where it is larger."""
    spread: float = 0.0
    """Standard deviation between runs, as a share of a score."""
    by_seed: float = 0.0
    """Share of this variance that is common to all runs of a seed."""
    unequal_robots: bool = False
    """Whether some robots are harder than others, for all variants alike."""

    def runs_of(self, variants: Sequence[str]) -> dict[str, int]:
        """Number of runs of each variant."""
        return {
            name: max(self.runs[i % len(self.runs)], self.repeated if name in ANCHORS else 1) for i, name in enumerate(variants)
        }


@dataclass(frozen=True)
class Rates:
    """How often claims were answered falsely."""

    null: Null
    studies: int
    false_holds: dict[str, float]
    """Share of studies in which a claim held falsely, by claim."""
    false_fails: dict[str, float]
    """Share of studies in which a claim failed falsely, by claim."""
    family_errors: float
    """Share of studies with any false answer among all claims as one family."""

    @property
    def holds(self) -> float:
        """Mean share of claims that held falsely."""
        return float(np.mean(list(self.false_holds.values())))

    @property
    def fails(self) -> float:
        """Mean share of claims that failed falsely."""
        return float(np.mean(list(self.false_fails.values())))


@dataclass(frozen=True)
class Args:
    """Print how often claims are answered falsely in studies whose variants are all equal."""

    studies: int = 100
    """Number of studies of each kind."""
    scenes: int = 18
    """Number of scenes of a study, over six tasks."""
    draws: int = 299
    """Number of bootstrap draws."""


class NullStudy(StudyGrades):
    """A study of equal variants with newly drawn scores for every study, without a table on disk.

    Args:
        null: what is drawn.
        scenes: number of scenes.
        draws: number of bootstrap draws.
    """

    def __init__(self, null: Null, scenes: int, draws: int) -> None:
        paper = read_paper()
        self._null, self._scales = null, _metric_scales(paper)
        infos = [info for info in paper.infos if info.name in METRICS]
        axes = {axis: np.array([getattr(paper.robots[robot], axis) for robot in ROBOT_NAMES]) for axis in AXES}
        super().__init__(_empty_table(null, scenes), infos, axes, draws=draws)
        columns = self._cells.columns
        variants, robots, metrics, trainings = (columns.get_level_values(level) for level in range(4))
        self._robot, self._metric = pd.Index(ROBOT_NAMES).get_indexer(robots), pd.Index(METRICS).get_indexer(metrics)
        self._training = pd.factorize(pd.MultiIndex.from_arrays([variants, trainings, metrics]))[0]
        self._seed = pd.factorize(pd.MultiIndex.from_arrays([trainings, metrics]))[0]
        self._sign = np.where([self.metrics[metric].higher_is_better for metric in metrics], -1.0, 1.0)
        self._drawn: list[Mean | None] = []
        self._pooled: dict[tuple[str, tuple[str, ...], str], Mean | None] = {}

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the scores of another study."""
        scenes, columns = self._cells.shape
        hard = rng.normal(0, HARDNESS, (scenes, 1))
        robots = rng.normal(0, ROBOTS_DIFFER * self._null.unequal_robots, (len(ROBOT_NAMES), len(METRICS)))
        own, common = rng.normal(0, self._null.spread, (2, columns))  # a run is good or bad on all robots
        share = self._null.by_seed
        runs = np.sqrt(1 - share) * own[self._training] + np.sqrt(share) * common[self._seed]
        loss = hard + rng.normal(0, NOISE, (scenes, columns)) + robots[self._robot, self._metric] + runs
        scores = self._scales[self._metric] * np.exp(self._sign * loss)
        self._drawn = list(bootstrap_means(scores, np.arange(len(scores)), self._strata, self._draws))
        self._pooled.clear()
        self._run_means.clear()

    def variant_mean(self, variant: str, robots: tuple[str, ...], metric: str, shared_part: str = "") -> Mean | None:
        """As of `StudyGrades`; no episode is missing, so a pool of robots is the mean of theirs."""
        key = (variant, robots, metric)
        if key not in self._pooled:
            means = [self._robot_mean(variant, robot, metric) for robot in robots]
            known = [mean for mean in means if mean]
            self._pooled[key] = _average(known) if len(known) == len(means) else None
        return self._pooled[key]

    def _robot_mean(self, variant: str, robot: str, metric: str) -> Mean | None:
        runs = self._drawn_runs(variant, robot, metric)
        return self._pool(variant, (robot,), metric, runs) if runs else None

    def _means_of_runs(self, variant: str, robots: tuple[str, ...], metric: str) -> Mapping[int, float]:
        return {seed: mean.value for seed, mean in self._drawn_runs(variant, robots[0], metric).items()}

    def _drawn_runs(self, variant: str, robot: str, metric: str) -> Mapping[int, Mean]:
        places = {run: self._columns.get((variant, robot, metric, run)) for run in self._trainings.get(variant, ())}
        return {run: mean for run, i in places.items() if i is not None and (mean := self._drawn[i])}


def _average(means: Sequence[Mean]) -> Mean:
    return means[0] if len(means) == 1 else combine(lambda *values: np.stack(values).sum(axis=0) / len(values), *means)


def _metric_scales(paper: Paper) -> np.ndarray:
    """[m] float64, a score of the paper for each metric, at which variants are equal."""
    return np.array([paper.score("actions", "optical_flow", "seen", metric) for metric in METRICS], np.float64)


def _empty_table(null: Null, scenes: int) -> pd.DataFrame:
    """The cells of a study of the paper's parts, without scores."""
    variants = {variant.name: variant for part in PAPER_PARTS for variant in PARTS[part]}
    scene = pd.DataFrame(
        {"task": [f"task{i % TASKS}" for i in range(scenes)], "seed": TEST_SEED_START + np.arange(scenes) // TASKS}
    )
    graded = [(name, robot) for name, variant in variants.items() for robot in variant.graded_robots]
    runs = [(name, run) for name, count in null.runs_of(list(variants)).items() for run in range(count)]
    cells = pd.DataFrame(graded, columns=["variant", "robot"]).merge(pd.DataFrame(runs, columns=["variant", "training"]))
    cells = cells.assign(model="reference", value=1.0).merge(pd.DataFrame({"metric": METRICS}), how="cross")
    return cells.merge(scene, how="cross")


def measure(null: Null, studies: int, scenes: int, draws: int, seed: int = 0) -> Rates:
    """Ask the paper's claims of studies in which there is nothing to find.

    Args:
        null: kind of study.
        studies: number of studies.
        scenes: number of scenes of each.
        draws: number of bootstrap draws.
        seed: of the scores.
    """
    claims = [claim for claim in CLAIMS if claim.where != "ours"]
    study, rng = NullStudy(null, scenes, draws), np.random.default_rng(seed)
    held, failed, wrong = dict.fromkeys(names(claims), 0), dict.fromkeys(names(claims), 0), 0
    asked: dict[str, None] = {}
    for _ in range(studies):
        study.draw(rng)
        errors = 0
        for finding in ask(study, claims):
            name, right = finding.claim.name, TRUE_OF_EQUALS.get(finding.claim.name, "")
            held[name] += finding.answer == HOLDS != right
            failed[name] += finding.answer == FAILS != right
            errors += finding.in_family in (HOLDS, FAILS) and finding.in_family != right
            asked |= {name: None} if finding.answer != UNMEASURED else {}
        wrong += errors > 0
    false_holds = {name: held[name] / studies for name in asked if TRUE_OF_EQUALS.get(name) != HOLDS}
    false_fails = {name: failed[name] / studies for name in asked if TRUE_OF_EQUALS.get(name) != FAILS}
    return Rates(null, studies, false_holds, false_fails, wrong / studies)


def names(claims: Sequence[Claim]) -> list[str]:
    """Names of claims."""
    return [claim.name for claim in claims]


def nulls() -> Iterator[Null]:
    """The kinds of studies of the suite."""
    yield Null("all runs equal")
    yield Null("robots of unequal difficulty", unequal_robots=True)
    for spread, by_seed in product(SPREADS, (0.0, 0.9)):
        differ = f"runs differ by {100 * spread:.0f} %{', mostly by their seed' if by_seed else ''}"
        yield Null(f"{differ}; one of each variant", spread=spread, by_seed=by_seed)
        yield Null(f"{differ}; three of three variants", repeated=3, spread=spread, by_seed=by_seed)
        yield Null(f"{differ}; one, two and three in turn", (1, 2, 3), spread=spread, by_seed=by_seed)
        yield Null(f"{differ}; three of each variant", (3,), spread=spread, by_seed=by_seed)


def format_rates(rates: Rates) -> str:
    """A row of the table: mean rates with the largest of any claim, and the rate of any false answer among all claims."""
    parts = [rates.null.title]
    for mean, by_claim in ((rates.holds, rates.false_holds), (rates.fails, rates.false_fails)):
        worst = max(by_claim, key=lambda name: by_claim[name])
        most = f"{100 * by_claim[worst]:.1f} %{f', {worst}' if by_claim[worst] else ''}"
        parts.append(f"{100 * mean:.1f} % ({most})")
    return f"| {' | '.join([*parts, f'{100 * rates.family_errors:.1f} %'])} |"


def main(args: Args) -> None:
    """Print the rates of all kinds of studies."""
    print(HEAD)
    for null in nulls():
        print(format_rates(measure(null, args.studies, args.scenes, args.draws)), flush=True)


if __name__ == "__main__":
    user_errors(lambda: main(tyro.cli(Args, prog="python -m lab.null")))()

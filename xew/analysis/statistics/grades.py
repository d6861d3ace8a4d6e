"""Means of scores for tables and findings, each with its bootstrap draws.

A mean has the same address in our study and in the paper: (part, row, robots, metric), such as ("actions", "optical_flow",
"franka_panda", "lpips"). Parts and rows are named as in `paper.py`; robots are one robot, or 'seen' for the pooled training
robots.

The means of `StudyGrades` vary over resamples of training runs and scenes, one resample for all cells, so differences and
ratios (`xew.statistics.combine`) are paired by scene and by training seed. A variant with one run carries the spread between
runs of the variants with several, the anchors. The means of `PaperGrades` vary over all values that print the same.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import ClassVar, Protocol, cast

import numpy as np
import pandas as pd

from xew.analysis.paper import Paper
from xew.analysis.scores import TRAINING, TRUTH, MetricInfo, name_graded
from xew.protocol import (
    BASELINES,
    CODEC_TRUTH,
    MULTI_VIEW,
    PARTS,
    ROBOT_NAMES,
    SHARED_MOTION,
    SPLITS,
    UNSEEN_BODIES,
    VARIANTS,
    Variant,
    reference,
    split_key,
)
from xew.statistics import (
    ASSUMED_SPREAD,
    DRAWS,
    LEVEL,
    Mean,
    RunSpread,
    Units,
    bootstrap_means,
    combine,
    describe_floors,
    describe_power,
    find_spread,
    fixed_mean,
    floor_sources,
    largest_floor,
    measure_power,
    noise_floor,
    pool_runs,
)
from xew.statistics.power import find_powerless

TOGETHER = {
    "few_shot": ("few_shot", "remedies"),
    "forgetting": ("forgetting", "remedies"),
    "baselines": ("baselines", "more_systems"),
}
"""Parts of the protocol that are ours and stand in a part of the paper's."""
SEEN = "seen"
REFERENCE = "reference"
"""The row of the few-shot part that stands for the model before adaptation, on the robots that it was trained on."""
BODIES = "bodies"
"""Name of the bodies that no model has seen, pooled."""


class Grades(Protocol):
    """All means of a study."""

    @property
    def level(self) -> float:
        """Share of the drawn values that an interval holds."""

    @property
    def metrics(self) -> Mapping[str, MetricInfo]:
        """By name."""

    @property
    def own_distances(self) -> bool:
        """Are the distances between robots this study's, or the paper's in their place?"""

    def mean(self, part: str, row: str, robots: str, metric: str, shared: bool = False) -> Mean | None:
        """The mean at an address, None where nothing is measured; `shared`: over the cells that all rows of the part have."""

    def against(self, part: str, row: str, baseline: str, robots: str, metric: str) -> tuple[Mean, Mean] | None:
        """The means of a row and of a baseline, over the cells that all rows of the part and the baseline have.

        None where one of both was not graded.
        """

    def floor(self, robots: str, metric: str, *rows: tuple[str, str]) -> float:
        """The largest noise floor of a metric on these robots for some rows (part, row); NaN if one is not known.

        It comes from the truth through the row's codec if that was graded, else from the true video.
        """

    def axis(self, name: str) -> np.ndarray:
        """Mean distance of each robot to the other four, in the order of ROBOT_NAMES: [5], or a row for each of
        `Mean.values`.
        """


def paired_means(grades: Grades, part: str, row: str, base: str, robots: str, metric: str) -> tuple[Mean, Mean] | None:
    """The means of two rows over the cells that all rows of the part have; None where one of both was not measured."""
    after, before = (grades.mean(part, key, robots, metric, shared=True) for key in (row, base))
    return (after, before) if after and before else None


def relative_gain(after: Mean, before: Mean, metric: MetricInfo) -> Mean:
    """Relative gain of a mean over another: 0.1 is 10 %; positive is better for every metric.

    Of scores that are never negative, all that there is can be lost (-1), or all of an error gained (1), and no more.
    """
    sign = 1 if metric.higher_is_better else -1
    gain = combine(lambda new, old: sign * (new - old) / np.abs(old), after, before)
    return gain.within((-1, np.inf) if sign > 0 else (-np.inf, 1)) if metric.range[0] >= 0 else gain


def relative_loss(after: Mean, before: Mean, metric: MetricInfo) -> Mean:
    """Relative loss of a mean against another; positive is worse for every metric."""
    gain = relative_gain(after, before, metric)
    low, high = gain.bounds
    return combine(np.negative, gain).within((-high, -low))


def mean_of_folds_that_saw(grades: Grades, robot: str, metric: str) -> Mean | None:
    """Mean on a robot over the leave-one-embodiment-out folds that trained on it; None where none was graded."""
    rows = [f"loeo_{other}" for other in ROBOT_NAMES if other != robot] if metric in grades.metrics else []
    means = [mean for row in rows if (mean := grades.mean("loeo", row, robot, metric, shared=True)) is not None]
    return combine(average, *means) if means else None


def unseen_gap(grades: Grades, robot: str, metric: str) -> Mean | None:
    """By how much the fold that never saw a robot is worse on it than the folds that did, of their mean; positive is worse.

    It is paired by episode, and the robot's own difficulty cancels. None where one of both was not graded.
    """
    saw = mean_of_folds_that_saw(grades, robot, metric)
    unseen = grades.mean("loeo", f"loeo_{robot}", robot, metric, shared=True) if saw is not None else None
    return None if saw is None or unseen is None else relative_loss(unseen, saw, grades.metrics[metric])


def average(*values: np.ndarray) -> np.ndarray:
    """Mean of arrays [...] of one shape."""
    return np.stack(values).sum(axis=0) / len(values)


def row_keys(part: str, variant: Variant) -> list[str]:
    """The rows of a part that a variant of it fills."""
    if variant.target is not None:
        remedy = "" if variant.remedy == "full" else f"-{variant.remedy}"
        return [f"{variant.target}-{variant.shots}{remedy}"]
    if part == "forgetting":
        return ["none"]
    if part == "few_shot" and (variant.action, variant.embodiment) == MULTI_VIEW:
        return [REFERENCE, *(f"{target}-0" for target in SPLITS[variant.split].held_out_robots)]
    if part == "baselines":
        return [variant.system]
    if part in ("ladder", "few_shot"):
        return [variant.embodiment]
    return [variant.action if part == "actions" else split_key(variant.split, SHARED_MOTION, variant.change)]


def variants_of(part: str) -> tuple[Variant, ...]:
    """All variants that may fill a row of a part."""
    return tuple(variant for name in TOGETHER.get(part, (part,)) for variant in PARTS[name])


def find_variant(part: str, row: str) -> Variant:
    """The variant that fills a row. Raises KeyError where the protocol knows none."""
    for variant in variants_of(part):
        if row in row_keys(part, variant):
            return variant
    raise KeyError(f"no variant of the protocol fills the row {row!r} of {part!r}")


def _find_anchors(trainings: Mapping[str, Sequence[int]]) -> list[str]:
    """Variants with several runs, whose spread those with one carry; adapted models only where there is no other."""
    several = [name for name, seeds in trainings.items() if len(seeds) > 1]
    first = [name for name in several if name not in VARIANTS or VARIANTS[name].target is None]
    return first or several


def pooled(variant: Variant, robots: str) -> tuple[str, ...]:
    """The robots behind a name: 'seen' are those that the variant's split trains on, 'bodies' those that no split does."""
    if robots == BODIES:
        return UNSEEN_BODIES
    return SPLITS[variant.split].train_robots if robots == SEEN else (robots,)


def _is_baseline(name: str) -> bool:
    return name.partition(" ")[0] in BASELINES


class StudyGrades:
    """Means of a score table with the column `variant`.

    Args:
        rows: variant, model, task, seed, robot, metric, value and optionally training; each cell once.
        metrics: descriptions of the metrics.
        axes, spreads: mean distances in the order of ROBOT_NAMES by axis, and their standard deviations.
        own_distances: whether the distances were measured.
        draws: number of bootstrap draws.
        codecs: conditions of the truth through the codec of each variant, for noise floors.
        assumed_spread: standard deviation between runs, as a share of a mean, where no variant has several; 0 for intervals of
            these runs alone.
    """

    level = LEVEL

    def __init__(
        self,
        rows: pd.DataFrame,
        metrics: Sequence[MetricInfo],
        axes: Mapping[str, np.ndarray],
        own_distances: bool = False,
        spreads: Mapping[str, np.ndarray] | None = None,
        draws: int = DRAWS,
        codecs: Mapping[str, Sequence[str]] | None = None,
        assumed_spread: float = ASSUMED_SPREAD,
    ) -> None:
        self.own_distances, self._assumed_spread = own_distances, assumed_spread
        self.metrics = {metric.name: metric for metric in metrics}
        self._axes, self._spreads, self._draws, self._codecs = axes, spreads or {}, draws, codecs or {}
        # Baselines belong to no variant; they are found by the model's name.
        named = rows.assign(variant=name_graded(rows))
        named = named if TRAINING in named else named.assign(**{TRAINING: 0})
        columns = ["variant", "robot", "metric", TRAINING]
        self._cells = named.pivot(index=["task", "seed"], columns=columns, values="value").sort_index()
        self.power = measure_power(rows, self.metrics)
        tasks, names_of = self._cells.index.get_level_values("task"), self._cells.columns.get_level_values("metric")
        for task, metric in find_powerless(self.power):
            self._cells = self._cells.mask(np.outer(tasks == task, names_of == metric))
        units = Units(self._cells.index.to_frame(index=False))
        self._numbers, self._strata = units.numbers(cast(pd.MultiIndex, self._cells.index)), units.strata
        self._columns: dict[tuple[str, str, str, int], int] = {}
        trainings: dict[str, set[int]] = {}
        names = self._cells.columns.to_frame(index=False).itertuples(index=False, name=None)
        for i, (variant, robot, metric, training) in enumerate(names):
            self._columns[str(variant), str(robot), str(metric), int(training)] = i
            trainings.setdefault(str(variant), set()).add(int(training))
        self._trainings = {variant: tuple(sorted(found)) for variant, found in trainings.items()}
        self.anchors = _find_anchors(self._trainings)
        """Names of the variants with several training runs that show the spread between runs."""
        self._cache: dict[tuple[str, tuple[str, ...], str, str], Mean | None] = {}
        self._run_means: dict[tuple[tuple[str, ...], str], Mapping[str, Mapping[int, float]]] = {}

    @property
    def scenes(self) -> int:
        """Number of scenes of all that is graded."""
        return len(self._strata)

    @property
    def variants(self) -> list[str]:
        """Names of the variants that were graded, without the baselines."""
        return [name for name in self._trainings if not _is_baseline(name)]

    @property
    def notes(self) -> str:
        """Sentences that say what the noise floors of the variants are of, and which tasks left which means."""
        titles = {name: info.title for name, info in self.metrics.items()}
        return " ".join(filter(None, (describe_floors(self.variants, self._codecs), describe_power(self.power, titles))))

    @property
    def codec_truths(self) -> list[str]:
        """Names of the truth through each codec that was graded, as `variant_mean` takes them."""
        return [name for name in self._trainings if name.startswith(f"{CODEC_TRUTH} ")]

    def trainings(self, variant: str) -> int:
        """Number of trainings of a variant that were graded."""
        return len(self._trainings.get(variant, ()))

    def mean(self, part: str, row: str, robots: str, metric: str, shared: bool = False) -> Mean | None:
        variant = find_variant(part, row)
        return self.variant_mean(variant.name, pooled(variant, robots), metric, part if shared else "")

    def has(self, variant: str) -> bool:
        return variant in self._trainings

    def count_episodes(self, variant: str, robots: Sequence[str]) -> int:
        """Number of episodes of some robots of which a variant, or a baseline, has any score."""
        held = [~np.isnan(self._scores(variant, tuple(robots), metric)).all(axis=0) for metric in self.metrics]
        return int(np.logical_or.reduce(held).sum())

    def variant_mean(self, variant: str, robots: tuple[str, ...], metric: str, shared_part: str = "") -> Mean | None:
        """Mean over all episodes of some robots, or over those that every measured variant of a part has.

        A variant with several training runs has their mean, over the episodes that all of them have.
        """
        key = (variant, robots, metric, shared_part)
        if key not in self._cache:
            # Tables show all metrics of a variant and robot, and one product of matrices is quicker than ten.
            metrics = [metric] if shared_part or metric not in self.metrics else list(self.metrics)
            scores = [self._scores(variant, robots, name) for name in metrics]
            if shared_part:
                scores = [
                    np.where(self._shared(shared_part, robots, name), x, np.nan)
                    for x, name in zip(scores, metrics, strict=True)
                ]
            for name, mean in zip(metrics, self._bootstrap(variant, robots, metrics, scores), strict=True):
                self._cache[variant, robots, name, shared_part] = mean
        return self._cache[key]

    def against(self, part: str, row: str, baseline: str, robots: str, metric: str) -> tuple[Mean, Mean] | None:
        variant = find_variant(part, row)
        if not (self.has(variant.name) and self.has(baseline)):
            return None
        names, pool = (variant.name, baseline), pooled(variant, robots)
        scores = [self._scores(name, pool, metric) for name in names]
        cells = self._shared(part, pool, metric) & ~np.isnan(scores[1]).all(axis=0)
        graded = zip(names, scores, strict=True)
        mean, other = (self._bootstrap(name, pool, [metric], [np.where(cells, own, np.nan)])[0] for name, own in graded)
        return None if mean is None or other is None else (mean, other)

    def floor(self, robots: str, metric: str, *rows: tuple[str, str]) -> float:
        info, names = self.metrics[metric], pooled(reference(), robots)
        truth = self.variant_mean(TRUTH, names, metric)
        floors = []
        for variant in [find_variant(*row).name for row in rows] or [""]:
            sources = [" ".join(filter(None, source)) for source in floor_sources(variant, self._codecs)]
            graded = [self.variant_mean(source, names, metric) for source in sources]
            known: list[Mean | None] = [mean for mean in graded if mean] or [truth]
            floors += [noise_floor(mean.value if mean else None, info.best, info.estimated) for mean in known]
        return largest_floor(floors)

    def axis(self, name: str) -> np.ndarray:
        """Mean distances to the other four robots, the paper's or the study's own (`own_distances`): [5] float64, or where they
        have a spread [1 + n 5], drawn from a normal distribution, in rows as those of `Mean.values`.
        """
        values, spread = self._axes[name], self._spreads.get(name, np.zeros(5))
        if not (spread > 0).any():
            return values
        drawn = np.repeat(values[None], 1 + self._draws, axis=0)
        rng = np.random.default_rng(list(name.encode()))
        drawn[1:] += spread * rng.standard_normal((self._draws, len(values)))
        return drawn

    def _bootstrap(
        self, variant: str, robots: tuple[str, ...], metrics: Sequence[str], scores: Sequence[np.ndarray]
    ) -> list[Mean | None]:
        """The mean of each of some metrics' scores [k s r] of all trainings, seeds and some robots; None without any score."""
        trainings, rows, count = scores[0].shape
        columns = np.stack([x.reshape(trainings, rows * count) for x in scores], axis=-1)  # [k s*r m]
        flat = columns.transpose(1, 2, 0).reshape(rows * count, -1)
        found = list(bootstrap_means(flat, np.repeat(self._numbers, count), self._strata, self._draws))
        seeds = self._trainings.get(variant, (0,))
        means: list[Mean | None] = []
        for i, metric in enumerate(metrics):
            own = zip(seeds, found[i * trainings : (i + 1) * trainings], strict=True)
            known = {seed: mean for seed, mean in own if mean is not None}
            means.append(self._pool(variant, robots, metric, known) if known else None)
        return means

    def _pool(self, variant: str, robots: tuple[str, ...], metric: str, means: Mapping[int, Mean]) -> Mean:
        """The mean of a variant over its runs, or of a baseline, from the mean of each by its training seed."""
        info = self.metrics.get(metric)
        mean = next(iter(means.values())) if _is_baseline(variant) else pool_runs(means, self._spread(variant, robots, metric))
        return mean.within(info.range) if info else mean

    def _spread(self, variant: str, robots: tuple[str, ...], metric: str) -> RunSpread:
        """What the mean of a single run carries: the spread of the anchors' runs on the same robots."""
        if (robots, metric) not in self._run_means:
            self._run_means[robots, metric] = {name: self._means_of_runs(name, robots, metric) for name in self.anchors}
        cell = f"{metric} of {' '.join(robots)}"
        return find_spread(variant, cell, self._run_means[robots, metric], self._assumed_spread)

    def _means_of_runs(self, variant: str, robots: tuple[str, ...], metric: str) -> Mapping[int, float]:
        """The mean of each run of a variant that has any score, by its training seed."""
        runs = zip(self._trainings[variant], self._scores(variant, robots, metric), strict=True)
        return {seed: float(np.nanmean(own)) for seed, own in runs if not np.isnan(own).all()}

    def _scores(self, variant: str, robots: tuple[str, ...], metric: str) -> np.ndarray:
        """Scores [k s r] of all trainings and seeds, NaN where there is none; also where another of the trainings has none."""
        empty, found = np.full(len(self._cells), np.nan), []
        for training in self._trainings.get(variant, (0,)):
            columns = [self._columns.get((variant, robot, metric, training)) for robot in robots]
            found.append(np.stack([empty if i is None else self._values[:, i] for i in columns], axis=1))
        scores = np.stack(found)
        if len(scores) == 1:
            return scores
        held = ~np.isnan(scores)
        graded = held.any(axis=(1, 2))
        return np.where(held[graded].all(axis=0), scores, np.nan)

    def _shared(self, part: str, robots: tuple[str, ...], metric: str) -> np.ndarray:
        """Which cells [s r] all variants of a part have that were asked for these robots and have any."""
        asked = [variant for variant in variants_of(part) if set(robots) <= set(variant.graded_robots)]
        held = [~np.isnan(self._scores(variant.name, robots, metric)).all(axis=0) for variant in asked]
        measured = [cells for cells in held if cells.any()]
        return np.logical_and.reduce(measured or [np.ones((len(self._cells), len(robots)), bool)])

    @cached_property
    def _values(self) -> np.ndarray:
        return self._cells.to_numpy(np.float64)


class PaperGrades:
    """The printed means. What prints the same is tried at the ends of its range, in DRAWS combinations drawn at random."""

    level = 1.0
    own_distances = True
    ALIASES: ClassVar = {
        ("fixed", "fixed"): ("actions", "optical_flow"),
        ("few_shot", "robot_render"): ("ladder", "robot_render"),
    }
    """Rows that it prints in another table."""

    def __init__(self, paper: Paper, metrics: Sequence[MetricInfo]) -> None:
        self.metrics = {metric.name: metric for metric in metrics}
        self._paper = paper
        self._rng = np.random.default_rng(0)
        self._cache: dict[tuple[str, str, str, str], Mean] = {}

    def mean(self, part: str, row: str, robots: str, metric: str, shared: bool = False) -> Mean | None:
        part, row = self.ALIASES.get((part, row), (part, row))
        key, printed = (part, row, robots, metric), self._paper.score(part, row, robots, metric)
        if printed is None:
            return None
        if key not in self._cache:
            ends = self._rng.choice([-1.0, 1.0], DRAWS) * self._paper.half_digit_of(part, metric)
            self._cache[key] = fixed_mean(np.concatenate([[printed], printed + ends]), 0, None)
        return self._cache[key]

    def against(self, part: str, row: str, baseline: str, robots: str, metric: str) -> tuple[Mean, Mean] | None:
        return None  # the paper prints no baseline

    def print(self, part: str, row: str, robots: str, metric: str) -> str:
        """A value with as many decimals as the paper prints; '' where it prints none."""
        part, row = self.ALIASES.get((part, row), (part, row))
        printed = self._paper.score(part, row, robots, metric)
        if printed is None:
            return ""
        return f"{printed:.{round(-np.log10(2 * self._paper.half_digit_of(part, metric)))}f}"

    def floor(self, robots: str, metric: str, *rows: tuple[str, str]) -> float:
        return 0.0  # the paper prints none

    def axis(self, name: str) -> np.ndarray:
        """Mean distances [1 + DRAWS 5] float64 to the other four robots: as printed, then at ends of what prints the same."""
        printed = np.array([getattr(self._paper.robots[robot], name) for robot in ROBOT_NAMES])
        # Each axis its own draws: two that moved together would leave out most of what prints the same.
        rng = np.random.default_rng(list(name.encode()))
        ends = rng.choice([-1.0, 1.0], (DRAWS, len(printed))) * self._paper.half_digit
        return np.concatenate([printed[None], printed + ends])

"""Training runs of a variant: which are drawn together, and the spread that a single run carries.

A training seed fixes initialization, order of samples and noise of every variant, so a seed is drawn for all variants at once,
and scenes besides (Owen 2007, "The pigeonhole bootstrap"). A variant with one run says nothing about its luck. It carries the
spread that variants with several runs show, in two parts: `common` is what a seed does to all variants, which cancels in a
difference within the seed, and `own` is what is left. Both are shares of a mean.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from xew.statistics.inference import SEED

ASSUMED_SPREAD = 0.05
"""Standard deviation between runs, as a share of a mean, where no variant has several.

In our six-task study it was 0.5 to 6.5 % in LPIPS, depending on the variant and robot.
"""


@dataclass(frozen=True)
class RunSpread:
    """The deviations of training runs that a mean of one run may have as well."""

    variant: str
    """Name of the variant, which has deviations of its own."""
    common: Mapping[str, float]
    """Deviations of seeds, as shares of the mean, scaled so their squares add up to the variance; by label."""
    own: Mapping[str, float]
    """The same of what is left in single runs."""
    common_freedom: float = np.inf
    own_freedom: float = np.inf

    def draw_common(self, seed: int, draws: int) -> np.ndarray:
        """[1 + draws] float64, what a training seed may have added for all variants, as a share: 0 and then random."""
        return _sum_normals(self.common, f"seed {seed}", draws)

    def draw_own(self, seed: int, draws: int) -> np.ndarray:
        """[1 + draws] float64, what the variant's run of this seed may have got besides."""
        return _sum_normals(self.own, f"{self.variant} {seed}", draws)


def find_spread(variant: str, cell: str, anchors: Mapping[str, Mapping[int, float]], assumed: float) -> RunSpread:
    """The spread of a mean between runs.

    Args:
        variant: name of the variant that carries it.
        cell: name of the robots and the metric, for an assumed spread.
        anchors: by variant with several runs, the mean of each run by its seed.
        assumed: standard deviation where there is no anchor, as a share.
    """
    known = {name: means for name, means in anchors.items() if len(means) > 1 and any(means.values())}
    if not known:
        return RunSpread(variant, {}, {cell: assumed})
    shared = sorted(set.intersection(*map(set, known.values())))
    if len(known) > 1 and len(shared) > 1:
        return _split_spread(variant, list(known), shared, np.array([[means[s] for s in shared] for means in known.values()]))
    freedom = sum(len(means) - 1 for means in known.values())
    deviations = {
        f"{name} {seed}": float(mean / np.mean(list(means.values())) - 1)
        for name, means in known.items()
        for seed, mean in means.items()
    }
    return RunSpread(variant, {}, _scale(deviations, freedom), own_freedom=freedom)


def _split_spread(variant: str, names: list[str], seeds: list[int], means: np.ndarray) -> RunSpread:
    """The two parts of the spread of means [a s] of anchors that share seeds: a two-way layout."""
    deviations = means / means.mean(axis=1, keepdims=True) - 1
    of_seed = deviations.mean(axis=0)
    own = {f"{name} {seed}": deviations[i, j] - of_seed[j] for i, name in enumerate(names) for j, seed in enumerate(seeds)}
    between = len(seeds) - 1
    left = (len(names) - 1) * between
    return RunSpread(
        variant, _scale(dict(zip(map(str, seeds), of_seed, strict=True)), between), _scale(own, left), between, left
    )


def _scale(deviations: Mapping[str, float], freedom: int) -> dict[str, float]:
    return {label: float(deviation / np.sqrt(freedom)) for label, deviation in deviations.items()}


def _sum_normals(deviations: Mapping[str, float], key: str, draws: int) -> np.ndarray:
    total = np.zeros(1 + draws)
    for label, deviation in deviations.items():
        total += deviation * draw_normals(f"{key} {label}", draws)
    return total


@lru_cache(maxsize=1024)
def draw_normals(key: str, draws: int) -> np.ndarray:
    """[1 + draws] float64: 0 and then standard normal draws, the same for the same key."""
    normals = np.concatenate([[0.0], np.random.default_rng([SEED, *key.encode()]).standard_normal(draws)])
    normals.setflags(write=False)
    return normals


@lru_cache(maxsize=64)
def draw_seeds(seeds: tuple[int, ...], draws: int) -> np.ndarray:
    """[1 + draws k] float64, the weight of each of k training seeds in every draw: 1 each in the first row; k in total.

    Weights are normal, because draws with replacement of two or three runs have too few values for the tails of an interval
    (the multiplier bootstrap). A seed is drawn for all variants at once.
    """
    count = len(seeds)
    drawn = np.stack([draw_normals(f"run {seed}", draws) for seed in seeds], axis=1)
    weights = 1 + np.sqrt(count / (count - 1)) * (drawn - drawn.mean(axis=1, keepdims=True))
    weights.setflags(write=False)
    return weights

"""Training runs that are drawn, and those that carry the spread of others: how often intervals hold, and what cancels."""

import numpy as np
import pytest

from xew.statistics import Mean, bootstrap_means, combine, fixed_mean, pool_runs
from xew.statistics.runs import draw_seeds, find_spread


def draw_variant(rng: np.random.Generator, name: str, runs: int, between: float, common: np.ndarray) -> Mean:
    """A variant around 1 on twenty scenes, whose runs differ by chance and with their seed."""
    values = 1 + common[:runs] + rng.normal(0, between, runs) + rng.normal(0, 0.05, (20, runs))
    means = [mean for mean in bootstrap_means(values, np.arange(20), (0,) * 20, 499) if mean]
    return pool_runs(dict(enumerate(means)), find_spread(name, "", {}, 0.0))


def draw_differences(runs: tuple[int, int], anchors: int, between: float, common: float) -> list[Mean]:
    """Differences of two variants that do not differ, by studies with so many anchors of three runs."""
    rng, found = np.random.default_rng(10), []
    for _ in range(200):
        luck = rng.normal(0, common, 5)
        shown = {f"anchor {i}": draw_variant(rng, "", 3, between, luck) for i in range(anchors)}
        known = {name: {seed: float(run[0]) for seed, run in mean.parts[0].runs.items()} for name, mean in shown.items()}
        pair = [draw_variant(rng, name, count, between, luck) for name, count in zip("ab", runs, strict=True)]
        carrying = [
            pool_runs({s: fixed_mean(v, 20, 20, 19) for s, v in mean.parts[0].runs.items()}, find_spread(name, "", known, 0.0))
            for name, mean in zip("ab", pair, strict=True)
        ]
        found.append(combine(np.subtract, *carrying))
    return found


def resolved(means: list[Mean]) -> float:
    """Share of the means whose interval leaves out 0."""
    ends = np.array([mean.interval() for mean in means])
    return float(((ends[:, 0] > 0) | (ends[:, 1] < 0)).mean())


@pytest.mark.parametrize("common", [0.0, 0.2])
@pytest.mark.parametrize("between", [0.01, 0.2])
@pytest.mark.parametrize("runs", [(3, 3), (5, 5), (1, 1), (1, 3)])
def test_intervals_hold_the_true_difference_as_often_as_they_say(runs: tuple[int, int], between: float, common: float) -> None:
    """With several runs of both, or one of either that carries the spread of three anchors."""
    found = draw_differences(runs, 3, between, common)
    assert resolved(found) <= 0.08 and {mean.trainings for mean in found} == {min(runs)}


def test_one_run_without_any_spread_does_not_say_what_another_would_give() -> None:
    assert resolved(draw_differences((1, 1), 0, 0.2, 0.0)) > 0.5


def test_seeds_are_drawn_for_all_variants_at_once() -> None:
    weights = draw_seeds((0, 1, 4), 999)
    assert (weights[0] == 1).all() and weights[1:].sum(axis=1) == pytest.approx(3)
    runs = {0: 1.0, 1: 3.0, 4: 2.0}
    means = [pool_runs({s: fixed_mean(np.full(1000, v + shift), 9, 9) for s, v in runs.items()}) for shift in (0, 7)]
    difference = combine(np.subtract, *means)
    assert difference.interval() == pytest.approx((-7, -7)) and np.ptp(means[0].interval()) > 1


def test_variants_without_a_common_seed_are_compared_by_all_their_runs() -> None:
    means = [pool_runs({seed: fixed_mean(np.full(1000, 1.0 + seed), 9, 9) for seed in seeds}) for seeds in ((0, 1), (2, 4))]
    difference = combine(np.subtract, *means)
    assert difference.value == -2.5 and difference.seeds == ((0, 1), (2, 4)) and np.ptp(difference.interval()) > 1


def test_the_spread_of_anchors_has_two_parts() -> None:
    """Three anchors of four seeds: half of the variance is the seed's, and one anchor has a seed more."""
    rng = np.random.default_rng(3)
    own, common = [], []
    for _ in range(300):
        means = 10 * (1 + rng.normal(0, 0.02, 4) + rng.normal(0, 0.02, (3, 4)))
        anchors = {name: dict(enumerate(row)) for name, row in zip("abc", means, strict=True)}
        anchors["a"][9] = 11.0
        spread = find_spread("v", "cell", anchors, 0.5)
        assert (spread.common_freedom, spread.own_freedom) == (3, 6)
        own.append(sum(np.square(list(spread.own.values()))))
        common.append(sum(np.square(list(spread.common.values()))))
    assert np.mean(own) == pytest.approx(0.02**2, rel=0.1)
    assert np.mean(common) == pytest.approx(0.02**2 * (1 + 1 / 3), rel=0.1)  # the seeds' own mean has some luck of the runs


def test_a_spread_without_anchors_is_assumed() -> None:
    for anchors in ({}, {"a": {0: 1.0}}, {"a": {0: 0.0, 1: 0.0}}):
        assert find_spread("v", "cell", anchors, 0.05).own == {"cell": 0.05}
    alone = find_spread("v", "cell", {"a": {0: 9.0, 1: 11.0}}, 0.05)
    assert not alone.common and np.square(list(alone.own.values())).sum() == pytest.approx(2 * 0.1**2)

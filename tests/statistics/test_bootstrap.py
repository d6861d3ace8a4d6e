"""Draws of scenes: against what is known, and to the last bit where that is promised."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from xew.protocol import join_fault
from xew.statistics import DRAWS, MIN_SCENES, fixed_mean
from xew.statistics.bootstrap import Units, bootstrap_means, draw_units, find_strata
from xew.statistics.correlation import every_draw


def one_task(count: int) -> tuple[int, ...]:
    """Strata of units that are all of one task."""
    return (0,) * count


def ends(values: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """[2 c] of the columns' intervals."""
    means = bootstrap_means(values, numbers, one_task(int(numbers.max()) + 1))
    return np.array([mean.interval() if mean else (np.nan, np.nan) for mean in means]).T


def test_intervals_are_those_of_scipy_at_the_level_of_a_student_up_to_chance() -> None:
    """SciPy's draws are narrower by a share of n - 1 of n scenes, and it knows no degrees of freedom."""
    values = np.random.default_rng(0).gamma(2, size=(40, 3))
    low, high = ends(values, np.arange(40))
    level = 1 - 2 * stats.norm.sf(stats.t.isf(0.025, 39) * np.sqrt(40 / 39))
    for column in range(3):
        expected = stats.bootstrap(
            (values[:, column],), np.mean, n_resamples=20000, method="percentile", confidence_level=level,
            rng=np.random.default_rng(1),
        ).confidence_interval  # fmt: skip
        width = expected.high - expected.low
        assert low[column] == pytest.approx(expected.low, abs=0.03 * width)
        assert high[column] == pytest.approx(expected.high, abs=0.03 * width)


def test_rows_of_a_unit_are_drawn_together() -> None:
    """Ten copies of each value say no more than one: the interval stays as wide, and is ten times too narrow without units."""
    values = np.random.default_rng(0).normal(size=(12, 1))
    once = ends(values, np.arange(12))
    copies = np.repeat(values, 10, axis=0)
    assert ends(copies, np.repeat(np.arange(12), 10)) == pytest.approx(once, abs=1e-12)
    alone = ends(copies, np.arange(120))
    assert np.ptp(alone) < 0.5 * np.ptp(once)


def test_all_commands_in_a_scene_are_drawn_with_it() -> None:
    seeds = [join_fault(fault, base) for base in (4, 7) for fault in (0, 1, 2)]
    rows = pd.DataFrame({"task": "a", "seed": seeds})
    units = Units(rows)
    assert len(units) == 2 and units.numbers(pd.MultiIndex.from_frame(rows)).tolist() == [0, 0, 0, 1, 1, 1]


def test_missing_values_are_left_out_and_few_units_have_no_interval() -> None:
    values = np.full((8, 4), np.nan)
    values[:, 0] = np.arange(8)
    values[1:7, 1] = np.arange(6)
    values[:5, 2] = 1.0
    all_eight, six, five, none = bootstrap_means(values, np.arange(8), one_task(8))
    assert none is None and all_eight and six and five
    assert (all_eight.count, all_eight.scenes, all_eight.value) == (8, 8, 3.5) and six.value == 2.5
    assert MIN_SCENES == 6 and np.isnan(five.interval()).all() and five.value == 1.0
    assert all(low < mean.value < high for mean in (all_eight, six) for low, high in [mean.interval()])


def test_equal_values_have_exactly_their_value_as_interval() -> None:
    [mean] = bootstrap_means(np.full((7, 1), 0.1), np.arange(7), one_task(7))
    assert mean and (mean.value, *mean.interval()) == (0.1, 0.1, 0.1)


def test_a_column_does_not_depend_on_those_beside_it_or_on_the_order_of_rows() -> None:
    """To the last bit: what is summed is exact, so that no library of matrices can round it otherwise."""
    rng = np.random.default_rng(4)
    values = rng.normal(1e3, 1, (90, 300)) * 10.0 ** rng.integers(-6, 6, 300)
    values[rng.random(values.shape) < 0.1] = np.nan
    numbers, order = np.arange(90) // 3, rng.permutation(90)
    strata = find_strata(list("aaaaaaabbbbcccccccddddddeffggg"))  # a task of one scene joins one of two
    together = list(bootstrap_means(values, numbers, strata))
    for i in (0, 1, 127, 128, 299):
        [alone] = bootstrap_means(values[order][:, [i]], numbers[order], strata)
        beside = together[i]
        assert alone and beside and alone.values.tobytes() == beside.values.tobytes()
        assert alone.value == pytest.approx(np.nanmean(values[:, i]), rel=1e-13)


def test_differences_of_means_are_means_of_differences() -> None:
    """All columns see the same draws, so that whatever is computed of several means is paired."""
    a, b = np.random.default_rng(5).normal(size=(2, 20, 1))
    first, second, difference = (next(bootstrap_means(v, np.arange(20), one_task(20))) for v in (a, b, a - b))
    assert first and second and difference
    np.testing.assert_allclose(first.values - second.values, difference.values, atol=1e-12)


def test_units_are_those_of_the_whole_table() -> None:
    rows = pd.DataFrame({"task": ["b", "a", "a", "b"], "seed": [0, 1, 0, 0]})
    index = pd.MultiIndex.from_tuples([("b", 0, "piper"), ("a", 1, "piper")], names=["task", "seed", "robot"])
    scenes, tasks = Units(rows), Units(rows, "task")
    assert (len(scenes), len(tasks)) == (3, 2) and (scenes.strata, tasks.strata) == ((0, 0, 0), (0, 0))
    assert scenes.numbers(index).tolist() == [2, 1] and tasks.numbers(index).tolist() == [1, 0]


def test_draws_are_the_same_at_every_call() -> None:
    [(members, scale, weights)] = draw_units(one_task(9))
    assert weights.shape == (1 + DRAWS, 9) and (weights[0] == 1).all() and (weights[1:].sum(axis=1) == 8).all()
    assert members.tolist() == list(range(9)) and scale[0] == 1 and scale[1] == 9 / 8
    draw_units.cache_clear()
    assert (draw_units(one_task(9))[0][2] == weights).all()


def test_scenes_are_drawn_within_their_tasks() -> None:
    """Where tasks differ and the scenes of each do not, other scenes of these tasks would give the same."""
    tasks = np.repeat([1.0, 2.0, 5.0], 4)
    [mean] = bootstrap_means(tasks[:, None], np.arange(12), find_strata(list("aaaabbbbcccc")))
    assert mean and mean.interval() == pytest.approx((mean.value, mean.value)) and mean.freedom == 9
    [pooled] = bootstrap_means(tasks[:, None], np.arange(12), one_task(12))
    assert pooled and np.ptp(pooled.interval()) > 1 and pooled.freedom == 11


def test_the_variance_of_the_draws_has_no_bias_with_two_scenes_of_a_task() -> None:
    rng = np.random.default_rng(8)
    values, strata = rng.normal(size=(24, 300)), tuple(np.repeat(np.arange(8), [2, 2, 2, 2, 4, 4, 4, 4]).tolist())
    means = [mean for mean in bootstrap_means(values, np.arange(24), strata, draws=999) if mean]
    assert np.mean([mean.values[1:].var() for mean in means]) == pytest.approx(1 / 24, rel=0.03)
    assert {mean.freedom for mean in means} == {16}


def test_tasks_of_one_scene_form_a_stratum_together() -> None:
    assert find_strata(["b", "a", "a", "c"]) == (0, 1, 1, 0)
    assert find_strata(["a", "a", "b", "b", "b", "c"]) == (0, 0, 1, 1, 1, 0)
    assert find_strata(["a"]) == (0,) and find_strata(["a", "b", "c"]) == (0, 0, 0)


@pytest.mark.parametrize("count", [6, 12])
def test_intervals_of_few_scenes_hold_the_true_mean_as_often_as_they_say(count: int) -> None:
    """Those of plain percentiles would leave it out in 15 % of six scenes and 11 % of twelve."""
    values = np.random.default_rng(9).normal(size=(count, 1500))
    low, high = np.array(
        [mean.interval() for mean in bootstrap_means(values, np.arange(count), one_task(count), 999) if mean]
    ).T
    assert ((low > 0) | (high < 0)).mean() == pytest.approx(0.05, abs=0.02)


def test_every_draw_is_counted_once() -> None:
    assert every_draw(2, least=1).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
    assert len(every_draw(3, least=2)) == 24 and len(every_draw(3, least=3)) == 6


def test_printed_means_have_all_that_was_drawn_and_few_scenes_nothing() -> None:
    values = np.array([99.0, *range(101), np.nan])
    assert fixed_mean(values, 0, None).interval(1.0) == (0, 100) and np.isnan(fixed_mean(values, 5, 5).interval()).all()
    printed, few = fixed_mean(values, 0, None), fixed_mean(values, 5, 5)
    assert (printed.p_above(-1, 1.0), printed.p_above(0, 1.0), printed.p_below(101, 1.0)) == (0, 1, 0)
    assert few.p_above(-1e9) == few.p_below(1e9) == 1

"""Intervals and p-values of draws whose answer is known, and Holm's correction against its definition."""

import numpy as np
import pytest
from scipy import stats

from xew.statistics import Component, Drawn, holm

DRAWN = np.concatenate([[2.0], stats.norm.ppf((np.arange(9999) + 0.5) / 9999) * 0.5 + 2.0])
"""Draws of a normal distribution round 2 with standard deviation 0.5, without any chance."""


@pytest.mark.parametrize("freedom", [2.0, 5.0, 30.0, np.inf])
@pytest.mark.parametrize("bound", [0.4, 0.9, 1.5, 2.0, 2.7, 4.0])
def test_a_p_value_is_that_of_a_student(bound: float, freedom: float) -> None:
    expected = stats.t.sf((2.0 - bound) / 0.5, freedom) if np.isfinite(freedom) else stats.norm.sf((2.0 - bound) / 0.5)
    drawn = Drawn(DRAWN, freedom)
    assert drawn.p_above(bound) == pytest.approx(expected, rel=0.01)
    assert Drawn(4.0 - DRAWN, freedom).p_below(4.0 - bound) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("freedom", [2.0, 5.0, 30.0, np.inf])
@pytest.mark.parametrize("level", [0.8, 0.95, 0.999])
def test_a_bound_at_the_end_of_an_interval_has_its_p(level: float, freedom: float) -> None:
    skew = np.random.default_rng(0).gamma(2, size=10000)
    drawn = Drawn(skew, freedom)
    low, high = drawn.interval(level)
    assert [drawn.p_above(low), drawn.p_below(high)] == pytest.approx([(1 - level) / 2] * 2, rel=0.02)


def test_what_does_not_vary_is_certain_but_at_its_bound() -> None:
    same = Drawn(np.full(100, 3.0))
    assert same.p_above(2.9) == 0 and same.p_above(3.0) == 1 and same.p_above(3.1) == 1
    assert same.p_below(3.1) == 0 and same.p_below(3.0) == 1 and same.interval() == (3.0, 3.0)


def test_an_interval_leaves_out_the_point_and_what_does_not_exist() -> None:
    values = np.array([99.0, *range(101), np.nan])
    assert Drawn(values).interval(0.9) == pytest.approx((5, 95)) and Drawn(values).interval(1.0) == (0, 100)
    assert np.isnan(Drawn(np.full(3, np.nan)).interval()).all() and Drawn(np.full(3, np.nan)).p_above(0) == 1


def test_runs_that_differ_have_the_freedom_of_their_number() -> None:
    """All variance is between three runs, or next to none."""
    drawn = np.concatenate([[0.0], np.random.default_rng(1).normal(0, 1 / np.sqrt(3), 9999)])
    high = Drawn(drawn, 1e6, [Component(1 / 3, 2)]).interval()[1]
    assert high == pytest.approx(stats.t.isf(0.025, 2) / np.sqrt(3), rel=0.05)
    calm = Drawn(drawn, 1e6, [Component(1e-4 / 3, 2)]).interval()
    assert calm[1] == pytest.approx(stats.norm.isf(0.025) / np.sqrt(3), rel=0.05)


def test_holm_is_the_sequentially_rejective_procedure() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.9]).tolist() == [1.0, 1.0] and holm([]).tolist() == []
    rng = np.random.default_rng(2)
    for given in rng.random((50, 6)) ** 3:
        rejected, adjusted = np.zeros(6, bool), holm(given)
        for i, place in enumerate(np.argsort(given)):  # Holm's own words: stop at the first that is too large
            if given[place] > 0.05 / (6 - i):
                break
            rejected[place] = True
        assert ((adjusted <= 0.05) == rejected).all()


def test_holm_makes_a_family_of_nulls_err_no_more_often_than_one() -> None:
    nulls = np.random.default_rng(3).random((4000, 12))
    assert np.mean([(holm(given) <= 0.05).any() for given in nulls]) == pytest.approx(0.05, abs=0.012)
    assert (nulls.min(axis=1) <= 0.05).mean() > 0.4

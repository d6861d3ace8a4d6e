"""The published correlations come out of the published inputs, as far as their rounding allows."""

import numpy as np
import pytest
from scipy import stats

from xew.analysis.correlation import dof_correlation, loeo_correlation

# Aloha, ARX, Franka, Piper, UR5; from the study's tables.
APPEARANCE = [0.175, 0.063, 0.107, 0.052, 0.058]
KINEMATIC = [0.144, 0.095, 0.082, 0.074, 0.070]
SCORES = {
    "psnr": ([18.791, 21.306, 19.429, 25.910, 22.143], True),
    "lpips": ([0.181, 0.107, 0.166, 0.087, 0.145], False),
    "mask_iou": ([0.854, 0.778, 0.659, 0.785, 0.824], True),
    "keypoint_error": ([7.424, 9.851, 21.914, 12.999, 15.718], False),
}
PUBLISHED = {
    ("psnr", "appearance"): (0.769, 0.780, 0.918),
    ("psnr", "kinematic"): (0.633, 0.443, 0.809),
    ("lpips", "appearance"): (0.812, 0.760, 0.923),
    ("lpips", "kinematic"): (0.549, -0.155, 0.706),
    ("mask_iou", "appearance"): (-0.176, -0.813, 0.952),
    ("mask_iou", "kinematic"): (-0.448, -0.691, 0.295),
    ("keypoint_error", "appearance"): (-0.286, -0.775, 0.823),
    ("keypoint_error", "kinematic"): (-0.671, -0.913, -0.358),
}
HALF_DIGIT = 0.0005


@pytest.mark.parametrize(("metric", "axis"), PUBLISHED)
def test_published_values_lie_within_the_rounding_of_the_published_inputs(metric: str, axis: str) -> None:
    rng = np.random.default_rng(0)
    distance = np.array(APPEARANCE if axis == "appearance" else KINEMATIC)
    score, higher = SCORES[metric]
    drawn = []
    for _ in range(400):
        # Corners of the rounding cube reach further than points inside it.
        signs = rng.choice([-1.0, 1.0], (2, 5)) * HALF_DIGIT
        result = loeo_correlation(distance + signs[0], np.array(score) + signs[1], higher_is_better=higher)
        drawn.append((result.r, result.low, result.high))
    low, high = np.min(drawn, axis=0), np.max(drawn, axis=0)
    for value, least, most in zip(PUBLISHED[metric, axis], low, high, strict=True):
        assert least - HALF_DIGIT <= value <= most + HALF_DIGIT


def test_published_p_values_are_exact() -> None:
    lpips = SCORES["lpips"][0]
    assert loeo_correlation(APPEARANCE, lpips).p_value == pytest.approx(0.075, abs=5e-4)
    assert loeo_correlation(KINEMATIC, lpips).p_value == pytest.approx(0.392, abs=5e-4)


def test_it_agrees_with_scipy() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(2, 5))
    result = loeo_correlation(x, y)
    assert result.r == pytest.approx(stats.pearsonr(x, y).statistic)
    exact = stats.permutation_test(
        (y,), lambda order: abs(stats.pearsonr(x, order).statistic), permutation_type="pairings", n_resamples=np.inf,
        alternative="greater",
    )  # fmt: skip
    assert result.p_value == pytest.approx(exact.pvalue)


def test_a_straight_line_and_its_turned_sign() -> None:
    line = loeo_correlation([1, 2, 3, 4, 5], [2, 4, 6, 8, 10])
    assert (line.r, line.low, line.high) == pytest.approx((1, 1, 1)) and line.p_value == pytest.approx(2 / 120)
    assert line.stable
    turned = loeo_correlation([1, 2, 3, 4, 5], [2, 4, 6, 8, 10], higher_is_better=True)
    assert turned.r == pytest.approx(-1)
    assert not loeo_correlation(KINEMATIC, SCORES["lpips"][0]).stable


@pytest.mark.parametrize("score", [[1, 2, 3, 4], [1, 2, 3, 4, np.nan], [1, 1, 1, 1, 1], [1, 1, 1, 1, 2]])
def test_what_has_no_correlation_is_an_error(score: list[float]) -> None:
    with pytest.raises(ValueError, match="score is"):
        loeo_correlation(APPEARANCE, score)


def test_spearman_asks_for_order_only() -> None:
    curved = loeo_correlation([1, 2, 3, 4, 5], [1, 10, 100, 1000, 10000])
    assert curved.spearman == pytest.approx(1) and curved.r < 0.9
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=5), np.array([1.0, 1.0, 2.0, 3.0, 0.0])  # a tie
    assert loeo_correlation(x, y).spearman == pytest.approx(stats.spearmanr(x, y).statistic)
    assert loeo_correlation(x, y, higher_is_better=True).spearman == pytest.approx(-stats.spearmanr(x, y).statistic)


def test_the_bootstrap_is_that_of_drawn_resamples() -> None:
    """All resamples at once give what many drawn ones tend to."""
    rng = np.random.default_rng(3)
    x, y = np.array(KINEMATIC), np.array(SCORES["lpips"][0])
    drawn = [d for d in rng.integers(0, 5, (20000, 5)) if len(set(d)) > 2]
    expected = np.quantile([np.corrcoef(x[d], y[d])[0, 1] for d in drawn], [0.025, 0.975])
    result = loeo_correlation(x, y)
    assert (result.bootstrap_low, result.bootstrap_high) == pytest.approx(expected, abs=0.03)
    assert result.bootstrap_low < result.r < result.bootstrap_high


def test_joints_are_a_diagnostic_though_one_robot_alone_differs() -> None:
    dof, (score, _) = [6, 6, 7, 6, 6], SCORES["lpips"]
    assert dof_correlation(dof, score) == pytest.approx(stats.pearsonr(dof, score).statistic)
    assert dof_correlation(dof, score, higher_is_better=True) == -dof_correlation(dof, score)
    with pytest.raises(ValueError, match="dof is"):
        dof_correlation([6] * 5, score)
    with pytest.raises(ValueError, match="score is"):
        dof_correlation(dof, [1.0] * 5)

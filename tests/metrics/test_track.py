"""Point metrics against plain loops over points, frames and warping paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from xew.metrics import (
    coverage,
    keypoint_error,
    keypoint_error_strict,
    ndtw,
    ndtw_strict,
    pck,
    pck_05,
    pck_strict,
    trajectory_error,
    trajectory_error_strict,
)
from xew.metrics.track import FAILURE, PATHS_AT_ONCE, SIDE, TAPVID_SIDE, TOLERANCES, failure_distance, strict_warpings

rng = np.random.default_rng(2)


def tracks(t: int = 9, k: int = 4, spread: float = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    target = rng.uniform(0, 60, (t, k, 2)).astype(np.float32)
    prediction = (target + rng.normal(0, spread, target.shape)).astype(np.float32)
    return prediction, target, rng.random((t, k)) < 0.7


def brute_diagonal(target: np.ndarray, valid: np.ndarray) -> np.ndarray:
    boxes = [points[keep] for points, keep in zip(target, valid, strict=True)]
    return np.array([np.linalg.norm(np.ptp(box, axis=0)) if len(box) else 0.0 for box in boxes])


def brute_dtw(a: np.ndarray, b: np.ndarray, most: float) -> float:
    table = np.full((len(a) + 1, len(b) + 1), np.inf)
    table[0, 0] = 0
    for i in range(len(a)):
        for j in range(len(b)):
            step = min(table[i, j], table[i, j + 1], table[i + 1, j])
            table[i + 1, j + 1] = np.fmin(np.linalg.norm(a[i] - b[j]), most) + step
    return table[-1, -1]


def brute_ndtw(prediction: np.ndarray, target: np.ndarray, valid: np.ndarray) -> float:
    diagonal = brute_diagonal(target, valid)
    scale = diagonal[diagonal > 0].mean() if (diagonal > 0).any() else np.nan
    paths = [(prediction[keep, i], target[keep, i]) for i, keep in enumerate(valid.T) if keep.any()]
    return float(np.mean([brute_dtw(*path, scale) / (2 * len(path[0]) * scale) for path in paths]))


@pytest.mark.parametrize("t", [1, 2, 9, 30])
def test_ndtw_equals_the_whole_table(t: int) -> None:
    prediction, target, valid = tracks(t)
    valid[0, :2] = True
    assert ndtw(prediction, target, valid) == pytest.approx(brute_ndtw(prediction, target, valid), rel=1e-5)


def test_a_points_warping_is_bounded_by_the_video_not_by_a_frame_whose_origins_coincide() -> None:
    """A box of 1e-5 pixels in the only frames of a point made scores of thousands."""
    _, target, valid = tracks(t=20, k=2)
    target[:, 1] = target[:, 0] + np.float32(1e-5)
    valid[:] = True
    far = target + np.float32([4e3, 0])
    lost = np.full_like(target, np.nan)
    for wrong in (far, lost):
        assert float(ndtw(wrong, target, valid)) == pytest.approx(0.5)
        assert float(ndtw(wrong, target, valid, np.full(20, 80, np.float32))) == pytest.approx(0.5)
    assert float(ndtw(target, target, valid, np.full(20, 80, np.float32))) == 0
    assert np.isnan(ndtw(target, target, valid, np.zeros(20, np.float32)))


def test_a_given_diagonal_is_the_scale_of_pck() -> None:
    _, target, valid = tracks()
    off, diagonal = target + np.float32([3, 0]), np.linspace(20, 40, len(target)).astype(np.float32)
    expected = np.repeat((0.1 * diagonal > 3)[:, None], valid.shape[1], axis=1)[valid].mean()
    assert float(pck(off, target, valid, diagonal=diagonal)) == pytest.approx(expected)
    assert float(pck_05(off, target, valid, diagonal)) == 0


def test_one_wild_point_has_no_more_than_the_images_diagonal() -> None:
    _, target, valid = tracks(k=1)
    valid[:] = True
    wild = target.copy()
    wild[0] += 1e5
    for metric in (keypoint_error, trajectory_error):
        assert float(metric(wild, target, valid)) == pytest.approx(400 / len(target), rel=1e-5)
        assert float(metric(wild, target, valid, largest=80)) == pytest.approx(80 / len(target), rel=1e-5)


@pytest.mark.lab
def test_ndtw_equals_the_exact_reference_of_fastdtw() -> None:
    import fastdtw

    prediction, target, valid = tracks(40, 3)
    valid[:] = True
    scale = brute_diagonal(target, valid).mean()
    assert np.linalg.norm(prediction - target, axis=-1).max() < scale, "no step is capped"
    costs = [fastdtw.dtw(prediction[:, i], target[:, i], dist=2)[0] for i in range(3)]
    assert ndtw(prediction, target, valid) == pytest.approx(np.mean(costs) / (80 * scale), rel=1e-5)


@pytest.mark.parametrize("alpha", [0.05, 0.1, 0.3])
def test_pck_equals_counting(alpha: float) -> None:
    prediction, target, valid = tracks(spread=3)
    near = np.linalg.norm(prediction - target, axis=-1) < alpha * brute_diagonal(target, valid)[:, None]
    counts = valid & (brute_diagonal(target, valid) > 0)[:, None]
    assert pck(prediction, target, valid, alpha=alpha) == pytest.approx(near[counts].mean(), abs=1e-6)


def test_the_second_tolerance_and_coverage_equal_counting() -> None:
    prediction, target, valid = tracks(spread=2)
    assert pck_05(prediction, target, valid) == pck(prediction, target, valid, alpha=0.05)
    prediction[rng.random(valid.shape) < 0.3] = np.nan
    found = np.isfinite(prediction).all(-1)
    assert coverage(prediction, target, valid) == pytest.approx(found[valid].mean(), abs=1e-6)
    assert np.isnan(coverage(prediction, target, np.zeros_like(valid)))


def test_the_order_of_points_does_not_matter() -> None:
    prediction, target, valid = tracks(k=6)
    order = rng.permutation(6)
    for metric in (pck, pck_05, coverage, keypoint_error, ndtw, trajectory_error):
        shuffled = metric(prediction[:, order], target[:, order], valid[:, order])
        assert shuffled == pytest.approx(float(metric(prediction, target, valid)), rel=1e-6)


def test_a_path_has_the_same_warping_whatever_paths_are_warped_with_it() -> None:
    prediction, target, valid = tracks(t=30, k=2 * PATHS_AT_ONCE + 7)
    together, counts = strict_warpings(prediction, target, valid)
    assert counts.all() and np.unique(together).size == len(together)
    for part in (np.s_[:PATHS_AT_ONCE], np.s_[PATHS_AT_ONCE - 5 : PATHS_AT_ONCE + 6], np.s_[-7:]):
        alone, _ = strict_warpings(prediction[:, part], target[:, part], valid[:, part])
        np.testing.assert_array_equal(alone, together[part])


def test_errors_equal_their_definitions() -> None:
    prediction, target, valid = tracks()
    distance = np.linalg.norm(prediction - target, axis=-1)
    assert keypoint_error(prediction, target, valid) == pytest.approx(distance[valid].mean(), rel=1e-5)
    per_object = [distance[valid[:, i], i].mean() for i in range(valid.shape[1])]
    assert trajectory_error(prediction, target, valid) == pytest.approx(np.mean(per_object), rel=1e-5)


def test_objects_never_seen_do_not_count_and_others_count_alike() -> None:
    prediction, target, valid = tracks(t=10, k=3)
    valid[:] = True
    valid[:, 0], valid[2:, 1] = False, False
    distance = np.linalg.norm(prediction - target, axis=-1)
    expected = (distance[:2, 1].mean() + distance[:, 2].mean()) / 2
    assert trajectory_error(prediction, target, valid) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("metric", "best"), [(pck, 1), (keypoint_error, 0), (ndtw, 0), (trajectory_error, 0)])
def test_identity_is_best_and_nothing_is_nan(metric: object, best: float) -> None:
    _, target, valid = tracks()
    assert metric(target, target, valid) == best
    assert np.isnan(metric(target, target, np.zeros_like(valid)))


def test_a_lost_point_is_a_miss_and_leaves_the_errors_alone() -> None:
    _, target, valid = tracks()
    valid[:] = True
    lost = target.copy()
    lost[3, 1] = np.nan
    assert pck(lost, target, valid) == pytest.approx(1 - 1 / valid.size)
    assert keypoint_error(lost, target, valid) == trajectory_error(lost, target, valid) == 0
    assert float(ndtw(lost, target, valid)) == pytest.approx(brute_ndtw(lost, target, valid)), "one step at the most"


def test_invalid_points_may_hold_anything() -> None:
    prediction, target, valid = tracks()
    wild = np.where(valid[..., None], prediction, np.float32(1e6))
    for metric in (pck, keypoint_error, ndtw, trajectory_error):
        assert metric(prediction, target, valid) == metric(wild, target, valid)


def test_a_point_exactly_at_the_threshold_is_a_miss() -> None:
    target = np.array([[[0, 0], [30, 40]]], np.float32)
    off = target + np.array([5, 0], np.float32)
    valid = np.ones((1, 2), bool)
    assert pck(off, target, valid, alpha=0.1) == 0
    assert pck(off, target, valid, alpha=0.11) == 1


def test_ndtw_forgives_a_late_start_that_the_error_does_not() -> None:
    path = np.stack([np.linspace(0, 50, 30), np.linspace(0, 10, 30)], -1).astype(np.float32)
    target = np.stack([path, path[:, ::-1]], 1)
    late = np.concatenate([target[:1], target[:1], target[:1], target[:-3]])
    valid = np.ones(target.shape[:2], bool)
    scale = float(np.mean(brute_diagonal(target, valid)))
    assert ndtw(late, target, valid) < 0.3 * keypoint_error(late, target, valid) / scale


@pytest.mark.parametrize("metric", [keypoint_error, ndtw, trajectory_error])
def test_gradients_are_finite_even_at_the_truth(metric: object) -> None:
    prediction, target, valid = tracks()
    for start in (prediction, target):
        assert np.isfinite(jax.grad(metric)(jnp.asarray(start), target, valid)).all()


def test_shapes_and_types_are_checked() -> None:
    prediction, target, valid = tracks()
    with pytest.raises(ValueError, match="one shape"):
        pck(prediction[1:], target, valid)
    with pytest.raises(ValueError, match="valid is"):
        ndtw(prediction, target, valid[1:])
    with pytest.raises(TypeError, match="bool"):
        keypoint_error(prediction, target, valid.astype(np.float32))


STRICT = (pck_strict, keypoint_error_strict, trajectory_error_strict, ndtw_strict)
LOST = 50 / 256 * np.sqrt(320 * 240)
"""Error of a lost point in an image of 320x240 [pixels]."""


def losing(share: float, spread: float = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    prediction, target, valid = tracks(t=12, k=5, spread=spread)
    valid[0] = True
    prediction[rng.random(valid.shape) < share] = np.nan
    return prediction, target, valid


def strict_distance(prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[t k] with plain NumPy: the distance, at most LOST, and LOST where there is none."""
    return np.fmin(np.linalg.norm(prediction - target, axis=-1), LOST)


@pytest.mark.parametrize("spread", [3, 60])
def test_strict_errors_equal_their_definitions(spread: float) -> None:
    prediction, target, valid = losing(0.3, spread)
    distance = strict_distance(prediction, target)
    expected = distance[valid].mean()
    assert keypoint_error_strict(prediction, target, valid) == pytest.approx(expected, rel=1e-5)
    assert trajectory_error_strict(prediction, target, valid) == pytest.approx(expected, rel=1e-5)
    found = np.isfinite(prediction).all(axis=-1)
    near = [np.mean((distance < d / 256 * np.sqrt(320 * 240)) & found, where=valid) for d in (1, 2, 4, 8, 16)]
    assert pck_strict(prediction, target, valid) == pytest.approx(np.mean(near), abs=1e-6)


def test_strict_position_accuracy_is_tap_vids() -> None:
    """In an image of 256x256 tolerances are 1, 2, 4, 8 and 16 pixels, and one exactly at a tolerance is not within it."""
    target = np.zeros((1, 6, 2), np.float32)
    away = np.float32([0.5, 1, 3, 7.9, 15, 17])
    prediction = np.stack([away, np.zeros(6, np.float32)], axis=-1)[None]
    expected = np.mean([1, 4 / 5, 3 / 5, 2 / 5, 1 / 5, 0])
    assert pck_strict(prediction, target, np.ones((1, 6), bool), TAPVID_SIDE) == pytest.approx(expected, abs=1e-6)
    assert failure_distance() == pytest.approx(LOST) and pytest.approx(np.sqrt(320 * 240)) == SIDE
    assert (TOLERANCES, FAILURE) == ((1, 2, 4, 8, 16), 50)


@pytest.mark.parametrize("share", [0, 0.3])
def test_strict_warping_equals_the_whole_table(share: float) -> None:
    prediction, target, valid = losing(share, spread=30)
    values = []
    for i in range(target.shape[1]):
        places, seen = prediction[valid[:, i], i], target[valid[:, i], i]
        cost = np.fmin(np.linalg.norm(places[:, None] - seen[None], axis=-1), LOST)
        table = np.full((len(seen) + 1,) * 2, np.inf)
        table[0, 0] = 0
        for a, b in np.ndindex(cost.shape):
            table[a + 1, b + 1] = cost[a, b] + min(table[a, b], table[a, b + 1], table[a + 1, b])
        values.append(table[-1, -1] / (2 * len(seen) * LOST))
    assert ndtw_strict(prediction, target, valid) == pytest.approx(np.mean(values), rel=1e-5)


def test_no_prediction_has_no_strict_score_and_losing_all_is_worst() -> None:
    _, target, valid = losing(0)
    lost = np.full_like(target, np.nan)
    scores = [float(metric(lost, target, valid)) for metric in STRICT]
    assert scores == [0, pytest.approx(LOST), pytest.approx(LOST), pytest.approx(0.5)]
    far = target + np.float32([4e4, 0])
    assert [float(metric(far, target, valid)) for metric in STRICT] == scores
    assert all(np.isnan(metric(target, target, np.zeros_like(valid))) for metric in STRICT), "a truth with nothing to grade"


def test_losing_a_point_never_pays() -> None:
    """Whatever the error of a point that was found, a prediction that loses it is no better."""
    prediction, target, valid = losing(0, spread=40)
    for t, i in np.argwhere(valid)[::7]:
        worse = prediction.copy()
        worse[t, i] = np.nan
        for metric, sign in zip(STRICT, (1, -1, -1, -1), strict=True):
            assert sign * metric(worse, target, valid) <= sign * metric(prediction, target, valid) + 1e-6

"""Totals: those of a video's parts, merged in any order, have the mean that the metric gives for the whole video."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from xew.metrics import METRICS, ndtw
from xew.metrics.grade import JUDGED
from xew.metrics.metric import Total, total_of
from xew.metrics.perceptual import union_box

rng = np.random.default_rng(5)
FRAMES = 4
MERGED = ["ssim", "lpips", "region_lpips", "robot_lpips", "boundary_f1", "pck", "keypoint_error_strict"]


def masks() -> np.ndarray:
    mask = np.zeros((FRAMES, 32, 40), bool)
    for t, row in enumerate(rng.integers(0, 6, FRAMES)):
        mask[t, row : row + 20, t : t + 15] = True
    mask[0, 0, 0] = mask[1, 31, 38] = True
    return mask


def inputs(kind: str) -> tuple[np.ndarray, ...]:
    """All frames, the first of them exact."""
    if kind == "mask":
        return masks(), masks()
    if kind in JUDGED:
        return rng.random(FRAMES, np.float32), rng.random(FRAMES, np.float32)
    if kind == "track":
        target = rng.uniform(0, 60, (FRAMES, 3, 2)).astype(np.float32)
        prediction = (target + rng.normal(0, 4, target.shape)).astype(np.float32)
        prediction[2, 1] = np.nan
        return prediction, target, rng.random((FRAMES, 3)) < 0.8
    prediction, target = rng.integers(0, 256, (2, FRAMES, 32, 40, 3), dtype=np.uint8)
    prediction[:1] = target[:1]
    target[:, 0] = target[:1, 0]  # stands still
    return (prediction, target) if kind == "video" else (prediction, target, masks())


@pytest.mark.parametrize("name", MERGED)
def test_parts_in_any_order_have_the_mean_of_the_whole(name: str) -> None:
    arrays = inputs(METRICS[name].inputs)
    options = {"box": union_box(arrays[2])} if name == "region_lpips" else {}
    whole = float(jnp.mean(METRICS[name].function(*arrays)))
    for cuts in ([0, FRAMES], [0, 2, FRAMES], range(FRAMES + 1)):
        parts = [METRICS[name].total(*(array[a:b] for array in arrays), **options) for a, b in itertools.pairwise(cuts)]
        for order in (parts, parts[::-1]):
            assert float(functools.reduce(Total.__add__, order).mean) == pytest.approx(whole, rel=2e-6)


@pytest.mark.parametrize("name", [name for name in METRICS if name != "trajectory_error"])
def test_the_total_of_a_video_has_the_metric_as_its_mean(name: str) -> None:
    arrays = inputs(METRICS[name].inputs)
    assert float(METRICS[name].total(*arrays).mean) == pytest.approx(float(jnp.mean(METRICS[name].function(*arrays))), rel=2e-6)


def test_a_mean_of_means_has_no_total() -> None:
    with pytest.raises(ValueError, match="Object error is a mean of means"):
        METRICS["trajectory_error"].total(*inputs("track"))


def test_what_does_not_count_is_in_no_total() -> None:
    scores = jnp.float32([1, jnp.nan, 3])
    total = total_of(scores, jnp.isfinite(scores))
    assert int(total.count) == 2 and float(total.mean) == 2
    assert np.isnan(total_of(scores).mean) and np.isnan(total_of(scores[:0]).mean)


def test_a_scan_carries_a_total() -> None:
    prediction, target = inputs("mask")

    @jax.jit
    def run(p: jax.Array, t: jax.Array) -> Total:
        step = lambda total, pair: (total + METRICS["mask_iou"].total(*pair), None)  # noqa: E731
        parts = tuple(array.reshape(2, 2, *array.shape[1:]) for array in (p, t))
        return jax.lax.scan(step, total_of(jnp.zeros(0)), parts)[0]

    assert float(run(prediction, target).mean) == pytest.approx(
        float(METRICS["mask_iou"].total(prediction, target).mean), rel=1e-6
    )


def test_paths_of_several_videos_are_averaged_over_keypoints() -> None:
    a, b = inputs("track"), inputs("track")
    total = METRICS["ndtw"].total(*a) + METRICS["ndtw"].total(*b)
    assert int(total.count) == 6
    assert float(total.mean) == pytest.approx((float(ndtw(*a)) + float(ndtw(*b))) / 2, rel=1e-6)

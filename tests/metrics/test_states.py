"""States: any split, order and number of hosts gives the same bits, and the metric's own number."""

import functools
import itertools
import math
from collections.abc import Sequence
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from xew.metrics import METRICS, ndtw, trajectory_error
from xew.metrics.perceptual import union_box
from xew.metrics.states import LIMBS, MEAN, STATES, mean_of, merge_means

rng = np.random.default_rng(5)
FRAMES = 4


def video() -> np.ndarray:
    return rng.integers(0, 256, (FRAMES, 32, 40, 3), dtype=np.uint8)


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
    if kind == "track":
        target = rng.uniform(0, 60, (FRAMES, 3, 2)).astype(np.float32)
        prediction = (target + rng.normal(0, 4, target.shape)).astype(np.float32)
        prediction[2, 1] = np.nan
        return prediction, target, rng.random((FRAMES, 3)) < 0.8
    prediction, target = video(), video()
    prediction[:1] = target[:1]
    return (prediction, target, masks()) if kind in ("region", "robot") else (prediction, target)


def options(name: str, arrays: Sequence[np.ndarray]) -> dict:
    return {"box": union_box(arrays[2])} if name == "region_lpips" else {}


def empty(name: str) -> object:
    return STATES[name].init(3) if name == "trajectory_error" else STATES[name].init()


def of_part(name: str, arrays: Sequence[np.ndarray], part: slice, **more: object) -> object:
    return STATES[name].update(empty(name), *(array[part] for array in arrays), **more)


def bits(tree: object) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


@pytest.mark.parametrize(
    "name", ["psnr", "ssim", "lpips", "region_lpips", "robot_lpips", "boundary_f1", "pck", "trajectory_error"]
)
def test_no_split_and_no_order_changes_a_bit(name: str) -> None:
    arrays = inputs(METRICS[name].inputs)
    more = options(name, arrays)
    whole = of_part(name, arrays, slice(0, FRAMES), **more)
    for cuts in ([0, 2, FRAMES], range(FRAMES + 1)):
        parts = [of_part(name, arrays, slice(a, b), **more) for a, b in itertools.pairwise(cuts)]
        for order in (range(len(parts)), rng.permutation(len(parts))):
            merged = functools.reduce(STATES[name].merge, [parts[i] for i in order])
            assert bits(merged) == bits(whole)
            assert bits(STATES[name].compute(merged)) == bits(STATES[name].compute(whole))
    assert bits(STATES[name].merge(empty(name), whole)) == bits(whole)


@pytest.mark.parametrize("name", sorted(METRICS))
def test_the_state_of_a_video_is_worth_what_the_function_says(name: str) -> None:
    arrays = inputs(METRICS[name].inputs)
    found = STATES[name].compute(of_part(name, arrays, slice(0, FRAMES), **options(name, arrays)))
    assert float(found) == pytest.approx(float(jnp.mean(METRICS[name].function(*arrays))), rel=2e-6)


def test_exact_frames_wait_for_the_cap_of_the_whole_video() -> None:
    prediction, target = inputs("video")
    first, rest = (of_part("psnr", (prediction, target), part) for part in (slice(0, 1), slice(1, FRAMES)))
    most = 10 * math.log10(255**2 * target[0].size)
    assert float(STATES["psnr"].compute(first)) == pytest.approx(most, rel=1e-6)
    assert int(first.exact) == 1 and int(rest.exact) == 0
    merged = STATES["psnr"].merge(first, rest)
    assert float(STATES["psnr"].compute(merged)) == pytest.approx(
        (float(STATES["psnr"].compute(rest)) * 3 + float(rest.largest)) / 4, rel=1e-6
    )


def exactly(values: np.ndarray) -> Fraction:
    return sum((Fraction(float(value)) for value in values), Fraction(0))


WILD = {
    "of all sizes": (rng.normal(0, 1, 3000) * 10.0 ** rng.uniform(-38, 30, 3000)).astype(np.float32),
    "that cancel": np.float32([3e37, 1e-20, -3e37, 1.5]),
    "subnormal": np.float32([1e-45, 3e-42, -1e-44]),
    "more than a block": rng.uniform(-1, 1, 9000).astype(np.float32),
    "negative": np.full(5, np.float32(-0.1)),
    "one": np.float32([0.3]),
}


@pytest.mark.parametrize("name", WILD)
def test_sums_are_exact(name: str) -> None:
    values = WILD[name]
    state = mean_of(values)
    limbs = [int(limb) for limb in state.total]
    assert sum(Fraction(limb) * Fraction(2) ** (16 * i - 149) for i, limb in enumerate(limbs)) == exactly(values)
    assert len(limbs) == LIMBS and all(0 <= limb < 2**16 for limb in limbs[:-1])
    if name != "subnormal":  # which the device may flush to zero when it is asked for a float
        assert float(state.value) == pytest.approx(float(exactly(values) / len(values)), rel=5e-7)


def test_what_is_not_finite_is_not_counted() -> None:
    state = MEAN.update(MEAN.init(), np.float32([1, np.nan, 3, np.inf]))
    assert int(state.count) == 2 and float(MEAN.compute(state)) == 2
    assert np.isnan(MEAN.compute(MEAN.init()))


def test_float32_addition_would_not_have_been_associative() -> None:
    """What the exact sum is for: the same three numbers, two orders."""
    a, b, c = np.float32([1e8, -1e8, 0.3])
    assert (a + b) + c != a + (b + c)
    orders = [[mean_of(value[None]) for value in order] for order in ((a, b, c), (c, b, a))]
    first, second = (functools.reduce(merge_means, states) for states in orders)
    assert bits(first) == bits(second) and float(first.value) == pytest.approx(0.1, rel=1e-6)


def test_a_scan_carries_a_state() -> None:
    prediction, target = inputs("mask")
    mergeable = STATES["mask_iou"]

    @jax.jit
    def run(p: jax.Array, t: jax.Array) -> jax.Array:
        step = lambda state, pair: (mergeable.update(state, *pair), None)  # noqa: E731
        parts = tuple(array.reshape(2, 2, *array.shape[1:]) for array in (p, t))
        return jax.lax.scan(step, mergeable.init(), parts)[0]

    assert bits(run(prediction, target)) == bits(of_part("mask_iou", (prediction, target), slice(0, FRAMES)))


def test_objects_count_alike_however_often_they_are_seen() -> None:
    prediction, target, valid = inputs("track")
    valid[:] = True
    valid[2:, 0] = False
    parts = [of_part("trajectory_error", (prediction, target, valid), slice(a, a + 2)) for a in range(0, FRAMES, 2)]
    found = STATES["trajectory_error"].compute(functools.reduce(merge_means, parts))
    assert float(found) == pytest.approx(float(trajectory_error(prediction, target, valid)), rel=1e-6)


def test_paths_of_several_videos_are_averaged_over_keypoints() -> None:
    a, b = inputs("track"), inputs("track")
    state = STATES["ndtw"].update(STATES["ndtw"].update(STATES["ndtw"].init(), *a), *b)
    assert int(state.count) == 6
    assert float(STATES["ndtw"].compute(state)) == pytest.approx((float(ndtw(*a)) + float(ndtw(*b))) / 2, rel=1e-6)

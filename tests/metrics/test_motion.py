"""Flicker, ghosts, last frames, onsets and apertures: the values that their definitions give, and what they do not see."""

import numpy as np
import pytest

from xew.metrics import (
    final_object_error,
    flicker,
    flicker_robot,
    found_error,
    ghosts,
    gripper_error,
    keypoint_error_strict,
    onset_shift,
)
from xew.metrics.motion import LATEST, flicker_frames
from xew.metrics.track import failure_distance

rng = np.random.default_rng(8)
T, H, W = 6, 40, 56
STILL = np.repeat(rng.integers(40, 200, (1, H, W, 3), dtype=np.uint8), T, axis=0)
ODD = (np.arange(T) % 2 == 1)[:, None, None, None]
EVERYWHERE = np.ones((T, H, W), bool)


def test_flicker_is_the_change_of_the_error_and_no_constant_error() -> None:
    flickering = STILL + np.uint8(12) * ODD.astype(np.uint8)
    for metric in (flicker, lambda p, t: flicker_robot(p, t, EVERYWHERE)):
        assert float(metric(flickering, STILL)) == 12
        assert float(metric(STILL + np.uint8(12), STILL)) == 0
    assert np.isnan(flicker_frames(flickering, STILL)[0]) and flicker_frames(flickering, STILL)[1:].tolist() == [12] * (T - 1)
    assert float(flicker(flickering / np.float32(255), STILL / np.float32(255))) == pytest.approx(12, rel=1e-4)


def test_flicker_counts_where_the_target_stands_still_and_on_the_robot_apart() -> None:
    target, prediction = STILL.copy(), STILL.copy()
    target[::2, :, :20] //= 2  # moves
    prediction[::2, :, :20] = 0
    robot = EVERYWHERE & (np.arange(W) < 20)
    assert float(flicker(prediction, target)) == 0 < float(flicker_robot(prediction, target, robot))
    assert np.isnan(flicker_robot(prediction, target, ~EVERYWHERE))
    assert np.isnan(flicker(255 - STILL * ODD, STILL * ODD.astype(np.uint8))), "no pixel stands still"


def test_a_ghost_is_what_the_still_scene_does_not_show() -> None:
    target = np.full((T, H, W, 3), 150, np.uint8)
    mask = np.zeros((T, H, W), bool)
    mask[:, :, :10] = True
    haunted = target.copy()
    haunted[:, 10:20, 30:50] = 110
    share = 10 * 20 / (H * W)
    np.testing.assert_allclose(ghosts(haunted, target, mask), share, rtol=1e-6)
    np.testing.assert_allclose(ghosts(haunted + np.uint8(12), target, mask), share, rtol=1e-6, err_msg="brighter")
    grainy = np.clip(target + rng.normal(0, 6, target.shape), 0, 255).astype(np.uint8)
    on_body = np.where(mask[..., None], np.uint8(0), target)
    for harmless in (target, target + np.uint8(20), grainy, on_body):
        assert ghosts(harmless, target, mask).max() == 0
    still_shown = np.where(mask[..., None], np.uint8(40), target)
    assert ghosts(still_shown, target, np.zeros_like(mask)).min() == pytest.approx(10 / W), "a robot that is no longer there"


def tracks(t: int = 40, k: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Points [t k 2] that stand still for twelve frames and then go to the right, and [t k] bool, all valid."""
    start = rng.uniform(20, 60, (k, 2)).astype(np.float32)
    steps = np.maximum(np.arange(t) - 11, 0)[:, None, None] * np.float32([5, 0])
    return start + steps, np.ones((t, k), bool)


def test_only_the_last_tenth_counts_for_the_final_error() -> None:
    target, valid = tracks()
    early, late = target.copy(), target.copy()
    early[:36] += 30
    late[36:] += np.float32([3, 4])
    lost = late.copy()
    lost[36:, :3] = np.nan
    assert float(final_object_error(early, target, valid)) == 0
    assert float(final_object_error(late, target, valid)) == pytest.approx(5)
    assert float(final_object_error(lost, target, valid)) == pytest.approx((5 + failure_distance()) / 2)
    filled = [np.concatenate([array, np.zeros_like(array[:24])]) for array in (late, target, valid)]
    assert float(final_object_error(*filled, frames=40)) == pytest.approx(5), "filled up behind its frames"


@pytest.mark.parametrize("shift", [-8, -3, 0, 4, 8])
def test_an_onset_is_shifted_by_as_many_frames_as_the_motion(shift: int) -> None:
    target, valid = tracks()
    shifted = target[np.clip(np.arange(40) - shift, 0, 39)]
    assert float(onset_shift(shifted, target, valid)) == abs(shift)


def test_an_onset_is_of_each_object_and_needs_a_motion_that_lasts() -> None:
    target, valid = tracks()
    body = np.array([4, 4, 4, 7, 7, 7])
    late = target.copy()
    late[:, 3:] = target[np.maximum(np.arange(40) - 6, 0), 3:]
    assert float(onset_shift(late, target, valid, body=body)) == 3, "mean of 0 and 6"
    one_wrong = target.copy()
    one_wrong[3:, 0] += 40
    jumps = target.copy()
    jumps[4:9] += 30
    blank, third_lost = target.copy(), target.copy()
    blank[::5] = np.nan
    third_lost[:, ::3] = np.nan
    for harmless in (one_wrong, jumps, blank, third_lost):
        assert float(onset_shift(harmless, target, valid, body=body)) == 0
    for never in (np.repeat(target[:1], 40, axis=0), np.full_like(target, np.nan)):
        assert float(onset_shift(never, target, valid, body=body)) == LATEST
    assert np.isnan(onset_shift(target, np.repeat(target[:1], 40, axis=0), valid)), "nothing moves"


def test_a_grippers_error_is_of_the_distance_between_its_fingers() -> None:
    target = np.float32([[[10, 20], [11, 22], [30, 20], [31, 22], [70, 50], [80, 50], [5, 5]]])
    finger, valid = np.array([0, 0, 1, 1, 2, 3, -1]), np.ones((1, 7), bool)
    wider = target.copy()
    wider[:, 2:4] += np.float32([6, 0])
    assert float(gripper_error(wider, target, valid, finger=finger)) == pytest.approx(3), "6 px of one hand, 0 of the other"
    assert float(gripper_error(target + 9, target, valid, finger=finger)) == pytest.approx(0, abs=1e-5), (
        "as a whole it may be off"
    )
    lost = target.copy()
    lost[:, 4] = np.nan
    most = 16 / 256 * np.sqrt(320 * 240)
    assert float(gripper_error(lost, target, valid, finger=finger)) == pytest.approx(most / 2)
    hidden = valid.copy()
    hidden[:, 4] = False
    assert float(gripper_error(lost, target, hidden, finger=finger)) == pytest.approx(0, abs=1e-5)
    assert np.isnan(gripper_error(target, target, valid, finger=np.full(7, -1)))


def test_where_and_whether_are_two_numbers() -> None:
    target, valid = tracks()
    half = target + np.float32([3, 4])
    half[:, :3] = np.nan
    assert float(found_error(half, target, valid)) == pytest.approx(5)
    assert float(keypoint_error_strict(half, target, valid)) == pytest.approx((5 + failure_distance()) / 2)
    assert float(found_error(target + 1e4, target, valid)) == pytest.approx(float(failure_distance()))
    assert np.isnan(found_error(np.full_like(target, np.nan), target, valid))

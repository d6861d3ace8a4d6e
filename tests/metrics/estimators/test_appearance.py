"""Appearance: what is evened out, what is mapped, and what has no appearance because it is not there."""

import numpy as np
import pytest

from lab.calibration.predictors import add_grain, expose, flicker, soften
from xew.metrics.estimators.appearance import REST, TrueAppearance, _describe

T, H, W = 14, 120, 160
rng = np.random.default_rng(3)


def spots(height: int, width: int, low: tuple[int, ...], high: tuple[int, ...]) -> np.ndarray:
    """[h w 3] uint8, soft spots between two colors."""
    share = np.kron(rng.random((height // 5 + 1, width // 5 + 1)), np.ones((5, 5)))[:height, :width, None]
    return soften((np.array(low) + share * (np.array(high) - low)).astype(np.uint8)[None], 1.5)[0]


SCENE, ROBOT, THING = (
    spots(H, W, (90,) * 3, (190,) * 3),
    spots(40, 30, (20, 20, 60), (70, 60, 150)),
    spots(20, 24, (150, 20, 20), (240, 90, 60)),
)
BODIES = {0: ROBOT, 3: THING}


def draw() -> tuple[np.ndarray, np.ndarray]:
    """A robot that goes to the right and a thing that stands: video [t h w 3] and labels [t h w]."""
    video, labels = np.repeat(SCENE[None], T, axis=0), np.full((T, H, W), REST, np.int16)
    for t in range(T):
        for body, (x, y) in ((0, (20 + 2 * t, 20)), (3, (100, 80))):
            where = np.s_[t, y : y + len(BODIES[body]), x : x + BODIES[body].shape[1]]
            video[where], labels[where] = BODIES[body], body
    return video, labels


TRUTH, LABELS = draw()


def given(video: np.ndarray) -> np.ndarray:
    """A prediction, whose frame 0 is the true one."""
    return np.concatenate([TRUTH[:1], video[1:]])


@pytest.mark.parametrize(
    "wrong",
    [expose(TRUTH, offset=12), expose(TRUTH, 0.8), expose(TRUTH, 1.2, -25.6), expose(TRUTH, (1, 0.9, 0.8)), flicker(TRUTH)],
    ids=["brighter", "darker", "contrast", "tinted", "flicker"],
)
def test_exposure_is_evened_out_frame_by_frame(wrong: np.ndarray) -> None:
    seen, reference = TrueAppearance(TRUTH, LABELS).match(given(wrong))
    assert reference is TRUTH
    assert np.abs(seen.astype(int) - TRUTH).mean() < 1.5 < np.abs(given(wrong).astype(int) - TRUTH).mean()


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize(
    "change",
    [lambda v: v[..., ::-1], lambda v: 255 - v, lambda v: expose(v, (0.4, 0.5, 0.9), 30)],
    ids=["swapped", "inverse", "bluish"],
)
def test_a_body_of_another_color_lends_it_to_the_truth(body: int, change: object) -> None:
    own = body == LABELS
    wrong = given(np.where(own[..., None], change(TRUTH), TRUTH))
    seen, reference = TrueAppearance(TRUTH, LABELS).match(wrong)
    assert seen is wrong
    assert np.abs(reference[1:].astype(int) - wrong[1:])[own[1:]].mean() < 4
    np.testing.assert_array_equal(reference[~own], TRUTH[~own])


@pytest.mark.parametrize(
    "video",
    [
        TRUTH,
        add_grain(TRUTH),
        np.repeat(TRUTH[:1], T, axis=0),
        np.full_like(TRUTH, 128),
        np.zeros_like(TRUTH),
        rng.integers(0, 256, TRUTH.shape, dtype=np.uint8),
        TRUTH[:, :, ::-1],
        np.repeat(SCENE[None], T, axis=0),
        np.where((LABELS == 3)[..., None], SCENE, TRUTH),
    ],
    ids=["truth", "grainy", "frozen", "gray", "black", "noise", "mirrored", "empty", "erased"],
)
def test_other_faults_are_no_appearance(video: np.ndarray) -> None:
    """Above all, what is not there has no color that the truth could take."""
    wrong = np.ascontiguousarray(video)
    seen, reference = TrueAppearance(TRUTH, LABELS).match(wrong)
    assert seen is wrong and reference is TRUTH


def test_a_body_that_the_truth_shows_later_has_the_colors_of_its_first_frames() -> None:
    hidden = LABELS.copy()
    hidden[:5][hidden[:5] == 3] = REST
    truth = np.where(((LABELS == 3) & (hidden != 3))[..., None], SCENE, TRUTH)
    wrong = np.where((hidden == 3)[..., None], 255 - truth, truth)
    reference = TrueAppearance(truth, hidden).take_colors(wrong)
    assert np.abs(reference.astype(int) - wrong)[hidden == 3].mean() < 4


def test_without_a_scene_there_is_no_exposure() -> None:
    brighter = expose(TRUTH, 0.8)
    assert TrueAppearance(TRUTH, np.zeros_like(LABELS)).even_exposure(brighter) is brighter


@pytest.mark.parametrize("count", [41, 44, 1001, 4800])
def test_percentiles_are_those_of_numpy(count: int) -> None:
    levels = np.random.default_rng(count).integers(0, 256, (3, count), np.uint8)
    spread, middle = _describe(levels)
    values = levels.T.astype(np.float32)
    np.testing.assert_array_equal(spread, np.diff(np.percentile(values, (10, 90), axis=0), axis=0)[0])
    np.testing.assert_array_equal(middle, np.median(values, axis=0))


def test_what_predictions_share_leaves_no_trace() -> None:
    shared = TrueAppearance(TRUTH, LABELS)
    for wrong in (flicker(TRUTH), np.where((LABELS == 3)[..., None], 255 - TRUTH, TRUTH), TRUTH, expose(TRUTH, 0.8)):
        for found, expected in zip(shared.match(wrong), TrueAppearance(TRUTH, LABELS).match(wrong), strict=True):
            np.testing.assert_array_equal(found, expected)

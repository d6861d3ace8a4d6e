"""The default mask estimator: near the truth on true video, and not to be won by standing still."""

import cv2
import numpy as np
import pytest

from tests.synthetic import write_cell
from xew.episode import read_states, read_video
from xew.metrics import boundary_f1, mask_iou
from xew.metrics.estimators.masks import estimate_masks, learn_appearance

FRAMES = 13
ROBOTS = ("franka_panda", "piper")


@pytest.fixture(scope="module", params=ROBOTS)
def episode(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, np.ndarray]:
    """True video [t h w 3] and masks [t h w]."""
    folder = write_cell(tmp_path_factory.mktemp("data"), "place_empty_cup", 1_000_000, request.param, FRAMES)
    return read_video(folder / "rgb.mkv"), read_states(folder).robot_mask


def mean(metric: object, a: np.ndarray, b: np.ndarray) -> float:
    return float(np.mean(metric(a, b)[1:]))


def test_on_true_video_it_is_near_perfect(episode: tuple[np.ndarray, np.ndarray]) -> None:
    video, mask = episode
    estimate = estimate_masks(video, video, mask)
    assert mean(mask_iou, estimate, mask) > 0.99
    assert mean(boundary_f1, estimate, mask) > 0.99


def test_a_soft_but_right_video_loses_little(episode: tuple[np.ndarray, np.ndarray]) -> None:
    video, mask = episode
    soft = np.stack([cv2.GaussianBlur(frame, (0, 0), 0.8) for frame in video])
    assert mean(mask_iou, estimate_masks(soft, video, mask), mask) > 0.98


WRONG_MOTIONS = {
    "frozen": np.zeros(FRAMES, int),
    "three frames late": np.maximum(np.arange(FRAMES) - 3, 0),
    "half as fast": np.arange(FRAMES) // 2,
}


@pytest.mark.parametrize("name", WRONG_MOTIONS)
def test_a_wrong_motion_is_scored_as_wrong_as_it_is(name: str, episode: tuple[np.ndarray, np.ndarray]) -> None:
    """The shown mask is known here, so that estimate and truth can be held side by side."""
    video, mask = episode
    shown = WRONG_MOTIONS[name]
    estimate = estimate_masks(video[shown], video, mask)
    for metric in (mask_iou, boundary_f1):
        assert mean(metric, estimate, mask) == pytest.approx(mean(metric, mask[shown], mask), abs=0.01)


def test_a_motion_that_the_truth_never_shows_is_scored_too(episode: tuple[np.ndarray, np.ndarray]) -> None:
    """Everything is shifted: no true frame shows it, so that flow, colors and background have to do."""
    video, mask = episode
    shift = np.array([[1, 0, 8], [0, 1, 0.0]])
    moved, shown = (
        np.stack([cv2.warpAffine(frame, shift, (320, 240), borderMode=cv2.BORDER_REPLICATE) for frame in frames])
        for frames in (video, mask.astype(np.uint8))
    )
    estimate = estimate_masks(moved, video, mask)
    for metric in (mask_iou, boundary_f1):
        assert mean(metric, estimate, mask) == pytest.approx(mean(metric, shown > 0, mask), abs=0.01)


def test_standing_still_does_not_win(episode: tuple[np.ndarray, np.ndarray]) -> None:
    video, mask = episode
    frozen = np.repeat(video[:1], FRAMES, axis=0)
    assert mean(mask_iou, estimate_masks(frozen, video, mask), mask) < 0.6


def test_what_is_kept_while_a_video_stands_still_changes_nothing(
    episode: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    video, mask = episode
    shown = np.array([0, 0, 0, 1, 1, 0])
    kept = estimate_masks(video[shown], video[:6], mask[:6])
    monkeypatch.setattr(np, "array_equal", lambda *frames: False)
    np.testing.assert_array_equal(kept, estimate_masks(video[shown], video[:6], mask[:6]))


def test_without_a_robot_in_sight_nothing_is_found(episode: tuple[np.ndarray, np.ndarray]) -> None:
    video, mask = episode
    empty = np.repeat(learn_appearance(video, mask).background[None], FRAMES, axis=0)
    estimate = estimate_masks(empty, video, mask)
    assert mean(mask_iou, estimate, mask) < 0.3


def test_it_is_the_same_every_time(episode: tuple[np.ndarray, np.ndarray]) -> None:
    video, mask = episode
    late = video[WRONG_MOTIONS["three frames late"]]
    np.testing.assert_array_equal(estimate_masks(late, video, mask), estimate_masks(late, video, mask))


def test_what_the_true_robot_hides_of_a_thing_that_it_carries_is_no_robot() -> None:
    """A thing, half in the robot's colors, is carried by a robot that is too high: no true frame shows what this uncovers."""
    rng = np.random.default_rng(0)
    ground, robot, thing = (_cloth(rng, *settings) for settings in ((120, 200, 210), (60, 30, 90), (40, 40, 90)))
    thing[:, :20] = thing[:, :20] // 3 + np.uint8([0, 0, 140])
    videos, masks = [], []
    for height in (0, 30):
        video, mask = np.repeat(ground[None], 18, axis=0), np.zeros((18, 120, 200), bool)
        for t in range(18):
            x, bottom = 50 + 2 * max(t - 8, 0), 30 + 6 * min(t, 8) - height
            video[t, 60:100, x : x + 40] = thing
            video[t, max(bottom - 60, 0) : bottom, x + 15 : x + 45] = robot[max(60 - bottom, 0) :, :30]
            mask[t, max(bottom - 60, 0) : bottom, x + 15 : x + 45] = True
        videos.append(video)
        masks.append(mask)
    estimate = estimate_masks(videos[1], videos[0], masks[0])
    hidden = masks[0] & ~masks[1]
    hidden[:, :60] = False
    assert hidden[9:].sum() > 1000
    # By looks alone half of what is uncovered passes for the robot, and IoU is 0.86.
    assert estimate[9:][hidden[9:]].mean() < 0.3
    assert mean(mask_iou, estimate[8:], masks[1][8:]) > 0.9


def _cloth(rng: np.random.Generator, height: int, width: int, level: int) -> np.ndarray:
    """[h w 3] uint8, soft gray blotches round a level."""
    blotches = cv2.GaussianBlur(rng.normal(0, 1, (height, width)), (0, 0), 2)
    return np.repeat(np.clip(level + 100 * blotches, 0, 255).astype(np.uint8)[..., None], 3, axis=2)

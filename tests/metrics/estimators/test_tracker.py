"""The default tracker: exact on true video, near the truth on wrong video, and not to be won by standing still."""

import cv2
import numpy as np
import pytest

from tests.synthetic import write_cell
from xew.episode import States, read_states, read_video
from xew.metrics import coverage, keypoint_error, pck
from xew.metrics.estimators import similarity
from xew.metrics.estimators.similarity import find_most_similar
from xew.metrics.estimators.tracks import estimate_tracks, likeness

FRAMES = 13
SHOWN = {
    "one frame late": np.maximum(np.arange(FRAMES) - 1, 0),
    "three frames late": np.maximum(np.arange(FRAMES) - 3, 0),
    "half as fast": np.arange(FRAMES) // 2,
    "frozen": np.zeros(FRAMES, int),
}
"""Wrong videos, by the true frame that each of their frames shows: where everything is in them is known."""
Episode = tuple[np.ndarray, States]


@pytest.fixture(scope="module", params=("franka_panda", "piper"))
def episode(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Episode:
    folder = write_cell(tmp_path_factory.mktemp("data"), "place_empty_cup", 1_000_000, request.param, FRAMES)
    return read_video(folder / "rgb.mkv"), read_states(folder)


def track(prediction: np.ndarray, episode: Episode) -> np.ndarray:
    video, states = episode
    return estimate_tracks(prediction, video, states.keypoints, states.keypoint_visible)


def error(tracks: np.ndarray, states: States) -> float:
    return float(keypoint_error(tracks, states.keypoints, states.keypoint_visible))


def test_on_true_video_it_is_exact(episode: Episode) -> None:
    video, states = episode
    tracks = track(video, episode)
    assert error(tracks, states) < 0.05
    assert float(coverage(tracks, states.keypoints, states.keypoint_visible)) == 1


def test_a_soft_and_grainy_but_right_video_loses_little(episode: Episode) -> None:
    video, states = episode
    grain = np.random.default_rng(0).normal(0, 3, video.shape)
    soft = np.stack([cv2.GaussianBlur(frame, (0, 0), 1.0) for frame in video])
    tracks = track(np.clip(soft + grain, 0, 255).astype(np.uint8), episode)
    assert error(tracks, states) < 1
    assert float(coverage(tracks, states.keypoints, states.keypoint_visible)) > 0.95


@pytest.mark.parametrize("name", SHOWN)
def test_a_wrong_motion_is_as_far_off_as_it_is(name: str, episode: Episode) -> None:
    video, states = episode
    tracks = track(video[SHOWN[name]], episode)
    assert error(tracks, states) == pytest.approx(error(states.keypoints[SHOWN[name]], states), abs=1)


def test_standing_still_wins_nothing(episode: Episode) -> None:
    video, states = episode
    shown = SHOWN["frozen"]
    true, found = (
        float(pck(tracks, states.keypoints, states.keypoint_visible))
        for tracks in (states.keypoints[shown], track(video[shown], episode))
    )
    assert found <= true + 0.02 < 0.9


def test_the_order_of_wrong_motions_is_kept(episode: Episode) -> None:
    video, states = episode
    names = ("one frame late", "three frames late", "frozen")
    errors = [error(track(video[SHOWN[name]], episode), states) for name in names]
    assert errors == sorted(errors) and errors[0] > 0


def test_a_motion_that_the_truth_never_shows_is_measured(episode: Episode) -> None:
    """Everything is shifted: no true frame looks like it, so that flow and search have to find it."""
    video, states = episode
    shift = np.array([6.0, -4.0], np.float32)
    moved = np.stack([cv2.warpAffine(f, np.array([[1, 0, 6], [0, 1, -4.0]]), (320, 240), borderMode=1) for f in video])
    tracks = track(moved, episode)
    assert np.nanmedian(np.linalg.norm(tracks - states.keypoints - shift, axis=-1)[states.keypoint_visible]) < 0.5
    assert error(tracks, states) == pytest.approx(float(np.linalg.norm(shift)), abs=1)


def test_without_a_robot_in_sight_points_are_lost(episode: Episode) -> None:
    video, states = episode
    tracks = track(np.full_like(video, 128), episode)
    assert float(coverage(tracks, states.keypoints, states.keypoint_visible)) < 0.05


def test_what_the_truth_hides_is_not_tracked_and_no_points_are_no_tracks(episode: Episode) -> None:
    video, states = episode
    visible = states.keypoint_visible.copy()
    visible[4:8, 0] = False
    points = np.where(visible[..., None], states.keypoints, np.nan)
    tracks = estimate_tracks(video, video, points, visible)
    np.testing.assert_array_equal(np.isfinite(tracks).all(-1), visible)
    assert estimate_tracks(video, video, points[:, :0], visible[:, :0]).shape == (FRAMES, 0, 2)


def test_it_is_the_same_every_time(episode: Episode) -> None:
    video, _ = episode
    late = video[SHOWN["three frames late"]]
    np.testing.assert_array_equal(track(late, episode), track(late, episode))


def test_the_moment_that_a_frame_shows(episode: Episode) -> None:
    video, _ = episode
    moving = np.flatnonzero((video[1:] != video[:-1]).any(axis=(1, 2, 3))) + 1
    shown = SHOWN["three frames late"]
    found, difference = find_most_similar(video[shown], video)
    np.testing.assert_array_equal(video[found], video[shown])
    assert len(moving) > 3 and difference.max() < 0.01
    still = np.repeat(video[:1], FRAMES, axis=0)
    np.testing.assert_array_equal(find_most_similar(still, still)[0], np.arange(FRAMES))


def test_thumbnails_are_made_once_a_video(monkeypatch: pytest.MonkeyPatch) -> None:
    resized: list[int] = []
    resize = similarity.cv2.resize
    monkeypatch.setattr(similarity.cv2, "resize", lambda *asked, **how: resized.append(1) or resize(*asked, **how))
    truth, *predictions = (np.full((3, 60, 80, 3), level, np.uint8) for level in (10, 20, 30, 40))
    for prediction in (*predictions, predictions[-1]):
        for _ in ("masks", "tracks"):
            find_most_similar(prediction, truth)
    assert len(resized) == 4 * 3, "three predictions and the truth, three frames each"
    find_most_similar(predictions[0], truth)
    assert len(resized) == 5 * 3, "a video of before is not kept"


def test_patches_are_compared_as_far_as_both_are_in_the_image(episode: Episode) -> None:
    """A point that nears the border still looks like itself: what would lie beyond the border is unknown."""
    frame = episode[0][0]
    point = np.float32([[160, 120]])
    cut = frame[:, :164]
    assert likeness(cut, point, frame, point)[0] == pytest.approx(1, abs=1e-6)
    assert likeness(frame, point, cut, point)[0] == pytest.approx(1, abs=1e-6)
    assert likeness(255 - cut, point, frame, point)[0] < 0.5


def test_a_point_that_leaves_the_image_is_not_found_where_its_like_has_always_stood() -> None:
    """An edge of an arm moves out of the image; a post with the same edge stands in the true video too."""
    rng = np.random.default_rng(0)
    table = np.clip(225 + rng.normal(0, 1, (240, 320, 3)), 0, 255).astype(np.uint8)
    table[:, 240:262] = 120
    true, shown = (np.repeat(table[None], 8, axis=0) for _ in range(2))
    for t in range(8):
        true[t, :, 290:] = shown[t, :, 290 + 10 * t :] = 120
    points = np.tile(np.float32([[[290, 120]]]), (8, 1, 1))
    tracks = estimate_tracks(shown, true, points, np.ones((8, 1), bool))
    assert np.isfinite(tracks[0]).all() and np.isnan(tracks[5:]).all()

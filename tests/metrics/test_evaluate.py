"""The command: rollouts in every admitted form to a table, and clear words for every mistake."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from tests.synthetic import write_synthetic_data
from xew.episode import episode_folder, read_states, read_video
from xew.metrics import mask_iou, psnr, ssim
from xew.metrics.estimate import estimate_masks
from xew.metrics.evaluate import Args, main
from xew.rollout import write_rollout

TASK, SEED, ROBOTS = "place_empty_cup", 1_000_000, ("franka_panda", "piper")
FRAMES, ASKED = 9, 7
CHEAP = ("psnr", "ssim", "mask_iou")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    write_synthetic_data(root, tasks=(TASK,), seeds=(SEED,), robots=ROBOTS, frames=FRAMES)
    return root


def truth(data: Path, robot: str) -> np.ndarray:
    return read_video(episode_folder(data, TASK, SEED, robot) / "rgb.mkv")


def late(video: np.ndarray) -> np.ndarray:
    return video[np.maximum(np.arange(len(video)) - 1, 0)]


@pytest.fixture
def rollouts(data: Path, tmp_path: Path) -> Path:
    """A model that is a frame late, asked for ASKED frames."""
    root = tmp_path / "rollouts"
    for robot in ROBOTS:
        header = {"model": "late", "condition": "none"}
        write_rollout(root, TASK, SEED, robot, late(truth(data, robot))[:ASKED], header)
    return root


def grade(rollouts: Path, data: Path, **settings: object) -> pd.DataFrame:
    out = settings.pop("out", rollouts.parent / "scores.parquet")
    main(Args((rollouts,), data, out, **{"metrics": CHEAP} | settings))
    return pd.read_parquet(out)


def value(scores: pd.DataFrame, model: str, robot: str, metric: str) -> float:
    found = scores[(scores["model"] == model) & (scores["robot"] == robot) & (scores["metric"] == metric)]
    assert len(found) == 1
    return float(found["value"].iloc[0])


def test_every_score_is_the_mean_of_the_functions_without_the_given_frame(rollouts: Path, data: Path) -> None:
    scores = grade(rollouts, data)
    for robot in ROBOTS:
        target = truth(data, robot)[:ASKED]
        mask = read_states(episode_folder(data, TASK, SEED, robot)).robot_mask[:ASKED]
        prediction = late(target)
        assert value(scores, "late", robot, "psnr") == pytest.approx(float(np.mean(psnr(prediction[1:], target[1:]))), rel=1e-5)
        assert value(scores, "late", robot, "ssim") == pytest.approx(float(np.mean(ssim(prediction, target)[1:])), rel=1e-5)
        expected = float(np.mean(mask_iou(estimate_masks(prediction, target, mask), mask)[1:]))
        assert value(scores, "late", robot, "mask_iou") == pytest.approx(expected, rel=1e-5)
    assert set(scores["frames"]) == {ASKED}


def test_all_default_metrics_with_baselines(rollouts: Path, data: Path) -> None:
    scores = grade(rollouts, data, metrics=Args.metrics, baselines=True)
    assert len(scores) == 3 * len(ROBOTS) * len(Args.metrics)
    described = scores.attrs["metrics"]
    assert list(described) == list(Args.metrics)
    for robot in ROBOTS:
        for name, info in described.items():
            frozen, model, perfect = (value(scores, m, robot, name) for m in ("copy_first_frame", "late", "ground_truth"))
            sign = 1 if info["higher_is_better"] else -1
            assert sign * frozen < sign * model < sign * perfect, (robot, name)
        for name, best in (("ssim", 1), ("lpips", 0), ("region_lpips", 0)):
            assert value(scores, "ground_truth", robot, name) == best
        assert value(scores, "ground_truth", robot, "mask_iou") > 0.95
    exact = scores[scores["model"] == "ground_truth"]["exact_frames"]
    assert set(exact) == {ASKED - 1}


def test_curves_hold_every_predicted_frame_and_average_to_the_scores(rollouts: Path, data: Path) -> None:
    scores = grade(rollouts, data)
    curves = pd.read_parquet(rollouts.parent / "scores.curves.parquet")
    assert sorted(set(curves["frame"])) == list(range(1, ASKED))
    means = curves.groupby(["robot", "metric"])["value"].mean()
    for row in scores.itertuples():
        assert means[row.robot, row.metric] == pytest.approx(row.value, rel=1e-6)


def as_mp4(folder: Path, video: np.ndarray) -> None:
    height, width = video.shape[1:3]
    writer = cv2.VideoWriter(str(folder / "video.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 16, (width, height))
    for frame in video:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()


def as_pngs(folder: Path, video: np.ndarray) -> None:
    (folder / "frames").mkdir()
    for i, frame in enumerate(video):
        cv2.imwrite(str(folder / "frames" / f"{i:05d}.png"), cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))


def as_npz(folder: Path, video: np.ndarray) -> None:
    np.savez_compressed(folder / "rgb.npz", rgb=video)


@pytest.mark.parametrize(("store", "lossless"), [(as_mp4, False), (as_pngs, True), (as_npz, True)])
def test_any_models_video_in_the_tree_is_graded(store: Callable, lossless: bool, data: Path, tmp_path: Path) -> None:
    folder = episode_folder(tmp_path / "their_model", TASK, SEED, "piper")
    folder.mkdir(parents=True)
    store(folder, late(truth(data, "piper")))
    scores = grade(tmp_path / "their_model", data)
    target = truth(data, "piper")
    expected = float(np.mean(psnr(late(target)[1:], target[1:])))
    assert value(scores, "their_model", "piper", "psnr") == pytest.approx(expected, rel=1e-5 if lossless else 0.2)


def test_a_second_run_grades_nothing_anew_and_writes_the_same(
    rollouts: Path, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = grade(rollouts, data, baselines=True)
    import xew.metrics.evaluate as evaluate

    monkeypatch.setattr(evaluate, "grade", lambda *_: pytest.fail("graded again"))
    pd.testing.assert_frame_equal(grade(rollouts, data, baselines=True), first)


def test_killed_and_resumed_it_ends_in_the_same_table(
    rollouts: Path, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import xew.metrics.evaluate as evaluate

    whole = grade(rollouts, data, baselines=True, out=tmp_path / "whole.parquet")
    monkeypatch.setattr(evaluate.ScoreTable, "save_now_and_then", evaluate.ScoreTable.save)
    real, calls = evaluate.grade, []

    def dies_at_the_third(*arguments: object) -> object:
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(evaluate, "grade", dies_at_the_third)
    with pytest.raises(SystemExit, match="130"):
        grade(rollouts, data, baselines=True, out=tmp_path / "parts.parquet")
    assert len(pd.read_parquet(tmp_path / "parts.parquet")) == 2 * len(CHEAP)
    resumed = grade(rollouts, data, baselines=True, out=tmp_path / "parts.parquet")
    assert len(calls) == 3 + 4
    pd.testing.assert_frame_equal(resumed, whole)
    curves = [pd.read_parquet(tmp_path / f"{name}.curves.parquet") for name in ("parts", "whole")]
    pd.testing.assert_frame_equal(*curves)


def test_a_rollout_made_anew_replaces_its_scores(rollouts: Path, data: Path) -> None:
    before = grade(rollouts, data)
    write_rollout(rollouts, TASK, SEED, "piper", truth(data, "piper")[:ASKED], {"model": "late", "condition": "none"})
    after = grade(rollouts, data)
    assert len(after) == len(before)
    assert value(after, "late", "piper", "ssim") == 1 > value(before, "late", "piper", "ssim")
    assert value(after, "late", "franka_panda", "ssim") == value(before, "late", "franka_panda", "ssim")


def short(folder: Path, data: Path) -> None:
    as_npz(folder, truth(data, "piper")[:-2])


def small(folder: Path, data: Path) -> None:
    as_npz(folder, truth(data, "piper")[:, ::2, ::2])


def floating(folder: Path, data: Path) -> None:
    as_npz(folder, truth(data, "piper") / np.float32(255))


def two_videos(folder: Path, data: Path) -> None:
    as_npz(folder, truth(data, "piper"))
    as_mp4(folder, truth(data, "piper"))


def broken(folder: Path, data: Path) -> None:
    (folder / "rgb.mkv").write_bytes(b"no video at all")


def nothing(folder: Path, data: Path) -> None:
    (folder / "notes.txt").write_text("later")


def other_source(folder: Path, data: Path) -> None:
    as_npz(folder, truth(data, "piper"))
    (folder / "rollout.json").write_text(json.dumps({"source_hash": "of another video"}))


def too_long(folder: Path, data: Path) -> None:
    as_npz(folder, truth(data, "piper"))
    (folder / "rollout.json").write_text(json.dumps({"frame_count": FRAMES + 1}))


MISTAKES = [
    (short, "7 frames of 320x240, expected 9 frames"),
    (small, "9 frames of 160x120, expected 9 frames of 320x240"),
    (floating, "float32"),
    (two_videos, "rgb.npz, video.mp4"),
    (broken, "no readable frame"),
    (nothing, "0 PNG files"),
    (other_source, "another video"),
    (too_long, "asks for 10 frames"),
]


@pytest.mark.parametrize(("spoil", "word"), MISTAKES, ids=[spoil.__name__ for spoil, _ in MISTAKES])
def test_a_mistake_is_one_clear_error(
    spoil: Callable, word: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder = episode_folder(tmp_path / "theirs", TASK, SEED, "piper")
    folder.mkdir(parents=True)
    spoil(folder, data)
    with pytest.raises(SystemExit) as exit_:
        grade(tmp_path / "theirs", data)
    assert exit_.value.code == 2
    message = capsys.readouterr().err
    assert word in message and "piper" in message and "Traceback" not in message


def test_missing_episodes_trees_and_metrics_are_named(
    rollouts: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    for settings, word in (
        ({"data": tmp_path / "nowhere"}, "does not hold"),
        ({"metrics": ("psrn",)}, "did you mean 'psnr'"),
        ({"metrics": ("pck",)}, "compares tracks"),
        ({"out": tmp_path / "scores.csv"}, ".parquet"),
    ):
        arguments = {"rollouts": rollouts, "data": data} | settings
        with pytest.raises(SystemExit):
            grade(arguments.pop("rollouts"), arguments.pop("data"), **arguments)
        assert word in capsys.readouterr().err
    with pytest.raises(SystemExit):
        grade(tmp_path / "empty", data)
    assert "xew.model.rollout" in capsys.readouterr().err


def test_keep_going_grades_the_rest_and_still_says_so(rollouts: Path, data: Path, capsys: pytest.CaptureFixture) -> None:
    (episode_folder(rollouts, TASK, SEED, "franka_panda") / "rgb.mkv").write_bytes(b"cut off")
    with pytest.raises(SystemExit) as exit_:
        grade(rollouts, data, keep_going=True)
    assert exit_.value.code == 2 and "1 of 2 could not be graded" in capsys.readouterr().err
    assert set(pd.read_parquet(rollouts.parent / "scores.parquet")["robot"]) == {"piper"}


def test_models_over_different_horizons_do_not_share_a_table(
    rollouts: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    other = tmp_path / "other"
    write_rollout(other, TASK, SEED, "piper", truth(data, "piper")[:5], {"model": "other", "condition": "none"})
    with pytest.raises(SystemExit):
        main(Args((rollouts, other), data, tmp_path / "scores.parquet", CHEAP))
    assert "different horizons" in capsys.readouterr().err
    shutil.rmtree(other)
    write_rollout(other, TASK, SEED, "piper", truth(data, "piper")[:ASKED], {"model": "late", "condition": "none"})
    with pytest.raises(SystemExit):
        main(Args((rollouts, other), data, tmp_path / "scores.parquet", CHEAP))
    assert "different names" in capsys.readouterr().err

"""Videos of other people's models: every admitted form is graded, and every mistake is one clear error."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from tests.metrics.grading.graded import FRAMES, SEED, TASK, grade, late, truth, value
from xew.episode import episode_folder, read_record
from xew.metrics import psnr, ssim
from xew.metrics.truth import Truth, read_truth


def as_mp4(folder: Path, video: np.ndarray, rate: float = 1000 / 60) -> None:
    height, width = video.shape[1:3]
    writer = cv2.VideoWriter(str(folder / "video.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), rate, (width, height))
    for frame in video:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()


def as_pngs(folder: Path, video: np.ndarray) -> None:
    """Their names do not sort as text: 10.png would come before 2.png."""
    (folder / "frames").mkdir()
    for i, frame in enumerate(video):
        cv2.imwrite(str(folder / "frames" / f"{i + 5}.png"), cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))


def as_npz(folder: Path, video: np.ndarray) -> None:
    np.savez_compressed(folder / "rgb.npz", rgb=video)


def their_folder(tmp_path: Path) -> Path:
    folder = episode_folder(tmp_path / "theirs", TASK, SEED, "piper")
    folder.mkdir(parents=True)
    return folder


@pytest.mark.parametrize(("store", "lossless"), [(as_mp4, False), (as_pngs, True), (as_npz, True)])
def test_any_models_video_in_the_tree_is_graded(store: Callable, lossless: bool, data: Path, tmp_path: Path) -> None:
    store(their_folder(tmp_path), late(truth(data, "piper")))
    scores = grade(tmp_path / "theirs", data, metrics=("psnr",))
    target = truth(data, "piper")
    expected = float(np.mean(psnr(late(target)[1:], target[1:])))
    assert value(scores, "theirs", "piper", "psnr") == pytest.approx(expected, rel=1e-5 if lossless else 0.2)


def test_what_becomes_of_frame_zero_is_said(data: Path, tmp_path: Path) -> None:
    target = truth(data, "piper")
    folder = their_folder(tmp_path)
    as_npz(folder, late(target)[1:])
    absent = grade(tmp_path / "theirs", data, metrics=("psnr",), frame_zero="absent")
    assert absent.attrs["frame_zero"] == "absent"
    expected = float(np.mean(psnr(late(target)[1:], target[1:])))
    assert value(absent, "theirs", "piper", "psnr") == pytest.approx(expected, rel=1e-5)
    noisy = target.copy()
    noisy[0] //= 2
    as_npz(folder, noisy)
    predicted = grade(tmp_path / "theirs", data, metrics=("ssim",), frame_zero="predicted")
    assert value(predicted, "theirs", "piper", "ssim") == pytest.approx(float(np.mean(ssim(noisy, target))), rel=1e-5)
    curves = pd.read_parquet(tmp_path / "scores.curves.parquet")
    assert curves["frame"].tolist() == list(range(FRAMES))


def test_what_is_allowed_is_done_and_said(data: Path, tmp_path: Path) -> None:
    target = truth(data, "piper")
    large = np.repeat(np.repeat(np.concatenate([late(target), target[-1:]]), 2, axis=1), 2, axis=2)
    as_mp4(their_folder(tmp_path), large, rate=24)
    scores = grade(tmp_path / "theirs", data, metrics=("psnr",), allow=("trim", "resize", "rate"))
    assert scores.attrs["allowed"] == ["rate", "resize", "trim"]
    expected = float(np.mean(psnr(late(target)[1:], target[1:])))
    assert value(scores, "theirs", "piper", "psnr") == pytest.approx(expected, rel=0.2)


def wide(video: np.ndarray) -> np.ndarray:
    """Frames of 256x256, all of the picture in them."""
    return np.stack([cv2.resize(frame, (256, 256), interpolation=cv2.INTER_AREA) for frame in video])


def test_another_aspect_ratio_is_stretched_only_if_asked(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    target = truth(data, "piper")
    as_npz(their_folder(tmp_path), wide(target))
    with pytest.raises(SystemExit):
        grade(tmp_path / "theirs", data, metrics=("psnr",), allow=("resize",))
    assert "is 256x256, its episode 320x240; these aspect ratios differ" in capsys.readouterr().err
    scores = grade(tmp_path / "theirs", data, metrics=("psnr",), allow=("stretch",))
    assert value(scores, "theirs", "piper", "psnr") > 30 and scores.attrs["allowed"] == ["stretch"]
    assert "1 of 1 videos were stretched from 256x256 to 320x240" in capsys.readouterr().out


def test_what_resizing_did_is_said(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    as_npz(their_folder(tmp_path), truth(data, "piper")[:, ::2, ::2])
    grade(tmp_path / "theirs", data, metrics=("psnr",), allow=("resize",))
    out = capsys.readouterr().out
    assert "1 of 1 videos were resized from 160x120 to 320x240" in out and "begin with" not in out


@pytest.mark.parametrize(
    ("first", "note"),
    [(1, "nearer to frame 1 than to frame 0; if they lack frame 0, pass"), (None, "unlike the given frame 0"), (0, "")],
)
def test_a_first_frame_that_is_not_the_given_one_is_said(
    first: int | None, note: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    target = truth(data, "piper")
    noise = np.random.default_rng(0).integers(-3, 4, target.shape)  # of a codec
    video = np.clip(target[np.minimum(np.arange(FRAMES) + (first or 0), FRAMES - 1)] + noise, 0, 255).astype(np.uint8)
    if first is None:
        video[0] = 0
    as_npz(their_folder(tmp_path), video)
    grade(tmp_path / "theirs", data, metrics=("psnr",))
    out = capsys.readouterr().out
    assert note in out and out.count("begin with") == bool(note)


@pytest.mark.parametrize(("frames", "frame_zero", "allow"), [(8, "given", ()), (10, "given", ("resize",)), (9, "absent", ())])
def test_only_what_helps_is_advised(
    frames: int, frame_zero: str, allow: tuple[str, ...], data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Not an option that was given, and each where it fits: fewer frames, more frames, more without the given one."""
    target = truth(data, "piper")
    as_npz(their_folder(tmp_path), np.concatenate([target, target])[:frames])
    with pytest.raises(SystemExit):
        grade(tmp_path / "theirs", data, metrics=("psnr",), frame_zero=frame_zero, allow=allow)
    message = capsys.readouterr().err
    assert "frame_count" in message and "resize" not in message and "stretch" not in message
    assert ("--allow trim" in message) == (frames > 8) and ("--frame-zero absent" in message) == (frames == 8)
    assert ("expected 8 frames of 320x240 after the given one" in message) == (frame_zero == "absent")


def short(folder: Path, video: np.ndarray) -> None:
    as_npz(folder, video[:-2])


def long(folder: Path, video: np.ndarray) -> None:
    as_npz(folder, np.concatenate([video, video[-1:]]))


def small(folder: Path, video: np.ndarray) -> None:
    as_npz(folder, video[:, ::2, ::2])


def not_numbers(folder: Path, video: np.ndarray) -> None:
    as_npz(folder, np.where(video > 200, np.float32("nan"), video / np.float32(255)))


def other_rate(folder: Path, video: np.ndarray) -> None:
    as_mp4(folder, video, rate=30)


def two_videos(folder: Path, video: np.ndarray) -> None:
    as_npz(folder, video)
    as_mp4(folder, video)


def broken(folder: Path, video: np.ndarray) -> None:
    (folder / "rgb.mkv").write_bytes(b"no video at all")


def nothing(folder: Path, video: np.ndarray) -> None:
    (folder / "notes.txt").write_text("later")


def other_source(folder: Path, video: np.ndarray) -> None:
    as_npz(folder, video)
    (folder / "rollout.json").write_text(json.dumps({"source_hash": "of another video"}))


def too_long(folder: Path, video: np.ndarray) -> None:
    as_npz(folder, video)
    (folder / "rollout.json").write_text(json.dumps({"frame_count": FRAMES + 1}))


def a_baselines_name(folder: Path, video: np.ndarray) -> None:
    as_npz(folder, video)
    (folder / "rollout.json").write_text(json.dumps({"model": "ground_truth"}))


MISTAKES = [
    (short, "7 frames of 320x240, expected 9 frames"),
    (long, "10 frames of 320x240, expected 9 frames"),
    (small, "9 frames of 160x120, expected 9 frames of 320x240"),
    (not_numbers, "float32 (9, 240, 320, 3), with NaN"),
    (other_rate, "30.00 frames per second, its episode 16.67"),
    (two_videos, "rgb.npz, video.mp4"),
    (broken, "no readable frame"),
    (nothing, "0 PNG files"),
    (other_source, "another video"),
    (too_long, "asks for 10 frames"),
    (a_baselines_name, "is a baseline's"),
]


@pytest.mark.parametrize(("spoil", "word"), MISTAKES, ids=[spoil.__name__ for spoil, _ in MISTAKES])
def test_a_mistake_is_one_clear_error_and_the_rest_is_graded_if_asked(
    spoil: Callable, word: str, rollouts: Path, data: Path, capsys: pytest.CaptureFixture
) -> None:
    folder = episode_folder(rollouts, TASK, SEED, "piper")
    shutil.rmtree(folder)
    folder.mkdir()
    spoil(folder, truth(data, "piper"))
    whole = episode_folder(rollouts, TASK, SEED, "franka_panda")
    shutil.rmtree(whole)
    whole.mkdir()
    as_npz(whole, late(truth(data, "franka_panda")))
    for keep_going in (False, True):
        with pytest.raises(SystemExit) as exit_:
            grade(rollouts, data, metrics=("psnr",), keep_going=keep_going)
        message = capsys.readouterr().err
        assert exit_.value.code == 2 and word in message and str(folder) in message and "Traceback" not in message
        assert message.count(word) == 1
    assert "1 of 2 could not be graded" in message
    assert pd.read_parquet(rollouts.parent / "scores.parquet")["robot"].tolist() == ["franka_panda"]


def test_a_video_that_is_replaced_while_it_is_graded_is_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its digest was taken before, and its scores would be kept under it."""
    folder, right = their_folder(tmp_path), late(truth(data, "piper"))
    as_npz(folder, right)

    def replace_video(*arguments: object) -> Truth:
        as_npz(folder, right // 2)
        return read_truth(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr("xew.metrics.grading.grade_episodes.read_truth", replace_video)
    with pytest.raises(SystemExit):
        grade(tmp_path / "theirs", data, metrics=("psnr",))
    assert "rgb.npz was replaced while this command ran; run it again" in capsys.readouterr().err
    assert not list(tmp_path.glob("scores*"))


def test_rollouts_that_name_no_video_are_counted(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = their_folder(tmp_path)
    as_npz(folder, late(truth(data, "piper")))
    grade(tmp_path / "theirs", data, metrics=("psnr",))
    assert "1 of 1 rollouts do not say which video they predict (source_hash" in capsys.readouterr().out
    source = read_record(episode_folder(data, TASK, SEED, "piper")).hashes["rgb"]
    (folder / "rollout.json").write_text(json.dumps({"source_hash": source}))
    grade(tmp_path / "theirs", data, metrics=("psnr",))
    assert "source_hash" not in capsys.readouterr().out

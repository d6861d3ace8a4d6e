"""The command: rollouts to a table of scores, and clear words for every mistake."""

import json
import re
import shutil
from dataclasses import fields, replace
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest

from tests.metrics.grading.graded import ASKED, CHEAP, FRAMES, ROBOTS, SEED, TASK, grade, late, truth, value
from xew.episode import Record, episode_folder, project, read_record, read_states, read_video, write_episode
from xew.metrics import METRICS, keypoint_error, mask_iou, perceptual, psnr, ssim
from xew.metrics.backends import Backend, estimate_masks
from xew.metrics.episode_cache import EpisodeCache
from xew.metrics.estimators.appearance import TrueAppearance
from xew.metrics.evaluate import Args, main
from xew.metrics.grade import Comparison
from xew.metrics.grade import grade as grade_one
from xew.metrics.grading import codecs
from xew.metrics.grading.baselines import BASELINES
from xew.metrics.grading.settings import WITHOUT_OUTCOME
from xew.metrics.grading.summary import summarize_robots
from xew.metrics.track import failure_distance
from xew.metrics.truth import Truth, _find_visible, read_truth
from xew.protocol import CODEC_TRUTH, OTHER_ROBOT
from xew.rollout import write_rollout
from xew.statistics import describe_floors


def shifted(prediction: np.ndarray, target: np.ndarray, points: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """A tracker whose answer is known: three pixels right of the truth where the frames differ, and never the last point."""
    found = points + np.where((prediction != target).any(axis=(1, 2, 3))[:, None, None], np.float32([3, 0]), 0)
    found[:, -1] = np.nan
    return np.where(visible[..., None], found, np.nan).astype(np.float32)


def exact(prediction: np.ndarray, target: np.ndarray, points: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """A tracker that says what is true, where that is visible."""
    return np.where(visible[..., None], points, np.nan).astype(np.float32)


OF_OBJECTS = {"trajectory_error", "trajectory_error_strict", "trajectory_error_found"}
COVERAGES = {"coverage", "coverage_strict", "object_coverage", "object_coverage_strict"}
NOT_BY_DELAY = OF_OBJECTS | COVERAGES | {"flicker", "flicker_robot"}
"""Metrics that do not say how late a video is: the disc hardly moves in a frame, all is found, and a frozen video is steady."""
UNDEFINED = {"gripper_error", "onset_shift", "final_object_error"}
"""Metrics of which these episodes have nothing: no finger, hardly a motion, an object that is hidden at the end."""
SHIFTED = Backend(lambda: shifted, None, "for tests")
EXACT = Backend(lambda: exact, None, "for tests")


def test_every_score_is_the_mean_of_the_functions_without_the_given_frame(rollouts: Path, data: Path) -> None:
    scores = grade(rollouts, data)
    for robot in ROBOTS:
        target = truth(data, robot)[:ASKED]
        mask = read_states(episode_folder(data, TASK, SEED, robot)).robot_mask[:ASKED]
        prediction = late(target)
        assert value(scores, "late", robot, "psnr") == pytest.approx(float(np.mean(psnr(prediction[1:], target[1:]))), rel=1e-5)
        assert value(scores, "late", robot, "ssim") == pytest.approx(float(np.mean(ssim(prediction, target)[1:])), rel=1e-5)
        alike = TrueAppearance(target, np.where(mask, 0, -1)).match(prediction)
        expected = float(np.mean(mask_iou(estimate_masks(*alike, mask), mask)[1:]))
        assert value(scores, "late", robot, "mask_iou") == pytest.approx(expected, rel=1e-5)
    assert set(scores["frames"]) == {ASKED}
    assert scores.attrs["estimators"] == {"masks": "default", "tracks": "default"} and scores.attrs["frame_zero"] == "given"


def test_points_on_surfaces_are_kept_beside_the_data(rollouts: Path, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = []

    def read(folder: Path, frames: int, compared: set[str], cache: Path, record: Record) -> Truth:
        folders.append(cache)
        return read_truth(folder, frames, compared)

    monkeypatch.setattr("xew.metrics.grading.grade_episodes.read_truth", read)
    grade(rollouts, data, metrics=("psnr",))
    assert folders == [data.with_name(f"{data.name}-surfaces")] * len(ROBOTS)


class Halved:
    """A codec for tests, which leaves every second pixel; the folder of its run has the name of the model."""

    def __init__(self, run: Path) -> None:
        self.model, self.digest = run.name.partition("-")[0], run.name.partition("-")[2] or "halved"

    def __call__(self, video: np.ndarray, episode: Path | None = None) -> np.ndarray:
        return video[:, ::2, ::2].repeat(2, axis=1).repeat(2, axis=2)


def test_the_floor_of_a_model_is_the_truth_through_its_codec(
    rollouts: Path, data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codecs, "OPENER", f"{__name__}:Halved")
    codec = {"metrics": ("psnr", "mask_iou"), "baselines": True}
    scores = grade(rollouts, data, codec=(Path("runs/late"),), **codec)
    through = scores[scores["model"] == CODEC_TRUTH]
    (key,) = set(through["condition"])
    assert scores.attrs["codecs"] == {"late": [key]} and len(through) == 2 * len(ROBOTS)
    for robot in ROBOTS:
        target, mask = truth(data, robot)[:ASKED], read_states(episode_folder(data, TASK, SEED, robot)).robot_mask[:ASKED]
        alike = TrueAppearance(target, np.where(mask, 0, -1)).match(Halved(Path("late"))(target))
        expected = float(np.mean(mask_iou(estimate_masks(*alike, mask), mask)[1:]))
        assert value(scores, CODEC_TRUTH, robot, "mask_iou") == pytest.approx(expected, rel=1e-5)
    summary = summarize_robots(scores)
    means = summary.means.set_index(["robot", "model", "metric"])
    for robot in ROBOTS:
        through_codec, softened = (means.loc[(robot, model, "mask_iou"), "mean"] for model in (CODEC_TRUTH, "ground_truth"))
        assert means.loc[(robot, "late", "mask_iou"), "noise"] == pytest.approx(1 - through_codec) != 1 - softened
        assert means.loc[(robot, "ground_truth", "mask_iou"), "noise"] == pytest.approx(1 - softened)
        assert means.loc[(robot, "late", "psnr"), "noise"] == 0
    assert key in summary.floors and summary.floors in (rollouts.parent / "scores.summary.md").read_text()
    assert "after a blur" in describe_floors(["late"], {})
    alone = summarize_robots(grade(rollouts, data, codec=(Path("runs/late"),), **codec | {"baselines": False}))
    pairs = alone.pairs[alone.pairs["metric"] == "mask_iou"].set_index("robot")
    assert set(pairs["other"]) == {CODEC_TRUTH}, "the true video was not graded"
    for robot in ROBOTS:
        assert pairs.loc[robot, "noise"] == means.loc[(robot, "late", "mask_iou"), "noise"]
    with pytest.raises(SystemExit):
        grade(rollouts, data, codec=(Path("runs/early"),), **codec)
    assert "of 'early', and no graded rollout was made with its codec; graded are late" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("runs", "digests", "floors"),
    [
        (("late",), (None, "halved"), {"late", "later"}),
        (("late",), ("halved", "halved"), {"late", "later"}),
        (("late", "later"), (None, None), {"late", "later"}),
        (("other", "late"), ("halved", "halved"), {"late", "later"}),
        (("late",), (None, "third"), {"late"}),
        (("other-third",), ("halved", "third"), {"later"}),
        (("late", "later-third"), ("halved", "third"), {"late", "later"}),
    ],
)
def test_models_with_one_codec_have_its_floor(
    runs: tuple[str, ...],
    digests: tuple[str | None, str | None],
    floors: set[str],
    data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By the digest that rollouts say, or else by the name of the run; the truth goes once through each codec."""
    monkeypatch.setattr(codecs, "OPENER", f"{__name__}:Halved")
    for model, digest in zip(("late", "later"), digests, strict=True):
        header = {"model": model} | ({"codec": digest} if digest else {})
        write_rollout(tmp_path / model, TASK, SEED, ROBOTS[0], late(truth(data, ROBOTS[0])), header)
    out, named = tmp_path / "scores.parquet", tuple(map(Path, runs))
    main(Args((tmp_path / "late", tmp_path / "later"), data, out, metrics=("psnr",), baselines=False, codec=named))
    scores = pd.read_parquet(out)
    through = scores[scores["model"] == CODEC_TRUTH]["condition"]
    assert set(scores.attrs["codecs"]) == floors and through.is_unique
    assert set(through) == {key for keys in scores.attrs["codecs"].values() for key in keys}


def test_a_model_has_one_codec(
    rollouts: Path, data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codecs, "OPENER", f"{__name__}:Halved")
    for robot, digest in zip(ROBOTS, ("halved", "third"), strict=True):
        header = {"model": "late", "codec": digest}
        write_rollout(rollouts, TASK, SEED, robot, late(truth(data, robot)), header)
    with pytest.raises(SystemExit):
        grade(rollouts, data, codec=(Path("late"), Path("other-third")))
    assert "rollouts of 'late' were made with two codecs of --codec" in capsys.readouterr().err


def test_baselines_are_graded_before_there_is_a_model(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codecs, "OPENER", f"{__name__}:Halved")
    codec = {"metrics": ("psnr",)}
    alone = tmp_path / "baselines.parquet"
    main(Args((), data, alone, baselines_of="test", codec=(Path("configs/any"),), max_frames=ASKED, **codec))
    scores = pd.read_parquet(alone)
    assert set(scores["model"]) == {*BASELINES, CODEC_TRUTH} and set(scores["frames"]) == {ASKED}
    assert "codecs" not in scores.attrs, "no model is there whose floor it would be"
    root = tmp_path / "rollouts"
    write_rollout(root, TASK, SEED, ROBOTS[0], late(truth(data, ROBOTS[0]))[:ASKED], {"model": "late", "condition": "none"})
    capsys.readouterr()
    beside = grade(root, data, codec=(Path("runs/late"),), baselines=True, **codec)
    assert f"{len(BASELINES) + 1} of {len(BASELINES) + 2} are graded already" in capsys.readouterr().out
    own = scores[scores["robot"] == ROBOTS[0]].set_index(["model", "condition"])["value"]
    assert own.sort_index().equals(beside[beside["model"] != "late"].set_index(["model", "condition"])["value"].sort_index())


def test_all_four_dimensions_with_baselines_by_default(rollouts: Path, data: Path) -> None:
    """A model that is a frame late lies between the frozen first frame and the truth, by every metric that says how far."""
    main(Args((rollouts,), data, rollouts.parent / "scores.parquet"))
    scores = pd.read_parquet(rollouts.parent / "scores.parquet")
    assert set(scores["model"]) == {"late", *BASELINES}
    whole = scores[scores["model"] != OTHER_ROBOT]  # of which no keypoint may be found where this robot's are
    assert set(whole["metric"]) == set(WITHOUT_OUTCOME) - UNDEFINED
    assert len(whole) == len(BASELINES) * len(ROBOTS) * (len(WITHOUT_OUTCOME) - len(UNDEFINED))
    described = scores.attrs["metrics"]
    assert list(described) == list(WITHOUT_OUTCOME), "all commands succeed"
    assert {info["dimension"] for info in described.values()} == {"visual", "morphology", "kinematics", "objects"}
    for robot in ROBOTS:
        for name, info in described.items():
            if name in UNDEFINED | NOT_BY_DELAY:
                continue
            frozen, model, perfect = (value(scores, m, robot, name) for m in ("copy_first_frame", "late", "ground_truth"))
            sign = 1 if info["higher_is_better"] else -1
            assert sign * frozen < sign * model < sign * perfect, (robot, name)
        for name, best in (("ssim", 1), ("lpips", 0), ("region_lpips", 0), ("robot_lpips", 0)):
            assert value(scores, "ground_truth", robot, name) == best
        assert value(scores, "ground_truth", robot, "mask_iou") > 0.95
    exact = scores[scores["model"] == "ground_truth"]["exact_frames"]
    assert set(exact) == {ASKED - 1}


def test_tracks_are_compared_with_what_the_episode_holds(rollouts: Path, data: Path) -> None:
    """With a tracker from outside whose error is known. The last keypoint, and the only object, it never finds."""
    names = tuple(name for name in METRICS if METRICS[name].inputs == "track")
    settings = {"metrics": names, "tracks": f"{__name__}:SHIFTED"}
    scores = grade(rollouts, data, baselines=True, **settings)
    assert scores.attrs["estimators"]["tracks"] == settings["tracks"]
    for robot in ROBOTS:
        states = read_states(episode_folder(data, TASK, SEED, robot))
        seen = states.keypoint_visible[1:ASKED]
        found = seen[:, :-1].sum() / seen.sum()
        assert value(scores, "ground_truth", robot, "coverage") == pytest.approx(found)
        assert value(scores, "ground_truth", robot, "pck") == pytest.approx(found), "what is lost is a miss"
        assert value(scores, "ground_truth", robot, "keypoint_error") == 3, "estimators see the truth softened"
        shifts = (late(truth(data, robot)) != truth(data, robot)).any(axis=(1, 2, 3))[1:ASKED]
        tracks = states.keypoints[1:ASKED] + np.where(shifts, 3, 0)[:, None, None] * np.float32([1, 0])
        expected = float(keypoint_error(tracks[:, :-1], states.keypoints[1:ASKED, :-1], seen[:, :-1]))
        assert value(scores, "late", robot, "keypoint_error") == pytest.approx(expected, rel=1e-5) and expected > 0
        rows = scores[(scores["robot"] == robot) & (scores["metric"] == "trajectory_error")]
        assert rows.empty, "an object that is never found has no error"
        assert value(scores, "late", robot, "object_coverage") == 0
        for model in ("late", "ground_truth"):
            assert value(scores, model, robot, "object_coverage_strict") == 0
            assert value(scores, model, robot, "trajectory_error_strict") == pytest.approx(failure_distance(), rel=1e-5)
            assert value(scores, model, robot, "coverage_strict") == 1, "of all points on surfaces the last is the object's"


def test_a_gray_video_is_worst_in_the_strict_suite_and_missing_in_the_papers(data: Path, tmp_path: Path) -> None:
    """The estimators find nothing in it, which the paper's errors leave out."""
    for robot in ROBOTS:
        target = truth(data, robot)
        gray = np.concatenate([target[:1], np.full_like(target[1:], 128)])
        write_rollout(tmp_path / "rollouts", TASK, SEED, robot, gray, {"model": "gray", "condition": "none"})
    names = tuple(name for name in METRICS if METRICS[name].inputs == "track")
    scores = grade(tmp_path / "rollouts", data, metrics=names, baselines=True)
    gray = scores[scores["model"] == "gray"]
    lost = {name for name in names if name.endswith("_found")} | {"keypoint_error", "trajectory_error"}
    assert not lost & set(gray["metric"])
    failures = ("keypoint_error_strict", "trajectory_error_strict")
    worst = dict.fromkeys(failures, failure_distance()) | dict.fromkeys(("ndtw", "ndtw_strict"), 0.5)
    for name in set(names) - lost - UNDEFINED:
        for robot in ROBOTS:
            assert value(scores, "gray", robot, name) == pytest.approx(worst.get(name, 0), rel=1e-5)


def test_suites_are_chosen_and_named_in_the_table(rollouts: Path, data: Path, capsys: pytest.CaptureFixture) -> None:
    names = ("psnr", "pck", "pck_strict")
    for suite, chosen in ((("paper",), ["psnr", "pck"]), (("strict",), ["psnr", "pck_strict"]), (Args.suite, list(names))):
        scores = grade(rollouts, data, metrics=names, suite=suite, tracks=f"{__name__}:EXACT", overwrite=True)
        assert list(scores.attrs["metrics"]) == chosen and set(scores["metric"]) == set(chosen)
        assert ("shapes of 2 of 2 episodes are not known" in capsys.readouterr().out) == ("pck_strict" in chosen)
    suites = {name: info["suites"] for name, info in scores.attrs["metrics"].items()}
    assert suites == {"psnr": ["paper", "strict"], "pck": ["paper"], "pck_strict": ["strict"]}


def test_only_what_moves_counts_among_objects(data: Path, tmp_path: Path) -> None:
    """A disc that stays where it is gives strict metrics of objects nothing to grade, for any prediction."""
    folder = episode_folder(data, TASK, SEED, "piper")
    read = read_truth(folder, FRAMES, ("object_points",))
    assert read.surfaces is not None and not read.surfaces.known and read.surfaces.objects.visible.shape == (FRAMES, 1)
    states = read_states(folder)
    still = replace(states, object_pose=np.repeat(states.object_pose[:1], FRAMES, axis=0))
    write_episode(tmp_path, read_record(folder), still, read.rgb, read_video(folder / "robot.mkv"))
    read = read_truth(episode_folder(tmp_path, TASK, SEED, "piper"), FRAMES, ("object_points",))
    assert read.surfaces is not None and read.surfaces.objects.visible.shape == (FRAMES, 0)
    grades = grade_one(
        Comparison(late(read.rgb), EpisodeCache(read), estimate_masks, exact), ("trajectory_error_strict", "pck_strict")
    )
    assert np.isnan(grades.values["trajectory_error_strict"]) and grades.values["pck_strict"] == 1
    with pytest.raises(ValueError, match="no points on surfaces; ask read_truth"):
        grade_one(Comparison(read.rgb, EpisodeCache(replace(read, surfaces=None)), estimate_masks, exact), ("pck_strict",))


def test_on_a_gpu_a_video_is_put_once_for_all_metrics_and_the_truth_once_for_all_predictions(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = episode_folder(data, TASK, SEED, "piper")
    names = ("psnr", "ssim", "lpips", "robot_lpips", "flicker", "flicker_robot", "ghosts")
    read = read_truth(folder, FRAMES, {"video", "robot", "bodies"})
    videos = late(read.rgb), late(late(read.rgb))
    episode = EpisodeCache(read)
    expected = [grade_one(Comparison(video, episode, estimate_masks, exact), names).values for video in videos]
    put: list[tuple[int, ...]] = []
    passes: list[bool] = []
    on_device, layers = jax.device_put, perceptual._layers
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr("xew.metrics.episode_cache.ACCELERATOR_CHUNK", FRAMES)  # a CPU takes long for 64
    monkeypatch.setattr(jax, "device_put", lambda array: put.append(array.shape) or on_device(array))
    monkeypatch.setattr(perceptual, "_layers", lambda *given: passes.append(True) or layers(*given))
    episode = EpisodeCache(read)
    for video, values, puts, masks, through in zip(videos, expected, (2, 1), (2, 0), (2, 1), strict=True):
        put.clear()
        passes.clear()
        assert grade_one(Comparison(video, episode, estimate_masks, exact), names).values == pytest.approx(values, rel=1e-4)
        assert len([shape for shape in put if len(shape) == 4]) == puts
        assert len([shape for shape in put if len(shape) == 3]) == masks, "of the robot and of all bodies"
        assert len(passes) == through, "through LPIPS's network, for two metrics"


def test_projected_objects_lie_where_they_are_drawn(data: Path) -> None:
    """The disc is the one thing that moves besides the robot; its color is at its projected center wherever that is free.
    What is put on a thing at rest hides it."""
    read = read_truth(episode_folder(data, TASK, SEED, "piper"), FRAMES, ("objects",))
    assert read.objects.shape == (FRAMES, 1, 2) and read.object_visible[0, 0]
    colors = [
        read.rgb[t, round(float(y)), round(float(x))]
        for t, ((x, y),) in enumerate(read.objects.tolist())
        if read.object_visible[t, 0]
    ]
    assert len(colors) > 1 and (np.array(colors) == colors[0]).all()
    assert not read.object_visible[-1, 0] and read.mask[-1][tuple(np.round(read.objects[-1, 0, ::-1]).astype(int))]
    rgb, points = read.rgb.copy(), np.repeat(read.objects[:1], FRAMES, axis=0)
    rgb[:] = rgb[0]
    assert _find_visible(points, rgb, np.zeros(rgb.shape[:3], bool)).all()
    x, y = np.round(points[0, 0]).astype(int)
    rgb[5:, y - 4 : y + 5, x - 4 : x + 5] = 0
    assert _find_visible(points, rgb, np.zeros(rgb.shape[:3], bool))[:, 0].tolist() == [t < 5 for t in range(FRAMES)]
    behind, _ = project(np.array([[0.0, 0.0, -1.0]]), np.eye(3), np.eye(4))
    assert np.isnan(behind).all()


def test_an_undefined_metric_has_no_row_and_the_rest_stands(rollouts: Path, data: Path, tmp_path: Path) -> None:
    """A robot that is never seen: it has no region and no keypoint."""
    folder = episode_folder(data, TASK, SEED, "piper")
    states = read_states(folder)
    mask = np.zeros_like(states.robot_mask)
    hidden = replace(states, robot_mask=mask, keypoint_visible=np.zeros_like(states.keypoint_visible))
    write_episode(tmp_path / "data", read_record(folder), hidden, truth(data, "piper"), read_video(folder / "robot.mkv"))
    shutil.rmtree(episode_folder(rollouts, TASK, SEED, "franka_panda"))
    scores = grade(rollouts, tmp_path / "data", metrics=("psnr", "region_lpips", "pck", "coverage"))
    assert scores["metric"].tolist() == ["psnr"]
    assert scores["value"].notna().all()


def test_the_region_of_a_robot_all_over_the_frame_is_the_frame(data: Path) -> None:
    """What is then taken from LPIPS is, to the bit, what region LPIPS computes alone; of a smaller region it is not taken."""
    read = read_truth(episode_folder(data, TASK, SEED, "piper"), 4, ("region",))
    corners = read.mask.copy()
    corners[1, 0, 0] = corners[2, -1, -1] = True
    for mask, same in ((corners, True), (read.mask & (np.arange(240) > 90)[:, None], False)):
        comparison = Comparison(late(read.rgb), EpisodeCache(replace(read, mask=mask)), estimate_masks, shifted)
        both = grade_one(comparison, ("lpips", "region_lpips")).curves
        alone = grade_one(comparison, ("region_lpips",)).curves["region_lpips"]
        assert both["region_lpips"].tobytes() == alone.tobytes()
        assert (both["region_lpips"].tobytes() == both["lpips"].tobytes()) == same


def test_curves_hold_every_predicted_frame_and_average_to_the_scores(rollouts: Path, data: Path) -> None:
    scores = grade(rollouts, data)
    curves = pd.read_parquet(rollouts.parent / "scores.curves.parquet")
    assert sorted(set(curves["frame"])) == list(range(1, ASKED))
    means = curves.groupby(["robot", "metric"])["value"].mean()
    for row in scores.itertuples():
        assert means[row.robot, row.metric] == pytest.approx(row.value, rel=1e-6)


def test_curves_of_tracks_are_the_metric_of_each_frame(rollouts: Path, data: Path) -> None:
    grade(rollouts, data, metrics=("pck", "keypoint_error", "ndtw", "coverage"), tracks=f"{__name__}:SHIFTED")
    curves = pd.read_parquet(rollouts.parent / "scores.curves.parquet").set_index(["robot", "metric", "frame"])["value"]
    for robot in ROBOTS:
        moved = (late(truth(data, robot)) != truth(data, robot)).any(axis=(1, 2, 3))
        for frame in range(1, ASKED):
            assert curves[robot, "keypoint_error", frame] == pytest.approx(3 * moved[frame])
            assert 0 < curves[robot, "coverage", frame] < 1
        assert (robot, "ndtw") not in curves.index.droplevel("frame")


def test_a_rollout_made_anew_replaces_its_scores(rollouts: Path, data: Path) -> None:
    before = grade(rollouts, data)
    write_rollout(rollouts, TASK, SEED, "piper", truth(data, "piper")[:ASKED], {"model": "late", "condition": "none"})
    after = grade(rollouts, data)
    assert len(after) == len(before)
    assert value(after, "late", "piper", "ssim") == 1 > value(before, "late", "piper", "ssim")
    assert value(after, "late", "franka_panda", "ssim") == value(before, "late", "franka_panda", "ssim")


def test_missing_episodes_trees_and_metrics_are_named(
    rollouts: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    for settings, word in (
        ({"data": tmp_path / "nowhere"}, "does not hold"),
        ({"metrics": ("psrn",)}, "did you mean 'psnr'"),
        ({"metrics": ("pck",), "suite": ("strict",)}, "no metric of pck is of the suites strict"),
        ({"suite": ("stric",)}, "did you mean 'strict'"),
        ({"masks": "sam3"}, "did you mean 'sam2'"),
        ({"masks": "sam2"}, "--masks-checkpoint"),
        ({"tracks_checkpoint": tmp_path / "none.pth"}, "does not exist"),
        ({"frame_zero": "predicted", "baselines": True}, "--no-baselines"),
        ({"baselines_of": "test", "baselines": True}, "leave out the rollouts"),
        ({"out": tmp_path / "scores.csv"}, ".parquet"),
    ):
        arguments = {"rollouts": rollouts, "data": data} | settings
        with pytest.raises(SystemExit):
            grade(arguments.pop("rollouts"), arguments.pop("data"), **arguments)
        assert word in capsys.readouterr().err
    with pytest.raises(SystemExit):
        grade(tmp_path / "empty", data)
    assert "xew.model.rollout" in capsys.readouterr().err


def test_kinds_of_motion_are_not_graded_together(
    rollouts: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    mixed = tmp_path / "mixed"
    shutil.copytree(data, mixed)
    header = episode_folder(mixed, TASK, SEED, "piper") / "episode.json"
    header.write_text(json.dumps(json.loads(header.read_text()) | {"motion": "own"}))
    with pytest.raises(SystemExit):
        grade(rollouts, mixed, metrics=("psnr",))
    message = capsys.readouterr().err
    assert "episodes of shared motion (1) and of own motion (1)" in message
    assert grade(rollouts, data, metrics=("psnr",)).attrs["motion"] == "shared"


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


def test_the_page_shows_what_works(data: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "evaluate.md").read_text()
    options = {field.name.replace("_", "-") for field in fields(Args)}
    assert {name.removeprefix("no-") for name in re.findall(r"--([a-z][a-z-]+)", text)} <= options
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    folder = episode_folder(data, TASK, SEED, "piper")
    code = code.replace("data/place_empty_cup/1000000/piper", str(folder)).replace("121", str(FRAMES))
    names: dict[str, object] = {"Path": Path, "video": late(truth(data, "piper"))}
    exec(code, names)
    assert set(names["grades"].values) == {"lpips", "mask_iou", "pck"}

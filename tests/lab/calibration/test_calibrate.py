"""Calibration: wrong renderings are wrong as they say, and the tables would show an estimator that errs."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lab.calibration.calibrate import (
    ESTIMATED,
    Args,
    choose,
    find_another,
    main,
    motion_table,
    order_table,
    reference_videos,
    true_grades,
)
from lab.calibration.perturbations import MOTIONS, Perturbation, render_perturbations
from lab.calibration.predictors import APPEARANCES
from tests.sim_warp.small import TASK
from tests.synthetic import write_synthetic_data
from xew.config import ConfigError
from xew.dataset import find_accepted
from xew.episode import Record, read_pixels, read_record, read_states, read_video
from xew.metrics import METRICS
from xew.metrics.grading.codecs import ModelCodec
from xew.metrics.truth import NEEDS, read_truth
from xew.protocol import join_fault


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots, two seeds, seven frames."""
    root = tmp_path_factory.mktemp("data")
    write_synthetic_data(root, seeds=(0, 1), robots=("franka_panda", "piper"), frames=7)
    return root


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An episode of the simulation, twelve frames."""
    from tests.sim_warp.small import produce
    from xew.sim_warp.production.cells import Job
    from xew.sim_warp.rendering.render import Renderer

    root = tmp_path_factory.mktemp("simulated")
    produce([Job(TASK, 1, ("piper",))], root, Renderer("cpu"))
    return find_accepted(root)[0][0]


def test_wrong_renderings_are_wrong_as_they_say(simulated: Path) -> None:
    shown = dict(render_perturbations(simulated))
    truth, states = read_video(simulated / "rgb.mkv"), read_states(simulated)
    assert list(shown) == list(MOTIONS)
    np.testing.assert_array_equal(shown["as recorded"].rgb, truth)
    np.testing.assert_array_equal(shown["as recorded"].mask, states.robot_mask)
    np.testing.assert_allclose(shown["as recorded"].keypoints, states.keypoints, atol=1e-3)
    late = np.maximum(np.arange(len(truth)) - 3, 0)
    np.testing.assert_array_equal(shown["3 frames late"].rgb, truth[late])
    np.testing.assert_array_equal(shown["frozen"].rgb, truth[np.zeros_like(late)])
    for video in shown.values():
        np.testing.assert_array_equal(video.rgb[0], truth[0])
    off = [np.abs(shown[f"joints off by {angle} rad"].keypoints - states.keypoints)[1:].mean() for angle in (0.05, 0.12)]
    assert 1 < off[0] < off[1]


def test_a_truth_that_was_kept_is_the_same_without_rendering(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = read_truth(simulated, 12, ("robot_points",), tmp_path)
    monkeypatch.setattr("xew.sim_warp.production.surfaces.track_surfaces", None)  # would be called to render
    again = read_truth(simulated, 12, ("robot_points",), tmp_path)
    assert first.surfaces is not None and first.surfaces.known and again.surfaces is not None
    for one, other in ((first.surfaces.robot, again.surfaces.robot), (first.surfaces.objects, again.surfaces.objects)):
        np.testing.assert_array_equal(one.pixels, other.pixels)
        np.testing.assert_array_equal(one.visible, other.visible)


def test_motions_leave_what_they_do_not_touch(data: Path) -> None:
    states = read_states(find_accepted(data)[0][0])
    biased = MOTIONS["joints off by 0.12 rad"](states)
    changed = (biased.joint_pos != states.joint_pos).any(axis=0)
    np.testing.assert_array_equal(np.flatnonzero(changed), [0, 1, 8, 9])  # two joints an arm; never a gripper
    np.testing.assert_array_equal(biased.object_pose, states.object_pose)


def test_half_the_motion_is_half_of_it(data: Path) -> None:
    states = read_states(find_accepted(data)[0][0])
    turn = np.linspace(0, 1.2, len(states.joint_pos))
    pose = states.object_pose.copy()
    pose[:, 0, 3:] = np.stack([0 * turn, 0 * turn, np.sin(turn / 2), np.cos(turn / 2)], axis=-1)
    states = replace(states, object_pose=pose)
    half = MOTIONS["half the motion"](states)
    np.testing.assert_allclose(half.joint_pos, (states.joint_pos + states.joint_pos[0]) / 2, atol=1e-6)
    np.testing.assert_allclose(half.object_pose[..., :3], (pose[..., :3] + pose[0, :, :3]) / 2, atol=1e-6)
    np.testing.assert_allclose(2 * np.arctan2(half.object_pose[:, 0, 5], half.object_pose[:, 0, 6]), turn / 2, atol=1e-5)


def test_true_grades_take_the_known_truth_and_not_an_estimate(data: Path) -> None:
    folder, record = find_accepted(data)[0]
    truth = read_truth(folder, record.frame_count, NEEDS)
    same = Perturbation(np.zeros_like(truth.rgb), truth.mask, truth.keypoints, truth.objects)
    values = true_grades(same, truth).values
    assert set(values) == set(ESTIMATED)
    assert values["mask_iou"] == values["boundary_f1"] == values["pck"] == values["coverage"] == 1
    assert values["keypoint_error"] == values["trajectory_error"] == 0
    off = Perturbation(same.rgb, np.roll(truth.mask, 5, axis=2), truth.keypoints + 3, truth.objects + np.float32([0, 4]))
    values = true_grades(off, truth).values
    assert values["mask_iou"] < 0.9 and values["boundary_f1"] < 0.9
    assert values["keypoint_error"] == pytest.approx(3 * np.sqrt(2), rel=1e-5)
    assert values["trajectory_error"] == pytest.approx(4, rel=1e-5)


class Inverse:
    """A codec of a model whose decoder reads the render of the episode's commands."""

    model, digest = "inverse", "inverse"

    def __call__(self, video: np.ndarray, episode: Path) -> np.ndarray:
        assert read_pixels(episode, "robot").shape == video.shape
        return 255 - video


def test_references_are_what_they_are_called(data: Path) -> None:
    episodes = find_accepted(data)
    folder, record = episodes[0]
    truth = read_truth(folder, record.frame_count, NEEDS)
    videos = dict(reference_videos(episodes, episodes[0], truth, ModelCodec(Inverse(), "inverse", Path("run"))))
    assert set(APPEARANCES) <= set(videos) and {len(video) for video in videos.values()} == {len(truth.rgb)}
    np.testing.assert_array_equal(videos["truth through the codec"], 255 - truth.rgb)
    np.testing.assert_array_equal(videos["frozen first frame"], np.repeat(truth.rgb[:1], len(truth.rgb), axis=0))
    others = {name: read_record(find_another(episodes, record, name.split()[1])) for name in ("another robot", "another seed")}
    assert (others["another robot"].robot, others["another robot"].seed) == ("piper", 0)
    assert (others["another seed"].robot, others["another seed"].seed) == ("franka_panda", 1)


def test_without_others_nothing_is_made_up(tmp_path: Path) -> None:
    write_synthetic_data(tmp_path, seeds=(0,), robots=("piper",), frames=3)
    episodes = find_accepted(tmp_path)
    record = episodes[0][1]
    assert find_another(episodes, record, "robot") is None and find_another(episodes, record, "seed") is None


def wrong_rows(estimates: list[float], truths: list[float]) -> pd.DataFrame:
    key = {"task": "t", "seed": 0, "robot": "r", "metric": "mask_iou"}
    pairs = enumerate(zip(estimates, truths, strict=True))
    return pd.DataFrame([key | {"case": f"case {i}", "estimate": e, "truth": t} for i, (e, t) in pairs])


def test_a_wrong_order_shows() -> None:
    """Six pairs, one of which is too near to have an order."""
    right = order_table(wrong_rows([0.9, 0.71, 0.7, 0.2], [1.0, 0.7, 0.698, 0.1]))
    wrong = order_table(wrong_rows([0.9, 0.71, 0.7, 0.8], [1.0, 0.7, 0.698, 0.1]))
    column = "pairs of an episode's videos in order"
    assert (right.loc["mask_iou", column], wrong.loc["mask_iou", column]) == ("5 of 5", "3 of 5")


def test_frames_are_told_by_their_motion() -> None:
    key = {"task": "t", "seed": 0, "robot": "r", "case": "c", "metric": "keypoint_error"}
    rows = [(1, 1.5, 1.0, 1.0), (2, 0.5, 1.0, 1.0), (3, 35.0, 30.0, 30.0)]
    frames = pd.DataFrame([key | dict(zip(("frame", "estimate", "truth", "motion"), row, strict=True)) for row in rows])
    table = motion_table(frames)
    assert table["frames"].to_dict() == {"0.5 to 2 px": "2", "20 to 40 px": "1"}
    assert table["keypoint_error"].to_dict() == {"0.5 to 2 px": "+0.000 (0.500)", "20 to 40 px": "+5.000 (5.000)"}


def test_the_command_writes_its_tables(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Synthetic episodes cannot be rendered; here a wrong video is one that stands still from the middle on."""

    def stopped(folder: Path) -> list[tuple[str, Perturbation]]:
        shown = np.minimum(np.arange(7), 3)
        states, video = read_states(folder), read_video(folder / "rgb.mkv")[shown]
        truth = read_truth(folder, 7, NEEDS)
        right = Perturbation(read_video(folder / "rgb.mkv"), truth.mask, truth.keypoints, truth.objects)
        return [
            ("right", right),
            ("stopped", Perturbation(video, states.robot_mask[shown], states.keypoints[shown], truth.objects[shown])),
        ]

    monkeypatch.setattr("lab.calibration.calibrate.render_perturbations", stopped)
    monkeypatch.setattr("lab.calibration.calibrate.METRICS", {name: METRICS[name] for name in METRICS if "lpips" not in name})
    main(Args(data=data, out=tmp_path / "out", seeds=(1,), episodes=1))
    text = (tmp_path / "out" / "calibration.md").read_text()
    assert "| stopped |" in text and "| another seed |" in text
    wrong = pd.read_parquet(tmp_path / "out" / "wrong.parquet").set_index(["case", "metric"])
    right = wrong.loc["right"]
    assert (right.loc["mask_iou", "estimate"] > 0.97) and right.loc["mask_iou", "truth"] == 1
    assert wrong.loc[("stopped", "mask_iou"), "estimate"] == pytest.approx(
        wrong.loc[("stopped", "mask_iou"), "truth"], abs=0.03
    )
    assert pd.read_parquet(tmp_path / "out" / "frames.parquet")["frame"].nunique() == 6


def test_a_seed_that_there_is_not_is_said(data: Path) -> None:
    with pytest.raises(ConfigError, match="holds no seed 7; it has 0, 1"):
        choose(find_accepted(data), Args(data=data, seeds=(7,)))
    first = choose(find_accepted(data), Args(data=data, episodes=2))
    assert {(record.seed, record.robot) for _, record in first} == {(0, "franka_panda"), (1, "piper")}


def test_predictors_may_be_chosen(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = Args(data=data, out=tmp_path, episodes=1, predictors=True, metrics=("psnr",))
    main(replace(args, cases=("gray", "frozen")))
    assert pd.read_parquet(tmp_path / "predictors.parquet")["case"].tolist() == ["gray", "frozen"]
    with pytest.raises(SystemExit):
        main(replace(args, cases=("frozn",)))
    assert "unknown predictor 'frozn'; did you mean 'frozen'?" in capsys.readouterr().err


def test_calibration_reads_validation_seeds_and_no_test_seed_unless_it_is_named() -> None:
    def chosen(*seeds: int, **named: tuple[int, ...]) -> set[int]:
        episodes = [(Path(str(seed)), Record("lift_pot", seed, "piper", True)) for seed in seeds]
        return {record.seed for _, record in choose(episodes, Args(**named))}

    assert chosen(0, 800_000, 1_000_000) == {800_000} and chosen(0, 1_000_000) == {0}
    assert chosen(0, 1_000_000, seeds=(1_000_000,)) == {1_000_000}
    with pytest.raises(ConfigError, match=r"test seeds alone.*--validation-seeds 4"):
        chosen(1_000_000)


def test_the_first_episodes_are_of_many_tasks_and_robots() -> None:
    seeds = (0, 1, join_fault(3, 0), join_fault(5, 1))
    cells = [(task, seed, robot) for task in ("a", "b", "c") for seed in seeds for robot in ("x", "y")]
    episodes = [(Path("/".join(map(str, cell))), Record(*cell, success=True)) for cell in cells]
    first = [(record.task, record.robot, record.seed) for _, record in choose(episodes, Args(episodes=6))]
    assert first[:3] == [("a", "x", 0), ("b", "y", join_fault(3, 0)), ("c", "x", 0)]
    assert {pair[:2] for pair in first} == {(task, robot) for task in "abc" for robot in "xy"}
    assert len(choose(episodes, Args())) == len(cells)


def test_the_command_loads_neither_simulation_nor_model() -> None:
    code = "import sys, lab.calibration.calibrate; "
    code += "sys.exit(any(m in sys.modules for m in ('warp', 'newton', 'flax', 'xew.model')))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0

"""Predictors made on purpose: they are wrong as they say, and the strict metrics put them in the right order."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.synthetic import draw_disc, project, sample_scene, write_synthetic_data
from xew.dataset import find_accepted
from xew.episode import read_states, read_video
from xew.metrics import METRICS
from xew.metrics.backends import open_masker, open_tracker
from xew.metrics.calibrate import find_another
from xew.metrics.calibration.matrix import expected_order, grade_predictors, matrix, order_violations, to_markdown
from xew.metrics.calibration.predictors import BELOW, PREDICTORS, Material, erase_objects, hold_objects, predict, soften
from xew.metrics.truth import MOVED

TASK, SEED, FRAMES = "place_empty_cup", 1_000_000, 17
CHEAP = tuple(name for name, metric in METRICS.items() if metric.inputs in ("video", "track") and name != "lpips")
"""Metrics that the test grades; those of masks and LPIPS take minutes, and stand in the table of docs/metrics.md."""
ORDERED = ("psnr", "ssim", "pck_strict", "keypoint_error_strict", "trajectory_error_strict")


def without_disc(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The synthetic episode with its disc at rest, and with none once it has moved."""
    scene = sample_scene(TASK, SEED, FRAMES)
    mask, rgb = read_states(folder).robot_mask, read_video(folder / "rgb.mkv")
    moved = np.linalg.norm(scene.disc - scene.disc[:1], axis=-1) > MOVED
    at_rest = draw_disc(scene.ground, project(scene.disc[0]), scene.disc_color)
    empty = np.where(moved[:, None, None, None], scene.ground, at_rest)
    still, erased = (np.where(mask[..., None], rgb, scenery).astype(np.uint8) for scenery in (at_rest, empty))
    return still, erased


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> list:
    root = tmp_path_factory.mktemp("data")
    write_synthetic_data(root, tasks=(TASK,), seeds=(SEED,), robots=("franka_panda", "piper"), frames=FRAMES)
    return find_accepted(root)


@pytest.fixture(scope="module")
def rows(episodes: list) -> pd.DataFrame:
    folder, record = episodes[1]
    other = find_another(episodes, record, "robot")
    estimators = open_masker("default"), open_tracker("default")
    return pd.DataFrame(grade_predictors(folder, record, other, *estimators, CHEAP, without_disc))


def test_every_predictor_has_every_strict_score(rows: pd.DataFrame) -> None:
    strict = rows[rows["metric"].map(lambda name: "strict" in METRICS[name].suites)]
    assert strict["value"].notna().all() and set(strict["case"]) == set(PREDICTORS)
    lost = rows[rows["case"].isin(["gray", "black", "noise"]) & rows["metric"].isin(["keypoint_error", "trajectory_error"])]
    assert lost["value"].isna().any(), "the paper's errors say nothing of what is lost"


@pytest.mark.parametrize("name", ORDERED)
def test_strict_metrics_put_predictors_in_order(name: str, rows: pd.DataFrame) -> None:
    table = matrix(rows)
    assert order_violations(table)[name] == [], table.loc[name].to_dict()


def test_erasing_an_object_is_worse_than_leaving_it_where_it_was(rows: pd.DataFrame) -> None:
    table = matrix(rows)
    assert table.loc["trajectory_error_strict", "object erased"] > table.loc["trajectory_error_strict", "object at rest"] > 5
    assert table.loc["psnr", "2 frames late"] > table.loc["psnr", "gray"]


def test_a_wrong_order_is_named() -> None:
    table = pd.DataFrame({"truth": [0.9, 1.0], "codec": [0.8, 2.0], "gray": [0.85, np.nan]}, ["ssim", "keypoint_error"])
    wrong = order_violations(table)
    assert wrong == {"ssim": [], "keypoint_error": []}, "steps that do not follow one another are not compared"
    swapped = table.rename(columns={"truth": "codec", "codec": "truth"})
    assert order_violations(swapped)["ssim"] == order_violations(swapped)["keypoint_error"] == [("truth", "codec")]
    missing = table.rename(columns={"codec": "frozen"})
    assert order_violations(missing)["keypoint_error"] == [("frozen", "gray")], "no score is no order"
    assert ("object at rest", "object erased") in expected_order(objects=True)
    text = to_markdown(missing)
    assert "| keypoint_error | paper | 1 | 2 | - | frozen, gray |" in text


def test_predictors_are_what_they_are_called() -> None:
    rng = np.random.default_rng(4)
    coarse = np.repeat(np.repeat(rng.integers(0, 256, (12, 4, 6, 3), dtype=np.uint8), 16, axis=1), 16, axis=2)
    material = Material(soften(coarse, 2), other_robot=255 - coarse)
    videos = {name: predict(name, material) for name in PREDICTORS}
    assert videos["object at rest"] is None and videos["object erased"] is None
    truth = material.truth
    for name, video in videos.items():
        if video is not None:
            assert video.shape == truth.shape and video.dtype == np.uint8, name
            np.testing.assert_array_equal(video[0], truth[0], err_msg="the given frame")
    np.testing.assert_array_equal(videos["2 frames late"][3:], truth[1:-2])
    np.testing.assert_array_equal(videos["frozen"], np.repeat(truth[:1], 12, axis=0))
    assert sorted(frame.tobytes() for frame in videos["shuffled"]) == sorted(frame.tobytes() for frame in truth)
    assert (videos["shuffled"] != truth).any()
    np.testing.assert_array_equal(videos["mirrored"][1:, :, 0], truth[1:, :, -1])
    off = {name: np.abs(videos[name][1:].astype(int) - truth[1:]).mean() for name in ("truth", "codec", "blur", "noise")}
    assert 0 < off["truth"] < off["blur"] and 0 < off["codec"] < 0.3 * off["noise"]


def test_objects_are_held_or_taken_away_from_where_they_begin_to_move(episodes: list) -> None:
    states = read_states(episodes[0][0])
    held, gone = hold_objects(states), erase_objects(states)
    assert (held.object_pose == states.object_pose[0]).all() and (held.joint_pos == states.joint_pos).all()
    moved = np.linalg.norm(states.object_pose[..., :3] - states.object_pose[:1, :, :3], axis=-1) > MOVED
    assert moved.any() and not moved[0].any()
    assert ((gone.object_pose[..., 2] == BELOW) == np.logical_or.accumulate(moved, axis=0)).all()
    hinged = replace(states, object_joint=np.linspace(0, 1, FRAMES, dtype=np.float32)[:, None])
    assert (erase_objects(hinged).object_pose[1:, 0, 2] == BELOW).all()

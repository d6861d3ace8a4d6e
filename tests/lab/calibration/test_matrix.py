"""Predictors made on purpose: they are wrong as they say, and the strict metrics put them in the right order."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lab.calibration.calibrate import appearance_table, as_markdown, reference_table
from lab.calibration.matrix import OWN_PAIRS, expected_order, grade_material, matrix, order_violations, to_markdown
from lab.calibration.predictors import (
    BELOW,
    PREDICTORS,
    Material,
    erase_objects,
    fail_at_end,
    hold_objects,
    open_grippers,
    predict,
    soften,
)
from tests.metrics.test_functions import AT_MOST
from tests.synthetic import write_synthetic_data
from xew.episode import States, read_states
from xew.metrics import METRICS
from xew.metrics.backends import open_masker, open_tracker
from xew.metrics.grading.settings import WITHOUT_OUTCOME
from xew.metrics.truth import MOVED, Points, Surfaces, Truth
from xew.protocol import ARMS, GRADING_PROTOCOL, HELD_OUT_ROBOTS, SEEN_ROBOTS
from xew.sim_warp.tasks import TASKS

FRAMES, HEIGHT, WIDTH = 41, 96, 128
ORDERED = ("keypoint_error_strict", "trajectory_error_strict")
CHEAP = (*ORDERED, "pck_strict", "coverage_strict", "object_coverage_strict", "psnr")
"""Metrics that the test grades; those of masks and networks take longer."""
ROBOT, THING = (34, 26), (15, 13)
"""Width and height [pixels] of the robot, a rectangle, and of the thing that moves, one too."""
MEASURED = Path(__file__).with_name("predictors.parquet")
"""Rows of `calibrate --predictors` on seed 800000 of five tasks, of held-out robots. The attributes say the protocol."""
FURTHER = Path(__file__).with_name("erased.parquet")
"""Object errors of objects at rest and erased on the same seed of the other tasks, with the PiPER (`calibrate --cases`)."""
APPEARANCE = Path(__file__).with_name("appearance.parquet")
"""Rows of the true motion in another exposure or color on the same seed of four tasks, with all five robots."""
ACCEPTANCE_TASKS = ("place_empty_cup", "grab_roller", "open_laptop", "stack_bowls_two")
"""A task of placing, one with two arms, an articulated object, and one of stacking."""
FLOORS = Path(__file__).with_name("floors.parquet")
"""Rows of the true video and of what the packaged codec leaves of it, of five tasks and all five robots."""
WORST = Path(__file__).with_name("worst.parquet")
"""Rows of twelve predictors of one episode, open_laptop with Franka, in which the tracker once erred most."""
NOISE = {"px": 0.5, "": 0.02, "frames": 0, "levels": 0, "dB": 0.1}
"""Distances, by unit, up to which the truth may be from the best score."""
PAGE = Path(__file__).parents[3] / "docs" / "metrics.md"
NOT_ORDERED: dict[str, list[tuple[str, str]]] = {
    "psnr": [("brighter", "every 5th blank"), ("object recolored", "object erased")],
    "flicker": [
        ("8 frames late", "other robot"),
        ("8 frames late", "frozen"),
        ("other robot", "gray"),
        ("frozen", "gray"),
        ("shuffled", "gray"),
        ("grain", "frozen"),
        ("flicker", "frozen"),
        ("jitter", "frozen"),
        ("ghost", "frozen"),
        ("every 5th blank", "frozen"),
        ("grippers open", "frozen"),
    ],
    "flicker_robot": [
        ("2 frames late", "8 frames late"),
        ("8 frames late", "frozen"),
        ("other robot", "gray"),
        ("frozen", "gray"),
        ("shuffled", "gray"),
        ("flicker", "frozen"),
        ("jitter", "frozen"),
        ("every 5th blank", "frozen"),
        ("2 frames late", "8 frames early"),
    ],
    "ghosts": [("every 5th blank", "frozen")],
    "keypoint_error_found": [("8 frames late", "other robot")],
    "coverage_strict": [("8 frames late", "frozen"), ("every 5th blank", "frozen")],
    "gripper_error": [("2 frames late", "8 frames early")],
    "trajectory_error_found": [("frozen", "gray"), ("shuffled", "gray"), ("object at rest", "object erased")],
    "final_object_error": [("2 frames late", "8 frames early"), ("fails at the end", "object at rest")],
    "onset_shift": [("truth", "codec"), ("frozen", "gray")],
}
"""Pairs that a strict metric does not put in order, and no others; docs/metrics.md says why."""
rng = np.random.default_rng(11)


def texture(width: int, height: int, low: tuple[int, int, int], high: tuple[int, int, int]) -> np.ndarray:
    """[height width 3] uint8 spots of about three pixels, between two colors."""
    spots = np.repeat(np.repeat(rng.random((height // 3 + 1, width // 3 + 1, 1)), 3, axis=0), 3, axis=1)[:height, :width]
    return (np.array(low) + spots * (np.array(high) - low)).astype(np.uint8)


GROUND = texture(WIDTH, HEIGHT, (150, 160, 150), (200, 200, 190))
LOOKS = {"robot": texture(*ROBOT, (10, 10, 60), (60, 60, 160))}
LOOKS["other"] = np.concatenate([LOOKS["robot"][:, :12], texture(22, 26, (90, 60, 10), (160, 130, 40))], axis=1)
THING_LOOKS = texture(*THING, (180, 10, 10), (250, 110, 60))


def paths() -> tuple[np.ndarray, np.ndarray]:
    """Upper left corners [t 2] int of the robot, which goes to and fro, and of the thing, which goes to the right and stays."""
    t = np.arange(FRAMES)
    robot = np.stack([8 + 1.2 * t, 12 + 6 * np.sin(t / 6)], axis=-1).astype(int)
    return robot, np.stack([20 + 1.5 * np.clip(t - 6, 0, 30), np.full(FRAMES, 66)], axis=-1).astype(int)


def draw(robot: str = "robot", thing: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A video [t h w 3] and whose each pixel is [t h w]: 0 the robot's, 1 the thing's, which is gone where it is negative."""
    corners, moving = paths()
    video, shown = np.repeat(GROUND[None], FRAMES, axis=0), np.full((FRAMES, HEIGHT, WIDTH), -1, np.int16)
    for t in range(FRAMES):
        bodies = ((1, THING_LOOKS, (moving if thing is None else thing)[t]), (0, LOOKS[robot], corners[t]))
        for body, looks, (x, y) in bodies:
            if x >= 0:
                video[t, y : y + looks.shape[0], x : x + looks.shape[1]] = looks
                shown[t, y : y + looks.shape[0], x : x + looks.shape[1]] = body
    return video, shown


def points(corners: np.ndarray, size: tuple[int, int], body: int) -> Points:
    """Nine points of a rectangle, always seen."""
    grid = np.stack(np.meshgrid(*(np.linspace(0.15, 0.85, 3) * (side - 1) for side in size)), axis=-1).reshape(-1, 2)
    pixels = (corners[:, None] + grid).astype(np.float32)
    return Points(pixels, np.ones(pixels.shape[:2], bool), np.full(len(grid), body))


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    """All predictors of a rectangle that goes about and of a thing that moves by 45 pixels, by the default estimators."""
    corners, moving = paths()
    rgb, shown = draw()
    robot, thing = points(corners, ROBOT, 0), points(moving, THING, 1)
    surfaces = Surfaces(robot, thing, shown, known=True)
    middles = thing.pixels[:, 4:5], thing.visible[:, :1]
    truth = Truth(rgb, shown == 0, robot.pixels, robot.visible, *middles, surfaces)
    at_rest = np.repeat(moving[:1], FRAMES, axis=0)
    gone = np.where((moving != moving[0]).any(axis=-1)[:, None], -1, moving)
    failing = np.where((np.arange(FRAMES) >= 0.8 * FRAMES)[:, None], moving[:1], moving)
    material = Material(
        rgb,
        draw("other")[0],
        draw(thing=at_rest)[0],
        draw(thing=gone)[0],
        draw(thing=failing)[0],
        rgb,
        robot=shown == 0,
        objects=shown == 1,
    )
    found = grade_material(material, truth, open_masker("default"), open_tracker("default"), CHEAP)
    return pd.DataFrame([{"task": "t", "seed": 0, "robot": "r"} | row for row in found])


@pytest.fixture(scope="module")
def states(tmp_path_factory: pytest.TempPathFactory) -> States:
    root = tmp_path_factory.mktemp("data")
    (folder,) = write_synthetic_data(root, seeds=(1_000_000,), robots=("piper",), frames=17)
    return read_states(folder)


def test_every_predictor_has_every_strict_score(rows: pd.DataFrame) -> None:
    strict = rows[rows["metric"].map(lambda name: "strict" in METRICS[name].suites)]
    assert strict["value"].notna().all() and set(strict["case"]) == set(PREDICTORS)


@pytest.mark.parametrize("name", ORDERED)
def test_strict_metrics_put_predictors_in_order(name: str, rows: pd.DataFrame) -> None:
    table = matrix(rows)
    assert order_violations(table)[name] == [], table.loc[name].to_dict()


@pytest.fixture(scope="module")
def measured() -> pd.DataFrame:
    """Rows of real episodes."""
    rows = read_rows(MEASURED)
    sizes = rows.groupby(["task", "robot"]).size()
    assert rows["task"].nunique() == 5 and set(rows["robot"]) == set(HELD_OUT_ROBOTS) and len(sizes) == 9
    assert (sizes == len(PREDICTORS) * len(WITHOUT_OUTCOME)).all()
    return rows


def read_rows(path: Path) -> pd.DataFrame:
    """Rows that the protocol of now graded: measure them again where it changes."""
    rows = pd.read_parquet(path)
    assert rows.attrs["protocol"] == GRADING_PROTOCOL
    return rows


def test_strict_metrics_order_predictors_over_five_tasks_and_both_unseen_robots(measured: pd.DataFrame) -> None:
    table = matrix(measured)
    wrong = order_violations(table)
    strict = [name for name in WITHOUT_OUTCOME if "strict" in METRICS[name].suites]
    assert {name: wrong[name] for name in strict} == {name: NOT_ORDERED.get(name, []) for name in strict}
    assert {name: set(wrong[name]) & set(pairs) for name, pairs in OWN_PAIRS.items()} == {name: set() for name in OWN_PAIRS}
    assert to_markdown(table) in PAGE.read_text(), "the page shows these rows"


def test_only_what_was_never_found_or_never_shown_has_no_strict_score(measured: pd.DataFrame) -> None:
    """Errors of found points need one, and a gripper's needs both fingers of a hand in sight."""
    strict = measured[measured["metric"].map(lambda name: "strict" in METRICS[name].suites)]
    missing = strict[strict["value"].isna()]
    assert set(missing["metric"]) <= {"keypoint_error_found", "trajectory_error_found", "gripper_error"}
    hidden = missing[missing["metric"] == "gripper_error"].groupby(["task", "robot"]).size()
    assert (hidden == len(PREDICTORS)).all(), "for every predictor alike"


@pytest.mark.parametrize("case", ["brighter", "contrast", "darker", "robot recolored", "object recolored"])
def test_a_wrong_appearance_costs_no_points_of_any_robot(case: str) -> None:
    """By robot and task: a body in the right place and the wrong color is found, within a pixel of where it is."""
    table = read_rows(APPEARANCE).pivot_table(index=["task", "robot", "case"], columns="metric", values="value")
    right, wrong = (table.xs(name, level="case") for name in ("truth", case))
    assert set(right.index) == set(product(ACCEPTANCE_TASKS, (*SEEN_ROBOTS, *HELD_OUT_ROBOTS)))
    off = (wrong - right).abs().max()
    assert (off[["keypoint_error_found", "trajectory_error_found"]] < 1).all(), off
    assert (off[["coverage_strict", "object_coverage_strict"]] < 0.1).all(), off
    assert off["mask_iou"] < 0.01, "the robot's masks do not depend on its color or that of objects"


def test_the_page_of_calibration_shows_the_measured_floors_and_appearances() -> None:
    page = PAGE.with_name("calibration.md").read_text()
    assert as_markdown(reference_table(read_rows(FLOORS))) in page
    assert as_markdown(appearance_table(read_rows(APPEARANCE))) in page


def test_in_the_worst_episode_the_truth_is_at_its_best_and_all_scores_are_in_range() -> None:
    for name, values in matrix(read_rows(WORST)).iterrows():
        metric, known = METRICS[str(name)], values.dropna()
        low, high = metric.range[0], AT_MOST.get(str(name), metric.range[1])
        assert known.between(low, high * (1 + 1e-6)).all(), values
        best = high if metric.higher_is_better else low
        assert known.empty or abs(known["truth"] - best) <= NOISE[metric.unit], values


def test_erasing_what_moves_is_worse_than_leaving_it_in_every_task(measured: pd.DataFrame) -> None:
    rows = pd.concat([measured, read_rows(FURTHER)]).query("metric == 'trajectory_error_strict'")
    errors = rows.pivot_table(index=["task", "robot"], columns="case", values="value")
    assert set(errors.index.get_level_values("task")) == set(TASKS)
    assert (errors["object erased"] > errors["object at rest"]).all(), errors[["object at rest", "object erased"]]


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
    missing = {name for name, video in videos.items() if video is None}
    needing = {"object at rest", "object erased", "fails at the end", "grippers open"}
    assert missing == needing | {"robot recolored", "object recolored", "ghost"}
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
    for name in ("codec", "shuffled", "noise"):
        np.testing.assert_array_equal(predict(name, material), videos[name], err_msg=f"{name} is the same every time")


def test_predictors_of_one_fault_have_that_fault_alone() -> None:
    truth = rng.integers(30, 200, (12, 20, 90, 3), dtype=np.uint8)
    robot, objects = np.zeros((2, *truth.shape[:3]), bool)
    robot[:, :8, :10], objects[:, 12:, 40:60] = True, True
    videos = {name: predict(name, Material(truth, robot=robot, objects=objects)) for name in PREDICTORS}
    levels = truth[1:].astype(int)
    np.testing.assert_array_equal(videos["brighter"][1:], levels + 12)
    np.testing.assert_array_equal(videos["contrast"][1:], np.rint(128 + 1.2 * (levels - 128)))
    np.testing.assert_array_equal(videos["flicker"][::2], truth[::2])
    np.testing.assert_array_equal(videos["flicker"][1::2], truth[1::2] + np.uint8(12))
    np.testing.assert_array_equal(videos["jitter"][2, :, 1:], truth[2, :, :-1])
    np.testing.assert_array_equal(videos["8 frames early"][1:4], truth[9:12])
    for name, own in (("robot recolored", robot), ("object recolored", objects)):
        np.testing.assert_array_equal((videos[name] != truth).any(axis=-1)[1:], own[1:])
    np.testing.assert_array_equal((videos["ghost"] != truth).any(axis=(0, 1, 3)), np.arange(90) // 10 == 6)
    blank = (videos["every 5th blank"] == 128).all(axis=(1, 2, 3))
    np.testing.assert_array_equal(np.flatnonzero(blank), [5, 10])


def test_a_task_fails_at_the_end_and_grippers_are_open(states: States) -> None:
    failed, opened = fail_at_end(states), open_grippers(states)
    np.testing.assert_array_equal(failed.object_pose[:14], states.object_pose[:14])
    assert (failed.object_pose[14:] == states.object_pose[0]).all() and (failed.joint_pos == states.joint_pos).all()
    grippers = [gripper for _, gripper in ARMS]
    arms = np.delete(np.arange(states.joint_pos.shape[1]), grippers)
    assert (opened.joint_pos[1:, grippers] == 1).all() and (opened.joint_pos[:, arms] == states.joint_pos[:, arms]).all()


def test_objects_are_held_or_taken_away_from_where_they_begin_to_move(states: States) -> None:
    held, gone = hold_objects(states), erase_objects(states)
    assert (held.object_pose == states.object_pose[0]).all() and (held.joint_pos == states.joint_pos).all()
    moved = np.linalg.norm(states.object_pose[..., :3] - states.object_pose[:1, :, :3], axis=-1) > MOVED
    assert moved.any() and not moved[0].any()
    assert ((gone.object_pose[..., 2] == BELOW) == np.logical_or.accumulate(moved, axis=0)).all()
    hinged = replace(states, object_joint=np.linspace(0, 1, states.frame_count, dtype=np.float32)[:, None])
    assert (erase_objects(hinged).object_pose[1:, 0, 2] == BELOW).all()

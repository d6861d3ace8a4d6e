"""The paper's figures are those of its tables."""

import numpy as np
import pytest

from xew.analysis.paper import AXES, read_paper
from xew.protocol import ROBOT_NAMES

PAPER = read_paper()


def test_all_figures_are_there_for_all_robots() -> None:
    assert tuple(PAPER.robots) == ROBOT_NAMES and len(PAPER.metrics) == 10
    for axis in AXES:
        matrix = np.array(PAPER.distances[axis])
        assert matrix.shape == (5, 5) and (matrix == matrix.T).all() and (np.diag(matrix) == 0).all()
    assert [name for name, metric in PAPER.metrics.items() if metric.higher_is_better] == [
        "psnr",
        "ssim",
        "mask_iou",
        "boundary_f1",
        "pck",
    ]


def test_metrics_are_described_as_our_own() -> None:
    from xew.metrics import METRICS

    for info in PAPER.infos:
        own = METRICS[info.name]
        assert (own.dimension, own.unit, own.higher_is_better) == (info.dimension, info.unit, info.higher_is_better)


EVERYWHERE = ("seen", "franka_panda", "piper")
"""Robots of the fixed split, as the paper groups them."""
SHOTS = [f"{robot}-{shots}" for robot in ("franka_panda", "piper") for shots in (1, 2, 3)]


def test_the_tables_of_scores_are_whole() -> None:
    places = {part: {key: tuple(row) for key, row in rows.rows.items()} for part, rows in PAPER.parts.items()}
    ladder = ("none", "reference_image", "nine_views", "articulation_clip", "robot_render")
    assert places["actions"] == dict.fromkeys(("joints", "ray_map", "mask", "optical_flow"), EVERYWHERE)
    assert places["ladder"] == dict.fromkeys(ladder, EVERYWHERE)
    assert places["baselines"] == dict.fromkeys(("irasim", "ctrl_world", "enerverse_ac", "reference"), EVERYWHERE)
    assert places["loeo"] == {f"loeo_{robot}": (robot,) for robot in ROBOT_NAMES}
    assert places["forgetting"] == dict.fromkeys(("none", *SHOTS), ("ur5_wsg",))
    zero = ("franka_panda-0", "piper-0")
    assert places["few_shot"] == {"reference": ("seen",)} | {key: (key.split("-")[0],) for key in (*zero, *SHOTS)}
    for part, rows in PAPER.parts.items():
        shown = {"lpips", "mask_iou", "pck", "trajectory_error"} if part == "baselines" else set(PAPER.metrics)
        assert all(set(scores) == shown for row in rows.rows.values() for scores in row.values())


def test_what_the_paper_prints_twice_is_the_same_twice() -> None:
    actions, ladder, few = (PAPER.parts[part].rows for part in ("actions", "ladder", "few_shot"))
    assert actions["optical_flow"] == ladder["none"]
    assert ladder["nine_views"]["seen"] == few["reference"]["seen"]
    for robot in ("franka_panda", "piper"):
        assert ladder["nine_views"][robot] == few[f"{robot}-0"][robot]
    for robot, row in PAPER.parts["baselines"].rows["reference"].items():
        for metric, value in row.items():
            # The table prints trajectory errors with one decimal only.
            assert value == pytest.approx(ladder["none"][robot][metric], abs=PAPER.half_digit_of("baselines", metric) + 1e-9)


def test_a_score_is_found_by_its_place_and_none_where_nothing_is_printed() -> None:
    assert PAPER.score("forgetting", "franka_panda-1", "ur5_wsg", "lpips") == 0.073
    assert PAPER.score("baselines", "irasim", "seen", "trajectory_error") == 20.8
    for place in (("baselines", "irasim", "seen", "psnr"), ("actions", "joints", "ur5_wsg", "psnr"), ("x", "x", "x", "psnr")):
        assert PAPER.score(*place) is None


def test_only_joints_of_one_robot_differ() -> None:
    assert PAPER.axis("dof").tolist() == [6, 6, 6, 7, 6]

"""The paper's figures are those of its tables, and its distance table comes out of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from xew.analysis.correlation import leave_one_out, loeo_correlation, pearson
from xew.analysis.paper import AXES, read_paper
from xew.analysis.statistics.recompute import rebuild, recompute_changes, recompute_mean_distances
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


@pytest.mark.parametrize("found", recompute_changes(PAPER), ids=lambda found: f"{found.change.metric}-{found.change.after}")
def test_every_percentage_of_the_text_comes_out_of_the_printed_scores(found) -> None:
    assert found.agrees and found.least <= found.ours <= found.most
    change = found.change
    if change.word == "rounded":
        # One that is off by more than rounding explains is found.
        for wrong in (-change.percent, found.most + 1, found.least - 1):
            assert not replace(found, change=replace(change, percent=wrong)).agrees
    elif change.word == "about":
        assert not replace(found, change=replace(change, percent=change.percent - 10)).agrees


def test_less_than_is_less() -> None:
    found = next(f for f in recompute_changes(PAPER) if f.change.word == "less than" and f.ours > 1)
    assert not replace(found, change=replace(found.change, percent=1)).agrees


def test_a_score_is_found_by_its_place_and_none_where_nothing_is_printed() -> None:
    assert PAPER.score("forgetting", "franka_panda-1", "ur5_wsg", "lpips") == 0.073
    assert PAPER.score("baselines", "irasim", "seen", "trajectory_error") == 20.8
    for place in (("baselines", "irasim", "seen", "psnr"), ("actions", "joints", "ur5_wsg", "psnr"), ("x", "x", "x", "psnr")):
        assert PAPER.score(*place) is None


CELLS = rebuild(PAPER)


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: f"{cell.metric}-{cell.axis}-{cell.quantity}")
def test_every_published_figure_comes_out_within_the_rounding_of_its_inputs(cell) -> None:
    assert cell.agrees
    # Rounding is no excuse for anything: from the printed inputs themselves nothing is further off than this.
    assert cell.ours == pytest.approx(cell.published, abs=0.02)


def test_no_figure_is_left_out() -> None:
    # Ten metrics with r, low and high on two axes and r with the joints; two p.
    assert len(CELLS) == 10 * 7 + 2 and len({(c.metric, c.axis, c.quantity) for c in CELLS}) == 72


def test_the_published_p_values() -> None:
    p_values = {cell.axis: cell.ours for cell in CELLS if cell.quantity == "p_value"}
    assert p_values == pytest.approx({"appearance": 9 / 120, "kinematic": 47 / 120})


def test_the_range_holds_what_unrounded_inputs_give_and_is_not_wide_for_nothing() -> None:
    """Draws inside the rounding cube stay between the ends that its corners give, and come near them."""
    rng = np.random.default_rng(0)
    cells = {cell.quantity: cell for cell in CELLS if (cell.metric, cell.axis) == ("lpips", "kinematic")}
    x, y = PAPER.axis("kinematic"), PAPER.scores("lpips")
    drawn = [loeo_correlation(*(v + rng.uniform(-5e-4, 5e-4, 5) for v in (x, y))) for _ in range(500)]
    for quantity in ("r", "low", "high"):
        values = [getattr(result, quantity) for result in drawn]
        cell = cells[quantity]
        assert cell.least <= min(values) and max(values) <= cell.most
        assert np.ptp(values) > 0.4 * (cell.most - cell.least)


def test_a_figure_that_does_not_belong_is_found() -> None:
    """A figure of another row or axis, or a sign not turned, is outside of what rounding allows."""
    cell = next(c for c in CELLS if (c.metric, c.axis, c.quantity) == ("psnr", "kinematic", "r"))
    for wrong in (0.769, 0.549, -0.633):
        assert not type(cell)(**{**vars(cell), "published": wrong}).agrees


def test_mean_distances_are_those_of_the_matrices() -> None:
    cells = recompute_mean_distances(PAPER)
    assert len(cells) == 10 and all(cell.agrees for cell in cells)


def test_only_joints_of_one_robot_differ() -> None:
    assert PAPER.axis("dof").tolist() == [6, 6, 6, 7, 6]


def test_one_set_of_unrounded_inputs_gives_all_correlations_at_once() -> None:
    """Cell by cell each might ask for other inputs; together they are consistent too."""
    half, signs = PAPER.half_digit, [-1 if metric.higher_is_better else 1 for metric in PAPER.metrics.values()]
    printed_x = np.array([PAPER.axis(axis) for axis in AXES])
    printed_y = np.array([PAPER.scores(metric) for metric in PAPER.metrics])
    published = np.array([cell.published for cell in CELLS if cell.quantity != "p_value"]).reshape(10, 7)

    def beyond_rounding(shifts: np.ndarray) -> np.ndarray:
        """How far each of the 70 figures is from what prints like the paper's, in half digits."""
        x = printed_x + half * shifts[:10].reshape(2, 5)
        y = (printed_y + half * shifts[10:].reshape(10, 5)) * np.array(signs)[:, None]
        columns = [part for axis in x for part in (pearson(axis, y), *leave_one_out(axis[None], y))]
        difference = np.stack([*columns, pearson(PAPER.axis("dof"), y)], axis=1) - published
        return (np.sign(difference) * np.maximum(np.abs(difference) / half - 0.9, 0)).ravel()

    found = least_squares(beyond_rounding, np.zeros(60), bounds=(-0.999, 0.999))
    assert np.abs(beyond_rounding(np.zeros(60))).max() > 10, "printed inputs alone are not enough"
    assert np.abs(beyond_rounding(found.x)).max() < 0.1

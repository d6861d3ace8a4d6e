"""The paper's distance table and the percentages of its text come out of its own figures, and what would not is named."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from lab.paper_figures.__main__ import Args, describe, main
from lab.paper_figures.recompute import mean_distances, rebuild, recompute_changes, recompute_mean_distances
from lab.paper_figures.tables import frame_distances, frame_results
from xew.analysis.correlation import leave_one_out, loeo_correlation
from xew.analysis.paper import AXES, read_paper
from xew.analysis.tables.table import format_signed
from xew.statistics import pearson

PAPER = read_paper()


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
    np.testing.assert_allclose(mean_distances([[0, 1, 2], [1, 0, 3], [2, 3, 0]]), [1.5, 2, 2.5])
    cells = recompute_mean_distances(PAPER)
    assert len(cells) == 10 and all(cell.agrees for cell in cells)


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


def test_the_page_has_every_figure_and_what_the_frame_changes(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """In the root's frame our clouds give the paper's r; in the arm's they give others."""
    main(Args(tmp_path / "page.md"))
    text, printed = (tmp_path / "page.md").read_text(), capsys.readouterr().out
    assert "72 of 72 printed figures come out" in printed and "28 of 28 percentages" in printed
    assert "as the text defines it, in the arm's base frame (our clouds, its scores), LPIPS has r = +0.8" in printed
    assert "By workspaces of the arm alone, in that frame (ours), LPIPS has r = +0.5" in printed
    for metric in PAPER.metrics.values():
        for of in (metric.appearance, metric.kinematic):
            assert f"✓ (paper {format_signed(of.low)} to {format_signed(of.high)})" in text
    # Ten rows of five cells, five robots with two means, 28 percentages.
    assert text.count(" ✓ ") - text.count("print like these") == 10 * 5 + 5 * 2 + 28
    root, own = (frame_results(PAPER, frame_distances()[frame]) for frame in ("root", "arm_base"))
    for name, result in root.items():
        assert result.r == pytest.approx(PAPER.correlation(name, "kinematic").r, abs=0.05)
    assert PAPER.correlation("lpips", "kinematic").low < 0 < 0.7 < own["lpips"].low
    assert own["lpips"].r == pytest.approx(PAPER.correlation("lpips", "appearance").r, abs=0.05)
    alone = frame_results(PAPER, frame_distances()["arm_alone"])
    page = (Path(__file__).parents[2] / "docs" / "distances.md").read_text()
    for found in (own["lpips"], alone["lpips"]):
        assert f"| {found.r:.3f} | {found.low:.3f} to {found.high:.3f} |" in page
    assert PAPER.correlation("keypoint_error", "kinematic").r < 0 < alone["keypoint_error"].low


def test_what_does_not_come_out_is_named() -> None:
    lpips = PAPER.metrics["lpips"]
    wrong = dataclasses.replace(lpips, appearance=dataclasses.replace(lpips.appearance, r=0.712))
    changes = [dataclasses.replace(PAPER.changes[0], percent=-39), *PAPER.changes[1:]]
    sentences, text = describe(dataclasses.replace(PAPER, metrics={**PAPER.metrics, "lpips": wrong}, changes=changes))
    assert "71 of 72 printed figures" in sentences[0] and "not LPIPS by appearance r." in sentences[0]
    assert "27 of 28 percentages of the text follow from the tables: not −39 % (sec:exp-actrep)." in sentences
    assert "✗ (paper +0.712)" in text and "(paper −39 %)" in text

"""Parts of inspect's pictures, drawn from arrays; test_inspect.py runs the command on data."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from xew.episode import EpisodeError, Record
from xew.sim_warp.inspection import pictures as inspect
from xew.sim_warp.inspection.pictures import GAP, LABEL_HEIGHT, LABEL_WIDTH, save_png, seeds_by_task, tile


def dark_columns(image: np.ndarray) -> np.ndarray:
    """Columns in which letters stand."""
    return np.flatnonzero((image < 128).any((0, 2)))


def test_a_label_is_centered_and_leaves_a_margin() -> None:
    label = inspect._label("piper", LABEL_WIDTH)
    assert label.shape == (LABEL_HEIGHT, LABEL_WIDTH, 3) and label.dtype == np.uint8
    letters = dark_columns(label)
    assert abs((letters[0] + letters[-1]) / 2 - (LABEL_WIDTH - GAP) / 2) < 3
    assert letters[0] > 2 and letters[-1] < LABEL_WIDTH - 2


def test_a_long_label_is_drawn_smaller_rather_than_cut() -> None:
    short, long = inspect._label("tasks", 100), inspect._label("a_task_of_a_very_long_name_indeed", 100)
    assert dark_columns(long)[-1] < 98
    assert np.ptp(np.flatnonzero((long < 200).any((1, 2)))) < np.ptp(np.flatnonzero((short < 200).any((1, 2))))


def test_no_text_is_a_white_label() -> None:
    assert (inspect._label("", 50) == 255).all()


def test_tiles_of_several_rows_keep_their_places() -> None:
    images = [[np.full((4, 6, 3), 10 * (3 * row + column), np.uint8) for column in range(3)] for row in range(2)]
    picture = tile(images)
    assert picture.shape == (2 * (4 + GAP), 3 * (6 + GAP), 3)
    for row in range(2):
        for column in range(3):
            part = picture[row * (4 + GAP) :, column * (6 + GAP) :]
            assert (part[:4, :6] == 10 * (3 * row + column)).all() and (part[4 : 4 + GAP, :6] == 255).all()


def test_the_robot_is_outlined_and_its_keypoints_are_dots() -> None:
    image, mask = np.full((40, 60, 3), 200, np.uint8), np.zeros((40, 60), bool)
    mask[10:20, 10:30] = True
    marked = inspect._mark_robot(image, np.array([[45.0, 30.0]]), mask)
    assert (image == 200).all(), "the image itself is left as it is"
    assert (marked[10, 10:30] == (255, 120, 0)).all() and (marked[12:18, 12:28] == 200).all()
    assert (marked[30, 45] == (0, 160, 255)).all() and (marked[35:, 50:] == 200).all()


def test_half_size_is_the_mean_of_four_pixels() -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[::2, ::2] = 100
    half = inspect.fit_picture(image, 2, 3)
    assert (half == 25).all() and half.shape == (2, 3, 3)


@pytest.mark.parametrize("shape", [(240, 320), (480, 640), (720, 320), (120, 160)])
def test_a_picture_of_any_size_fits_into_a_sheet(shape: tuple[int, int]) -> None:
    image = np.full((*shape, 3), 7, np.uint8)
    fitted = inspect.fit_picture(image)
    height, width = (np.array(shape) * min(240 / shape[0], 320 / shape[1])).round().astype(int)
    assert fitted.shape == (240, 320, 3) and (fitted[:height, :width] == 7).all()
    assert (fitted[height:] == 255).all() and (fitted[:, width:] == 255).all()


def test_cells_are_found_by_task_and_seed_in_their_order() -> None:
    cells = [(Path(f"{task}/{seed}/{robot}"), Record(task, seed, robot, True)) for task, seed, robot in (
        ("b", 1, "piper"), ("a", 0, "piper"), ("b", 1, "ur5_wsg"), ("b", 0, "piper"),
    )]  # fmt: skip
    by_task = seeds_by_task(cells)
    assert list(by_task) == ["b", "a"] and sorted(by_task["b"]) == [0, 1]
    assert [record.robot for _, record in by_task["b"][1]] == ["piper", "ur5_wsg"]


def test_a_png_keeps_its_colors_and_a_bad_path_is_told(tmp_path: Path) -> None:
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    save_png(tmp_path / "a.png", image)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png"))[..., ::-1], image)
    with pytest.raises(EpisodeError, match="Choose another folder with --pictures"):
        save_png(tmp_path / "a.png" / "b.png", image)

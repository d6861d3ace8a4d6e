"""Closed grippers carry objects of the first frame: on a drawn table, by hands of which only poses and grippers exist."""

from pathlib import Path

import numpy as np
import pytest

from tests import synthetic
from xew.episode import WHITE, read_record, read_states
from xew.model.conditions import carried_render, make_command, pasted_render
from xew.model.video.carried_scene import View, carry, find_grasps
from xew.model.video.ground import SPREAD
from xew.sim_warp.geometry.camera import HEAD_CAMERA, project

VIEW = View(HEAD_CAMERA.intrinsics, HEAD_CAMERA.extrinsics)
GROUND, RED, FRAMES = (229, 229, 229), (200, 40, 30), 12
CLOSING = np.array([1, 1, 0.5, 0, 0, 0, 0, 0, 0, 0.5, 1, 1.0])
"""A gripper that holds in frames 3 to 8."""
START, GOAL = np.array([-0.1, 0.0, 0.75]), np.array([0.1, 0.05, 0.75])
"""Places of the hand in frames 3 and 8."""


def pixel(place: np.ndarray) -> tuple[int, int]:
    """Row and column of a place [3] m."""
    x, y = np.round(project(HEAD_CAMERA, place)[0]).astype(int)
    return int(y), int(x)


def table(*places: np.ndarray) -> np.ndarray:
    """A plain table with red squares of 17 pixels at these places."""
    image = np.full((240, 320, 3), GROUND, np.uint8)
    for row, column in map(pixel, places):
        image[row - 8 : row + 9, column - 8 : column + 9] = RED
    return image


def hands(*paths: np.ndarray) -> np.ndarray:
    """Poses [t n 7] of hands on these paths [t 3] that never turn."""
    return np.stack([np.column_stack([path, np.tile([0, 0, 0, 1.0], (FRAMES, 1))]) for path in paths], axis=1)


def path(start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """[t 3]: at the start until frame 3, at the goal from frame 8 on."""
    return start + np.clip((np.arange(FRAMES) - 3) / 5, 0, 1)[:, None] * (goal - start)


def scenes(first: np.ndarray, tools: np.ndarray, *grippers: np.ndarray) -> np.ndarray:
    return carry(first, np.full((FRAMES, 240, 320, 3), 255, np.uint8), tools, np.stack(grippers, axis=1), VIEW)


def test_an_object_moves_with_the_hand_that_holds_it_and_stays_where_it_is_left() -> None:
    first, way = table(START), path(START, GOAL)
    way[10:] = START  # the open hand leaves
    made = scenes(first, hands(way), CLOSING)
    np.testing.assert_array_equal(made[:3], np.stack([first] * 3))
    for frame in range(3, FRAMES):
        row, column = pixel(way[frame] if frame < 10 else GOAL)
        red = (np.abs(made[frame].astype(int) - RED) < 12).all(axis=-1)
        assert red[row - 7 : row + 8, column - 7 : column + 8].all() and red.sum() < 19 * 19
    assert np.abs(made[-1][pixel(START)].astype(int) - GROUND).max() <= 2  # the hole


@pytest.mark.parametrize(
    ("start", "gripper"),
    [
        (START, np.ones(FRAMES)),
        (START, np.zeros(FRAMES)),
        (START, np.where(CLOSING < 1, 0.5, 1.0) * 0.05),
        (GOAL, CLOSING),
        (np.array([2.0, 0, 0.75]), CLOSING),
        (np.array([0, -2.0, 2.0]), CLOSING),
    ],
    ids=["open", "closed from the start", "trembling", "on nothing", "out of view", "behind the camera"],
)
def test_a_hand_that_grasps_nothing_moves_nothing(start: np.ndarray, gripper: np.ndarray) -> None:
    first = table(START)
    assert (scenes(first, hands(path(start, GOAL)), gripper) == first).all()


def test_a_shadow_is_no_object() -> None:
    row, column = pixel(START)
    first = table()
    first[row - 8 : row + 9, column - 8 : column + 9] = np.multiply(GROUND, 0.88).astype(np.uint8)
    assert (scenes(first, hands(path(START, GOAL)), CLOSING) == first).all()


def test_an_object_goes_over_to_the_other_hand_and_can_be_taken_again() -> None:
    """The right hand closes at the meeting place before the left one opens, and carries on from there."""
    end = np.array([0.15, -0.05, 0.75])
    left, right = path(START, GOAL), np.tile(GOAL, (FRAMES, 1))
    left[8:] = GOAL
    right[10:] = end
    taking = np.where(np.arange(FRAMES) < 8, 1.0, 0.0)
    made = scenes(table(START), hands(left, right), CLOSING, taking)
    assert np.abs(made[-1][pixel(end)].astype(int) - RED).max() < 12
    assert np.abs(made[-1][pixel(GOAL)].astype(int) - GROUND).max() <= 2


@pytest.mark.parametrize(
    ("gripper", "held"),
    [
        (CLOSING, range(3, 9)),
        (0.6 + 0.4 * CLOSING, range(3, 9)),
        ([1, 0.5, 0.5, 0.2, 0, 0], range(4, 6)),
        ([0, 0, 1, 1, 0, 1], [4]),
        ([1, 1, 1], []),
    ],
    ids=["closing and opening", "partly closed on something thick", "until the end", "again", "never"],
)
def test_grasps_begin_when_a_gripper_has_closed(gripper: np.ndarray, held: list[int]) -> None:
    assert list(np.flatnonzero(find_grasps(np.asarray(gripper, float)))) == list(held)


def test_the_condition_is_the_render_in_the_carried_scene(tmp_path: Path) -> None:
    folder = synthetic.write_cell(tmp_path, "place_empty_cup", 0, "piper", frames=5)
    command = make_command(folder, read_record(folder), read_states(folder))
    made, pasted = carried_render(command), pasted_render(command)
    assert made.shape == pasted.shape == command.carried_scene.shape and made.dtype == np.uint8
    np.testing.assert_array_equal(made[0], pasted[0])
    robot = command.render.min(axis=-1) < WHITE
    assert WHITE == WHITE and robot.any()
    np.testing.assert_array_equal(made[1:][robot[1:]], pasted[1:][robot[1:]])


def test_an_object_that_a_shadow_joins_to_another_is_taken_alone() -> None:
    """A dark shadow lies between the object and a mat."""
    (row, column), first = pixel(START), table(START)
    first[row + 9 : row + 20, column - 8 : column + 30] = np.multiply(GROUND, 0.76).astype(np.uint8)
    first[row + 20 : row + 30, column + 20 : column + 70] = (90, 90, 95)
    made = scenes(first, hands(path(START, GOAL)), CLOSING)
    assert (made[:, row + 21 : row + 29, column + 21 : column + 69] == (90, 90, 95)).all()
    assert np.abs(made[-1][pixel(GOAL)].astype(int) - RED).max() < 12


@pytest.fixture
def half_hidden() -> tuple[np.ndarray, np.ndarray]:
    """A first frame in which the robot hides the right half of the object, and its render."""
    (row, column), first = pixel(START), table(START)
    render = np.full((FRAMES, 240, 320, 3), 255, np.uint8)
    render[0, row - 20 : row + 20, column : column + 40] = first[row - 20 : row + 20, column : column + 40] = (20, 20, 20)
    return first, render


def is_red(images: np.ndarray) -> np.ndarray:
    return (images[..., 0] > 190) & (images[..., 1:] < 120).all(axis=-1)


def test_what_the_robot_hides_of_an_object_is_completed_about_its_grasp(half_hidden: tuple[np.ndarray, np.ndarray]) -> None:
    """What is seen of it, turned about the hand, stands where the robot was, before the grasp too, and moves with it."""
    made = carry(*half_hidden, hands(path(START, GOAL)), CLOSING[:, None], VIEW)
    red = is_red(made)
    assert made[..., 0].min() > 190 and red.sum(axis=(1, 2)).max() < 19 * 19
    for frame, place in ((0, START), (-1, GOAL)):
        row, column = pixel(place)
        assert red[frame, row - 6 : row + 7, column - 6 : column + 7].all()
    row, column = pixel(START)
    assert np.abs(made[-1, row, column - 8 : column + 40].astype(int) - GROUND).max() <= 2


def test_an_object_runs_out_a_little_into_the_place_of_the_robot(half_hidden: tuple[np.ndarray, np.ndarray]) -> None:
    """The color of an object that nothing grasps goes on for a few pixels. The ground lies beyond."""
    made = carry(*half_hidden, hands(path(GOAL, GOAL)), CLOSING[:, None], VIEW)
    row, column = pixel(START)
    assert is_red(made[:, row, column]).all()
    assert np.abs(made[:, row, column + SPREAD + 2 : column + 40].astype(int) - GROUND).max() <= 2

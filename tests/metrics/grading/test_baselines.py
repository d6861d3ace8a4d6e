"""Baselines: what each video is made of, that none looks at what it may not know, and which are left out."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.synthetic import write_synthetic_data
from xew.episode import episode_folder, read_record, read_states, read_video, write_episode
from xew.metrics import psnr
from xew.metrics.grading.baselines import BASELINES, find_other_robot, other_robot, pasted_render
from xew.metrics.grading.grade_episodes import make_baseline
from xew.metrics.grading.list_jobs import Job
from xew.metrics.grading.scores import Cell
from xew.metrics.truth import Truth, read_truth
from xew.protocol import BASELINES as TITLES
from xew.protocol import CODEC_TRUTH, OTHER_ROBOT, PASTED_RENDER
from xew.rollout import RolloutError

TASK, SEED, ROBOTS, FRAMES = "place_empty_cup", 0, ("arx_x5", "franka_panda", "piper"), 9


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("baselines")
    write_synthetic_data(root, tasks=(TASK,), seeds=(SEED,), robots=ROBOTS, frames=FRAMES)
    return root


def episode(data: Path, robot: str) -> Path:
    return episode_folder(data, TASK, SEED, robot)


def truth(data: Path, robot: str, frames: int = FRAMES) -> Truth:
    return read_truth(episode(data, robot), frames, ("video",))


def test_every_baseline_has_a_title_and_the_shape_of_the_truth(data: Path) -> None:
    assert list(BASELINES) == [name for name in TITLES if name != CODEC_TRUTH]  # which is of a run's codec
    for baseline in BASELINES.values():
        video = baseline.make(episode(data, "piper"), truth(data, "piper", 7))
        assert video.dtype == np.uint8 and video.shape == (7, 240, 320, 3)


def test_pasting_shows_the_robot_where_its_render_is_and_nothing_where_it_was(data: Path) -> None:
    folder, true = episode(data, "piper"), truth(data, "piper")
    pasted, mask = pasted_render(folder, true), read_states(folder).robot_mask
    np.testing.assert_array_equal(pasted[0], true.rgb[0])
    np.testing.assert_array_equal(pasted[mask & (np.arange(FRAMES) > 0)[:, None, None]], true.rgb[1:][mask[1:]])
    left = mask[0] & ~mask[-1]
    assert left.sum() > 100
    ghost, filled = (np.abs(video[left].astype(int) - true.rgb[-1][left]).mean() for video in (true.rgb[0], pasted[-1]))
    assert filled < ghost / 5
    frozen = np.repeat(true.rgb[:1], FRAMES, axis=0)
    assert np.mean(psnr(pasted[1:], true.rgb[1:])) > np.mean(psnr(frozen[1:], true.rgb[1:])) + 5


def test_pasting_knows_the_first_frame_and_the_commands_alone(data: Path) -> None:
    folder, true = episode(data, "piper"), truth(data, "piper")
    later = true.rgb.copy()
    later[1:] = 255 - later[1:]
    np.testing.assert_array_equal(pasted_render(folder, replace(true, rgb=later)), pasted_render(folder, true))


def test_another_robot_is_the_next_by_name_in_the_same_scene(data: Path, tmp_path: Path) -> None:
    for robot, other in zip(ROBOTS, (*ROBOTS[1:], ROBOTS[0]), strict=True):
        video = other_robot(episode(data, robot), truth(data, robot))
        np.testing.assert_array_equal(video, read_video(episode(data, other) / "rgb.mkv"))
    longer = replace(truth(data, "piper"), rgb=np.repeat(truth(data, "piper").rgb, 2, 0))
    video = other_robot(episode(data, "piper"), longer)
    assert video.shape == longer.rgb.shape, "in own motion robots take their own time; the quicker stands still at its end"
    assert (video[len(video) // 2 :] == video[len(video) // 2 - 1]).all()
    copy = tmp_path / "data"
    shutil.copytree(data, copy)
    folder = episode(copy, "arx_x5")
    states, rgb, robot = read_states(folder), read_video(folder / "rgb.mkv"), read_video(folder / "robot.mkv")
    write_episode(copy, replace(read_record(folder), scene_hash="another"), states, rgb, robot)
    other = find_other_robot(episode(copy, "piper"), read_record(episode(copy, "piper")))
    assert other is not None and other[0] == episode(copy, "franka_panda")
    assert find_other_robot(folder, read_record(folder)) is None


def test_what_the_data_do_not_hold_is_left_out(data: Path, tmp_path: Path) -> None:
    folder = tmp_path / TASK / "0000000" / "piper"
    shutil.copytree(episode(data, "piper"), folder)
    record = read_record(folder)
    assert BASELINES[PASTED_RENDER].source(folder, record) == record.hashes["robot"]
    (folder / "robot.mkv").unlink()
    left_out = {name for name, baseline in BASELINES.items() if baseline.source(folder, record) is None}
    assert left_out == {PASTED_RENDER, OTHER_ROBOT}


@pytest.mark.parametrize("name", [PASTED_RENDER, OTHER_ROBOT])
def test_a_baseline_of_an_episode_that_was_replaced_is_refused(name: str, data: Path) -> None:
    """The digest of what it is made from was taken when the videos were listed."""
    folder, record = episode(data, "piper"), read_record(episode(data, "piper"))
    cell = Cell(name, "", TASK, SEED, "piper", FRAMES, BASELINES[name].source(folder, record) or "", "", "", "")
    assert len(make_baseline(Job(cell, None, folder, record), truth(data, "piper"), {})) == FRAMES
    with pytest.raises(RolloutError, match="was replaced while this command ran"):
        make_baseline(Job(replace(cell, prediction="old"), None, folder, record), truth(data, "piper"), {})

"""All cameras of a RoboTwin file become views of the imported data."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.exchange import robotwin_file as made
from tests.exchange.test_robotwin import LEGACY, MODERN
from xew.dataset import list_views, view_episode, view_folder
from xew.episode import HEIGHT, WIDTH, EpisodeError, episode_folder, read_record, read_states, read_video, verify_episode
from xew.exchange.hdf5 import read_robotwin
from xew.exchange.robotwin import Args, import_all
from xew.sim_warp.cameras import commanded_camera
from xew.sim_warp.geometry.camera import HEAD_CAMERA
from xew.sim_warp.robots import get_robot


@pytest.mark.parametrize("layout", ["legacy", "1.0"])
def test_all_cameras_of_a_file_come_in_as_views(layout: str, tmp_path: Path) -> None:
    path = made.write_legacy(tmp_path / LEGACY) if layout == "legacy" else made.write_modern(tmp_path / MODERN)
    args = Args(tmp_path, tmp_path / "out", instruction="put it there")
    import_all([path], args)
    assert list_views(args.out) == []
    made.add_cameras(path)
    (record,), problems = import_all([path], args)
    assert not problems and list_views(args.out) == ["front", "wrist_left", "wrist_right"]
    base = episode_folder(args.out, record.task, record.seed, record.robot)
    for arm, name in enumerate(("wrist_left", "wrist_right")):
        folder = view_episode(base, name)
        seen, states = verify_episode(folder), read_states(folder)
        np.testing.assert_allclose(states.extrinsics, made.wrist_extrinsics(arm), atol=1e-6)
        assert seen.camera.fixed_to == f"{name.removeprefix('wrist_')}_tool"
        np.testing.assert_allclose(seen.camera.position, [-0.1, 0, 0], atol=1e-5)
        moved = commanded_camera(seen.camera, get_robot(record.robot, view_folder(args.out, name)), states)
        np.testing.assert_allclose(moved.extrinsics, states.extrinsics, atol=1e-5)
        assert (read_video(folder / "robot.mkv") < 200).any(), "the hand is before the camera"
        block = read_video(folder / "rgb.mkv")[:, HEIGHT // 4 + 8 : HEIGHT // 2 - 8, WIDTH // 4 + 8 : WIDTH // 2 - 8]
        assert np.abs(block.reshape(-1, 3).astype(int) - made.RED).max() <= 4
    front = read_record(view_episode(base, "front")).camera
    assert front.fixed_to == "world" and front.position[0] == pytest.approx(HEAD_CAMERA.position[0] - 0.1)


def test_another_camera_that_does_not_fit_is_told(tmp_path: Path) -> None:
    path = made.add_cameras(made.write_legacy(tmp_path / LEGACY))
    with h5py.File(path, "a") as file:
        del file["observation/left_camera/extrinsic_cv"]
        file["observation/left_camera/extrinsic_cv"] = np.zeros((made.FRAMES - 1, 3, 4))
    with pytest.raises(EpisodeError, match=r"left_camera/extrinsic_cv has shape .*; expected one matrix for each of 5 frames"):
        read_robotwin(path)

"""Models from outside: what they are told, how their rollouts are written and resumed, and what a wrong one is told."""

import pickle
import shutil
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from tests import synthetic
from xew.config import ConfigError
from xew.dataset import find_records
from xew.episode import read_record, read_states, read_video, write_episode
from xew.model import outside
from xew.model.outside import read_inputs
from xew.protocol import CameraSpec
from xew.rollout import RolloutError, find_rollouts, read_rollout_video

FRAMES = 9
MODELS = """
import numpy as np

def small(inputs):
    return inputs.first_frame[None, ::2, ::2].repeat(inputs.frame_count, 0)

def floats(inputs):
    return small(inputs) / 255

def short(inputs):
    return small(inputs)[1:]

class Views:
    views = ("head", "wrist_left")

    def __call__(self, inputs):
        assert inputs.first_frame.shape == (120, 160, 3) and inputs.extrinsics.shape == (4, 4)
        assert inputs.views["head"].first_frame.shape == (240, 320, 3)
        assert inputs.views["wrist_left"].extrinsics.shape == (inputs.frame_count, 4, 4)
        return inputs.first_frame[None].repeat(inputs.frame_count, 0)

number = 3
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    synthetic.write_synthetic_data(root, seeds=(0, 1_000_000), robots=("piper", "arx_x5"), frames=FRAMES)
    return root


@pytest.fixture(autouse=True)
def importable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_models_of_test.py").write_text(MODELS)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    sys.modules.pop("own_models_of_test", None)


@pytest.mark.parametrize("rate", [25.0, 250 / 14])
def test_rollouts_have_the_rate_of_their_episode(rate: float, data: Path, tmp_path: Path) -> None:
    folder = data / "place_empty_cup" / "1000000" / "piper"
    videos = (read_video(folder / f"{name}.mkv") for name in ("rgb", "robot"))
    write_episode(tmp_path / "data", replace(read_record(folder), frame_rate=rate), read_states(folder), *videos)
    outside.main(["own_models_of_test:small", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")])
    (rollout,) = find_rollouts(tmp_path / "out")
    assert len(read_rollout_video(rollout, frame_rate=rate)) == FRAMES
    with pytest.raises(RolloutError, match=f"has {rate:.2f} frames per second, its episode 16.67"):
        read_rollout_video(rollout, frame_rate=1000 / 60)


def test_a_model_is_given_the_views_that_it_asks_for(data: Path, tmp_path: Path) -> None:
    """It predicts one view, whose pictures have another size, and sees the head camera and a camera on the hand too."""
    copy = tmp_path / "data"
    shutil.copytree(data, copy)
    synthetic.write_synthetic_view(copy, CameraSpec("shelf", size=(160, 120)))
    synthetic.write_synthetic_view(copy, CameraSpec("wrist_left", "left_tool", (-0.1, 0, 0), (0, 0, 0)))
    arguments = ["--data", str(copy), "--view", "shelf_160x120", "--robots", "piper", "--out", str(tmp_path / "out")]
    outside.main(["own_models_of_test:Views", *arguments])
    (rollout,) = find_rollouts(tmp_path / "out")
    record = read_record(copy / "views/shelf_160x120/place_empty_cup/1000000/piper")
    assert rollout.header["source_hash"] == record.hashes["rgb"]
    assert read_rollout_video(rollout).shape == (FRAMES, 120, 160, 3)


def truth(data: Path, made: object) -> np.ndarray:
    return read_video(data / made.task / f"{made.seed:07d}" / made.robot / "rgb.mkv")


def test_the_examples_run_and_pasting_beats_freezing(data: Path, tmp_path: Path) -> None:
    errors = {}
    for name in ("freeze", "PasteRender"):
        outside.main([f"examples.own_model:{name}", "--data", str(data), "--out", str(tmp_path / name)])
        made = find_rollouts(tmp_path / name)
        assert {(r.seed, r.robot) for r in made} == {(1_000_000, "piper"), (1_000_000, "arx_x5")}
        assert {r.model for r in made} == {name} and {r.frame_count for r in made} == {FRAMES}
        videos = [(read_rollout_video(r).astype(float), truth(data, r)) for r in made]
        np.testing.assert_array_equal(videos[0][0][0], videos[0][1][0])
        errors[name] = np.mean([np.square(video - real).mean() for video, real in videos])
    assert errors["PasteRender"] < errors["freeze"] / 2


def test_a_model_is_told_commands_only(data: Path) -> None:
    from xew.sim_warp.kinematics.forward import tool_pose
    from xew.sim_warp.robots import ROBOTS

    folder, record = next((f, r) for f, r in find_records(data) if r.robot == "arx_x5")
    inputs = read_inputs((folder, record), max_frames=5)
    assert (inputs.task, inputs.seed, inputs.robot, inputs.frame_count) == (record.task, record.seed, "arx_x5", 5)
    assert inputs.instruction == record.instruction and inputs.first_frame.shape == (240, 320, 3)
    assert inputs.joints.shape == (5, 16) and inputs.grippers.shape == (5, 2)
    assert inputs.intrinsics.shape == (3, 3) and inputs.extrinsics.shape == (4, 4)
    assert inputs.robot_render.shape == (5, 240, 320, 3)
    right = tool_pose(ROBOTS["arx_x5"], 1, inputs.joints[:, 8 : 8 + ROBOTS["arx_x5"].arm_joint_count])
    np.testing.assert_allclose(inputs.tool_poses[:, 1], right)
    assert inputs.tool_poses.shape == (5, 2, 7)
    assert not {"joint_pos", "object_pose", "states", "contact"} & set(dir(inputs))


def test_masks_and_flow_are_rendered_for_models_that_ask(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from xew.sim_warp.geometry.camera import HEAD_CAMERA

    episode = next((f, r) for f, r in find_records(data) if r.robot == "arx_x5")
    camera = {"intrinsics": HEAD_CAMERA.intrinsics, "extrinsics": HEAD_CAMERA.extrinsics}
    told = outside.episode_command(*episode)
    monkeypatch.setattr(outside, "episode_command", lambda *_: replace(told, action=told.action[:2], **camera))
    inputs = read_inputs(episode, max_frames=2, streams=True)
    assert inputs.robot_mask.shape == (2, 240, 320) and inputs.robot_mask.dtype == bool and inputs.robot_mask.any()
    assert inputs.optical_flow.shape == (2, 240, 320, 2)
    with pytest.raises(ConfigError, match="needs_streams = True"):
        _ = read_inputs(episode, max_frames=2).optical_flow


def test_nothing_that_a_model_is_given_leads_to_the_truth(data: Path) -> None:
    """No path, and no view: a frame of a video that is held leads to all its frames."""
    for folder, record in find_records(data):
        inputs = read_inputs((folder, record))
        for field in fields(inputs):
            given = getattr(inputs, field.name)
            assert isinstance(given, (np.ndarray, str, int, float, type(None))), field.name
            assert not isinstance(given, np.ndarray) or given.base is None, field.name
        written = pickle.dumps(inputs)
        assert str(data).encode() not in written and folder.name.encode() in written
        later = truth(data, inputs)[1:]
        assert all(frame.tobytes() not in written for frame in later)


def test_rollouts_resume_in_the_models_own_size(data: Path, tmp_path: Path) -> None:
    arguments = ["own_models_of_test:small", "--data", str(data), "--out", str(tmp_path / "out"), "--condition", "none"]
    outside.main(arguments)
    first, second = find_rollouts(tmp_path / "out")
    assert read_rollout_video(first).shape == (FRAMES, 120, 160, 3) and first.condition == "none"
    before = second.video[0].stat().st_mtime_ns
    shutil.rmtree(first.folder)
    outside.main(arguments)
    assert len(find_rollouts(tmp_path / "out")) == 2 and second.video[0].stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nothing_there:model", "cannot import the model 'nothing_there:model'"),
        ("own_models_of_test:other", "has no attribute 'other'"),
        ("freeze", "expected module:NAME"),
        ("own_models_of_test:number", "is a int; expected a function"),
        ("own_models_of_test:floats", "gave float64 [9, 120, 160, 3]"),
        ("own_models_of_test:short", "gave uint8 [8, 120, 160, 3]"),
    ],
)
def test_a_wrong_model_is_told_what_is_wrong(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, said: str
) -> None:
    with pytest.raises(SystemExit) as stop:
        outside.main([name, "--data", str(data), "--out", str(tmp_path / "out")])
    assert stop.value.code == 2
    assert said in capsys.readouterr().err

"""The latent cache: straight from states as from video, batches, threads, wrong frame counts."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from tests import synthetic
from tests.networks import TINY_CODEC
from tests.sim_warp.small import TASK, work_inline
from xew.config import ConfigError
from xew.dataset import find_accepted
from xew.episode import EpisodeError, read_record, write_video
from xew.model import latents
from xew.model.cache import encode
from xew.model.cache.clips import needed_pixels
from xew.model.cache.encode import encode_episodes, encode_many
from xew.model.cache.store import open_cache
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.codecs.contract import CodecSettings
from xew.model.conditions import Command
from xew.model.devices import parts
from xew.model.experiment import load_experiment
from xew.model.video.pixels import stored_pixels
from xew.protocol import CameraSpec

CONFIG = """
clip: {frames: 9, height: 64, width: 80}
codec: {weights: TINY_CODEC}
model: {size: tiny, action: optical_flow, embodiment: robot_render,
  history: [], reference: frame, visibility: joint, prediction: velocity, dtype: float32, remat: none}
train: {steps: 1, batch: 1,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, ema: 0, motion_loss_weight: 0}
""".replace("TINY_CODEC", str(TINY_CODEC))


def write_config(root: Path) -> str:
    path = root / "config.yaml"
    path.write_text(f"data: {root / 'data'}\nout: {root / 'run'}\n{CONFIG}")
    return str(path)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one simulated episode in data, the same without its videos in bare, and a config."""
    from xew.sim_warp import generate

    root = tmp_path_factory.mktemp("latents")
    chosen = ["--tasks", TASK, "--robots", "aloha_agilex", "--train-seeds", "1", "--test-seeds", "0"]
    with pytest.MonkeyPatch.context() as patch:
        work_inline(patch)
        patch.setattr(sys, "argv", ["generate", *chosen, "--out", str(root / "data")])
        generate.main()
    shutil.copytree(root / "data", root / "bare")
    for video in (root / "bare").rglob("*.mkv"):
        video.unlink()
    for path in (root / "bare").rglob("episode.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"videos": False}))
    write_config(root)
    return root


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_latents_from_states_are_those_from_video(simulated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = str(simulated / "config.yaml")
    latents.main([config])
    bare = [config, "--data", str(simulated / "bare")]
    with pytest.raises(SystemExit):
        latents.main(bare)
    assert "made with --states-only" in capsys.readouterr().err
    latents.main([*bare, "--from-states"])
    from_video, from_states = files(simulated / "data-latents"), files(simulated / "bare-latents")
    assert len([name for name in from_video if name.endswith(".safetensors")]) == 3
    assert from_states == from_video
    assert not list((simulated / "bare").rglob("*.mkv"))


def test_missing_lpips_is_told_before_anything_is_encoded(
    simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> None:
        raise FileNotFoundError("LPIPS needs its weights")

    monkeypatch.setattr("xew.metrics.networks.alexnet.read_alexnet", missing)
    with pytest.raises(SystemExit):
        latents.main([str(simulated / "config.yaml"), "--cache", str(tmp_path / "cache")])
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "LPIPS needs its weights" in said and not (tmp_path / "cache").exists()


def test_processes_encode_as_one_does(simulated: Path, tmp_path: Path) -> None:
    for processes in ("1", "2"):
        shutil.copytree(simulated / "data", tmp_path / processes / "data")
        latents.main([str(simulated / "config.yaml"), "--data", str(tmp_path / processes / "data"), "--processes", processes])
    encoded = {processes: files(tmp_path / processes / "data-latents") for processes in ("1", "2")}
    assert len([name for name in encoded["1"] if name.endswith(".safetensors")]) == 3
    assert encoded["2"] == encoded["1"]


def test_gpus_share_the_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process a GPU encodes, and two read for each; GPUs are names here. Latents are those of one process with threads."""
    encoded, written = [], []
    for gpus in ((), ("4", "7")):
        root = tmp_path / str(len(gpus))
        synthetic.write_synthetic_data(root / "data", seeds=(0, 1, 2), robots=("arx_x5",), frames=7)
        monkeypatch.setattr(encode, "visible_gpus", lambda gpus=gpus: gpus)
        monkeypatch.setattr(jax, "default_backend", lambda gpus=gpus: "gpu" if gpus else "cpu")
        cache = open_cache(load_experiment(Path(write_config(root))).encoding)
        written.append(encode_episodes(cache, find_accepted(root / "data"), processes=2 if gpus else 1))
        assert encode_episodes(cache, find_accepted(root / "data")) == 0
        encoded.append(files(root / "data-latents"))
    assert encoded[1] == encoded[0] and len(encoded[0]) == 9
    assert written[1] == written[0] > 0


@pytest.mark.parametrize(
    ("processes", "cores", "gpus", "episodes", "readers"),
    [
        (0, 64, 4, 900, 14),
        (0, 64, 8, 900, 6),
        (0, 128, 4, 900, 16),
        (0, 64, 4, 20, 5),
        (0, 64, 4, 7, 0),
        (0, 3, 1, 900, 0),
        (1, 64, 4, 900, 0),
        (9, 4, 1, 900, 9),
    ],
)
def test_readers_of_a_gpu_follow_from_cores_and_work(
    processes: int, cores: int, gpus: int, episodes: int, readers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(encode, "usable_cores", lambda: cores)
    monkeypatch.setattr(parts, "free_gpu_memory", lambda _: (78.0,))
    assert encode.count_readers(processes, episodes, gpus) == readers


@pytest.fixture(scope="module")
def codec() -> ConvAutoencoderCodec:
    return ConvAutoencoderCodec.open(CodecSettings(weights=TINY_CODEC))


def test_batches_encode_as_single_clips_do(codec: ConvAutoencoderCodec) -> None:
    rng = np.random.default_rng(1)
    clips = [rng.integers(0, 255, (frames, 32, 32, 3), np.uint8) for frames in (5, 1, 5, 5, 9, 1, 5, 5)]
    for batch in (1, 4):
        for clip, encoded in zip(clips, encode_many(codec, clips, batch), strict=True):
            np.testing.assert_allclose(encoded, codec.encode(clip), atol=1e-5)


def test_clip_of_a_wrong_length_is_told(codec: ConvAutoencoderCodec) -> None:
    with pytest.raises(ValueError, match="t = 4 k"):
        encode_many(codec, [np.zeros((6, 32, 32, 3), np.uint8)], 4)


def test_video_that_is_not_as_long_as_its_episode_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder,) = synthetic.write_synthetic_data(tmp_path / "data", seeds=(0,), robots=("arx_x5",), frames=7)
    video = stored_pixels(folder, read_record(folder), ("rgb",))["rgb"]
    write_video(folder / "rgb.mkv", video[:5])
    with pytest.raises(EpisodeError, match=r"arx_x5: rgb has hash \w+, expected \w+ as in its header.*Delete the folder"):
        stored_pixels(folder, read_record(folder), ("rgb",))
    with pytest.raises(SystemExit) as stop:
        latents.main([write_config(tmp_path)])
    assert stop.value.code == 2
    assert "rgb has hash" in capsys.readouterr().err


@pytest.mark.parametrize("change", [lambda clips: clips[:-1], lambda clips: clips[..., :-1], lambda clips: clips.sum()])
def test_latents_of_another_shape_are_refused(change: Any, simulated: Path, tmp_path: Path) -> None:
    config = [str(simulated / "config.yaml"), "--cache", str(tmp_path / "cache")]
    latents.main(config)
    experiment = load_experiment(config[0], config[1:])
    cache, (_, record) = open_cache(experiment.encoding), find_accepted(simulated / "data")[0]
    path = cache.path(record, "rgb")
    assert cache.read(record, "rgb", 0).shape == experiment.inputs.latent_shape
    save_file({"clips": np.array(change(load_file(path)["clips"]))}, path)
    with pytest.raises(ConfigError, match=r"is damaged \(its shape is .*, expected .*; delete it and"):
        cache.read(record, "rgb", 0)


def test_latents_of_a_view_depend_on_the_table_before_its_robot(simulated: Path) -> None:
    cache = open_cache(load_experiment(simulated / "config.yaml").encoding)
    head = find_accepted(simulated / "data")[0][1]
    side, raised = (replace(head, camera=CameraSpec("side"), table=table) for table in (None, 0.75))
    paths = {name: {cache.path(record, name) for record in (head, side, raised)} for name in cache.streams}
    assert {name: len(of_name) for name, of_name in paths.items()} == {"rgb": 1, "action": 3, "embodiment": 3}


def test_latents_of_conditions_depend_on_the_height_of_the_table_and_on_no_other_change(simulated: Path) -> None:
    cache = open_cache(load_experiment(simulated / "config.yaml").encoding)
    plain = find_accepted(simulated / "data")[0][1]
    records = [plain, *(replace(plain, change=change) for change in ("light:2", "height:3", "height:4"))]
    paths = {name: {cache.path(record, name) for record in records} for name in cache.streams}
    assert {name: len(of_name) for name, of_name in paths.items()} == {"rgb": 1, "action": 3, "embodiment": 3}


def test_a_description_of_the_robot_has_a_length_of_its_own(simulated: Path, tmp_path: Path) -> None:
    """Nine views are three latent frames, whatever the length of a clip."""
    config = [str(simulated / "config.yaml"), "--cache", str(tmp_path / "cache"), "--model.embodiment", "nine_views"]
    latents.main([*config, "--clip.frames", "5"])
    experiment = load_experiment(config[0], [*config[1:], "--clip.frames", "5"])
    cache, (_, record) = open_cache(experiment.encoding), find_accepted(simulated / "data")[0]
    assert cache.read(record, "embodiment", 0).shape == (3, *experiment.inputs.latent_shape[1:])


def test_only_what_is_needed_is_read(simulated: Path) -> None:
    experiment = load_experiment(simulated / "config.yaml")
    assert needed_pixels(experiment.conditions, ["rgb", "action", "embodiment"]) == ["rgb", "robot"]
    assert needed_pixels(experiment.conditions, ["action"]) == []
    joints = load_experiment(simulated / "config.yaml", ["--model.action", "joints", "--model.embodiment", "none"])
    assert needed_pixels(joints.conditions, ["rgb", "joints"]) == ["rgb"]
    for embodiment in ("pasted_render", "carried_render"):
        pasted = load_experiment(simulated / "config.yaml", ["--model.action", "none", "--model.embodiment", embodiment])
        assert needed_pixels(pasted.conditions, ["map_channels"]) == ["robot"], "one frame of the scene is no whole video"


def test_a_render_at_hand_is_not_read_again() -> None:
    video = np.zeros((1, 2, 2, 3), np.uint8)
    command = Command("piper", np.zeros((1, 16), np.float32), np.eye(3), np.eye(4), Path("nowhere.mkv"), video)
    assert command.render is video

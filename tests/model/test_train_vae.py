"""Training an autoencoder on synthetic data: what it is fed, resuming, its file, and a world model's latents by it."""

import json
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest

from tests import synthetic
from xew.dataset import find_accepted, read_dataset
from xew.episode import EpisodeError, read_video
from xew.model import latents, train_vae
from xew.model.cache.store import open_cache
from xew.model.codecs.codec import CodecSettings, WanVaeCodec
from xew.model.episodes.choice import training_episodes
from xew.model.experiment import load_experiment
from xew.model.settings.parts import EpisodeChoice
from xew.model.train_vae import init_vae_state, load_vae_experiment, make_vae_step
from xew.model.training.vae_data import Cut, make_dataset, random_clips, read_frames, video_files
from xew.model.video.frames import to_model_size
from xew.protocol import seed_split

pytestmark = pytest.mark.usefixtures("quick_compile")

CONFIG = """
clip: {frames: 5, height: 64, width: 80}
vae: tiny
streams: [rgb, robot_render]
train:
  steps: 4
  batch: 2
  frames: 5
  crop: 32
  clips_of_a_video: 2
  learning_rate: 2e-3
  warmup_steps: 0
  decay_to: 1.0
  lpips: 0.0
  statistics_clips: 4
  log_every: 1
  save_every: 2
  sample_every: 0
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data and vae.yaml."""
    root = tmp_path_factory.mktemp("world")
    synthetic.write_synthetic_data(root / "data", seeds=(0, 1_000_000), frames=12)
    (root / "vae.yaml").write_text(f"data: {root / 'data'}\nout: {root / 'run'}\n{CONFIG}")
    return root


@pytest.fixture(scope="module")
def run(world: Path) -> Path:
    """Four straight steps."""
    train_vae.main([str(world / "vae.yaml")])
    return world / "run"


def lines(run: Path, name: str) -> list[float]:
    logged = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [line[name] for line in logged if name in line]


def test_resumed_run_repeats_the_straight_one(world: Path, run: Path) -> None:
    config, out = str(world / "vae.yaml"), world / "resumed"
    train_vae.main([config, "--out", str(out), "--train.steps", "2"])
    train_vae.main([config, "--out", str(out), "--resume"])
    assert len(lines(run, "train/loss")) == 4
    assert lines(out, "train/loss") == lines(run, "train/loss")
    stored, resumed = (json.loads((folder / "vae.json").read_text()) for folder in (run, out))
    assert stored["hash"] == resumed["hash"]


def test_what_is_written_is_a_codec(run: Path) -> None:
    """Its latents are of zero mean and unit size on what it was trained on, and its quality is on record."""
    report = json.loads((run / "vae.json").read_text())
    assert set(report["reconstruction"]) == {"seen", "unseen"}
    assert all(5 < found["psnr"] < 60 and found["lpips"] > 0 for found in report["reconstruction"].values())
    settings = CodecSettings("wan_vae", spatial_factor=8, channels=48, vae="tiny", weights=run)
    codec = WanVaeCodec.prepare(settings, list)
    assert codec.hash == report["hash"]
    experiment = load_vae_experiment(run / "config.yaml")
    files = video_files(
        experiment.streams,
        training_episodes(read_dataset(experiment.data), EpisodeChoice(experiment.robots)),
        experiment.cache_folder,
    )
    clips = [random_clips(*file, experiment.cut(whole=True), np.random.default_rng(1))[0] for file in files]
    encoded = np.concatenate([codec.encode(clip).reshape(-1, codec.channels) for clip in clips])
    assert np.abs(encoded.mean(0)).max() < 0.3
    assert np.abs(np.log(encoded.std(0))).max() < 0.3


def test_a_world_model_s_latents_are_made_with_it(world: Path, run: Path) -> None:
    config = world / "world_model.yaml"
    config.write_text(f"""
data: {world / "data"}
out: {world / "model"}
clip: {{frames: 5, height: 64, width: 80}}
codec: {{name: wan_vae, spatial_factor: 8, channels: 48, vae: tiny, weights: {run}}}
model: {{size: tiny}}
train: {{steps: 1, batch: 1}}
""")
    latents.main([str(config)])
    experiment = load_experiment(config)
    episodes = training_episodes(read_dataset(experiment.data), EpisodeChoice(experiment.robots))
    cache = open_cache(experiment.encoding, episodes)
    codec = cache.codec
    stored = cache.read(episodes[0][1], "rgb", 0)
    clip = to_model_size(read_video(episodes[0][0] / "rgb.mkv")[:5], 64, 80)
    np.testing.assert_allclose(stored, codec.encode(clip), atol=0.01)
    header = json.loads((experiment.cache_folder / "header.json").read_text())
    measured = json.loads((run / "vae.json").read_text())["reconstruction"]["unseen"]
    assert header["ceiling"]["psnr"] == pytest.approx(measured["psnr"], abs=0.05)
    assert header["ceiling"]["robots"] == ["franka_panda", "piper"]


def test_steps_learn(world: Path) -> None:
    """One batch again and again is reconstructed better."""
    experiment = load_vae_experiment(world / "vae.yaml", ["--train.steps", "100", "--train.lpips", "0.2"])
    graph, statistics, state = init_vae_state(experiment)
    step = make_vae_step(graph, statistics, experiment)
    files = video_files(
        ("rgb",), training_episodes(read_dataset(experiment.data), EpisodeChoice(experiment.robots)), experiment.cache_folder
    )
    pictures = next(iter(make_dataset(files, experiment.cut(), 2, 0)))
    psnr, perceptual = [], []
    for _ in range(25):
        state, losses = step(state, pictures)
        psnr.append(float(losses.psnr))
        perceptual.append(float(losses.lpips))
    assert np.isfinite(psnr).all() and np.isfinite(perceptual).all()
    assert psnr[-1] > psnr[0] + 3 and perceptual[-1] < perceptual[0]
    behind = [np.abs(a - b).mean() for a, b in zip(*map(jax.tree.leaves, (state.params, state.ema)), strict=True)]
    assert max(behind) > 0


def test_only_training_robots_and_seeds_are_seen(world: Path) -> None:
    experiment = load_vae_experiment(world / "vae.yaml")
    chosen = training_episodes(read_dataset(experiment.data), EpisodeChoice(experiment.robots))
    everything = find_accepted(experiment.data)
    robots = {record.robot for _, record in chosen}
    assert robots == set(experiment.robots.train_robots) and len(chosen) == 3 < len(everything)
    assert all(seed_split(record.seed) == "train" for _, record in chosen)
    files = video_files(("rgb", "rgb", "robot_render"), chosen, experiment.cache_folder)
    assert [path.name for path, _ in files[:3]] == ["rgb.mkv", "rgb.mkv", "robot.mkv"]


def test_clips_are_of_the_video(world: Path) -> None:
    folder, record = find_accepted(world / "data")[0]
    video = to_model_size(read_video(folder / "rgb.mkv"), 64, 80)
    clips = random_clips(folder / "rgb.mkv", record.frame_count, Cut(3, 5, (64, 80), (32, 48)), np.random.default_rng(0))
    assert clips.shape == (3, 5, 32, 48, 3)
    views = np.lib.stride_tricks.sliding_window_view(video, (5, 32, 48), (0, 1, 2)).transpose(0, 1, 2, 4, 5, 6, 3)
    for clip in clips:
        places = np.argwhere((views[:, :, :, 0, 0, 0] == clip[0, 0, 0]).all(-1))
        assert any(np.array_equal(views[tuple(place)], clip) for place in places)


def test_a_short_video_is_continued_by_its_last_frame(world: Path) -> None:
    folder, record = find_accepted(world / "data")[0]
    clip = random_clips(folder / "rgb.mkv", record.frame_count, Cut(1, 17, (64, 80), (64, 80)), np.random.default_rng(0))[0]
    np.testing.assert_array_equal(clip[12:], np.repeat(clip[11:12], 5, 0))
    with pytest.raises(EpisodeError, match="damaged or shorter"):
        read_frames(folder / "rgb.mkv", {12})


def fails(command: Callable[[list[str]], None], arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        command(arguments)
    assert stop.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "said"),
    [
        (["--train.crop", "36"], "multiple of 8"),
        (["--train.frames", "8"], "4 k + 1"),
        (["--train.clips-of-a-video", "0"], "train.clips_of_a_video is 0; it must be at least 1"),
        (["--train.statistics-clips", "0"], "train.statistics_clips is 0; it must be at least 1"),
        (["--vae", "smal"], "did you mean 'small'"),
        (["--streams", "rbg"], "did you mean 'rgb'"),
        (["--train.batch", "3"], "multiple of train.clips_of_a_video"),
        (["--data", "nowhere"], "nowhere"),
    ],
)
def test_mistakes_are_told(override: list[str], said: str, world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(world / "mistaken")]
    assert said in fails(train_vae.main, [str(world / "vae.yaml"), *out, *override], capsys)
    assert not (world / "mistaken").exists()


def test_a_run_is_not_overwritten_unasked(world: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = str(world / "vae.yaml")
    assert "--resume" in fails(train_vae.main, [config], capsys)
    assert "train.kl" in fails(train_vae.main, [config, "--resume", "--train.kl", "1.0"], capsys)

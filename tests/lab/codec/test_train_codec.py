"""Training an autoencoder on synthetic data: what it is fed, resuming, its budget, its file, its report, a model's latents."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lab.codec import __main__ as train_codec
from lab.codec import pictures as pictures_module
from lab.codec import sampling
from lab.codec.pictures import Cut, Pictures, cut_description, gather_pictures
from lab.codec.report import choose_robots
from lab.codec.sampling import Batches, Schedule
from lab.codec.settings import CodecTrainSettings, load_codec_experiment
from lab.codec.step import augment, codec_losses, unpack_regions
from lab.codec.unpaired import select_unpaired, unpaired_training_episodes
from tests import synthetic
from xew.config import ConfigError
from xew.dataset import find_accepted, read_dataset
from xew.episode import EpisodeError, read_states, read_video
from xew.model import latents
from xew.model.cache.store import open_cache
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.codecs.ceiling import reconstruct
from xew.model.codecs.contract import CodecSettings
from xew.model.episodes.choice import training_episodes
from xew.model.experiment import load_experiment
from xew.model.training.loop import STOPPED
from xew.model.video.frames import to_model_size
from xew.protocol import HELD_OUT_ROBOTS, SEEN_ROBOTS, SHARED_MOTION, expand_robots

CONFIG = """
clip: {frames: 5, height: 64, width: 96}
size: tiny
streams: {rgb: 1, robot_render: 1}
pictures: {every: 1, host_gb: 1}
report: {clips: 1, trained_robots: 1}
train:
  steps: 4
  batch: 2
  learning_rate: 2e-3
  warmup_steps: 2
  lpips: 0.0
  region: 1.0
  flip: true
  jitter: 0.1
  statistics_clips: 64
  log_every: 1
  save_every: 2
  sample_every: 0
"""
CONFIGS = Path(__file__).parents[3] / "lab" / "codec"
CUT = Cut(4, 2, 64, 96)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data and codec.yaml."""
    root = tmp_path_factory.mktemp("world")
    synthetic.write_synthetic_data(root / "data", seeds=(0, 1_000_000), frames=12)
    (root / "codec.yaml").write_text(f"data: {root / 'data'}\nout: {root / 'run'}\n{CONFIG}")
    return root


@pytest.fixture(scope="module")
def run(world: Path) -> Path:
    """Four straight steps of the project's own autoencoder."""
    train_codec.main([str(world / "codec.yaml")])
    return world / "run"


def lines(run: Path, name: str) -> list[float]:
    logged = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [line[name] for line in logged if name in line]


def description(run: Path) -> dict[str, Any]:
    return json.loads((run / "autoencoder.json").read_text())


def test_resumed_run_repeats_the_straight_one(world: Path, run: Path) -> None:
    config, out = str(world / "codec.yaml"), world / "resumed"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stop:
        patch.setattr("xew.model.training.loop.StopSignal.is_agreed", lambda signal: next(asked))
        asked = iter([False] * 3 + [True])  # twice a step
        train_codec.main([config, "--out", str(out)])
    assert stop.value.code == STOPPED
    assert not (out / "autoencoder.safetensors").exists()
    train_codec.main([config, "--out", str(out), "--resume"])
    assert len(lines(run, "loss/train")) == 4
    assert lines(out, "loss/train") == lines(run, "loss/train")
    assert description(out)["hash"] == description(run)["hash"]
    assert (out / "autoencoder.safetensors").read_bytes() == (run / "autoencoder.safetensors").read_bytes()


def test_what_is_written_is_a_codec(run: Path) -> None:
    """Its latents are of zero mean and unit size on what it was trained on, and its hash and size are on record."""
    said = description(run)
    codec = ConvAutoencoderCodec.open(CodecSettings(weights=run))
    assert codec.hash == said["hash"] and said["steps"] == 4
    assert said["bytes"] == (run / "autoencoder.safetensors").stat().st_size
    experiment = load_codec_experiment(run / "config.yaml")
    clips = training_pictures(experiment).clips
    encoded = [codec.encode(np.concatenate([clip[:1], clip]))[1:].reshape(-1, 48) for clip in clips]
    assert np.abs(np.concatenate(encoded).mean(0)).max() < 0.3
    assert np.abs(np.log(np.concatenate(encoded).std(0))).max() < 0.3


def training_pictures(experiment: Any, regions: bool = False) -> Pictures:
    episodes = unpaired_training_episodes(read_dataset(experiment.data), experiment.train_robots, experiment.motion)
    return gather_pictures(episodes, list(experiment.streams), experiment.cut, 1.0, regions=regions)


def test_the_report_is_of_robots_that_were_not_trained_on(run: Path) -> None:
    """Every robot and stream has its ceilings, a row of the table and a picture; test seeds were not read."""
    rows = description(run)["reconstruction"]
    assert {(row["robot"], row["stream"]) for row in rows if not row["trained"]} == {
        (robot, stream) for robot in HELD_OUT_ROBOTS for stream in ("rgb", "robot_render")
    }
    assert {row["robot"] for row in rows if row["trained"]} == {SEEN_ROBOTS[0]}
    assert all(5 < row["psnr"] < 60 and 0 < row["lpips"] < 2 and 0 < row["region_psnr"] < 60 for row in rows)
    table = (run / "report.md").read_text()
    assert "training seeds" in table and table.count("| piper |") == 2
    assert "rgb, robots not trained on: PSNR" in table
    assert {path.name for path in (run / "pictures").iterdir()} == {f"{row['robot']}-{row['stream']}.png" for row in rows}


def test_ceilings_are_those_of_the_metrics(run: Path) -> None:
    """One of them by hand: two clips' worth of frames through the codec, graded at the camera's size."""
    from xew.metrics import psnr

    experiment, codec = load_codec_experiment(run / "config.yaml"), ConvAutoencoderCodec.from_weights(run)
    ((folder, _),) = select_unpaired(read_dataset(experiment.data), ("piper",), "train")
    video, mask = read_video(folder / "rgb.mkv")[:5], read_states(folder).robot_mask[:5]
    decoded = reconstruct(codec, video, len(video), 64, 96)
    (row,) = (r for r in description(run)["reconstruction"] if r["robot"] == "piper" and r["stream"] == "rgb")
    assert row["psnr"] == pytest.approx(float(np.mean(psnr(decoded, video))), abs=0.02)
    squares = np.square(decoded[mask].astype(float) - video[mask]).mean()
    assert row["region_psnr"] == pytest.approx(10 * np.log10(255**2 / squares), abs=0.02)


def test_robots_of_the_report(world: Path) -> None:
    experiment, dataset = load_codec_experiment(world / "codec.yaml"), read_dataset(world / "data")
    assert choose_robots(experiment, dataset) == [*HELD_OUT_ROBOTS, SEEN_ROBOTS[0]]
    asked = replace(experiment, report=replace(experiment.report, robots=("ur5_wsg",), trained_robots=0))
    assert choose_robots(asked, dataset) == ["ur5_wsg"]


def test_a_world_model_s_latents_are_made_with_it(world: Path, run: Path) -> None:
    config = world / "world_model.yaml"
    config.write_text(f"""
data: {world / "data"}
out: {world / "model"}
clip: {{frames: 5, height: 64, width: 96}}
codec: {{weights: {run}}}
model: {{size: tiny}}
train: {{steps: 1, batch: 1}}
""")
    latents.main([str(config)])
    experiment = load_experiment(config)
    episodes = training_episodes(read_dataset(experiment.data), experiment.choice)
    cache = open_cache(experiment.encoding)
    stored = cache.read(episodes[0][1], "rgb", 0)
    clip = to_model_size(read_video(episodes[0][0] / "rgb.mkv")[:5], 64, 96)
    np.testing.assert_allclose(stored, cache.codec.encode(clip), atol=0.02)


# Pictures.


def test_clips_are_of_the_videos_and_regions_of_the_robots(world: Path) -> None:
    episodes = select_unpaired(read_dataset(world / "data"), SEEN_ROBOTS, "train")
    found = gather_pictures(episodes, ["robot_render", "rgb"], CUT, 1.0, regions=True)
    starts = [CUT.starts(record) for _, record in episodes]
    assert all(0 <= start <= 8 for some in starts for start in some)
    assert {name: len(numbers) for name, numbers in found.streams.items()} == dict.fromkeys(
        ("robot_render", "rgb"), sum(map(len, starts))
    )
    folder, start = episodes[0][0], starts[0][0]
    first = found.streams["rgb"][0]
    video = to_model_size(read_video(folder / "rgb.mkv"), 64, 96)
    np.testing.assert_array_equal(found.clips[first], video[start : start + 4])
    bits = np.asarray(unpack_regions(jnp.asarray(found.regions[first : first + 1]), 4))[0, ..., 0]
    mask = np.repeat(read_states(folder).robot_mask[start : start + 4, ..., None], 3, -1).astype(np.uint8) * 255
    np.testing.assert_array_equal(bits > 0, to_model_size(mask, 64, 96)[..., 0] > 127)
    assert 0 < bits.mean() < 0.5
    assert gather_pictures(episodes, ["rgb"], CUT, 1.0).regions is None


def test_streams_that_are_drawn_may_be_of_fewer_episodes(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(pictures_module.DRAWN, "mask", lambda command: np.full((13, 240, 320, 3), 7, np.uint8))
    episodes = select_unpaired(read_dataset(world / "data"), SEEN_ROBOTS, "train")
    found = gather_pictures(episodes, ["rgb", "mask"], replace(CUT, drawn_every=2), 1.0)
    counts = [len(CUT.starts(record)) for _, record in episodes]
    assert len(episodes) == 3 and len(found.streams["rgb"]) == sum(counts)
    assert len(found.streams["mask"]) == counts[0] + counts[2]
    assert (found.clips[list(found.streams["mask"])] == 7).all()


def test_a_short_video_is_continued_by_its_last_frame(world: Path) -> None:
    episodes = select_unpaired(read_dataset(world / "data"), ("piper",), "train")
    found = gather_pictures(episodes, ["rgb"], Cut(17, 1, 64, 96), 1.0)
    assert found.clips.shape == (1, 17, 64, 96, 3)
    np.testing.assert_array_equal(found.clips[0, 12:], np.repeat(found.clips[0, 11:12], 5, 0))
    folder, record = episodes[0]
    with pytest.raises(EpisodeError, match="has 12 frames, its header says 13"):
        gather_pictures([(folder, replace(record, frame_count=13))], ["rgb"], Cut(17, 1, 64, 96), 1.0, regions=False)


def test_descriptions_of_robots_are_drawn_once_and_taken_whole(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In groups as a codec takes them: the first picture four times, then fours."""
    drawn = []

    def draw(command: Any) -> np.ndarray:
        drawn.append(command.robot)
        return np.stack([np.full((240, 320, 3), 20 * number, np.uint8) for number in range(9)])

    monkeypatch.setitem(pictures_module.UNALIGNED, "nine_views", draw)
    episodes = select_unpaired(read_dataset(world / "data"), SEEN_ROBOTS, "train") * 2
    found = gather_pictures(episodes, ["rgb", "nine_views"], CUT, 1.0)
    assert sorted(drawn) == sorted(SEEN_ROBOTS)
    groups = found.clips[list(found.streams["nine_views"])][:3, :, 0, 0, 0]
    np.testing.assert_array_equal(groups, [[0, 0, 0, 0], [20, 40, 60, 80], [100, 120, 140, 160]])
    assert cut_description(np.zeros((9, 64, 96, 3), np.uint8), 5).shape == (1, 5, 64, 96, 3)


def test_too_many_pictures_are_told_before_any_is_decoded(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures_module, "read_pixels", None)
    episodes = select_unpaired(read_dataset(world / "data"), SEEN_ROBOTS, "train")
    with pytest.raises(ConfigError, match=r"more than pictures\.host_gb 1e-06; raise pictures\.every \(now 2\)"):
        gather_pictures(episodes, ["rgb"], CUT, 1e-6)


def test_only_training_robots_and_seeds_are_seen(world: Path) -> None:
    dataset = read_dataset(world / "data")
    chosen = unpaired_training_episodes(dataset, SEEN_ROBOTS, SHARED_MOTION)
    assert {record.robot for _, record in chosen} == set(SEEN_ROBOTS)
    assert len(chosen) == 3 < len(find_accepted(world / "data"))
    with pytest.raises(ConfigError, match="has no training episode with videos of body_0, body_1; it has aloha_agilex"):
        unpaired_training_episodes(dataset, expand_robots(["body:0-1"]), SHARED_MOTION)


# Samples.


def counting(n: int = 40) -> Pictures:
    clips = np.arange(n, dtype=np.uint8)[:, None, None, None, None] * np.ones((1, 4, 2, 2, 3), np.uint8)
    return Pictures(clips, None, {"rgb": range(0, 30), "mask": range(30, n)})


def test_samples_follow_the_shares_and_the_step_alone() -> None:
    settings = CodecTrainSettings(batch=64, steps=100)
    batches = Batches(counting(), {"mask": 3.0, "rgb": 1.0, "nine_views": 5.0}, settings)
    straight = [next(batches) for _ in range(6)]
    numbers = np.concatenate([batch.clips[:, 0, 0, 0, 0] for batch in straight])
    assert set(numbers) == set(range(40))
    assert (numbers >= 30).mean() == pytest.approx(0.75, abs=0.07)
    again = Batches(counting(), {"mask": 3.0, "rgb": 1.0}, settings)
    again.set_state(json.loads(json.dumps({"step": 4, "seconds": 0.0})))
    for expected, found in zip(straight[4:], (next(again), next(again)), strict=True):
        np.testing.assert_array_equal(found.clips, expected.clips)
        assert found.rate == expected.rate
    assert again.get_state()["step"] == 6


def test_pictures_on_a_device_are_the_same_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    host = Batches(counting(), {"rgb": 1.0}, CodecTrainSettings(batch=8, steps=9))
    placed = replace(counting(), clips=jnp.asarray(counting().clips))
    device = Batches(placed, {"rgb": 1.0}, CodecTrainSettings(batch=8, steps=9))
    assert device.on_device and not host.on_device
    np.testing.assert_array_equal(next(device).clips, next(host).clips)
    assert sampling.place_pictures(counting(), 0.5).clips.__class__ is np.ndarray, "a CPU has no memory of its own"


def test_rate_follows_steps_or_time() -> None:
    by_steps = Schedule(CodecTrainSettings(batch=1, steps=10, warmup_steps=0, learning_rate=1.0, decay_to=0.1))
    assert [by_steps.rate(step, 99.0) for step in (0, 5, 10)] == pytest.approx([1.0, 0.55, 0.1])
    assert by_steps.is_over(10, 0.0) and not by_steps.is_over(9, 1e9)
    by_time = Schedule(CodecTrainSettings(batch=1, seconds=60.0, warmup_steps=4, learning_rate=1.0, decay_to=0.1))
    assert by_time.rate(1, 30.0) == pytest.approx(0.275)
    assert by_time.rate(100, 60.0) == pytest.approx(0.1)
    assert by_time.is_over(3, 60.0) and not by_time.is_over(10**9, 59.0)


def test_a_budget_of_time_ends_the_training(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each look at the clock is a quarter of a second; what passed before an interruption counts when it goes on."""
    monkeypatch.setattr("lab.codec.sampling.perf_counter", Ticks())
    config, out = str(world / "codec.yaml"), world / "timed"
    options = ["--train.steps", "0", "--report.no-pictures", "--report.trained-robots", "0", "--report.robots", "piper"]
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):
        asked = iter([False] * 5 + [True])  # twice a step
        patch.setattr("xew.model.training.loop.StopSignal.is_agreed", lambda signal: next(asked))
        train_codec.main([config, "--out", str(out), "--train.seconds", "10", *options])
    taken = len(lines(out, "loss/train"))
    train_codec.main([config, "--out", str(out), "--train.seconds", "10", *options, "--resume"])
    rates = lines(out, "train/learning_rate")
    assert taken == 3 < len(rates)
    assert rates[-1] < 0.2 * max(rates), "the rate has come down with the time"
    assert description(out)["seconds"] == pytest.approx(10, abs=1.5)


class Ticks:
    """A clock that goes on by a quarter of a second whenever it is read."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 0.25
        return self.now


# What is done to samples.


def shown(settings: CodecTrainSettings, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random clips [16 4 32 32 3], and what is shown of them with their regions, whose value is the red channel's."""
    clips = jax.random.uniform(jax.random.key(seed), (16, 4, 32, 32, 3), minval=-0.5, maxval=0.5)
    made, regions = augment(jax.random.split(jax.random.key(1), 16), clips, clips[..., :1], settings)
    return np.asarray(clips), np.asarray(made), np.asarray(regions)


def test_nothing_is_changed_unasked() -> None:
    clips, made, regions = shown(CodecTrainSettings(batch=16, permute=0.0, still=0.0))
    np.testing.assert_array_equal(made, clips)
    np.testing.assert_array_equal(regions, clips[..., :1])


def test_colors_change_places_in_a_part_of_the_samples() -> None:
    clips, made, regions = shown(CodecTrainSettings(batch=16, permute=0.5, still=0.0))
    np.testing.assert_array_equal(regions, clips[..., :1])
    np.testing.assert_allclose(np.sort(made, -1), np.sort(clips, -1))
    changed = (made != clips).any(axis=(1, 2, 3, 4))
    assert 0 < changed.sum() < 16


def test_samples_are_mirrored_with_their_regions_and_stand_still() -> None:
    clips, made, regions = shown(CodecTrainSettings(batch=16, permute=0.0, still=0.0, flip=True))
    np.testing.assert_array_equal(regions, made[..., :1])
    mirrored = np.array([np.array_equal(m, c[:, :, ::-1]) for m, c in zip(made, clips, strict=True)])
    same = np.array([np.array_equal(m, c) for m, c in zip(made, clips, strict=True)])
    assert (mirrored | same).all() and mirrored.any() and same.any()
    _, made, regions = shown(CodecTrainSettings(batch=16, permute=0.0, still=0.5))
    still = (made == made[:, :1]).all(axis=(1, 2, 3, 4))
    assert 0 < still.sum() < 16
    np.testing.assert_array_equal(regions, made[..., :1])


def test_jitter() -> None:
    clips, made, _ = shown(CodecTrainSettings(batch=16, permute=0.0, still=0.0, jitter=0.2))
    change = np.abs(made - clips).max(axis=(1, 2, 3, 4))
    assert (change == 0).any() and 0.02 < change.max() <= 0.2 * 0.5 + 0.2


def test_the_robot_s_pixels_weigh_more(world: Path) -> None:
    """With a weight on the region, the same errors count by where they are."""
    clips = jnp.zeros((1, 4, 32, 32, 3))
    inside = jnp.zeros((1, 4, 32, 32, 1)).at[:, :, :8].set(1.0)
    settings = CodecTrainSettings(batch=1, lpips=0.0, region=3.0, noise=0.0)
    weights, key = 1 + settings.region * inside, jax.random.key(0)
    here, elsewhere = (float(codec_losses(Off(where), clips, weights, key, settings).l1) for where in (inside, 1 - inside))
    assert here == pytest.approx(4 * 0.25 / (4 * 0.25 + 0.75))
    assert here + elsewhere == pytest.approx(1)


@dataclass(frozen=True)
class Off:
    """Stands for an autoencoder whose pictures are off by these errors."""

    errors: Any

    def encode_groups(self, groups: Any) -> Any:
        return groups

    def decode_groups(self, latents: Any) -> Any:
        return latents + self.errors


# Mistakes.


def fails(command: Callable[[list[str]], None], arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        command(arguments)
    assert stop.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "said"),
    [
        (["--clip.height", "40"], "multiple of 16"),
        (["--clip.frames", "8"], "4 k + 1"),
        (["--pictures.every", "0"], "pictures.every is 0; it must be at least 1"),
        (["--train.seconds", "5"], "train.steps is 4, train.seconds 5; set one of them"),
        (["--train.steps", "0"], "train.steps is 0, train.seconds 0; set one of them"),
        (["--size", "bas"], "did you mean 'base'"),
        (["--split", "fixd"], "did you mean 'fixed'"),
        (["--streams.rgb", "-1"], "must be at least 0"),
        (["--data", "nowhere"], "nowhere"),
    ],
)
def test_mistakes_are_told(override: list[str], said: str, world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(world / "mistaken")]
    assert said in fails(train_codec.main, [str(world / "codec.yaml"), *out, *override], capsys)
    assert not (world / "mistaken").exists()


def test_a_stream_that_does_not_exist_is_told(world: Path) -> None:
    text = (world / "codec.yaml").read_text().replace("streams: {rgb: 1", "streams: {rbg: 1")
    (world / "wrong.yaml").write_text(text)
    with pytest.raises(ConfigError, match="did you mean 'rgb'"):
        load_codec_experiment(world / "wrong.yaml")


def test_a_run_is_not_overwritten_unasked(world: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = str(world / "codec.yaml")
    assert "--resume" in fails(train_codec.main, [config], capsys)
    assert "train.penalty" in fails(train_codec.main, [config, "--resume", "--train.penalty", "1.0"], capsys)


@pytest.mark.parametrize("name", ["codec", "debug"])
def test_configs_are_valid(name: str) -> None:
    assert load_codec_experiment(CONFIGS / f"{name}.yaml").cut.clip_bytes > 0


def test_the_shipped_codec_learns_from_bodies_alone() -> None:
    experiment = load_codec_experiment(CONFIGS / "codec.yaml")
    assert experiment.train_robots == tuple(f"body_{number}" for number in range(64))
    assert set(experiment.streams) == {*pictures_module.ALIGNED, *pictures_module.UNALIGNED}
    assert not experiment.report.test_seeds


def test_missing_lpips_is_told_before_anything_is_decoded(
    world: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> None:
        raise FileNotFoundError("LPIPS needs its weights")

    monkeypatch.setattr("xew.metrics.networks.alexnet.read_alexnet", missing)
    said = fails(train_codec.main, [str(world / "codec.yaml"), "--out", str(world / "mistaken")], capsys)
    assert said.count("\n") == 1 and "LPIPS needs its weights" in said
    assert not (world / "mistaken").exists()

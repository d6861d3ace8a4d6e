"""Latents, training, resuming and rollouts on synthetic data, end to end and tiny."""

import ast
import functools
import itertools
import json
import os
import shutil
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests import synthetic
from tests.networks import TINY_CODEC
from xew.dataset import find_accepted, find_records, read_dataset, view_folder
from xew.episode import HEIGHT, WIDTH, read_record, read_video, verify_episode
from xew.metrics.evaluate import grade_tables
from xew.metrics.grading.settings import Args
from xew.model import latents, rollout, train
from xew.model.cache.clips import clip_starts
from xew.model.codecs.contract import decode_to_pictures, encode_pictures
from xew.model.devices.sharding import MeshSettings, make_mesh, place_batch
from xew.model.episodes.choice import training_episodes
from xew.model.experiment import Experiment, load_experiment
from xew.model.runs.log import RunLog
from xew.model.runs.roundtrip import open_roundtrip
from xew.model.training import order
from xew.model.training.data import ClipSource, fake_batch
from xew.model.training.order import make_dataset
from xew.model.training.step import as_float32
from xew.protocol import SEEN_ROBOTS, CameraSpec
from xew.rollout import find_rollouts, read_rollout_video
from xew.sim_warp.inspection.checks import tile_views

FRAMES = 12
CONFIG = """
clip: {frames: 5, height: 64, width: 80}
codec: {weights: TINY_CODEC}
model: {size: tiny, action: joints, embodiment: robot_render,
  history: [], reference: frame, visibility: joint, prediction: velocity, dtype: float32, remat: none}
train: {steps: 4, batch: 2, learning_rate: 1e-3, log_every: 1, save_every: 2, ema: 0.25, samples: 1,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, motion_loss_weight: 0}
rollout: {steps: 2, batch: 3,
  sampler: euler}
""".replace("TINY_CODEC", str(TINY_CODEC))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data and config.yaml; latents are encoded."""
    root = tmp_path_factory.mktemp("world")
    synthetic.write_synthetic_data(root / "data", seeds=(0, 1_000_000), frames=FRAMES)
    (root / "config.yaml").write_text(f"data: {root / 'data'}\nout: {root / 'run'}\n{CONFIG}")
    latents.main([str(root / "config.yaml")])
    return root


@pytest.fixture(scope="module")
def run(world: Path) -> Path:
    """A run of four straight steps."""
    train.main([str(world / "config.yaml")])
    return world / "run"


@pytest.fixture
def experiment(world: Path) -> Experiment:
    return load_experiment(world / "config.yaml")


def lines(run: Path, name: str) -> list[float]:
    logged = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [line[name] for line in logged if name in line]


def refusal(command: Callable[[list[str]], None], arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What a command says when it exits with code 2."""
    with pytest.raises(SystemExit) as stop:
        command(arguments)
    assert stop.value.code == 2
    return capsys.readouterr().err


def test_resumed_run_repeats_the_straight_one(world: Path, run: Path) -> None:
    config, out = str(world / "config.yaml"), world / "resumed"
    train.main([config, "--out", str(out), "--train.steps", "2"])
    train.main([config, "--out", str(out), "--resume"])
    assert lines(out, "loss/train") == lines(run, "loss/train")
    assert lines(out, "train/gradient_norm") == lines(run, "train/gradient_norm")
    assert len(lines(run, "loss/train")) == 4


def test_sigterm_saves_and_the_rest_repeats(world: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, out, write = str(world / "config.yaml"), tmp_path / "run", RunLog.scalars

    def interrupt(log: RunLog, step: int, values: dict[str, float]) -> None:
        write(log, step, values)
        if step == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(RunLog, "scalars", interrupt)
    with pytest.raises(SystemExit) as stop:
        train.main([config, "--out", str(out)])
    assert stop.value.code == 143, "a study must not take it for done"
    assert len(lines(out, "loss/train")) == 3
    monkeypatch.undo()
    train.main([config, "--out", str(out), "--resume"])
    assert lines(out, "loss/train") == lines(run, "loss/train")


def test_run_folder_holds_what_a_rerun_needs(run: Path, experiment: Experiment) -> None:
    assert load_experiment(run / "config.yaml") == experiment
    assert sorted(path.name for path in (run / "checkpoints").iterdir() if path.is_dir()) == ["2", "4"]
    assert {path.name for path in (run / "checkpoints" / "4").iterdir()} >= {"params", "optimizer", "ema", "data"}
    assert list(run.glob("events.out.tfevents.*"))


def test_samples_are_graded_next_to_the_pasted_render(run: Path) -> None:
    for metric in ("lpips", "psnr", "mask_iou", "object_coverage"):
        (value,), (pasted,) = lines(run, f"validation/{metric}/seen"), lines(run, f"validation/{metric}_of_pasted_render/seen")
        assert np.isfinite([value, pasted]).all() and value != pasted
        assert not lines(run, f"validation/{metric}/unseen"), "the data hold no validation body"
    accumulator = EventAccumulator(str(run))
    accumulator.Reload()
    assert "validation/seen/ur5_wsg" in accumulator.Tags()["images"]


def test_a_view_is_trained_and_rolled_out_at_its_size(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, wrist = tmp_path / "data", CameraSpec("wrist_left", "left_tool", (-0.1, 0, 0), (0, 0, 0), size=(160, 120))
    synthetic.write_synthetic_data(data, seeds=(0, 1_000_000), robots=SEEN_ROBOTS, frames=FRAMES)
    config = [str(world / "config.yaml"), "--data", str(data), "--view", wrist.view, "--out", str(tmp_path / "run")]
    assert f"has no view '{wrist.view}', but head; add it by" in refusal(latents.main, config, capsys)
    synthetic.write_synthetic_view(data, wrist)
    latents.main(config)
    assert sorted(path.name for path in tmp_path.glob("data-latents/*")) == ["views"], "the head camera's cache is another"
    train.main(config)
    rollout.main([str(tmp_path / "run"), "--out", str(tmp_path / "out")])
    made = find_rollouts(tmp_path / "out")
    assert len(made) == len(SEEN_ROBOTS) and made[0].header["config"]["view"] == wrist.view
    truth = read_record(view_folder(data, wrist.view) / made[0].task / f"{made[0].seed:07d}" / made[0].robot)
    assert made[0].header["source_hash"] == truth.hashes["rgb"]
    assert read_rollout_video(made[0]).shape == (FRAMES, 120, 160, 3)
    table = tmp_path / "scores.parquet"
    grade_tables(Args((tmp_path / "out",), data, table, metrics=("psnr", "mask_iou"), view=wrist.view))
    assert np.isfinite(pd.read_parquet(table)["value"]).all()
    assert (tmp_path / "data-baselines/views" / wrist.view).is_dir() and not list((data / "views").glob("*-*"))


def test_three_views_are_one_picture_and_their_rollouts_are_cut(world: Path, tmp_path: Path) -> None:
    data, views = tmp_path / "data", ("head", "wrist_left", "side")
    synthetic.write_synthetic_data(data, seeds=(0, 1_000_000), robots=SEEN_ROBOTS, frames=FRAMES)
    synthetic.write_synthetic_view(data, CameraSpec("wrist_left", "left_tool", (-0.1, 0, 0), (0, 0, 0)))
    synthetic.write_synthetic_view(data, CameraSpec("side"))
    tile_views(find_accepted(data), views)
    tiled = view_folder(data, "+".join(views))
    assert all(verify_episode(folder).camera.size == (320, 720) for folder, _ in find_accepted(tiled))
    config = [
        str(world / "config.yaml"),
        "--data",
        str(data),
        "--view",
        tiled.name,
        "--clip.height",
        "192",
        "--clip.width",
        "80",
    ]
    config += ["--out", str(tmp_path / "run"), "--train.samples", "0"]
    latents.main(config)
    train.main(config)
    rollout.main([str(tmp_path / "run"), "--robots", "ur5_wsg", "--out", str(tmp_path / "out")])
    (whole,) = find_rollouts(tmp_path / "out")
    video = read_rollout_video(whole)
    assert video.shape == (FRAMES, 720, 320, 3)
    for number, view in enumerate(views):
        (cut,) = find_rollouts(tmp_path / "out-views" / view)
        np.testing.assert_array_equal(read_rollout_video(cut), video[:, 240 * number : 240 * (number + 1)])
        folder = view_folder(data, view) / cut.task / f"{cut.seed:07d}" / cut.robot
        assert cut.header["source_hash"] == read_record(folder).hashes["rgb"]


def test_existing_run_is_not_touched_unasked(world: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refusal(train.main, [str(world / "config.yaml")], capsys)
    assert "--resume" in said and "--overwrite" in said
    said = refusal(train.main, [str(world / "config.yaml"), "--resume", "--train.learning-rate", "0.5"], capsys)
    assert "train.learning_rate was 0.001, is 0.5" in said
    assert len(lines(run, "loss/train")) == 4


def test_missing_data_and_latents_name_the_command(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = str(world / "config.yaml")
    assert "python -m xew.sim_warp.generate" in refusal(train.main, [config, "--data", str(tmp_path / "none")], capsys)
    said = refusal(train.main, [config, "--cache", str(tmp_path / "none"), "--out", str(tmp_path / "run")], capsys)
    assert "python -m xew.model.latents" in said
    assert not (tmp_path / "run").exists()


def test_other_data_makes_the_cache_stale(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same cells, recorded differently: nothing of the old cache is taken for them."""
    synthetic.write_synthetic_data(tmp_path / "data", seeds=(0, 1_000_000), frames=FRAMES + 1)
    shutil.copytree(world / "data-latents", tmp_path / "data-latents")
    said = refusal(
        train.main, [str(world / "config.yaml"), "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run")], capsys
    )
    assert "was encoded from other data" in said and "python -m xew.model.latents" in said


def test_stale_stream_is_an_error(
    experiment: Experiment, world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A stream encoded from an older recording has another key."""
    shutil.copytree(world / "data-latents", tmp_path / "cache")
    victim = next((tmp_path / "cache").glob("*/*/arx_x5/rgb-*.safetensors"))
    victim.rename(victim.with_name("rgb-000000000000.safetensors"))
    config = [str(world / "config.yaml"), "--cache", str(tmp_path / "cache"), "--out", str(tmp_path / "run")]
    assert "was encoded from other data" in refusal(train.main, config, capsys)
    victim.write_bytes(b"cut off")
    assert f"{victim} is damaged" in refusal(train.main, config, capsys)


def test_training_sees_training_robots_and_seeds_only(experiment: Experiment) -> None:
    episodes = training_episodes(read_dataset(experiment.data), experiment.choice)
    assert {record.robot for _, record in episodes} == set(SEEN_ROBOTS)
    assert {record.seed for _, record in episodes} == {0}


def test_encoding_again_writes_nothing(world: Path, experiment: Experiment) -> None:
    before = {path: path.stat().st_mtime_ns for path in (world / "data-latents").rglob("*.safetensors")}
    latents.main([str(world / "config.yaml")])
    assert {path: path.stat().st_mtime_ns for path in (world / "data-latents").rglob("*.safetensors")} == before
    assert len(before) == len(SEEN_ROBOTS) * 3


def test_batches_have_the_declared_shapes_and_resume(experiment: Experiment) -> None:
    episodes = training_episodes(read_dataset(experiment.data), experiment.choice)
    source = ClipSource.open(experiment.encoding, experiment.instructions, episodes)
    assert len(source) == len(episodes) * len(clip_starts(FRAMES, 5))
    batches = iter(make_dataset(source, 2, seed=0))
    first, position = next(batches), batches.get_state()
    second = next(batches)
    fake = fake_batch(experiment.inputs, 2)
    assert first.latents.shape == fake.latents.shape == (2, *experiment.inputs.latent_shape)
    assert {k: v.shape for k, v in first.conditions.items()} == {k: v.shape for k, v in fake.conditions.items()}
    assert first.text.shape == fake.text.shape
    continued = iter(make_dataset(source, 2, seed=0))
    continued.set_state(position)
    np.testing.assert_array_equal(next(continued).latents, second.latents)


def test_batches_do_not_depend_on_the_number_of_threads_and_keep_the_type_on_disk(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = training_episodes(read_dataset(experiment.data), experiment.choice)
    source = ClipSource.open(experiment.encoding, experiment.instructions, episodes)
    read = []
    for threads in (1, 8):
        monkeypatch.setattr(order, "usable_cores", lambda threads=threads: threads)
        read.append(list(itertools.islice(make_dataset(source, 2, seed=0), 4)))
    for one, other in zip(*read, strict=True):
        np.testing.assert_array_equal(one.latents, other.latents)
        np.testing.assert_array_equal(one.text, other.text)
    assert one.latents.dtype == np.float16 and as_float32(one).latents.dtype == np.float32


def test_threads_parse_no_python(experiment: Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two parsers at a time end in a SystemError now and then; loaders run beside all that the user does."""
    parsed: list[str] = []
    parse = ast.parse

    def noted(*args: Any, **kwargs: Any) -> ast.AST:
        parsed.append(threading.current_thread().name)
        return parse(*args, **kwargs)

    monkeypatch.setattr(ast, "parse", noted)
    episodes = training_episodes(read_dataset(experiment.data), experiment.choice)
    source = ClipSource.open(experiment.encoding, experiment.instructions, episodes)
    parsed.clear()
    place = functools.partial(place_batch, mesh=make_mesh(MeshSettings()))
    batches = iter(make_dataset(source, 2, seed=0, place=place))
    for _ in range(3):
        next(batches)
    assert [name for name in parsed if name != threading.main_thread().name] == []


@pytest.mark.parametrize(
    ("frame_count", "starts"), [(5, (0,)), (9, (0, 4)), (12, (0, 4, 7)), (3, (0,))], ids=["one", "two", "rest", "short"]
)
def test_clips_cover_an_episode(frame_count: int, starts: tuple[int, ...]) -> None:
    assert clip_starts(frame_count, 5) == starts


def test_rollouts_cover_the_test_episodes(run: Path, world: Path) -> None:
    out = world / "rollouts"
    rollout.main([str(run), "--out", str(out)])
    found = {(r.task, r.seed, r.robot): r for r in find_rollouts(out)}
    tested = {(r.task, r.seed, r.robot): r for _, r in find_records(world / "data") if r.seed >= 1_000_000}
    assert set(found) == set(tested)
    for key, made in found.items():
        assert read_rollout_video(made).shape == (FRAMES, HEIGHT, WIDTH, 3)
        assert made.header["source_hash"] == tested[key].hashes["rgb"]
        assert made.condition == "joints+robot_render"
    codec = open_roundtrip(run)  # whose truth is the floor of these rollouts' scores
    assert open_roundtrip(run / "config.yaml").digest == codec.digest, "the codec in the cache, before there is a run"
    assert {(made.model, made.header["codec"]) for made in found.values()} == {(codec.model, codec.digest)}
    true = read_video(world / "data" / "/".join(next(iter(found.values())).folder.parts[-3:]) / "rgb.mkv")
    left = codec(true)
    error, inverse = (np.abs(left.astype(int) - video).mean() for video in (true, 255 - true))
    assert left.shape == true.shape and 0 < error < inverse / 2
    programs = encode_pictures._cache_size(), decode_to_pictures._cache_size()
    whole = (len(true) - 2 - 1) // 4 * 4 + 1  # frames of groups that are not filled up
    shorter = codec(true[:-2])
    assert shorter.shape == true[:-2].shape and np.abs(shorter[:whole].astype(int) - left[:whole]).max() <= 1
    assert programs == (encode_pictures._cache_size(), decode_to_pictures._cache_size()), "lengths share programs"
    smaller = replace(codec, experiment=replace(codec.experiment, clip=replace(codec.experiment.clip, height=32, width=40)))
    assert smaller.digest != codec.digest


def test_rollouts_resume_and_do_not_depend_on_the_batch(run: Path, world: Path, tmp_path: Path) -> None:
    rollout.main([str(run), "--out", str(tmp_path), "--robots", "piper", "ur5_wsg"])
    piper, ur5 = (next(tmp_path.glob(f"*/*/{robot}/rgb.mkv")) for robot in ("piper", "ur5_wsg"))
    before, untouched = read_video(piper), ur5.stat().st_mtime_ns
    shutil.rmtree(piper.parent)
    older = ur5.with_name("rollout.json")  # which did not name its codec
    older.write_text(json.dumps({name: value for name, value in json.loads(older.read_text()).items() if name != "codec"}))
    rollout.main([str(run), "--out", str(tmp_path), "--robots", "piper", "ur5_wsg"])
    assert ur5.stat().st_mtime_ns == untouched
    again = read_video(piper)
    assert np.abs(again.astype(int) - before).max() <= 1


def test_rollout_mistakes(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "did you mean 'piper'" in refusal(rollout.main, [str(run), "--robots", "pipr"], capsys)
    assert "holds no run" in refusal(rollout.main, [str(tmp_path)], capsys)
    assert "xew.sim_warp.generate" in refusal(rollout.main, [str(run), "--data", str(tmp_path)], capsys)

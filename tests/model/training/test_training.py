"""The training step and runs at tiny size: parts of a batch, two chunks, what is not finite, memory, adaptation, LoRA."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax.sharding import AbstractMesh

from tests import synthetic
from tests.networks import TINY_CODEC
from xew.config import ConfigError, save
from xew.dataset import read_dataset
from xew.model import latents, train
from xew.model.devices.sharding import AXES, make_mesh, place_batch
from xew.model.diffusion.flow_matching import sample_losses
from xew.model.episodes.choice import first_of_each, replayed_episodes, sample_episodes, training_episodes
from xew.model.experiment import Experiment, load_experiment
from xew.model.network.lora import apply_lora, init_lora
from xew.model.runs import checkpoint
from xew.model.runs.checkpoint import TrainState, restore_sum
from xew.model.runs.folder import trace_start
from xew.model.settings.optimizer import learning_rate, set_steps
from xew.model.training import data, memory
from xew.model.training.data import Batch, ClipSource, fake_batch
from xew.model.training.flops import flops_of_step
from xew.model.training.memory import estimate_memory
from xew.model.training.order import make_dataset
from xew.model.training.step import cut_samples, estimate_clean, join_samples, make_trainer, sample_pairs
from xew.protocol import HELD_OUT_ROBOTS, seed_split

FRAMES = 12
CONFIG = """
clip: {frames: 5, height: 64, width: 80}
codec: {weights: TINY_CODEC}
model: {size: tiny, action: joints, embodiment: robot_render,
  history: [], reference: frame, visibility: joint, prediction: velocity, dtype: float32, remat: none}
train: {steps: 2, batch: 2, learning_rate: 1e-3, log_every: 1, save_every: 1, samples: 0,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, ema: 0, motion_loss_weight: 0}
rollout: {steps: 2, batch: 3,
  sampler: euler}
""".replace("TINY_CODEC", str(TINY_CODEC))
ADAPT = ("--adapt.robots", "piper", "--adapt.episodes", "2")


CONFIGS = Path(__file__).parents[3] / "configs"
WAN5B = CONFIGS / "wan5b" / "fixed.yaml"
FEWSHOT = [CONFIGS / "wan5b" / "fewshot.yaml", *sorted((CONFIGS / "fewshot").glob("*.yaml"))]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data of two tasks and two training seeds, config.yaml and a trained run; latents are encoded."""
    root = tmp_path_factory.mktemp("training")
    tasks = ("place_empty_cup", "shake_bottle")
    synthetic.write_synthetic_data(root / "data", tasks, seeds=(0, 1, 1_000_000), frames=FRAMES)
    (root / "config.yaml").write_text(f"data: {root / 'data'}\nout: {root / 'run'}\n{CONFIG}")
    latents.main([str(root / "config.yaml")])
    train.main([str(root / "config.yaml")])
    return root


@pytest.fixture
def experiment(world: Path) -> Experiment:
    return load_experiment(world / "config.yaml")


def lines(run: Path, name: str) -> list[float]:
    logged = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [line[name] for line in logged if name in line]


def fails(command: Callable[[list[str]], None], arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What a command says when it exits with code 2."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        command(arguments)
    assert stop.value.code == 2
    return capsys.readouterr().err


def network(run: Path) -> tuple[Any, int]:
    """Parameters of a run, and of which step they are."""
    experiment = load_experiment(run / "config.yaml")
    return checkpoint.load_params(run, experiment.network)


def changed(experiment: Experiment, **settings: Any) -> Experiment:
    return replace(experiment, train=replace(experiment.train, **settings))


Step = Callable[[Batch], tuple[TrainState, Any]]


def first_step(experiment: Experiment, codec: Any = None) -> Step:
    """The first step from parameters that are random throughout: at its own start the network predicts zero."""
    mesh = make_mesh(experiment.mesh)
    trainer = make_trainer(experiment.spec, mesh, codec)
    start = trainer.init_state()
    noise = jax.tree.map(lambda leaf: 0.1 * np.random.default_rng(7).standard_normal(leaf.shape, np.float32), start.params)
    start = jax.device_get(replace(start, params=jax.tree.map(np.add, start.params, noise)))
    return lambda batch: trainer.step(jax.device_put(start), place_batch(batch, mesh))


# Parts of a batch.


def test_parts_of_a_batch_make_the_same_step(experiment: Experiment) -> None:
    batch = fake_batch(experiment.inputs, 4)
    whole, of_whole = first_step(changed(experiment, batch=4))(batch)
    cut, of_cut = first_step(changed(experiment, batch=4, accumulate=2))(batch)
    np.testing.assert_allclose(of_cut.losses, of_whole.losses, atol=1e-5)
    np.testing.assert_array_equal(of_cut.sigma, of_whole.sigma)
    np.testing.assert_allclose(of_cut.gradient_norm, of_whole.gradient_norm, rtol=1e-5)
    for ours, theirs in zip(jax.tree.leaves(cut.optimizer), jax.tree.leaves(whole.optimizer), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_rows_of_parts_come_back_in_order() -> None:
    values = jnp.arange(24).reshape(12, 2)
    np.testing.assert_array_equal(join_samples(cut_samples(values, 3)), values)
    np.testing.assert_array_equal(cut_samples(values, 3)[1, :, 0] // 2, [1, 4, 7, 10])


def test_bfloat16_moment_is_kept_as_such(experiment: Experiment) -> None:
    state = make_trainer(changed(experiment, mu_dtype="bfloat16").spec, make_mesh(experiment.mesh)).shapes
    assert {str(leaf.dtype) for leaf in jax.tree.leaves(state.optimizer)} == {"int32", "float32", "bfloat16"}
    assert {str(leaf.dtype) for leaf in jax.tree.leaves(state.params)} == {"float32"}


# Two chunks.


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LastFrame:
    """Stands for a codec in which the last latent frame is the last picture; notes what it was given."""

    def next_reference(self, latents: jax.Array) -> jax.Array:
        jax.debug.callback(lambda value: SEEN.append(np.asarray(value)), latents)
        return latents[:, -1:]


SEEN: list[np.ndarray] = []


@pytest.fixture(scope="module")
def two(world: Path) -> Experiment:
    return changed(load_experiment(world / "config.yaml"), chunks=2)


@pytest.fixture(scope="module")
def two_chunks(two: Experiment) -> Step:
    return first_step(two, LastFrame())


def test_second_chunk_starts_from_the_prediction_and_not_from_the_truth(two: Experiment, two_chunks: Step) -> None:
    batch = fake_batch(two.inputs, 2)
    _, result = two_chunks(batch)
    assert result.losses.shape == result.sigma.shape == (2, 2)
    np.testing.assert_array_equal(result.weights, 0.5)

    other_truth = batch.following.latents.copy()
    other_truth[:, 0] += 3
    _, same = two_chunks(replace(batch, following=replace(batch.following, latents=other_truth)))
    np.testing.assert_array_equal(same.losses, result.losses)

    told = {name: values + 1 for name, values in batch.conditions.items()}
    _, other = two_chunks(replace(batch, conditions=told))
    difference = np.abs(np.asarray(other.losses - result.losses))
    assert (difference > 1e-4).all(), "the second loss changes too, though only what the first chunk is told has"


def test_estimate_is_the_clip_where_the_prediction_is_right() -> None:
    """x0 = x_t - sigma v with v = noise - x0; frame 0 is the clean reference and not the perturbed one."""
    latents = jax.random.normal(jax.random.key(0), (3, 4, 2, 2, 5))
    pair = sample_pairs(jax.random.split(jax.random.key(1), 3), latents, 5.0)
    np.testing.assert_allclose(estimate_clean(latents, pair, pair.velocity), latents, atol=1e-5)
    assert np.abs(np.asarray(pair.noisy[:, 0] - latents[:, 0])).max() > 1e-3
    assert len(np.unique(pair.sigma)) == 3


def test_codec_is_given_the_estimate_of_the_first_chunk(two: Experiment, two_chunks: Step) -> None:
    SEEN.clear()
    batch = fake_batch(two.inputs, 2)
    two_chunks(batch)
    jax.effects_barrier()
    (seen,) = SEEN
    np.testing.assert_allclose(seen[:, 0], batch.latents[:, 0], atol=1e-6)
    assert np.abs(seen[:, 1] - batch.latents[:, 1]).max() > 0.1, "a prediction, not the truth"


def test_a_missing_second_chunk_counts_for_nothing(two: Experiment, two_chunks: Step, experiment: Experiment) -> None:
    batch = fake_batch(two.inputs, 2)
    ended = replace(batch, following=replace(batch.following, valid=np.zeros_like(batch.following.valid)))
    state, result = two_chunks(ended)
    np.testing.assert_array_equal(result.weights, [[1, 0], [1, 0]])
    alone, of_alone = first_step(experiment)(replace(batch, following=None))
    np.testing.assert_allclose(result.losses[:, :1], of_alone.losses, rtol=1e-5)
    np.testing.assert_allclose(result.gradient_norm, of_alone.gradient_norm, rtol=1e-5)
    for ours, theirs in zip(jax.tree.leaves(state.optimizer), jax.tree.leaves(alone.optimizer), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_frames_past_the_end_are_not_in_the_loss() -> None:
    pair = sample_pairs(jax.random.split(jax.random.key(1), 2), jnp.ones((2, 3, 1, 1, 4)), 5.0)
    predicted = jnp.zeros_like(pair.velocity)
    by_frame = np.square(pair.velocity).mean(axis=(2, 3, 4))
    found = sample_losses(predicted, pair, jnp.array([[1.0, 1, 1], [1, 1, 0]]))
    np.testing.assert_allclose(found, [by_frame[0, 1:].mean(), by_frame[1, 1]], rtol=1e-6)
    np.testing.assert_allclose(sample_losses(predicted, pair), by_frame[:, 1:].mean(axis=1), rtol=1e-6)
    assert float(sample_losses(predicted, pair, jnp.zeros((2, 3))).sum()) == 0


def test_two_chunks_from_latents_to_a_run(world: Path, tmp_path: Path) -> None:
    config = [str(world / "config.yaml"), "--train.chunks", "2", "--cache", str(tmp_path / "cache")]
    latents.main(config)
    train.main([*config, "--out", str(tmp_path / "run")])
    assert len(lines(tmp_path / "run", "loss/train")) == 2
    experiment = load_experiment(tmp_path / "run" / "config.yaml")
    episodes = training_episodes(read_dataset(experiment.data), experiment.choice)
    source = ClipSource.open(experiment.encoding, experiment.instructions, episodes)
    batch = next(iter(make_dataset(source, 3, seed=0)))
    assert jax.tree.map(np.shape, batch) == jax.tree.map(np.shape, fake_batch(experiment.inputs, 3))


# What is not finite, and memory.


@pytest.mark.parametrize(("samples", "batch"), [(1, 1), (5, 1), (1, 2), (5, 2)])
def test_batches_never_end_however_few_samples_there_are(samples: int, batch: int) -> None:
    class Numbers:
        """A source whose samples are their own numbers."""

        fresh = samples

        def __len__(self) -> int:
            return samples

        def __getitem__(self, index: int) -> Batch:
            return Batch(np.float32(index), {}, np.int32(0))

    batches = iter(make_dataset(Numbers(), batch, seed=0))  # type: ignore[arg-type]
    drawn = np.concatenate([next(batches).latents for _ in range(2 * samples)])
    assert len(drawn) == 2 * samples * batch
    np.testing.assert_array_equal(np.bincount(drawn.astype(int)), np.full(samples, 2 * batch))


def test_a_spoilt_state_is_never_saved(world: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="not finite"):
        train.main([str(world / "config.yaml"), "--out", str(tmp_path / "run"), "--train.learning-rate", "1e38"])
    steps = [path for path in (tmp_path / "run" / "checkpoints").glob("*") if path.name.isdigit()]
    assert steps == []


def test_too_little_memory_is_told_before_anything_is_made(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(memory, "device_memory", lambda: 1e5)
    arguments = [str(world / "config.yaml"), "--out", str(tmp_path / "run")]
    said = fails(train.main, arguments, capsys)
    assert "memory of each device [GB]: parameters" in said
    assert "mesh.fsdp" in said and "--model.remat full" in said and "--ignore-memory" in said
    assert not (tmp_path / "run").exists()
    train.main([*arguments, "--ignore-memory"])
    assert len(lines(tmp_path / "run", "loss/train")) == 2


def test_log_lines_hold_what_a_run_is_watched_by(world: Path) -> None:
    run = world / "run"
    workload = [f"workload/{name}" for name in ("step_s", "data_wait_s", "samples_per_s")]
    for name in ("train/learning_rate", "train/gradient_norm", *workload):
        values = lines(run, name)
        assert len(values) == 2 and all(value >= 0 for value in values), name
    assert lines(run, "train/learning_rate") == pytest.approx([1e-3, 1e-3])


def estimate(experiment: Experiment, devices: int) -> memory.Memory:
    """Memory of each device where the state is cut over all of them."""
    return estimate_memory(make_trainer(experiment.spec, AbstractMesh((1, devices), AXES)), experiment.encoding)


def test_projection_is_that_of_the_arithmetic() -> None:
    """5.0e9 parameters on 8 devices: 4 bytes each and 8 for the moments, cut in 8; 2 for the copy; 2 + 4 for gradients."""
    experiment = load_experiment(WAN5B)
    whole, cut = estimate(experiment, 1).parts, estimate(experiment, 8).parts
    numbers = whole["parameters"] / 4
    assert numbers == pytest.approx(5.0e9, rel=0.01)
    for name, bytes_each in (("parameters", 4), ("optimizer", 8), ("rounded to bfloat16", 2), ("gradients", 6)):
        assert whole[name] == pytest.approx(bytes_each * numbers, rel=1e-3), name
        assert cut[name] == pytest.approx(bytes_each * numbers / 8, rel=0.01), name
    assert whole["activations"] == pytest.approx(8 * cut["activations"])
    assert whole["layers gathered"] == 0 < cut["layers gathered"] < 1e9
    assert 2.8e9 < cut["autoencoder"] < 10e9
    half = estimate(changed(experiment, mu_dtype="bfloat16", chunks=1), 1).parts
    assert half["optimizer"] == pytest.approx(6 * numbers, rel=1e-3)
    assert half["gradients"] == pytest.approx(2 * numbers, rel=0.01)
    assert half["autoencoder"] == 0


def test_estimate_is_printed_without_a_device(capsys: pytest.CaptureFixture[str]) -> None:
    train.main([str(WAN5B), "--estimate", "--devices", "8", "--memory-gb", "80"])
    said = capsys.readouterr().out
    assert "8 devices, state in 8 parts, 1 samples at once on each, remat full" in said
    assert "fits in 80 GB a device" in said
    train.main([str(WAN5B), "--estimate", "--devices", "1", "--memory-gb", "80"])
    assert "does not fit in 80 GB" in capsys.readouterr().out


# Configs.


@pytest.mark.parametrize("path", [WAN5B, *FEWSHOT], ids=lambda path: path.stem)
def test_shipped_configs_load_and_survive_saving(path: Path, tmp_path: Path) -> None:
    experiment = load_experiment(path)
    save(experiment, tmp_path / "saved.yaml")
    assert load_experiment(tmp_path / "saved.yaml") == experiment


@pytest.mark.parametrize("path", FEWSHOT, ids=lambda path: path.stem)
def test_adaptations_have_the_network_of_the_run_they_start_from(path: Path) -> None:
    adapted, trained = (
        load_experiment(path),
        load_experiment(CONFIGS / ("wan5b" if "wan5b" in str(path) else "") / "fixed.yaml"),
    )
    assert adapted.adapt.start_from == trained.out
    assert (adapted.clip, adapted.codec) == (trained.clip, trained.codec)
    network, source = (replace(settings.model, weights=None) for settings in (adapted, trained))
    assert network == source
    assert set(adapted.adapt.robots) <= set(HELD_OUT_ROBOTS)
    assert adapted.train.epochs == 20


@pytest.mark.loose_types("JAX's own attention, which loosens them for itself, is traced inside a checkpoint that does not")
def test_step_of_the_full_size_is_made_from_shapes() -> None:
    """The whole program of wan5b, two chunks of 121 frames in three streams, without one of its weights."""
    experiment = load_experiment(WAN5B)
    mesh = make_mesh(experiment.mesh)
    trainer = make_trainer(experiment.spec, mesh, LastFrame())
    batch = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, fake_batch(experiment.inputs, 8)))
    with jax.set_mesh(mesh):
        state, result = trainer._compiled_step.lower(trainer.shapes, batch, trainer._codec_copies).out_info
    assert result.losses.shape == (8, 2)
    assert jax.tree.map(lambda leaf: leaf.shape, state) == jax.tree.map(lambda leaf: leaf.shape, trainer.shapes)


# Length and settings.


def test_epochs_are_passes_over_the_new_samples(experiment: Experiment) -> None:
    passes = changed(experiment, steps=0, epochs=20, batch=8)
    assert set_steps(passes.train, 75).steps == 188
    replaying = replace(passes, adapt=replace(passes.adapt, replay=0.25))
    assert set_steps(replaying.train, 75, replaying.adapt.replay).steps == 250
    assert set_steps(experiment.train, 75) is experiment.train


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["--train.steps", "0"], "set one of them"),
        (["--train.epochs", "2"], "set one of them"),
        (["--train.batch", "3", "--train.accumulate", "2"], "train.batch is 3; it must be a multiple of"),
        (["--mesh.fsdp", "3"], "mesh is data -1 x fsdp 3, there are 1 devices"),
        (["--adapt.start-from", "x"], "adapt needs adapt.robots"),
        (["--train.shift", "0"], "train.shift is 0; it must be over 0"),
        (["--train.log-every", "0"], "train.log_every is 0; it must be at least 1"),
        (["--train.batch", "0"], "train.batch is 0; it must be at least 1"),
        (["--train.ema", "0.5"], "train.ema is 0.5 of the run; it must be at most 0.25"),
        (["--adapt.robots", "piper"], "adapt is set without adapt.start_from"),
        (["--adapt.start-from", "x", "--adapt.robots", "piper", "--adapt.replay", "0.9"], "a part below 1 that leaves"),
        (["--adapt.start-from", "x", "--adapt.robots", "piper", "--adapt.replay", "-0.1"], "adapt.replay is -0.1 of"),
        (["--adapt.start-from", "nowhere", "--adapt.robots", "piper"], "nowhere holds no run"),
    ],
)
def test_mistakes_are_told(
    world: Path, tmp_path: Path, overrides: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said in fails(train.main, [str(world / "config.yaml"), "--out", str(tmp_path / "run"), *overrides], capsys)
    assert not (tmp_path / "run").exists()


def test_the_rate_has_decayed_at_the_last_step(experiment: Experiment) -> None:
    settings = replace(experiment.train, steps=50, warmup_steps=10, learning_rate=1e-2, decay_to=0.1)
    rates = [float(learning_rate(settings)(step)) for step in range(51)]
    assert rates[0] == 0 and np.argmax(rates) == 10
    np.testing.assert_allclose([rates[10], rates[30], rates[50]], [1e-2, 5.5e-3, 1e-3], rtol=1e-5)


def test_arithmetic_that_one_way_streams_save_is_not_counted(experiment: Experiment) -> None:
    one_way = replace(experiment, model=replace(experiment.model, visibility="one_way"))
    assert flops_of_step(one_way.spec) < flops_of_step(experiment.spec)


def test_episodes_without_videos_give_no_samples(world: Path, tmp_path: Path) -> None:
    """Data made with --states-only: a sample begins with a stored picture."""
    shutil.copytree(world / "data", tmp_path / "data")
    shutil.copytree(world / "data-latents", tmp_path / "data-latents")
    for path in (tmp_path / "data").glob("*/*/*/episode.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"videos": False}))
    arguments = [str(world / "config.yaml"), "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run")]
    train.main([*arguments, "--train.steps", "1", "--train.samples", "1"])
    assert not lines(tmp_path / "run", "validation/psnr/seen")


# Adaptation.


def test_a_robot_to_adapt_to_that_the_data_lack_is_told(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start = ["--adapt.start-from", str(world / "run"), "--adapt.robots", "pipr", "--out", str(tmp_path / "run")]
    said = fails(train.main, [str(world / "config.yaml"), *start], capsys)
    assert "has no training episode of pipr; did you mean 'piper'?" in said


def test_a_robot_of_ones_own_is_adapted_to(world: Path, tmp_path: Path) -> None:
    shutil.copytree(world / "data", tmp_path / "data")
    for folder in (tmp_path / "data").glob("*/*/piper"):
        header = folder.rename(folder.with_name("my_arm")) / "episode.json"
        header.write_text(json.dumps(json.loads(header.read_text()) | {"robot": "my_arm"}))
    start = ["--adapt.start-from", str(world / "run"), "--adapt.robots", "my_arm", "--train.steps", "1"]
    arguments = [str(world / "config.yaml"), "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run"), *start]
    latents.main(arguments)
    train.main(arguments)
    assert network(tmp_path / "run")[1] == 1


def test_the_run_that_an_adaptation_starts_from_is_not_overwritten(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = ["--adapt.start-from", str(world / "run"), *ADAPT, "--overwrite"]
    assert "choose another --out" in fails(train.main, [str(world / "config.yaml"), *start], capsys)
    assert network(world / "run")[1] == 2


def adapt(world: Path, out: Path, *options: str) -> list[str]:
    config = [str(world / "config.yaml"), "--adapt.start-from", str(world / "run"), *ADAPT, *options]
    latents.main(config)
    return [*config, "--out", str(out)]


def test_adaptation_learns_from_few_episodes_of_the_target(world: Path, experiment: Experiment) -> None:
    adapted = replace(experiment, adapt=replace(experiment.adapt, start_from=world / "run", robots=("piper",), episodes=1))
    chosen = {
        (record.task, record.robot, record.seed) for _, record in training_episodes(read_dataset(adapted.data), adapted.choice)
    }
    assert chosen == {("place_empty_cup", "piper", 0), ("shake_bottle", "piper", 0)}
    assert replayed_episodes(read_dataset(adapted.data), adapted.choice) == []
    with pytest.raises(ConfigError, match=r"adapt.episodes is 3, there are only 2 training episodes of piper"):
        more = replace(adapted, adapt=replace(adapted.adapt, episodes=2)).choice
        first_of_each(training_episodes(read_dataset(adapted.data), more), 3)


def test_adapted_run_starts_from_the_trained_weights(world: Path, tmp_path: Path) -> None:
    arguments = adapt(world, tmp_path / "run")
    train.main([*arguments, "--train.steps", "1", "--resume"])  # of nothing: it begins, and notes where
    adapted = load_experiment(tmp_path / "run" / "config.yaml")
    trainer = make_trainer(adapted.spec, make_mesh(adapted.mesh))
    start, base = (
        restore_sum(trace_start(tmp_path / "run", world / "run"), trainer.network_shapes)[0],
        network(world / "run")[0],
    )
    jax.tree.map(np.testing.assert_array_equal, start, base)
    after = network(tmp_path / "run")[0]
    moved = [float(np.abs(np.asarray(a - b)).max()) for a, b in zip(*map(jax.tree.leaves, (after, start)), strict=True)]
    assert 0 < max(moved) <= 1.1e-3, "one step of AdamW moves a weight by the learning rate"


def test_samples_of_an_adapted_run_are_named_by_role(experiment: Experiment) -> None:
    adapt = replace(experiment.adapt, start_from=Path("runs/x"), robots=("piper",))
    adapted = replace(experiment, adapt=adapt, train=replace(experiment.train, samples=1))
    names = sample_episodes(read_dataset(adapted.data), adapted.choice.samples)
    seen = {"seen/aloha_agilex", "seen/arx_x5", "seen/ur5_wsg"}
    assert set(names) == seen | {"target/piper"}
    assert {seed_split(record.seed) for _, record in names.values()} == {"train"}, "no test seed is looked at"


def test_adapting_another_network_is_told(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = ["--adapt.start-from", str(world / "run"), *ADAPT, "--out", str(tmp_path / "run")]
    said = fails(train.main, [str(world / "config.yaml"), *start, "--model.action", "none"], capsys)
    assert "model.action is 'joints' there, 'none' here" in said


def test_replay_is_a_part_of_every_batch(world: Path, experiment: Experiment) -> None:
    settings = replace(experiment.adapt, start_from=world / "run", robots=("piper",), episodes=2, replay=0.25)
    adapted = replace(experiment, adapt=settings)
    old, new = (
        replayed_episodes(read_dataset(adapted.data), adapted.choice),
        training_episodes(read_dataset(adapted.data), adapted.choice),
    )
    assert {record.robot for _, record in old} == {"aloha_agilex", "arx_x5", "ur5_wsg"}

    class Names(ClipSource):
        def __getitem__(self, index: int) -> Batch:
            return Batch(np.array(self.samples[index][0].robot == "piper"), {}, np.array(index))

    source = Names.open(adapted.encoding, adapted.instructions, new, old)
    batches = iter(make_dataset(source, 8, seed=0, replay=0.25))
    drawn = [next(batches) for _ in range(6)]
    assert all(batch.latents.sum() == 6 for batch in drawn)
    assert len({int(index) for batch in drawn for index in batch.text[6:]}) == 12, "replay goes on through its episodes"


def test_corrections_change_nothing_at_first_and_only_they_are_learned(experiment: Experiment) -> None:
    low_rank = replace(experiment, adapt=replace(experiment.adapt, lora_rank=2))
    mesh = make_mesh(experiment.mesh)
    full = make_trainer(experiment.spec, mesh).init_state()
    start = jax.tree.map(lambda leaf: leaf + 0.1, full.params)  # the head's own start is zero and gives no gradient
    base = jax.device_get(start)
    trainer = make_trainer(low_rank.spec, mesh)
    state = trainer.init_state(start)
    jax.tree.map(np.testing.assert_array_equal, apply_lora(state.base, state.params), base)
    assert len(state.params["blocks"]) == 10, "q, k, v, o of both attentions and both layers of the feed-forward"
    moments = sum(leaf.size for leaf in jax.tree.leaves(state.optimizer))
    assert moments < 2.1 * sum(leaf.size for leaf in jax.tree.leaves(state.params))
    for _ in range(2):
        state, _ = trainer.step(state, place_batch(fake_batch(low_rank.inputs, 2), mesh))
    jax.tree.map(np.testing.assert_array_equal, state.base, base)
    assert all(np.abs(np.asarray(leaf["b"])).max() > 0 for leaf in state.params["blocks"].values())


def test_corrections_have_the_gradient_of_the_whole_matrix(experiment: Experiment) -> None:
    """W + A B: with dL/dW known, dL/dB is A transposed times it."""
    params = {"blocks": {"ffn": {"first": {"kernel": jax.random.normal(jax.random.key(0), (2, 3, 4))}}}}
    learned = init_lora(params, 2, jax.random.key(1))
    weight = jax.random.normal(jax.random.key(2), (2, 3, 4))
    gradient = jax.grad(lambda c: (apply_lora(params, c)["blocks"]["ffn"]["first"]["kernel"] * weight).sum())(learned)
    a = learned["blocks"]["ffn.first.kernel"]["a"]
    np.testing.assert_allclose(gradient["blocks"]["ffn.first.kernel"]["b"], a.swapaxes(1, 2) @ weight, rtol=1e-5)


def test_run_with_corrections_resumes_and_is_read(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = tmp_path / "base"
    shutil.copytree(world / "run", base)
    arguments = adapt(world, tmp_path / "run", "--adapt.lora-rank", "2", "--adapt.start-from", str(base))
    train.main([*arguments, "--train.steps", "1"])
    train.main([*arguments, "--train.steps", "3", "--resume"])
    straight = adapt(world, tmp_path / "straight", "--adapt.lora-rank", "2", "--adapt.start-from", str(base))
    train.main([*straight, "--train.steps", "3"])
    assert lines(tmp_path / "run", "loss/train") == lines(tmp_path / "straight", "loss/train")

    after, step = network(tmp_path / "run")
    before, _ = network(base)
    assert step == 3
    moved = [
        ".".join(path)
        for (path, ours), (_, theirs) in zip(nnx.to_flat_state(after), nnx.to_flat_state(before), strict=True)
        if not np.array_equal(ours.get_value(), theirs.get_value())
    ]
    assert len(moved) == 10 and all(path.startswith("blocks.") and path.endswith(".kernel") for path in moved)
    elsewhere = (tmp_path / "run").rename(tmp_path / "elsewhere")
    jax.tree.map(np.testing.assert_array_equal, network(elsewhere)[0], after)
    shutil.rmtree(base / "checkpoints" / "2")
    with pytest.raises(ConfigError, match="no longer exists or was trained again"):
        network(elsewhere)
    (elsewhere / "start.json").unlink()
    with pytest.raises(ConfigError, match="does not say from which checkpoint"):
        network(elsewhere)


def test_a_run_is_resumed_with_the_episodes_that_it_was_begun_with(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same elsewhere; not without a task, nor with another seed, nor with other content."""
    shutil.copytree(world / "run", tmp_path / "run")
    shutil.copytree(world / "data", tmp_path / "data")
    resume = [str(world / "config.yaml"), "--out", str(tmp_path / "run"), "--resume", "--train.steps", "3"]
    resume += ["--data", str(tmp_path / "data"), "--cache", str(tmp_path / "cache")]
    latents.main([*resume[:1], *resume[-4:]])
    shutil.move(tmp_path / "data/shake_bottle", tmp_path / "shake_bottle")
    synthetic.write_synthetic_data(tmp_path / "data", ("place_empty_cup",), seeds=(2,), frames=FRAMES)
    changed = next((tmp_path / "data/place_empty_cup/0000001").glob("ur5_wsg/episode.json"))
    changed.write_text(json.dumps(json.loads(changed.read_text()) | {"instruction": "another"}))
    latents.main([*resume[:1], *resume[-4:]])
    said = fails(train.main, resume, capsys)
    line = said.splitlines()[-1]
    assert "was begun with 12 episodes, and --data has others: 6 missing (such as shake_bottle/0/" in line
    assert "3 new (such as place_empty_cup/2/" in line and "1 of other content (such as place_empty_cup/1/ur5_wsg)" in line
    assert line.startswith("error: ") and network(tmp_path / "run")[1] == 2
    shutil.rmtree(tmp_path / "data")
    (tmp_path / "data").symlink_to(world / "data")
    train.main(resume)
    assert network(tmp_path / "run")[1] == 3


def test_checkpoint_of_a_step_that_is_not_there_is_told(world: Path) -> None:
    with pytest.raises(ConfigError, match=r"has no checkpoint of step 9; it has 1, 2\."):
        checkpoint.load_params(world / "run", load_experiment(world / "config.yaml").network, 9)


def test_fake_batches_have_a_second_chunk_only_where_asked(experiment: Experiment) -> None:
    assert data.fake_batch(experiment.inputs, 1).following is None
    two = changed(experiment, chunks=2).inputs
    assert data.fake_batch(two, 1).following.latents.shape == (1, *two.latent_shape)

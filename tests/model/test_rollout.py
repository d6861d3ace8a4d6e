"""Predicting: batches, devices, guidance, one-way streams and published weights; the command's writing and its mistakes."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from tests import synthetic
from tests.commands import on_devices
from tests.model.codecs.test_render_head import make_head
from tests.networks import TINY_CODEC
from xew.dataset import Episode, read_dataset
from xew.episode import EpisodeError, array_hash, read_video, write_video
from xew.model import latents, rollout
from xew.model.cache.store import load_codec
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.codecs.contract import encode_pictures
from xew.model.experiment import Experiment, load_experiment
from xew.model.network.dit import WorldModel
from xew.model.network.dit_layouts import save_dit
from xew.model.sampling.predict import ChunkInputs, Predictor, guided_velocity, make_predictor
from xew.model.sampling.writing import RolloutWriter
from xew.protocol import ROBOT_NAMES
from xew.rollout import find_rollouts, read_rollout_video

FRAMES = 12
CONFIG = """
data: {root}/data
out: {root}/run
clip: {{frames: 5, height: 64, width: 80}}
codec: {{weights: TINY_CODEC}}
model: {{size: tiny, action: joints, embodiment: robot_render, history: [-4],
  reference: frame, visibility: joint, prediction: velocity, dtype: float32, remat: none}}
train: {{steps: 1, batch: 2,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, ema: 0, motion_loss_weight: 0}}
rollout: {{steps: 2, batch: 3,
  sampler: euler}}
""".replace("TINY_CODEC", str(TINY_CODEC))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("world")
    synthetic.write_synthetic_data(root / "data", seeds=(0, 1_000_000), frames=FRAMES)
    (root / "config.yaml").write_text(CONFIG.format(root=root))
    latents.main([str(root / "config.yaml")])
    return root


@pytest.fixture(scope="module")
def predictor(world: Path) -> Predictor:
    return random_predictor(load_experiment(world / "config.yaml"))


def random_predictor(experiment: Experiment) -> Predictor:
    """A network whose output depends on all that it is given: nothing of it is zero."""
    codec = load_codec(experiment.encoding)
    params = nnx.state(WorldModel(experiment.network), nnx.Param)
    keys = iter(jax.random.split(jax.random.key(3), 200))
    noisy = jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(next(keys), leaf.shape, leaf.dtype), params)
    return make_predictor(experiment, codec, noisy, {})


def choose_tests(data: Path) -> list[Episode]:
    return read_dataset(data).select(robots=ROBOT_NAMES, split="test")


def near(found: np.ndarray, expected: np.ndarray) -> bool:
    """Equal but for a step of rounding here and there: float32 sums are in another order for another batch."""
    difference = np.abs(found.astype(int) - expected)
    return difference.max() <= 2 and difference.mean() < 0.01


def test_an_episode_does_not_depend_on_its_batch(predictor: Predictor, world: Path) -> None:
    episodes = choose_tests(world / "data")[:3]
    together = predictor.predict(episodes, FRAMES)
    assert together.shape == (3, FRAMES, 64, 80, 3) and together.dtype == np.uint8
    assert np.abs(together[0].astype(int) - together[1]).mean() > 1
    for episode, expected in zip(episodes, together, strict=True):
        assert near(predictor.predict([episode], FRAMES)[0], expected)


def test_later_chunks_continue_the_predicted_and_never_read_the_recorded(
    predictor: Predictor, world: Path, tmp_path: Path
) -> None:
    """All but the first frame of the scene is replaced: the prediction stays."""
    episode = choose_tests(world / "data")[0]
    before = predictor.predict([episode], FRAMES)
    folder, record = episode
    video = read_video(folder / "rgb.mkv")
    video[1:] = 255 - video[1:]
    for name in ("states.npz", "episode.json", "robot.mkv"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    write_video(tmp_path / "rgb.mkv", video)
    changed = replace(record, hashes=record.hashes | {"rgb": array_hash(video)})
    np.testing.assert_array_equal(predictor.predict([(tmp_path, changed)], FRAMES), before)
    chunks = predictor.begin([predictor.reader.read(episode)], FRAMES).chunks
    assert len(chunks) == 3
    reference = encode_pictures(predictor.codec, np.asarray(chunks[0])[:, -1:])
    expected = predictor.codec.decode(np.asarray(reference)[0])[0]
    assert np.abs(np.asarray(chunks[1])[0, 0].astype(int) - expected).mean() < 1


@pytest.mark.parametrize("embodiment", ["robot_render", "carried_render"])
def test_a_decoder_that_sees_the_render_sees_no_later_frame_of_the_scene(embodiment: str, world: Path, tmp_path: Path) -> None:
    """The commands and the first frame give the whole rollout; another render gives another."""
    predictor = random_predictor(load_experiment(world / "config.yaml", ["--model.embodiment", embodiment]))
    assert isinstance(predictor.codec, ConvAutoencoderCodec)
    seeing = replace(predictor, codec=predictor.codec.with_head(make_head()))
    folder, record = choose_tests(world / "data")[0]
    before = seeing.predict([(folder, record)], FRAMES)
    assert np.abs(before.astype(int) - predictor.predict([(folder, record)], FRAMES)).mean() > 1
    scene, robot = read_video(folder / "rgb.mkv"), read_video(folder / "robot.mkv")
    for name in ("states.npz", "episode.json", "robot.mkv"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    scene[1:], robot = 255 - scene[1:], robot[::-1].copy()
    write_video(tmp_path / "rgb.mkv", scene)
    changed = replace(record, hashes=record.hashes | {"rgb": array_hash(scene)})
    np.testing.assert_array_equal(seeing.predict([(tmp_path, changed)], FRAMES), before)
    write_video(tmp_path / "robot.mkv", robot)
    changed = replace(changed, hashes=changed.hashes | {"robot": array_hash(robot)})
    assert (seeing.predict([(tmp_path, changed)], FRAMES) != before).any()


def test_guidance_of_one_is_none_and_more_goes_away_from_the_negative(predictor: Predictor) -> None:
    model = nnx.merge(predictor.graph, predictor.params)
    shape = predictor.inputs.latent_shape
    latents_, level = jax.random.normal(jax.random.key(0), (1, *shape)), jnp.array([0.7], jnp.float32)
    conditions = {
        name: jax.random.normal(jax.random.key(1), (1, *predictor.inputs.shapes[name])) for name in predictor.inputs.conditions
    }
    text, negative = jnp.array([[5, 6, 0, 0, 0, 0, 0, 0]]), jnp.array([[9, 0, 0, 0, 0, 0, 0, 0]])
    forward = jax.jit(lambda words: model(latents_, conditions, level, words))
    of = {"wanted": forward(text), "unwanted": forward(negative)}
    inputs = ChunkInputs(jnp.zeros(()), conditions, text, negative, jnp.zeros(()), jnp.zeros(()))
    for guidance in (1.0, 3.0):
        expected = of["unwanted"] + guidance * (of["wanted"] - of["unwanted"])
        found = jax.jit(lambda guidance=guidance: guided_velocity(model, inputs, guidance)(latents_, level))()
        np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.abs(of["wanted"] - of["unwanted"]).max() > 1e-3


def test_guidance_reaches_the_rollout(predictor: Predictor, world: Path) -> None:
    episodes = choose_tests(world / "data")[:1]
    plain = predictor.predict(episodes, 5)
    settings = replace(predictor.settings, guidance=6.0, negative_prompt="blurred")
    guided = replace(predictor, settings=settings)
    assert np.abs(guided.predict(episodes, 5).astype(int) - plain).max() > 0


def test_one_way_streams_are_computed_once_with_the_same_result(world: Path) -> None:
    options = ["--model.visibility", "one_way", "--model.history"]
    one_way = random_predictor(load_experiment(world / "config.yaml", options))
    model = nnx.merge(one_way.graph, one_way.params)
    shape = one_way.inputs.latent_shape
    conditions = {
        name: jax.random.normal(jax.random.key(1), (1, *one_way.inputs.shapes[name])) for name in one_way.inputs.conditions
    }
    inputs = ChunkInputs(jnp.zeros(()), conditions, jnp.array([[5, 6, 0, 0, 0, 0, 0, 0]]), None, jnp.zeros(()), jnp.zeros(()))
    latents_, level = jax.random.normal(jax.random.key(0), (1, *shape)), jnp.array([0.7], jnp.float32)
    cached = jax.jit(lambda: guided_velocity(model, inputs, 1.0)(latents_, level))()
    whole = jax.jit(lambda: model(latents_, conditions, level, inputs.text))()
    np.testing.assert_allclose(cached, whole, atol=1e-5)
    episode = choose_tests(world / "data")[:1]
    assert one_way.predict(episode, FRAMES).shape == (1, FRAMES, 64, 80, 3)


def test_sampler_and_noise_schedule_are_chosen_by_name(predictor: Predictor, world: Path) -> None:
    def choose(sampler: str, schedule: str) -> Predictor:
        options = ["--rollout.sampler", sampler, "--rollout.noise-schedule", schedule]
        chosen = load_experiment(world / "config.yaml", options)
        return replace(predictor, settings=chosen.rollout, schedule=chosen.schedule)

    episodes = choose_tests(world / "data")[:1]
    plain = predictor.predict(episodes, 5)
    assert np.abs(choose("unipc", "wan_official").predict(episodes, 5).astype(int) - plain).max() > 0
    from_outside = choose("xew.model.diffusion.samplers:euler", "xew.model.diffusion.samplers:flowwam")
    np.testing.assert_array_equal(from_outside.predict(episodes, 5), plain)


def test_a_codec_may_come_from_outside(world: Path) -> None:
    config = [str(world / "config.yaml"), "--codec.name", "xew.model.codecs.codec:ConvAutoencoderCodec"]
    latents.main(config)
    experiment = load_experiment(config[0], config[1:])
    assert load_codec(experiment.encoding).channels == 8


DEVICES = """
import sys
sys.path[:0] = {path!r}
import jax, numpy as np
from pathlib import Path
from tests.model.test_rollout import FRAMES, choose_tests, load_experiment, random_predictor
from xew.model.devices.sharding import MeshSettings, make_mesh, replicated_sharding
from dataclasses import replace
assert len(jax.devices()) == 2
experiment = load_experiment({config!r})
predictor = random_predictor(experiment)
mesh = make_mesh(MeshSettings())
predictor = replace(predictor, params=jax.device_put(predictor.params, replicated_sharding(mesh)))
episodes = choose_tests(experiment.data)[:3]
begun = predictor.begin([predictor.reader.read(episode) for episode in episodes], FRAMES)
assert len(begun.chunks[0].sharding.device_set) == 2 and begun.chunks[0].shape[0] == 4
np.save({out!r}, begun.fetch())
"""


def test_two_devices_share_a_batch_and_give_the_same(predictor: Predictor, world: Path, tmp_path: Path) -> None:
    """Three episodes on two devices: the batch is filled up, cut, and what filled it is left out."""
    path = [str(Path(__file__).parents[2])]
    script = DEVICES.format(path=path, config=str(world / "config.yaml"), out=str(tmp_path / "frames.npy"))
    environment = os.environ | on_devices(2)
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    episodes = choose_tests(world / "data")[:3]
    assert near(np.load(tmp_path / "frames.npy"), predictor.predict(episodes, FRAMES))


@pytest.fixture(scope="module")
def published(world: Path) -> Path:
    """A config with published weights, and no run."""
    experiment = load_experiment(world / "config.yaml")
    save_dit(
        WorldModel(replace(experiment, model=replace(experiment.model, text="learned")).network),
        world / "dit.safetensors",
        "official",
    )
    weights = f"weights: {world / 'dit.safetensors'}, action: joints"
    (world / "published.yaml").write_text((world / "config.yaml").read_text().replace("action: joints", weights))
    return world / "published.yaml"


def test_published_weights_are_rolled_out_untrained(published: Path, tmp_path: Path) -> None:
    arguments = [str(published), "--robots", "piper", "--out", str(tmp_path), "--rollout.max-frames", "5"]
    rollout.main(arguments)
    (made,) = find_rollouts(tmp_path)
    assert read_rollout_video(made).shape == (5, 240, 320, 3)
    assert made.header["checkpoint_step"] is None and made.header["config"]["model"]["weights"]
    touched = made.video[0].stat().st_mtime_ns
    rollout.main([*arguments, "--rollout.batch", "2"])
    assert made.video[0].stat().st_mtime_ns == touched
    rollout.main([*arguments, "--rollout.seed", "1"])
    assert find_rollouts(tmp_path)[0].video[0].stat().st_mtime_ns != touched


def refusal(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        rollout.main(arguments)
    assert stop.value.code == 2
    return capsys.readouterr().err


def test_mistakes_end_in_one_clear_error(
    world: Path, published: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "names no model.weights" in refusal([str(world / "config.yaml")], capsys)
    assert "did you mean 'piper'" in refusal([str(published), "--robots", "pipr"], capsys)
    assert "did you mean 'unipc'" in refusal([str(published), "--rollout.sampler", "unipcc"], capsys)
    assert "did you mean 'flowwam'" in refusal([str(published), "--rollout.noise-schedule", "flowam"], capsys)
    assert "xew.sim_warp.generate" in refusal([str(published), "--data", str(tmp_path)], capsys)
    assert "rollout.steps is 0; it must be at least 1" in refusal([str(published), "--rollout.steps", "0"], capsys)


def test_rollouts_never_take_the_place_of_episodes(world: Path, published: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "the folder of the episodes" in refusal([str(published), "--out", str(world / "data")], capsys)
    assert choose_tests(world / "data")


def test_rollouts_are_called_as_their_run() -> None:
    assert rollout.default_name(Path("runs/rate_0.1")) == "rate_0.1"
    assert rollout.default_name(Path("configs/fixed.yaml")) == "fixed"
    assert rollout.default_name(Path(".")) == Path.cwd().name


def test_a_run_allows_rollout_overrides_only(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from xew.model import train

    run = str(tmp_path / "run")
    train.main([str(world / "config.yaml"), "--out", run, "--train.samples", "0"])
    capsys.readouterr()
    assert "--model.action" in refusal([run, "--model.action", "none"], capsys)
    assert "has no checkpoint of step 9" in refusal([run, "--checkpoint", "9"], capsys)
    out = tmp_path / "out"
    rollout.main([run, "--checkpoint", "1", "--out", str(out), "--robots", "piper", "--rollout.steps", "3"])
    header = json.loads(next(out.glob("*/*/*/rollout.json")).read_text())
    assert header["config"]["rollout"]["steps"] == 3 and header["checkpoint_step"] == 1
    made = capsys.readouterr().out
    again = [run, "--checkpoint", "1", "--out", str(out), "--robots", "piper", "--rollout.steps", "3"]
    rollout.main(again)
    assert "1 rollouts new" in made and "0 rollouts new" in capsys.readouterr().out
    train.main([str(world / "config.yaml"), "--out", run, "--train.samples", "0", "--overwrite"])
    rollout.main(again)
    assert "1 rollouts new" in capsys.readouterr().out, "the same config trained anew makes other rollouts"
    for file in (tmp_path / "run" / "codec").iterdir():
        file.unlink()
    assert "lacks its codec" in refusal([run], capsys)


def test_a_failed_write_is_told(world: Path, tmp_path: Path) -> None:
    _, record = choose_tests(world / "data")[0]
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(EpisodeError, match="cannot write the rollout"), RolloutWriter(tmp_path / "file", list) as writer:
        writer.write(record, np.zeros((2, 64, 80, 3), np.uint8), {})

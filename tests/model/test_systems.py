"""The other systems of the paper, end to end and tiny: latents, training, rollouts."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import nnx

from tests import synthetic
from tests.networks import TINY_CODEC
from xew.config import ConfigError
from xew.dataset import find_accepted, read_dataset
from xew.episode import read_record, read_states, read_video, write_episode
from xew.model import latents, rollout, train
from xew.model.cache.keys import scales_path
from xew.model.cache.scales import load_scales
from xew.model.cache.store import load_codec
from xew.model.conditions import ACTIONS, list_conditions
from xew.model.episodes.choice import training_episodes
from xew.model.experiment import load_experiment
from xew.model.network.dit import WorldModel
from xew.model.sampling.predict import make_predictor
from xew.model.training.data import ClipSource, fake_batch
from xew.rollout import find_rollouts

FRAMES = 9
ROBOTS = ("aloha_agilex", "arx_x5", "piper")
CONFIGS = Path(__file__).parents[2] / "configs"
SHIPPED = {path.stem: path for path in sorted((CONFIGS / "baselines").glob("*.yaml"))}
SYSTEMS = [*SHIPPED, "mask_and_flow_channels"]
CONFIG = """
clip: {frames: 5, height: 64, width: 80}
codec: {weights: TINY_CODEC}
train: {steps: 2, batch: 2, learning_rate: 1e-3, log_every: 1, save_every: 2, history_noise: 0.3, ema: 0}
rollout: {steps: 1, batch: 1}
""".replace("TINY_CODEC", str(TINY_CODEC))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with episodes and a config of every system."""
    root = tmp_path_factory.mktemp("systems")
    synthetic.write_synthetic_data(root / "data", seeds=(0, 1_000_000), robots=ROBOTS, frames=FRAMES)
    for name in SYSTEMS:
        shipped = load_experiment(SHIPPED.get(name, CONFIGS / "fixed.yaml")).model
        history = [frame // 10 for frame in shipped.history if frame > -400]
        plain = {"reference": "frame", "visibility": "joint", "prediction": "velocity", "dtype": "float32", "remat": "none"}
        model = {"size": "tiny", "action": shipped.action, "embodiment": "none", "history": history, **plain}
        text = f"data: {root / 'data'}\nout: {root / name}\nmodel: {json.dumps(model)}\n{CONFIG}"
        (root / f"{name}.yaml").write_text(text)
    return root


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_system_is_trained_and_rolled_out(world: Path, name: str) -> None:
    config = str(world / f"{name}.yaml")
    latents.main([config])
    train.main([config])
    rollout.main([str(world / name), "--out", str(world / "rollouts" / name), "--robots", "piper"])
    made = find_rollouts(world / "rollouts" / name)
    assert [(rolled.robot, rolled.condition) for rolled in made] == [("piper", name)]
    logged = [json.loads(line) for line in (world / name / "metrics.jsonl").read_text().splitlines()]
    assert np.isfinite([line["loss/train"] for line in logged if "loss/train" in line]).sum() == 2
    scaled = any(condition.scale != "none" for condition in list_conditions(ACTIONS[name]))
    assert (world / name / "scales.json").exists() == scaled


@pytest.mark.parametrize("name", SYSTEMS)
def test_what_is_cached_has_the_declared_shapes(world: Path, name: str) -> None:
    latents.main([str(world / f"{name}.yaml")])
    experiment = load_experiment(world / f"{name}.yaml")
    episodes = training_episodes(read_dataset(experiment.data), experiment.choice)
    source = ClipSource.open(experiment.encoding, experiment.instructions, episodes)
    fake = fake_batch(experiment.inputs, 1).conditions
    assert {key: (1, *value.shape) for key, value in source[0].conditions.items()} == {k: v.shape for k, v in fake.items()}
    for stream, condition in experiment.conditions.items():
        assert condition.scale != "percentiles" or np.abs(source[0].conditions[stream]).max() <= 1


def test_a_rollout_s_history_is_its_own(world: Path, tmp_path: Path) -> None:
    """What was recorded after the first frame changes nothing of a rollout, in its first chunk nor in its second.

    The parameters are drawn anew, so that the network minds all that it is told.
    """
    experiment = load_experiment(world / "ctrl_world.yaml")
    latents.main([str(world / "ctrl_world.yaml")])
    episodes = training_episodes(read_dataset(experiment.data), experiment.choice)
    params = nnx.state(WorldModel(experiment.network), nnx.Param)
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    drawn = [0.2 * jax.random.normal(key, leaf.shape) for key, leaf in zip(keys, leaves, strict=True)]
    codec, scales = load_codec(experiment.encoding), load_scales(experiment.encoding, episodes)
    drawn_params = jax.tree.unflatten(tree, drawn)
    predictor = make_predictor(experiment, codec, drawn_params, scales)
    folder, record = next((f, r) for f, r in find_accepted(world / "data") if r.robot == "piper" and r.seed)
    before = predictor.predict([(folder, record)], FRAMES)

    def recorded(first: int) -> np.ndarray:
        video = read_video(folder / "rgb.mkv")
        video[first:] = 255 - video[first:]
        states, render = read_states(folder), read_video(folder / "robot.mkv")
        other = write_episode(tmp_path / str(first), record, states, video, render)
        return predictor.predict([(other, read_record(other))], FRAMES)

    np.testing.assert_array_equal(before, recorded(1))
    assert (recorded(0) != before).any()
    other = replace(predictor, inputs=replace(predictor.inputs, history=(-1, -1, -1, -1, -1, -1)))
    changed = other.predict([(folder, record)], FRAMES) != before
    assert not changed[:, :5].any() and changed[:, 5:].any()


def test_what_a_system_needs_and_lacks_is_an_error(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = world / "bwm.yaml"
    latents.main([str(config)])
    experiment = load_experiment(config)
    scales_path(experiment.encoding, training_episodes(read_dataset(experiment.data), experiment.choice)).unlink()
    with pytest.raises(SystemExit) as stop:
        train.main([str(config), "--out", str(tmp_path / "run")])
    said = capsys.readouterr().err
    assert stop.value.code == 2 and "scales of grouped_tool_poses" in said and "python -m xew.model.latents" in said
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match=r"model.history is \[-10, 0\]; expected negative frames"):
        load_experiment(config, ["--model.history", "-10", "0"])
    with pytest.raises(ConfigError, match="one_way computes earlier frames without the poses"):
        load_experiment(world / "ctrl_world.yaml", ["--model.visibility", "one_way"])
    with pytest.raises(ConfigError, match="did you mean 'irasim'"):
        load_experiment(config, ["--model.action", "irasm"])

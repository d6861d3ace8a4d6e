"""A run's checkpoint out to other projects, and back in as published weights."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import load_file, save_file

from tests.networks import TINY_CODEC
from xew.config import ConfigError
from xew.model import export
from xew.model.devices.sharding import make_mesh
from xew.model.experiment import load_experiment
from xew.model.network.dit import WorldModel
from xew.model.network.dit_layouts import check_dit, load_dit, load_dit_params
from xew.model.runs.checkpoint import TrainState, open_checkpoints, save_state
from xew.model.runs.folder import check_start
from xew.model.training.step import make_trainer
from xew.model.weights.reading import read_tensors

CONFIG = """
data: data
clip: {frames: 5, height: 64, width: 80}
codec: {weights: TINY_CODEC}
model: {size: tiny, embodiment: robot_render,
  history: [], reference: frame, visibility: joint, prediction: velocity, dtype: float32, remat: none, action: none}
train: {steps: 2, batch: 1,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, ema: 0, motion_loss_weight: 0}
""".replace("TINY_CODEC", str(TINY_CODEC))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with checkpoints of random networks at steps 1 and 2."""
    out = tmp_path_factory.mktemp("run")
    (out / "config.yaml").write_text(f"out: {out}\n{CONFIG}")
    experiment = load_experiment(out / "config.yaml")
    with open_checkpoints(out, keep=2) as checkpoints:
        for step in (1, 2):
            params = jax.tree.map(lambda leaf, step=step: leaf + step, nnx.state(WorldModel(experiment.network), nnx.Param))
            save_state(checkpoints, TrainState(jnp.int32(step), params, {"count": jnp.int32(0)}), {})
        checkpoints.wait_until_finished()
    return out


@pytest.mark.parametrize("naming", ["diffusers", "official"])
def test_network_goes_out_and_comes_back(naming: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    export.main([str(run), "--out", str(tmp_path / "out"), "--naming", naming])
    assert "of step 2" in capsys.readouterr().out
    assert (tmp_path / "out" / "config.json").exists() == (naming == "diffusers")
    model = WorldModel(load_experiment(run / "config.yaml").network)
    expected = jax.tree.map(lambda leaf: leaf + 2, nnx.state(model, nnx.Param))
    load_dit(model, tmp_path / "out")
    jax.tree.map(np.testing.assert_array_equal, nnx.state(model, nnx.Param), expected)


def test_constants_of_a_checkpoint_are_those_of_the_model(run: Path, tmp_path: Path) -> None:
    """What weights alone do not tell: the eps of norms, and the base of rotary positions, which diffusers cannot have."""
    export.export(run, tmp_path / "out")
    config = tmp_path / "out" / "config.json"
    written, model = json.loads(config.read_text()), WorldModel(load_experiment(run / "config.yaml").network)
    assert written["eps"] == model.size.epsilon and written["_rope_base"] == model.size.rotary_base
    for key, other, said in (
        ("eps", 1e-5, "eps = 1e-05 .*has epsilon = 1e-06"),
        ("eps", "small", "eps = 'small'"),
        ("_rope_base", 3.0, "_rope_base = 3.0"),
    ):
        config.write_text(json.dumps(written | {key: other}))
        for check, of in ((load_dit, tmp_path / "out"), (check_dit, read_tensors(tmp_path / "out"))):
            with pytest.raises(ConfigError, match=said):
                check(model, of)
    config.write_text("[")
    with pytest.raises(ConfigError, match=r"config\.json cannot be read"):
        load_dit(model, tmp_path / "out")


def test_one_file_of_an_earlier_step_rounded(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "wan.safetensors"
    export.main([str(run), "--out", str(out), "--naming", "official", "--dtype", "bfloat16", "--checkpoint", "1"])
    assert "belong to streams" in capsys.readouterr().out
    tensors = read_tensors(out)
    assert {str(array.dtype) for array in tensors.values()} == {"bfloat16"}
    np.testing.assert_array_equal(np.asarray(tensors["blocks.1.norm3.weight"], np.float32), 2)
    assert load_file(out).keys() == set(tensors)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--checkpoint", "7"], "has no checkpoint of step 7; it has 1, 2"),
        (["--out", "."], "exists already; choose another --out"),
    ],
)
def test_what_cannot_be_exported(
    arguments: list[str], said: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        export.main([str(run), "--out", str(tmp_path / "out"), *arguments])
    assert stop.value.code == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_training_starts_from_published_weights(run: Path, tmp_path: Path) -> None:
    """Found to fit before a run is begun, then placed on the mesh; what Wan lacks starts from what it has."""
    export.export(run, tmp_path / "wan.safetensors", "official")
    tensors = dict(read_tensors(tmp_path / "wan.safetensors"))
    only_wan = {key: array for key, array in tensors.items() if not key.startswith("stream")}
    save_file(only_wan, tmp_path / "wan.safetensors")
    experiment = load_experiment(run / "config.yaml", ["--model.weights", str(tmp_path / "wan.safetensors")])
    check_start(experiment)
    trainer = make_trainer(experiment.spec, make_mesh(experiment.mesh))
    params = load_dit_params(*trainer.random_network(), tmp_path / "wan.safetensors")
    expected = nnx.state(WorldModel(experiment.network), nnx.Param)
    np.testing.assert_array_equal(
        params["blocks"]["ffn"]["first"]["kernel"][...], expected["blocks"]["ffn"]["first"]["kernel"][...] + 2
    )
    copied = params["stream_inputs"]["embodiment"]["kernel"][...]
    np.testing.assert_array_equal(copied, params["patch_embedding"]["kernel"][...])


def test_networks_that_cannot_be_trained_are_told_first(run: Path, tmp_path: Path) -> None:
    export.export(run, tmp_path / "wan.safetensors", "official")
    foreign = ["--model.weights", str(tmp_path / "wan.safetensors"), "--model.size", "debug"]
    with pytest.raises(ConfigError, match=r"wan\.safetensors does not fit the model: .* missing"):
        check_start(load_experiment(run / "config.yaml", foreign))
    with pytest.raises(ConfigError, match="there are no weights at nowhere"):
        check_start(load_experiment(run / "config.yaml", ["--model.weights", "nowhere"]))

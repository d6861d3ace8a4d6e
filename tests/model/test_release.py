"""A run made ready to be handed on: smaller, with a card, and taken by the commands as any run."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests import synthetic
from tests.networks import TINY_CODEC
from xew.episode import EpisodeError
from xew.model import latents, release, train
from xew.model.loading import load_predictor
from xew.model.runs.checkpoint import find_damage, load_params
from xew.model.runs.folder import load_run_config

CONFIG = """
clip: {frames: 5, height: 64, width: 80}
codec: {weights: TINY_CODEC}
model: {size: tiny, action: joints, embodiment: robot_render,
  history: [], reference: frame, visibility: joint, prediction: velocity, dtype: float32, remat: none}
train: {steps: 1, batch: 2, learning_rate: 1e-3, ema: 0.1, log_every: 1, save_every: 1, samples: 0,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, motion_loss_weight: 0}
""".replace("TINY_CODEC", str(TINY_CODEC))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trained run beside its data."""
    root = tmp_path_factory.mktemp("release")
    synthetic.write_synthetic_data(root / "data", ("place_empty_cup", "shake_bottle"), seeds=(0, 1, 1_000_000), frames=9)
    (root / "config.yaml").write_text(f"data: {root / 'data'}\nout: {root / 'run'}\n{CONFIG}")
    latents.main([str(root / "config.yaml")])
    train.main([str(root / "config.yaml")])
    return root / "run"


@pytest.fixture(scope="module")
def released(run: Path) -> Path:
    """The run, released with a summary of scores."""
    scores, out = run.parent / "scores.summary.md", run.parent / "released"
    scores.write_text("| model | lpips |\n|---|---|\n| run | 0.1 [0.05, 0.2] |\n")
    release.main([str(run), "--out", str(out), "--scores", str(scores)])
    return out


def test_the_network_is_the_average_of_the_run_rounded_once(run: Path, released: Path) -> None:
    (expected, step), (found, same) = (load_params(folder, load_run_config(folder).network) for folder in (run, released))
    assert step == same == 1
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a.astype(jnp.bfloat16).astype(jnp.float32), b), expected, found)


def test_only_the_network_is_handed_on_and_its_bytes_are_known(run: Path, released: Path) -> None:
    def bytes_of(folder: Path) -> int:
        return sum(file.stat().st_size for file in (folder / "checkpoints" / "1").rglob("*") if file.is_file())

    assert bytes_of(released) < bytes_of(run) / 3
    assert not find_damage(released, 1, ["params"])
    changed = max((released / "checkpoints" / "1" / "params").rglob("*"), key=lambda file: file.stat().st_size)
    before = changed.read_bytes()
    changed.write_bytes(bytes([before[0] ^ 1]) + before[1:])
    assert find_damage(released, 1, ["params"])
    changed.write_bytes(before)
    assert not list(released.glob("events.*")) and not (released / "metrics.jsonl").exists()


def test_a_released_run_rolls_out_as_any_run(run: Path, released: Path) -> None:
    predictor, step = load_predictor(released, load_run_config(released))
    original, _ = load_predictor(run, load_run_config(run))
    assert step == 1 and predictor.scales.keys() == original.scales.keys()
    assert predictor.codec.hash == original.codec.hash


def test_the_card_tells_data_robots_scores_and_limits(released: Path) -> None:
    card = (released / release.CARD).read_text()
    assert "| place_empty_cup | 2 | 6 |" in card and "aloha_agilex, arx_x5, ur5_wsg" in card
    assert "0.1 [0.05, 0.2]" in card and "What it is not for" in card
    config = (released / "config.yaml").read_text()
    assert str(released.parent) not in config.replace(str(released), "")


def test_mistakes_are_told(run: Path, released: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, said in (
        ([str(run), "--out", str(released)], "holds a run already"),
        ([str(tmp_path), "--out", str(tmp_path / "out")], "holds no run"),
        ([str(run), "--out", str(tmp_path / "out"), "--scores", str(tmp_path / "none.md")], "is not a file"),
    ):
        with pytest.raises(SystemExit) as stopped:
            release.main(arguments)
        assert stopped.value.code
        assert said in capsys.readouterr().err
    with pytest.raises(EpisodeError, match="no accepted episode"):
        release.release(run, tmp_path / "out", data=tmp_path / "nowhere")

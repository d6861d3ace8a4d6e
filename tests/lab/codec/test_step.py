"""A step of training a codec: pictures are learned, and the average of the parameters follows."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from lab.codec.pictures import gather_pictures
from lab.codec.sampling import Batch
from lab.codec.settings import load_codec_experiment
from lab.codec.step import init_codec_state, make_codec_step
from lab.codec.unpaired import unpaired_training_episodes
from tests import synthetic
from xew.dataset import read_dataset

CONFIG = """
clip: {frames: 5, height: 32, width: 32}
size: tiny
streams: {rgb: 1}
pictures: {every: 1, host_gb: 1}
train: {steps: 100, batch: 2, warmup_steps: 0, region: 1.0, flip: false, jitter: 0.0}
"""


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file codec.yaml beside its data."""
    root = tmp_path_factory.mktemp("world")
    synthetic.write_synthetic_data(root / "data", seeds=(0,), frames=12)
    (root / "codec.yaml").write_text(f"data: {root / 'data'}\nout: {root / 'run'}\n{CONFIG}")
    return root / "codec.yaml"


def test_steps_learn(config: Path) -> None:
    """The same clips again and again are reconstructed better, by LPIPS too where it counts; the average follows behind."""
    experiment = load_codec_experiment(config, ["--train.lpips", "0.2"])
    experiment = replace(experiment, train=replace(experiment.train, permute=0.0, still=0.0, noise=0.0))
    graph, statistics, state = init_codec_state(experiment)
    step = make_codec_step(graph, statistics, experiment)
    episodes = unpaired_training_episodes(read_dataset(experiment.data), experiment.train_robots, experiment.motion)
    found = gather_pictures(episodes, ["rgb"], experiment.cut, 1.0, regions=True)
    batch = Batch(found.clips[:2], found.regions[:2], np.float32(3e-3))
    losses = []
    for _ in range(20):
        state, loss = step(state, batch)
        losses.append(jax.device_get(loss))
    assert np.isfinite([loss.total for loss in losses]).all()
    assert losses[-1].psnr > losses[0].psnr + 3
    assert losses[-1].lpips < 0.9 * losses[0].lpips
    behind = [np.abs(a - b).mean() for a, b in zip(*map(jax.tree.leaves, (state.params, state.ema)), strict=True)]
    assert max(behind) > 0

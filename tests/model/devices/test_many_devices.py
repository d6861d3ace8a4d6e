"""One config on one, two and four devices and on two processes: the same numbers; checkpoints go from any to any."""

import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jax.sharding import PartitionSpec

from tests import synthetic
from tests.commands import on_devices
from tests.networks import TINY_CODEC
from xew.config import ConfigError
from xew.model import latents
from xew.model.cache.clips import clip_starts, sample_starts
from xew.model.devices.sharding import MeshSettings, check_batch, mesh_shape, parameter_spec
from xew.model.training.data import valid_frames

HERE = Path(__file__).parent
CONFIG = """
clip: {frames: 5, height: 32, width: 32}
codec: {weights: TINY_CODEC}
model: {size: tiny, action: joints, embodiment: robot_render,
  history: [], reference: frame, visibility: joint, prediction: velocity, dtype: float32, remat: none}
train: {steps: 4, batch: 4, learning_rate: 1e-3, log_every: 1, save_every: 2, samples: 0, ema: 0.25,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, motion_loss_weight: 0}
rollout: {steps: 1, batch: 4,
  sampler: euler}
""".replace("TINY_CODEC", str(TINY_CODEC))
TWO, FOUR = ("--mesh.fsdp", "2"), ("--mesh.data", "2", "--mesh.fsdp", "2")
"""Overrides for so many devices."""
FLOAT_NOISE = 1e-5
"""How far losses of about 2 may differ where sums are taken in another order."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data, config.yaml and the outcome of all runs."""
    root = tmp_path_factory.mktemp("devices")
    synthetic.write_synthetic_data(root / "data", seeds=(0,), robots=("aloha_agilex", "arx_x5", "ur5_wsg"), frames=9)
    (root / "config.yaml").write_text(f"data: {root / 'data'}\nout: {root / 'run'}\n{CONFIG}")
    latents.main([str(root / "config.yaml")])
    return root


def job(world: Path, out: str, devices: int, *overrides: str, kill: bool = False) -> dict[str, Any]:
    return {"devices": devices, "arguments": [str(world / "config.yaml"), "--out", str(world / out), *overrides], "kill": kill}


def begin(jobs: Sequence[dict[str, Any]], devices: int = 4, **environment: str) -> subprocess.Popen:
    """A process with so many CPU devices that does these jobs."""
    paths = {"PYTHONPATH": str(HERE.parents[2])}
    command = [sys.executable, str(HERE / "device_runs.py"), json.dumps(list(jobs))]
    return subprocess.Popen(
        command, env=os.environ | on_devices(devices) | paths | environment, stderr=subprocess.PIPE, text=True
    )


def end(process: subprocess.Popen, code: int = 0) -> str:
    _, said = process.communicate(timeout=300)
    assert process.returncode == code, said[-3000:]
    return said


def losses(world: Path, out: str) -> np.ndarray:
    logged = [json.loads(line) for line in (world / out / "metrics.jsonl").read_text().splitlines()]
    return np.array([line["loss/train"] for line in logged if "loss/train" in line])


@pytest.fixture(scope="module")
def killed(world: Path) -> Path:
    """Runs that were killed after the checkpoint of step 2, on 1 and on 2 devices."""
    jobs = (job(world, "killed_one", 1, kill=True), job(world, "killed_two", 2, *TWO, kill=True))
    for process in [begin([killed]) for killed in jobs]:
        end(process, -signal.SIGKILL)
    return world


@pytest.fixture(scope="module")
def done(killed: Path) -> Path:
    """Four straight steps on 1, 2 and 4 devices: runs one, two, four; in two parts: parts. What was killed has
    gone on: killed_one and killed_two on as many devices as before, two_on_one and two_on_four on others. All by one process.
    """
    for name in ("two_on_one", "two_on_four"):
        shutil.copytree(killed / "killed_two", killed / name)
    jobs = [job(killed, "one", 1), job(killed, "two", 2, *TWO), job(killed, "four", 4, *FOUR)]
    jobs += [job(killed, "parts", 2, *TWO, "--train.accumulate", "2")]
    jobs += [job(killed, "killed_one", 1, "--resume"), job(killed, "killed_two", 2, *TWO, "--resume")]
    jobs += [job(killed, "two_on_one", 1, "--resume"), job(killed, "two_on_four", 4, *FOUR, "--resume")]
    end(begin(jobs))
    return killed


def test_the_same_config_gives_the_same_numbers(done: Path) -> None:
    one = losses(done, "one")
    assert len(one) == 4
    for other in ("two", "four", "parts"):
        np.testing.assert_allclose(losses(done, other), one, atol=FLOAT_NOISE)


def test_killed_runs_repeat_the_straight_ones_on_any_devices(done: Path) -> None:
    """2 steps, kill, 2 steps are 4 straight steps: to the bit on as many devices, to float noise on others."""
    np.testing.assert_array_equal(losses(done, "killed_one"), losses(done, "one"))
    np.testing.assert_array_equal(losses(done, "killed_two"), losses(done, "two"))
    for name in ("two_on_one", "two_on_four"):
        np.testing.assert_allclose(losses(done, name), losses(done, "one"), atol=FLOAT_NOISE)


def test_two_processes_are_as_one(done: Path) -> None:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    asked = job(done, "processes", 2, *TWO)
    variables = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": "2"}
    for process in [begin([asked], 1, JAX_PROCESS_ID=str(number), **variables) for number in range(2)]:
        end(process)
    np.testing.assert_allclose(losses(done, "processes"), losses(done, "one"), atol=FLOAT_NOISE)


@pytest.mark.parametrize(
    ("asked", "devices", "found"), [((-1, 1), 8, (8, 1)), ((-1, 8), 8, (1, 8)), ((2, -1), 8, (2, 4)), ((1, 1), 1, (1, 1))]
)
def test_mesh_takes_the_rest(asked: tuple[int, int], devices: int, found: tuple[int, int]) -> None:
    assert mesh_shape(MeshSettings(*asked), devices) == found


@pytest.mark.parametrize("asked", [(-1, -1), (0, 1), (-2, 1), (-1, 3), (2, 2), (16, 1)])
def test_mesh_that_does_not_fit_is_named(asked: tuple[int, int]) -> None:
    with pytest.raises(ConfigError, match=f"mesh is data {asked[0]} x fsdp {asked[1]}"):
        mesh_shape(MeshSettings(*asked), 8)


def test_batch_that_does_not_fit_is_named() -> None:
    check_batch(16, 2, 8)
    with pytest.raises(ConfigError, match=r"train.batch is 12; .* for example 16"):
        check_batch(12, 2, 8)


def test_largest_axis_is_cut_but_never_the_layers() -> None:
    assert parameter_spec(("blocks", "ffn", "first", "kernel"), (32, 3072, 14336), 8) == PartitionSpec(None, None, "fsdp")
    assert parameter_spec(("blocks", "ffn", "second", "kernel"), (32, 14336, 3071), 8) == PartitionSpec(None, "fsdp", None)
    assert parameter_spec(("0", "mu", "blocks", "self_attn", "q", "kernel"), (30, 3072, 3072), 8)[2] == "fsdp"
    assert parameter_spec(("time_projection", "kernel"), (3072, 18432), 8) == PartitionSpec(None, "fsdp")
    assert parameter_spec(("blocks", "ffn", "first", "bias"), (32, 14336), 8) == PartitionSpec()
    assert parameter_spec(("head", "head", "kernel"), (3071, 193), 8) == PartitionSpec()
    assert parameter_spec((), (), 8) == PartitionSpec()


@pytest.mark.parametrize(
    ("frame_count", "samples"),
    [(3, ((0,),)), (5, ((0,),)), (6, ((0, 4),)), (9, ((0, 4),)), (10, ((0, 4), (4, 8))), (1, ((0,),))],
)
def test_two_chunks_share_a_frame(frame_count: int, samples: tuple[tuple[int, ...], ...]) -> None:
    assert sample_starts(frame_count, 5, 2) == samples
    assert clip_starts(frame_count, 5, 2) == tuple(sorted(set(itertools.chain(*samples))))


@pytest.mark.parametrize(
    ("left", "valid"), [(1, [1, 0, 0]), (2, [1, 1, 0]), (5, [1, 1, 0]), (6, [1, 1, 1]), (9, [1, 1, 1]), (99, [1, 1, 1])]
)
def test_frames_past_the_end_are_not_valid(left: int, valid: list[int]) -> None:
    assert valid_frames(left, 9).tolist() == valid

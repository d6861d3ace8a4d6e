"""A metric, a robot, a condition and a task from a module outside go through every command, to a report that shows them.

A procedural body goes with them, and both robots move each in its own way: that spares a second run of all commands.
"""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

from tests.commands import run_command
from tests.networks import TINY_CODEC
from tests.sim_warp.small import work_inline
from xew.dataset import find_records
from xew.metrics import METRICS

pytestmark = [
    pytest.mark.loose_types("Optax raises its decays to an int32 count of steps"),
]

MODULE = '''"""One of each kind."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from tests.sim_warp import small
from xew.metrics.metric import Metric
from xew.model.conditions import Command, Condition
from xew.protocol import Split
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.scene import Scene
from xew.sim_warp.tasks.task import Task


@jax.jit
def brightness_error(prediction, target):
    difference = prediction.astype(jnp.float32) - target.astype(jnp.float32)
    return jnp.abs(difference.mean(axis=(1, 2, 3)))


def half_way(command: Command) -> np.ndarray:
    return command.action / 2


def sample(rng: np.random.Generator, seed: int) -> Scene:
    return replace(small.sample(rng, seed), task="additions:TASK")


METRIC = Metric(brightness_error, brightness_error, "visual", "levels", (0, 255), False, "video", "difference of means")
ROBOT = replace(ROBOTS["piper"], title="An added robot")
CONDITION = Condition("half_way", "joints", half_way)
TASK = Task("added", "close both hands", sample, small.plan, small.success)
SPLIT = Split(("additions:ROBOT", "body_64"), (), motion="own")
'''
ROBOTS = ("additions:ROBOT", "body_64")
CONFIG = """
data: data
out: runs/added
split: additions:SPLIT
clip: {frames: 5, height: 64, width: 80}
codec: {weights: TINY_CODEC}
model: {size: tiny, action: "additions:CONDITION",
  history: [], reference: frame, visibility: joint, prediction: velocity, dtype: float32, remat: none, embodiment: none}
train: {steps: 1, batch: 2, samples: 0,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, ema: 0, motion_loss_weight: 0}
rollout: {steps: 1, batch: 1, max_frames: 5,
  sampler: euler}
""".replace("TINY_CODEC", str(TINY_CODEC))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the module, importable here and in processes started from here; the metric is in its registry."""
    (tmp_path / "additions.py").write_text(MODULE)
    (tmp_path / "config.yaml").write_text(CONFIG)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(__file__).parents[1]}")
    work_inline(monkeypatch)
    monkeypatch.setitem(METRICS, "brightness_error", importlib.import_module("additions").METRIC)
    yield tmp_path
    sys.modules.pop("additions", None)


def test_what_is_added_goes_the_whole_way(folder: Path) -> None:
    made = ("--tasks", "additions:TASK", "--robots", *ROBOTS, "--motion", "own", "--train-seeds", "1", "--test-seeds", "1")
    run_command("xew.sim_warp.generate", *made, "--device", "cpu", "--workers", "1", "--out", "data")
    assert {record.motion for _, record in find_records(Path("data"))} == {"own"}
    run_command("xew.model.latents", "config.yaml")
    run_command("xew.model.train", "config.yaml")
    run_command("xew.model.rollout", "runs/added", "--data", "data", "--split", "test", "--out", "rollouts")
    graded = ("--metrics", "psnr", "brightness_error", "--out", "scores.parquet")
    run_command("xew.metrics.evaluate", "rollouts", "--data", "data", *graded)
    scores = pd.read_parquet(folder / "scores.parquet")
    assert set(scores["metric"]) == {"psnr", "brightness_error"}
    assert set(scores["task"]) == {"additions:TASK"} and set(scores["robot"]) == set(ROBOTS)
    assert scores.attrs["motion"] == "own"
    assert "additions:CONDITION" in set(scores["condition"])
    values = scores[scores["metric"] == "brightness_error"].set_index("model")["value"]
    assert (values["ground_truth"] == 0).all() and values.drop("ground_truth").max() > 0
    run_command("xew.analysis.report", "scores.parquet", "--data", "data", "--rollouts", "rollouts", "--out", "report")
    page = (folder / "report" / "index.html").read_text()
    for shown in ("brightness_error", *ROBOTS, "additions:CONDITION"):
        assert shown in page or shown.replace("_", " ") in page.lower(), f"the report does not show {shown}"
    run_command("xew.analysis.distance", "--robot", "body_64", "--seeds", "1", "--no-looks", "--out", "distances")
    pairs = pd.read_csv("distances/distances.csv")
    of_body = pairs[(pairs["axis"] == "kinematic") & (pairs[["robot", "other"]] == "body_64").any(axis=1)]
    assert len(of_body) == 5 and (of_body["value"] > 0).all()

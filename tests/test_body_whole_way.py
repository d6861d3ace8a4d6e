"""Procedural bodies, in motion of their own, go through every command: generate, latents, train, rollout, evaluate, distance."""

from pathlib import Path

import pandas as pd
import pytest

from tests.commands import run_command
from tests.sim_warp.small import TASK, work_inline
from xew.dataset import find_records

pytestmark = pytest.mark.loose_types("Optax raises its decays to an int32 count of steps")

SEEN, UNSEEN = "body_0", "body_64"
CONFIG = """
data: data
out: runs/bodies
split: scaling_bodies_4_own
clip: {frames: 5, height: 32, width: 48}
codec: {spatial_factor: 8, channels: 4}
model: {size: tiny, action: joints}
train: {steps: 1, batch: 1, sample_every: 0}
rollout: {steps: 1, batch: 1, max_frames: 5}
"""


def test_a_body_goes_the_whole_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    work_inline(monkeypatch)
    Path("config.yaml").write_text(CONFIG)
    made = ("--tasks", TASK, "--robots", "body:0", "body:64", "--train-seeds", "1", "--test-seeds", "1", "--motion", "own")
    run_command("xew.sim_warp.generate", *made, "--device", "cpu", "--workers", "1", "--out", "data")
    assert {(record.robot, record.motion) for _, record in find_records(Path("data"))} == {(SEEN, "own"), (UNSEEN, "own")}
    run_command("xew.model.latents", "config.yaml")
    run_command("xew.model.train", "config.yaml")
    run_command("xew.model.rollout", "runs/bodies", "--data", "data", "--robots", "body:64", "--out", "rollouts")
    graded = ("--metrics", "psnr", "--no-baselines", "--out", "scores.parquet")
    run_command("xew.metrics.evaluate", "rollouts", "--data", "data", *graded)
    scores = pd.read_parquet("scores.parquet")
    assert list(scores["robot"]) == [UNSEEN] and scores["value"].iloc[0] > 0 and scores.attrs["motion"] == "own"
    run_command("xew.analysis.distance", "--robot", "body:64", "--seeds", "1", "--no-looks", "--out", "distances")
    pairs = pd.read_csv("distances/distances.csv")
    of_body = pairs[(pairs["axis"] == "kinematic") & (pairs[["robot", "other"]] == UNSEEN).any(axis=1)]
    assert len(of_body) == 5 and (of_body["value"] > 0).all()

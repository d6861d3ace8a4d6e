"""What version 0.1.0 wrote is read by today's code: episodes, latents, a run, rollouts, scores with their bundle, a ledger.

The archive was written by that version's commands on synthetic episodes of five frames: `latents`, `train` (four steps of the
size `tiny`), `rollout`, `evaluate`, and records of a study's steps with these products.
"""

import json
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.commands import run_command
from xew.dataset import find_accepted
from xew.episode import read_states, read_video, verify_episode
from xew.protocol import GRADING_PROTOCOL

ARCHIVE = Path(__file__).with_name("version_0_1_0.tar.xz")
EPISODE = Path("place_empty_cup/1000000/piper")
ROUNDING = 0.5
"""Mean difference of 8-bit pixels that another order of sums may make after two steps of sampling."""

pytestmark = pytest.mark.loose_types("Optax raises its decays to an int32 count of steps")


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive, unpacked; not to be written to."""
    folder = tmp_path_factory.mktemp("version_0_1_0")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    return folder


@pytest.fixture
def old(unpacked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the archive's files, which is the working folder: configs name their data relative to it."""
    folder = tmp_path / "old"
    shutil.copytree(unpacked, folder)
    monkeypatch.chdir(folder)
    return folder


def test_episodes_are_whole(old: Path) -> None:
    found = find_accepted(old / "data")
    assert [(record.seed, record.robot) for _, record in found] == [(0, "aloha_agilex"), (1_000_000, "piper")]
    for folder, record in found:
        assert verify_episode(folder) == record
        assert read_video(folder / "rgb.mkv").shape == (5, 240, 320, 3) and read_states(folder).frame_count == 5


def test_a_run_goes_on_from_its_checkpoint_and_latents(old: Path) -> None:
    before = (old / "runs/tiny/metrics.jsonl").read_text()
    run_command("xew.model.train", "config.yaml", "--resume", "--train.steps", "6")
    after = (old / "runs/tiny/metrics.jsonl").read_text()
    assert after.startswith(before) and json.loads(after.splitlines()[-1])["step"] == 6
    assert (old / "runs/tiny/checkpoints/6").is_dir()


def test_rollouts_come_out_as_before(old: Path) -> None:
    run_command("xew.model.rollout", "runs/tiny", "--data", "data", "--split", "test", "--out", "again")
    before, again = (read_video(old / name / EPISODE / "rgb.mkv") for name in ("rollouts", "again"))
    assert before.shape == again.shape == (5, 240, 320, 3)
    assert np.abs(before.astype(int) - again).mean() < ROUNDING
    headers = [json.loads((old / name / EPISODE / "rollout.json").read_text()) for name in ("rollouts", "again")]
    for key in ("model", "condition", "source_hash", "frame_count", "checkpoint_step", "checkpoint_saved"):
        assert headers[0][key] == headers[1][key], key


def test_rollouts_that_are_done_are_not_made_again(old: Path) -> None:
    before = (old / "rollouts" / EPISODE / "rgb.mkv").stat().st_mtime_ns
    run_command("xew.model.rollout", "runs/tiny", "--data", "data", "--split", "test", "--out", "rollouts")
    assert (old / "rollouts" / EPISODE / "rgb.mkv").stat().st_mtime_ns == before


def test_the_bundle_is_whole_and_says_that_the_protocol_was_another(old: Path) -> None:
    run_command("xew.metrics.evaluate", "--check", "scores.bundle.json")
    with pytest.raises(AssertionError, match=f"protocol is 3, here {GRADING_PROTOCOL}"):
        run_command("xew.metrics.evaluate", "rollouts", "--data", "data", "--check", "scores.bundle.json")


def test_the_papers_metrics_give_the_same_scores_anew(old: Path) -> None:
    """The protocol has another number since there are two suites; the definitions of the first are what they were."""
    key = ["model", "condition", "task", "seed", "robot", "metric"]
    before = pd.read_parquet(old / "scores.parquet").set_index(key)["value"]
    metrics = ("--metrics", "psnr", "mask_iou", "pck", "--suite", "paper")
    run_command("xew.metrics.evaluate", "rollouts", "--data", "data", "--out", "again.parquet", *metrics)
    again = pd.read_parquet(old / "again.parquet").set_index(key)["value"]
    shared = again[again.index.isin(before.index)]
    assert set(shared.index.get_level_values("metric")) == {"psnr", "mask_iou", "pck"}
    pd.testing.assert_series_equal(shared, before, rtol=1e-3, atol=1e-3)


def test_scores_become_a_report(old: Path) -> None:
    run_command("xew.analysis.report", "scores.parquet", "--data", "data", "--rollouts", "rollouts", "--out", "report")
    page = (old / "report" / "index.html").read_text()
    assert "tiny · joints+robot_render" in page and "Mask IoU" in page
    assert "No pictures: no held-out robot has a score of lpips" in page


def test_steps_of_a_study_that_are_done_are_known(old: Path) -> None:
    """Keys and digests of products are made as before, else a study would begin anew."""
    from xew.analysis.studies.ledger import Ledger
    from xew.analysis.studies.plan import Step

    products = {"generate": "data", "latents": "data-latents", "train": "runs/tiny", "rollout": "rollouts"}
    ledger, needs = Ledger(old / "study"), ()
    for kind, product in (products | {"evaluate": "scores.parquet"}).items():
        variant = "" if kind in ("generate", "latents") else "tiny"
        step = Step(kind, variant, ("module",), needs, {"made of": "the last version"}, Path(product))
        assert ledger.find_done(step), f"{step.name}: {ledger.record(step)}"
        needs = (step.name,)
    changed = Step("train", "tiny", ("module",), ("latents",), {"made of": "today's"}, Path("runs/tiny"))
    assert not ledger.find_done(changed)

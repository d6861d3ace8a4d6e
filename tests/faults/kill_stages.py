"""A small study command by command: what is run, killed and run again, and what it must have made in the end."""

import hashlib
import json
import runpy
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest

from tests.analysis.inline import InlineMachines
from tests.metrics.quick import QUICK, QUICK_TRACKS
from tests.networks import TINY_CODEC
from tests.sim_warp.small import SLOW, TASK, work_inline
from tests.synthetic import write_synthetic_data
from xew.model.runs.checkpoint import open_checkpoints
from xew.protocol import SEEN_ROBOTS

CONFIG = """
data: data
out: run
clip: {frames: 5, height: 32, width: 48}
codec: {weights: TINY_CODEC}
model: {size: tiny, action: joints, embodiment: robot_render,
  history: [], reference: frame, visibility: joint, prediction: velocity, dtype: float32, remat: none}
train: {steps: 2, batch: 1, log_every: 1, save_every: 1, samples: 0, keep_checkpoints: 2,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, ema: 0, motion_loss_weight: 0}
rollout: {steps: 1, batch: 2,
  sampler: euler}
""".replace("TINY_CODEC", str(TINY_CODEC))
ROLLED_OUT = ("piper", SEEN_ROBOTS[0])
TIMES = "workload/"
"""Beginning of the names of logged numbers that differ between two runs of the same training."""


def command(module: str, *arguments: str) -> Callable[[], None]:
    """A command, as `python -m module arguments` runs it."""

    def run() -> None:
        sys.argv = [module, *arguments]
        sys.modules.pop(module, None)
        warnings.simplefilter("ignore", RuntimeWarning)
        runpy.run_module(module, run_name="__main__", alter_sys=True)

    return run


def generate() -> None:
    """`generate` of two robots, of which one fails at odd seeds, with its work done in this process."""
    with pytest.MonkeyPatch.context() as patch:
        work_inline(patch)
        robots, seeds = ("franka_panda", SLOW), ("--train-seeds", "1", "--test-seeds", "0")
        names = ("--tasks", TASK, "--robots", *robots)
        command("xew.sim_warp.generate", *names, *seeds, "--device", "cpu", "--workers", "1", "--out", "simulated")()


def study() -> None:
    """A study whose steps cost nothing: its configs, its ledger and its status are real."""
    from xew.analysis import study as runner
    from xew.analysis.studies import ledger, plan

    def chain(settings: Any) -> Mapping[str, plan.Step]:
        found = {}
        for name, needs in (("data", ""), ("left", "data"), ("right", "data"), ("end", "left right")):
            needed = tuple(f"train/{other}" for other in needs.split())
            step = ("tests.analysis.steps", str(settings.out / name), name)
            found[f"train/{name}"] = plan.Step("train", name, step, needed, [], settings.out / name)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "plan", chain)
        patch.setattr(runner, "check_configs", lambda paths: None)
        patch.setattr(runner, "open_machines", lambda settings: InlineMachines())
        patch.setattr(runner, "format_status", lambda *_: "status")
        patch.setattr(runner, "format_cost", lambda *_: "cost")
        patch.setattr(runner, "correct_by_ledger", lambda seconds, *_: seconds)
        patch.setattr(runner, "estimate", lambda settings, steps: dict.fromkeys(steps, 1.0))
        patch.setattr(ledger, "digest_product", lambda kind, product: ledger._digest_file(product))
        runner.main(["xew:study_debug", "--out", "study", "--variants", "fixed-joints-none"])


def digests(folder: Path, left_out: Sequence[str] = ()) -> dict[str, str]:
    """SHA-256 of every file of a folder, by its path."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and not any(path.match(p) for p in left_out))
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def of_run(folder: Path) -> dict[str, Any]:
    """What a training leaves: its files, the numbers of its log but for times, the arrays of its checkpoints."""
    differ = ("checkpoints/", "sums/", "events.", "metrics.jsonl")  # Orbax names files at random
    found: dict[str, Any] = {name: sha for name, sha in digests(folder).items() if not name.startswith(differ)}
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    found["log"] = [{name: value for name, value in line.items() if not name.startswith(TIMES)} for line in lines]
    found["sums"] = sorted(path.name for path in (folder / "sums").iterdir())
    with open_checkpoints(folder) as checkpoints:
        for step in checkpoints.all_steps():
            items = dict.fromkeys(("params", "optimizer"), ocp.args.StandardRestore())
            restored = checkpoints.restore(step, args=ocp.args.Composite(**items))
            for item in items:
                leaves = jax.tree_util.tree_leaves_with_path(restored[item])
                found |= {f"{step}/{item}{jax.tree_util.keystr(path)}": np.asarray(leaf).tobytes() for path, leaf in leaves}
    return found


def of_study(folder: Path) -> dict[str, Any]:
    """What a study leaves: its files; its records but for times and machines."""
    found: dict[str, Any] = digests(folder, ("state/*", "state/*/*", "*.begun", "logs/*", "logs/*/*"))
    for path in sorted((folder / "state").rglob("*.json")):
        record = json.loads(path.read_text())
        found[path.name] = (record["status"], record["key"], record["outcome"])
    return found


@dataclass(frozen=True)
class Stage:
    """A command of the study."""

    run: Callable[[], None]
    """Runs it in the working folder; run again, it goes on."""
    product: str
    """Folder that it makes."""
    after: str = ""
    """Name of the command that comes before it, if any."""
    contents: Callable[[Path], dict[str, Any]] = digests
    """What of the folder must be the same in the end."""
    once: bool = False
    """Whether the command refuses, with exit status 2, to make what is there already."""


STAGES: dict[str, Stage] = {
    "generate": Stage(generate, "simulated"),
    "latents": Stage(command("xew.model.latents", "config.yaml"), "data-latents"),
    "train": Stage(command("xew.model.train", "config.yaml", "--resume"), "run", "latents", of_run),
    "rollout": Stage(command("xew.model.rollout", "run", "--robots", *ROLLED_OUT, "--out", "rollouts"), "rollouts", "train"),
    "evaluate": Stage(
        command(
            *("xew.metrics.evaluate", "rollouts", "--data", "data", "--out", "scores/scores.parquet"),
            *("--metrics", "psnr", "mask_iou", "--masks", QUICK, "--tracks", QUICK_TRACKS),
        ),
        "scores",
        "rollout",
    ),
    "report": Stage(
        command(
            *("xew.analysis.report", "scores/scores.parquet", "--data", "data", "--rollouts", "rollouts", "--out", "report")
        ),
        "report",
        "evaluate",
    ),
    "lerobot": Stage(command("xew.exchange.lerobot", "data", "--out", "lerobot"), "lerobot", once=True),
    "study": Stage(study, "study", contents=of_study),
}
"""Commands by name."""


def begin(folder: Path) -> None:
    """Write what the first commands read."""
    write_synthetic_data(folder / "data", seeds=(0, 1_000_000), robots=(*SEEN_ROBOTS, "piper"), frames=5)
    (folder / "config.yaml").write_text(CONFIG)

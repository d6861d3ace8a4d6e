"""What changes of the small size's recipe gain, in one run on one GPU: each is trained anew and rolls out validation seeds.

    python -m benchmarks.recipe --data data --out recipe                      # short trainings of all that CHANGES lists
    python -m benchmarks.recipe --data data --changes none --steps 5400 --samplers euler:20 unipc:10 unipc:6

Needs episodes with validation seeds (`python -m xew.sim_warp.generate --validation-seeds 1 …`); test seeds are not looked at.
Prints a Markdown table, a line a change and sampler: loss over the last eighth of the steps, LPIPS and PSNR of whole
validation episodes of seen and unseen robots, LPIPS of their first and last 32 frames, and seconds of the commands that train
and roll out, with their starts and compiling. A training that fails has
a line that says so, and the others go on; <out>/logs has what all commands printed.
"""

import itertools
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

CHANGES: dict[str, tuple[str, ...]] = {
    "none": (),
    "no mask, no flow": ("--model.action", "none"),
    "render as channels": ("--model.embodiment", "robot_render_channels"),
    "first frame once": ("--model.reference", "frame"),
    "velocity": ("--model.prediction", "velocity"),
    "no earlier frame": ("--model.history",),
    "all places weigh alike": ("--train.motion-loss-weight", "0"),
    "AdamW": ("--train.optimizer", "adamw"),
    "shift 3": ("--train.shift", "3"),
    "two chunks": ("--train.chunks", "2", "--train.batch", "2"),
}
"""Overrides of the config by the name of the change."""
FRAMES = 32
"""Number of frames at the beginning and at the end of an episode whose LPIPS tells how a prediction drifts."""
EPISODE = ["task", "seed", "robot"]
"""Columns of score tables that name an episode."""


@dataclass(frozen=True)
class Args:
    data: Path
    """Episodes, with training and validation seeds."""
    out: Path = Path("recipe")
    """Folder for latents, runs, logs and results."""
    config: Path = Path("configs/fixed.yaml")
    changes: tuple[str, ...] = tuple(CHANGES)
    """Names in CHANGES."""
    steps: int = 900
    samplers: tuple[str, ...] = ("unipc:8",)
    """Samplers with their number of steps."""
    beside: int = 1
    """Number of trainings at once. Their times tell nothing then."""
    overrides: str = ""
    """Further overrides of the config, in one string, as --overrides="--model.size tiny"."""


def main(args: Args) -> int:
    """Train, roll out and print; the number of changes that failed."""
    assert_workload(args.data)
    for folder in ("logs", "scores"):
        (args.out / folder).mkdir(parents=True, exist_ok=True)
    found: list[dict[str, Any]] = []
    with ThreadPoolExecutor(args.beside) as pool:
        for change in pool.map(lambda name: measure(name, args), args.changes):
            found.append(change)
            (args.out / "results.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
            print(f"{change['change']}: {change.get('failed', 'done')}", flush=True)
    print(table(found))
    return sum("failed" in change for change in found)


def assert_workload(data: Path) -> None:
    """Check that there are training and validation episodes of robots that train and of others."""
    from xew.dataset import read_dataset
    from xew.protocol import SPLITS

    split, dataset = SPLITS["fixed"], read_dataset(data)
    seen = {record.robot for _, record in dataset.select(split="validation", robots=None)}
    assert dataset.select(split="train", robots=split.train_robots), f"{data} has no training episodes"
    assert seen & set(split.train_robots) and seen & set(split.held_out_robots), f"validation seeds are of {sorted(seen)} alone"


def measure(name: str, args: Args) -> dict[str, Any]:
    """Train with one change, roll out validation seeds by each sampler, and grade."""
    run = args.out / "runs" / name.replace(" ", "_").replace(",", "")
    graded = {sampler: args.out / "scores" / f"{run.name}-{sampler.replace(':', '_')}.parquet" for sampler in args.samplers}
    seconds = {}
    for step, command in list_commands(run, name, graded, args).items():
        begin = time.perf_counter()
        if run_logged(command, run, args):
            return {"change": name, "failed": f"{step}, see the log"}
        seconds[step] = time.perf_counter() - begin
    rollouts = [
        {"sampler": sampler, "seconds": seconds[f"rollouts by {sampler}"], **summarize(path)}
        for sampler, path in graded.items()
    ]
    return {"change": name, "loss": last_loss(run, args.steps), "train_s": seconds["training"], "rollouts": rollouts}


def list_commands(run: Path, name: str, graded: Mapping[str, Path], args: Args) -> dict[str, list[str]]:
    """The commands of a change, in their order, with modules of xew and their arguments.

    Args:
        run: folder of the run.
        name: of the change.
        graded: score table to write for each sampler.
        args: of the benchmark.
    """
    data = ["--data", str(args.data)]
    base = [str(args.config), *data, "--out", str(run), *CHANGES[name], "--train.steps", str(args.steps)]
    base += ["--train.save-every", str(args.steps), "--train.samples", "0"]
    base += shlex.split(args.overrides)
    commands = {"latents": ["model.latents", *base], "training": ["model.train", *base, "--overwrite"]}
    for sampler, scores in graded.items():
        rollouts, (kind, steps) = args.out / "rollouts" / scores.stem, sampler.split(":")
        asked = ["--split", "validation", "--out", str(rollouts), "--rollout.sampler", kind, "--rollout.steps", steps]
        commands[f"rollouts by {sampler}"] = ["model.rollout", str(run), *data, *asked]
        asked = ["--out", str(scores), "--metrics", "lpips", "psnr", "--no-baselines"]
        commands[f"grades by {sampler}"] = ["metrics.evaluate", str(rollouts), *data, *asked]
    return commands


def summarize(scores: Path) -> dict[str, list[float]]:
    """LPIPS, PSNR [dB], LPIPS of the first and of the last frames: means over episodes of seen and of unseen robots."""
    import pandas as pd

    from xew.protocol import SPLITS

    curves = pd.read_parquet(scores.with_suffix(".curves.parquet")).sort_values("frame")
    lpips = curves[curves["metric"] == "lpips"].groupby(EPISODE)["value"]
    whole = pd.read_parquet(scores).set_index(EPISODE)
    found = pd.DataFrame({name: whole.loc[whole["metric"] == name, "value"] for name in ("lpips", "psnr")})
    found["first"] = lpips.apply(lambda values: values.head(FRAMES).mean())
    found["last"] = lpips.apply(lambda values: values.tail(FRAMES).mean())
    seen = found.index.get_level_values("robot").isin(SPLITS["fixed"].train_robots)
    return {kind: found[chosen].mean().tolist() for kind, chosen in (("seen", seen), ("unseen", ~seen))}


def run_logged(command: Sequence[str], run: Path, args: Args) -> int:
    """Run a module of xew with its output appended to the run's log; its exit status."""
    environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"} | os.environ
    with (args.out / "logs" / f"{run.name}.log").open("a", encoding="utf-8") as log:
        command = [sys.executable, "-m", f"xew.{command[0]}", *command[1:]]
        return subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=environment).returncode


def last_loss(run: Path, steps: int) -> float:
    """Mean loss over the last eighth of the steps, from the run's log of scalars."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder = next(path.parent for path in run.rglob("events.out.tfevents.*"))
    accumulator = EventAccumulator(str(folder))
    accumulator.Reload()
    return float(np.mean([event.value for event in accumulator.Scalars("loss/train") if event.step > 7 * steps // 8]))


def table(found: Sequence[dict[str, Any]]) -> str:
    """Markdown: a line a change and sampler, LPIPS and PSNR of seen / unseen robots."""
    lines = [
        f"| change | loss | training [s] | sampler | LPIPS | PSNR [dB] | first {FRAMES} frames | last {FRAMES} | rollout [s] |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for change in found:
        if "failed" in change:
            lines.append(f"| {change['change']} | failed: {change['failed']} |" + " |" * 7)
            continue
        for number, rollout in enumerate(change["rollouts"]):
            head = [change["change"], f"{change['loss']:.3f}", f"{change['train_s']:.0f}"] if number == 0 else ["", "", ""]
            pairs = list(itertools.zip_longest(rollout["seen"], rollout["unseen"]))
            cells = [f"{a:.{d}f} / {b:.{d}f}" for (a, b), d in zip(pairs, (3, 1, 3, 3), strict=True)]
            lines.append("| " + " | ".join([*head, rollout["sampler"], *cells, f"{rollout['seconds']:.0f}"]) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))

"""What changes of the small size's recipe gain, in one run on one GPU: each is trained anew and rolls out validation seeds.

    python benchmarks/recipe.py --data data --out recipe                      # short trainings of all that CHANGES lists
    python benchmarks/recipe.py --data data --changes none --steps 5400 --samplers euler:20 unipc:10 unipc:6

Needs episodes with validation seeds (`python -m xew.sim_warp.generate --validation-seeds 1 …`); test seeds are not looked at.
Prints a Markdown table, a line a change and sampler: loss over the last eighth of the steps, LPIPS and PSNR of whole
validation episodes of seen and unseen robots, LPIPS of their first and last 32 frames, seconds. A training that fails has
a line that says so, and the others go on; <out>/logs has what all commands printed.
"""

import itertools
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

CHANGES: dict[str, tuple[str, ...]] = {
    "none": (),
    "render as channels": ("--model.embodiment", "robot_render_channels"),
    "first frame as channels": ("--model.reference", "channels"),
    "residual": ("--model.prediction", "residual"),
    "all three": (
        *("--model.embodiment", "robot_render_channels", "--model.reference", "channels"),
        *("--model.prediction", "residual"),
    ),
    "all three, no flow": (
        *("--model.embodiment", "robot_render_channels", "--model.reference", "channels"),
        *("--model.prediction", "residual", "--model.action", "none"),
    ),
    "shift 3": ("--train.shift", "3"),
    "two chunks": ("--train.chunks", "2", "--train.batch", "1"),
}
"""Overrides of the config by the name of the change."""
FRAMES = 32
"""Number of frames at the beginning and at the end of an episode whose LPIPS tells how a prediction drifts."""


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
    batch: int = 15
    """Number of episodes that are rolled out at once."""
    overrides: str = ""
    """Further overrides of the config, in one string, as --overrides="--model.size tiny"."""
    side: str = ""
    """Roll out one run in this process (the command calls itself with it)."""


def main(args: Args) -> int:
    """Train, roll out and print; the number of changes that failed."""
    if args.side:
        for result in roll_out(Path(args.side), args):
            print("RESULT " + json.dumps(result), flush=True)
        return 0
    assert_workload(args.data)
    (args.out / "logs").mkdir(parents=True, exist_ok=True)
    found: list[dict[str, Any]] = []
    with ThreadPoolExecutor(args.beside) as pool:
        for change in pool.map(lambda name: measure(name, args), args.changes):
            found.append(change)
            (args.out / "results.json").write_text(json.dumps(found, indent=1) + "\n")
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
    """Train with one change and roll out."""
    run = args.out / "runs" / name.replace(" ", "_").replace(",", "")
    base = [str(args.config), "--data", str(args.data), "--out", str(run), *CHANGES[name]]
    base += ["--train.steps", str(args.steps), "--train.save-every", str(args.steps), "--train.sample-every", "0"]
    base += ["--train.ema-decay", str(round(1 - 10 / args.steps, 6)), *shlex.split(args.overrides)]
    begin = time.perf_counter()
    for module, extra in (("latents", ()), ("train", ("--overwrite",))):
        if run_logged([sys.executable, "-m", f"xew.model.{module}", *base, *extra], run, args):
            return {"change": name, "failed": f"{module}, see the log"}
        begin = time.perf_counter() if module == "latents" else begin
    seconds = time.perf_counter() - begin
    this = [sys.executable, __file__, "--data", str(args.data), "--batch", str(args.batch), "--side", str(run)]
    if run_logged([*this, "--samplers", *args.samplers], run, args):
        return {"change": name, "failed": "rollouts, see the log"}
    lines = (args.out / "logs" / f"{run.name}.log").read_text().splitlines()
    rollouts = [json.loads(line.removeprefix("RESULT ")) for line in lines if line.startswith("RESULT ")]
    return {"change": name, "loss": last_loss(run, args.steps), "train_s": seconds, "rollouts": rollouts[-len(args.samplers) :]}


def run_logged(command: Sequence[str], run: Path, args: Args) -> int:
    """Run a command with its output appended to the run's log; its exit status."""
    environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"} | os.environ
    with (args.out / "logs" / f"{run.name}.log").open("a") as log:
        return subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=environment).returncode


def last_loss(run: Path, steps: int) -> float:
    """Mean loss over the last eighth of the steps, from the run's log of scalars."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder = next(path.parent for path in run.rglob("events.out.tfevents.*"))
    accumulator = EventAccumulator(str(folder))
    accumulator.Reload()
    return float(np.mean([event.value for event in accumulator.Scalars("train/loss") if event.step > 7 * steps // 8]))


def roll_out(run: Path, args: Args) -> Iterator[dict[str, Any]]:
    """Whole validation episodes by each sampler: means over robots that were seen, and that were not."""
    from dataclasses import replace

    from xew.compilation import keep_compiled_programs
    from xew.episode import read_video
    from xew.model.episodes.choice import select_episodes
    from xew.model.rollout import load_predictor
    from xew.model.runs.folder import load_run_config
    from xew.protocol import SPLITS

    keep_compiled_programs()
    config = load_run_config(run)
    episodes = sorted(select_episodes(args.data, "validation", None, False), key=lambda episode: episode[1].frame_count)
    for choice in args.samplers:
        sampler, steps = choice.split(":")
        experiment = replace(config, rollout=replace(config.rollout, sampler=sampler, steps=int(steps), unroll=1))
        predictor, _ = load_predictor(run, experiment)
        rows: dict[str, list[list[float]]] = {"seen": [], "unseen": []}
        seconds = 0.0
        for first in range(0, len(episodes), args.batch):
            group = episodes[first : first + args.batch]
            begin = time.perf_counter()
            size = min(args.batch, len(episodes))
            videos = predictor.begin(group, max(record.frame_count for _, record in group), size).fetch()
            seconds += time.perf_counter() - begin
            for (folder, record), video in zip(group, videos, strict=True):
                kind = "seen" if record.robot in SPLITS["fixed"].train_robots else "unseen"
                rows[kind].append(scores(video[: record.frame_count], read_video(folder / "rgb.mkv")))
        means = {kind: np.mean(values, axis=0).tolist() for kind, values in rows.items()}
        yield {"sampler": choice, "episodes": len(episodes), "seconds": seconds, **means}


def scores(video: np.ndarray, truth: np.ndarray) -> list[float]:
    """LPIPS, PSNR [dB], LPIPS of the first and of the last frames of a prediction [t h w 3] at the model's size."""
    from xew.metrics import lpips, psnr
    from xew.model.video.frames import to_camera_size

    predicted = to_camera_size(video)[1:]
    by_frame = np.asarray(lpips(predicted, truth[1:]))
    mean_psnr = np.asarray(psnr(predicted, truth[1:])).mean()
    return [float(value) for value in (by_frame.mean(), mean_psnr, by_frame[:FRAMES].mean(), by_frame[-FRAMES:].mean())]


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

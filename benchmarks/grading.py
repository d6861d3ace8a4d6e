"""How long `python -m xew.metrics.evaluate` takes for a model's rollouts and all baselines, by OpenCV and in Warp kernels.

    python -m benchmarks.grading --data data                                  # 40 test episodes, on this machine's GPU
    python -m benchmarks.grading --data data --codec configs/fixed.yaml      # and the truth through a codec
    python -m benchmarks.grading --data data --episodes 10 --ways default:2 opencv:2

Needs a data set with test seeds, of several robots where another robot's episode is to be graded too. The model's rollouts
are made here: the true video, four frames late and softened, as a model errs. The command is run as users run it, in a
process of its own, once for each way to programs and kernels that are not there yet, and then again from no scores: the
second time is told by the clock, of one process its processor time beside it, and a ratio to the first way.
Before a figure is told it is checked that all videos are graded, and that each way gives the scores of the first: the mean
difference of a metric's scores at most 2 % of their spread over all videos.
"""

import os
import platform
import resource
import shutil
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tyro

from lab.calibration.predictors import delay, soften
from xew.dataset import read_dataset
from xew.episode import read_video
from xew.metrics.grading.open_graders import PROCESSES
from xew.rollout import write_rollout

LATE = 4
"""Number of frames by which the made-up model is late."""
AGREE = 0.02
"""Mean difference of two ways' scores of a metric that is let pass, as a part of their standard deviation."""
KEY = ["model", "condition", "task", "seed", "robot", "metric"]
"""Columns of score tables that name a score."""


@dataclass(frozen=True)
class Args:
    data: Path
    """Episodes with test seeds."""
    out: Path = Path("grading")
    """Folder for what is made here; what is there is replaced."""
    episodes: int = 40
    codec: Path | None = None
    """Run of `xew.model.train`, or its config, whose codec the truth goes through."""
    ways: tuple[str, ...] = ("default:0", "default:1", "opencv:16")
    """Estimators and numbers of processes; 0: as many as the command chooses."""


def main(args: Args) -> None:
    shutil.rmtree(args.out, ignore_errors=True)
    count = make_workload(args)
    print(f"{platform.processor()}, {os.cpu_count()} cores; {count} episodes")
    first: pd.Series[Any] | None = None
    fastest = 0.0
    print("| estimators | processes | first time [s] | again [s] | processor time [s] | factor | videos/s |")
    print("|---" * 7 + "|")
    for way in args.ways:
        estimators, processes = way.split(":")
        cold, _ = grade(args, estimators, processes)
        seconds, busy = grade(args, estimators, processes)
        scores = pd.read_parquet(args.out / "scores.parquet").set_index(KEY)["value"]
        videos = len(scores.groupby(KEY[:-1]))
        assert videos >= (4 + bool(args.codec)) * count, f"{videos} videos of {count} episodes: baselines are missing"
        if first is None:
            first, fastest = scores, seconds
        compare(way, first, scores)
        processor = f"{busy:.0f}" if processes == "1" else "-"  # nobody waits for processes of a fork server, or counts them
        cells = [f"{cold:.1f}", f"{seconds:.1f}", processor, f"{seconds / fastest:.2f}", f"{videos / seconds:.1f}"]
        print("| " + " | ".join([estimators, processes, *cells]) + " |", flush=True)


def make_workload(args: Args) -> int:
    """Copy whole scenes of test seeds, in turns of the tasks, and make rollouts of their episodes; the number of these."""
    dataset = read_dataset(args.data)
    scenes: dict[tuple[int, str], list[Path]] = {}
    ranks: dict[str, list[int]] = {}
    for folder, record in dataset.select(robots=None, split="test"):
        seeds = ranks.setdefault(record.task, [])
        seeds += [] if record.seed in seeds else [record.seed]
        scenes.setdefault((seeds.index(record.seed), record.task), []).append(folder)
    chosen: list[Path] = []
    for _, folders in sorted(scenes.items()):
        chosen += folders if len(chosen) < args.episodes else []
    assert len(chosen) >= args.episodes, f"{args.data} has {len(chosen)} episodes of test seeds; {args.episodes} are asked for"
    with ProcessPoolExecutor() as pool:
        list(pool.map(make_rollout, [args] * len(chosen), chosen))
    return len(chosen)


def make_rollout(args: Args, folder: Path) -> None:
    """Copy one episode and write its made-up rollout."""
    task, seed, robot = folder.parts[-3:]
    shutil.copytree(folder, args.out / "data" / task / seed / robot)
    header = {"model": args.codec.stem if args.codec else "late", "condition": "made up"}
    video = soften(delay(read_video(folder / "rgb.mkv"), LATE))
    write_rollout(args.out / "rollouts", task, int(seed), robot, video, header)


def grade(args: Args, estimators: str, processes: str) -> tuple[float, float]:
    """Seconds of the command from no scores, by the clock and of the processors of its own process."""
    for path in (*args.out.glob("scores*"), args.out / "data-baselines"):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    command = [sys.executable, "-m", "xew.metrics.evaluate", "rollouts", "--data", "data"]
    command += ["--masks", estimators, "--tracks", estimators]
    command += ["--codec", str(args.codec.resolve())] if args.codec else []
    start, before = time.perf_counter(), busy_seconds()
    with (args.out / "log.txt").open("a", encoding="utf-8") as log:
        done = subprocess.run(command, cwd=args.out, stdout=log, stderr=subprocess.STDOUT, env=environment(processes))
    assert done.returncode == 0, f"{' '.join(command)} failed; see {args.out}/log.txt"
    return time.perf_counter() - start, busy_seconds() - before


def environment(processes: str) -> dict[str, str]:
    """This one, in which modules are found from another folder as from this, and which says how many processes grade."""
    paths = [str(Path(__file__).resolve().parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    chosen = {} if processes == "0" else {PROCESSES: processes}
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)} | chosen


def busy_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def compare(way: str, first: "pd.Series[Any]", scores: "pd.Series[Any]") -> None:
    """Fail unless the scores agree."""
    both = pd.concat([first, scores], axis=1, keys=["first", "other"])
    assert (both["first"].isna() == both["other"].isna()).all(), f"{way}: other videos have a score"
    for metric, rows in both.dropna().groupby("metric"):
        apart = np.abs(rows["first"] - rows["other"]).mean()
        assert apart <= AGREE * rows["first"].std() + 1e-6, f"{way}: {metric} differs by {apart:.4g} on average"


if __name__ == "__main__":
    main(tyro.cli(Args))

"""How long `python -m xew.metrics.evaluate` takes for a model's rollouts and all baselines, by OpenCV and in Warp kernels.

    python -m benchmarks.grading --data data                                  # 40 test episodes, on this machine's GPU
    python -m benchmarks.grading --data data --codec configs/fixed.yaml      # and the truth through a codec
    python -m benchmarks.grading --data data --episodes 10 --ways default:2 opencv:2

Needs a data set with test seeds, of several robots where another robot's episode is to be graded too. The model's rollouts
are made here: the true video, four frames late and softened, as a model errs. The command is run as users run it, in a
process of its own: once for each way to compile programs and kernels that are missing, then again without scores, and a
third time with the baselines' scores only, as for a further model. Of the second run the table has the clock's time, the
time until the first video is graded, with one process its processor time, and a ratio to the first way. A second table has
the stages of one video in this process.
Before a figure is printed it is checked that all videos are graded, and that each way gives the scores of the first: the
mean difference of a metric's scores at most 2 % of their spread over all videos.
"""

import os
import platform
import resource
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tyro

from lab.calibration.predictors import delay, soften
from xew.dataset import read_dataset
from xew.episode import read_video
from xew.metrics import METRICS
from xew.metrics.grade import Comparison
from xew.metrics.grade import grade as grade_video
from xew.metrics.grading.grade_episodes import read_prediction
from xew.metrics.grading.list_jobs import Job, list_jobs
from xew.metrics.grading.open_graders import PROCESSES, open_grader, prepare_process
from xew.metrics.grading.settings import Args as Settings
from xew.metrics.grading.settings import GradingSettings, resolve
from xew.rollout import Rollout, write_rollout

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
    titles = ["first time [s]", "again [s]", "first video [s]", "processor time [s]", "factor", "videos/s", "model only [s]"]
    print("| " + " | ".join(["estimators", "processes", *titles]) + " |\n" + "|---" * 9 + "|")
    for way in args.ways:
        estimators, processes = way.split(":")
        cold, _, _ = grade(args, estimators, processes)
        seconds, first_video, busy = grade(args, estimators, processes)
        scores = pd.read_parquet(args.out / "scores.parquet").set_index(KEY)["value"]
        videos = len(scores.groupby(KEY[:-1]))
        assert videos >= (4 + bool(args.codec)) * count, f"{videos} videos of {count} episodes: baselines are missing"
        if first is None:
            first, fastest = scores, seconds
        compare(way, first, scores)
        processor = f"{busy:.0f}" if processes == "1" else "-"  # nobody waits for processes of a fork server, or counts them
        further, _, _ = grade(args, estimators, processes, baselines=False)
        cells = [f"{cold:.1f}", f"{seconds:.1f}", f"{first_video:.1f}", processor, f"{seconds / fastest:.2f}"]
        cells += [f"{videos / seconds:.1f}", f"{further:.1f}"]
        print("| " + " | ".join([estimators, processes, *cells]) + " |", flush=True)
    print("\n| one video, this process | ms |\n|---|---|")
    for stage, seconds in time_stages(args).items():
        print(f"| {stage} | {1000 * seconds:.0f} |")


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


def grade(args: Args, estimators: str, processes: str, baselines: bool = True) -> tuple[float, float, float]:
    """Seconds of the command without scores, until its first video is graded, and of the processors of its own process.

    `baselines`: whether it grades the baselines, too; otherwise it finds their scores.
    """
    kept = args.out / "data-baselines"
    for path in (*args.out.glob("scores*"), *([kept] if baselines else [])):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    command = [sys.executable, "-m", "xew.metrics.evaluate", "rollouts", "--data", "data"]
    command += ["--masks", estimators, "--tracks", estimators]
    command += ["--codec", str(args.codec.resolve())] if args.codec else []
    start, clock, before = time.perf_counter(), time.time(), busy_seconds()
    with (args.out / "log.txt").open("a", encoding="utf-8") as log:
        done = subprocess.run(command, cwd=args.out, stdout=log, stderr=subprocess.STDOUT, env=environment(processes))
    assert done.returncode == 0, f"{' '.join(command)} failed; see {args.out}/log.txt"
    seconds = time.perf_counter() - start
    cells = [path for folder in (args.out / "scores.cells", kept) for path in folder.rglob("*.json")]
    first_video = min(path.stat().st_mtime for path in cells if path.stat().st_mtime > clock) - clock
    return seconds, first_video, busy_seconds() - before


def time_stages(args: Args) -> dict[str, float]:
    """Seconds of each stage of grading the first video of an episode, compiled before."""
    prepare_process(())
    settings = resolve(Settings((args.out / "rollouts",), args.out / "data", args.out / "stages.parquet", baselines=False))
    listing = list_jobs(settings)
    job = max(listing.jobs, key=lambda job: job.cell.frames)
    assert job.rollout is not None, "baselines are left out"
    grade_by_stages(settings, job, job.rollout)
    return grade_by_stages(settings, job, job.rollout)


def grade_by_stages(settings: GradingSettings, job: Job, rollout: Rollout) -> dict[str, float]:
    """Seconds of each stage of grading a rollout."""
    grader = open_grader(settings, {}, threading.Event())
    seconds: dict[str, float] = {}
    with timed(seconds, "episode: video, states, points on surfaces"):
        episode = grader.read_episode([(job, settings.metrics)])
    with timed(seconds, "the model's video"):
        video, _ = read_prediction(job, rollout, episode.truth, settings.args)
    comparison = Comparison(video, episode, grader.resources.masker, grader.resources.tracker)
    with timed(seconds, "colors"):
        episode.appearance.match(video)
    with timed(seconds, "masks, with colors again"):
        masks = comparison.estimate_masks()
    with timed(seconds, "points"):
        comparison.track("robot_points")
        comparison.track("keypoints")
    of_points = [name for name in settings.metrics if METRICS[name].inputs == "track"]
    of_network = [name for name in settings.metrics if name.endswith("lpips")]
    others = [name for name in settings.metrics if name not in (*of_points, *of_network)]
    with timed(seconds, "metrics of points"):
        grades = grade_video(comparison, of_points)
    comparison = Comparison(video, episode, lambda *_: masks, grader.resources.tracker)
    for part, names in (("LPIPS", of_network), ("other metrics", others)):
        with timed(seconds, part):
            grade_video(comparison, names)
    with timed(seconds, "writing"):
        settings.store.write(job.cell, grades)
    return seconds


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


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

"""The command that grades rollouts against the episodes that they predict.

Reads  <rollouts>/<task>/<seed>/<robot>/ (xew.rollout) and the same folders of the data set
Writes scores.parquet, one row per model, condition, task, seed, robot and metric; beside it
       scores.curves.parquet (the same by frame), scores.summary.md and .csv (means, intervals, noise), scores.pairs.csv
       (differences between models), scores.power.csv (which tasks tell a frozen frame from the truth), scores.bundle.json
       (what others need to check all this), scores.cells/ (to go on from);
       <data>-baselines/, the baselines' scores, for every table on the same data

    python -m xew.metrics.evaluate demo/rollouts --data demo/data --out demo/scores.parquet
    python -m xew.metrics.evaluate demo/rollouts --data demo/data --check demo/scores.bundle.json --regrade 5
    python -m xew.metrics.evaluate --data demo/data --baselines-of test --out demo/baselines.parquet
"""

import itertools
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
import tyro
from tqdm import tqdm

from xew.concurrency import begin_importing, free_gpu_memory, map_in_order, map_in_processes, visible_gpus
from xew.config import ConfigError, pick, suggestion, user_errors
from xew.dataset import demand_one_motion, find_accepted
from xew.episode import EpisodeError, read_record, verify_episode
from xew.files import hold_lock, write_section
from xew.metrics import METRICS
from xew.metrics.backends import MASKERS, TRACKERS, identity
from xew.metrics.grade import DIAGNOSTICS, input_kind
from xew.metrics.grading.baselines import BASELINES
from xew.metrics.grading.bundle import Bundle, differences, disagreements, raise_if_any, read_bundle, write_bundle
from xew.metrics.grading.codecs import OPENER, ModelCodec, open_codecs
from xew.metrics.grading.grader import Graded, GraderOpener, Group, prepare_process
from xew.metrics.grading.jobs import Job, list_baseline_jobs, list_jobs
from xew.metrics.grading.power import HEADING, power_section
from xew.metrics.grading.scores import (
    CellStore,
    baselines_folder,
    check_out,
    describe,
    path_beside,
    surfaces_folder,
    write_diagnostics,
    write_tables,
    write_whole,
)
from xew.metrics.grading.summary import summarize, to_markdown
from xew.metrics.grading.weights import check_weights
from xew.metrics.grading.workers import choose_allocator, worker_count
from xew.metrics.metric import SUITES
from xew.metrics.truth import read_truth
from xew.names import csv_text
from xew.protocol import GRADING_PROTOCOL, HELD_OUT_ROBOTS, seed_split
from xew.rollout import find_rollouts

IMPORTED = ("xew.metrics.grading.grader",)
"""Modules that processes that grade need."""
DIMENSIONS = tuple(dict.fromkeys(metric.dimension for metric in METRICS.values()))


@dataclass(frozen=True)
class Args:
    """Grade rollouts against the episodes they predict. Done videos are kept: run it again to go on where it stopped."""

    rollouts: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Rollout trees; several are graded into one table."""
    data: Path = Path("data")
    """The data set that holds the true episodes."""
    out: Path = Path("scores.parquet")
    """Score table; all else that is written lies beside it."""
    metrics: tuple[str, ...] = tuple(METRICS)
    """Names of xew.metrics.METRICS."""
    dimensions: tuple[str, ...] = DIMENSIONS
    """Dimensions whose metrics are graded."""
    suite: tuple[str, ...] = tuple(SUITES)
    """Suites whose metrics are graded: paper, strict, or both."""
    masks: str = "default"
    """Estimator of robot masks in a prediction: a name of xew.metrics.backends.MASKERS, or module:NAME."""
    masks_checkpoint: Path | None = None
    """Its weights, where it has some."""
    tracks: str = "default"
    """Estimator of keypoints and objects in a prediction: a name of xew.metrics.backends.TRACKERS, or module:NAME."""
    tracks_checkpoint: Path | None = None
    """Its weights, where it has some."""
    frame_zero: Literal["given", "absent", "predicted"] = "given"
    """given: frame 0 of a video is the frame that the model was given, and is in no score. absent: videos begin with frame 1.
    predicted: frame 0 is scored like the others."""
    allow: tuple[Literal["resize", "trim", "rate"], ...] = ()
    """Changes to videos that are errors without it. resize: bring videos of another size to the episode's. trim: cut longer
    videos. rate: take any frame rate of a container, its frames being the episode's one by one."""
    baselines: bool = True
    """Also grade, as models of their own, the frozen first frame, the robot's render pasted into it, another robot's episode,
    and the true video itself: the noise floor of the scores."""
    baselines_of: Literal["train", "validation", "test"] | None = None
    """In place of rollouts: grade the baselines on all episodes of these seeds, before there is a model."""
    max_frames: int = 0
    """With --baselines-of: number of frames that are graded, for rollouts that are cut to it; 0 for whole episodes."""
    codec: tuple[Path, ...] = ()
    """Runs of `xew.model.train` that made some of the rollouts: the truth is graded through the codec of each, and is the noise
    floor of its model's scores. Other models have the floor of the true video. With --baselines-of a config of
    `xew.model.train` may be named in place of a run."""
    codec_opener: str = OPENER
    """Function that opens these runs, as module:NAME (`xew.metrics.grading.codecs.open_codec`)."""
    power_page: Path | None = None
    """Markdown page whose section on what the metrics can tell on each task is written anew, such as docs/tasks.md."""
    diagnostics: bool = False
    """Also write scores.diagnostics.parquet: contact F1, which is too unreliable in predicted video to be reported."""
    resample: Literal["scene", "task"] = "scene"
    """Unit that the summary's intervals resample: scenes (what would other scenes of these tasks give?), or whole tasks."""
    keep_going: bool = False
    """Grade the rest when a rollout cannot be graded; the exit status still says so."""
    overwrite: bool = False
    """Grade everything anew."""
    workers: int = 0
    """Threads that read, estimate and grade, shared out to the devices; 0: one for each processor core."""
    processes: int = 1
    """Processes that episodes are shared out to, in place of threads, and that have the GPUs in turn. Threads wait for Python's
    lock, so that only processes keep more than about six cores, or a GPU, busy; each takes some ten seconds to start. 8 to 12
    suit a GPU that nothing else uses, if there are as many cores."""
    check: Path | None = None
    """Grade nothing: check that a bundle is consistent, and, where rollouts are named, that it was made from them."""
    regrade: int = 0
    """With --check: grade so many of its videos anew and compare."""
    mixed_motion: bool = False
    """Grade episodes of shared and of own motion into one table."""
    trust: tuple[str, ...] = ()
    """Modules of your own tasks and robots, such as my_lab.tasks, that the data may name."""


POWER_COMMAND = "python -m xew.metrics.evaluate --data data --baselines-of validation --power-page docs/tasks.md"
"""Command that the page of the tasks names."""
WRITTEN = {
    "parquet": "scores",
    "curves.parquet": "the same by frame",
    "summary.md": "means and differences between models",
    "summary.csv": "means, intervals, noise",
    "pairs.csv": "differences between models",
    "power.csv": "which tasks tell the frozen first frame from the truth",
    "bundle.json": "for others to check",
}
"""Files that are written beside each other, by the ending of the name, with what each holds."""


@user_errors
def main(args: Args) -> None:
    """Grade, write, and print what came out; or check a bundle."""
    prepare_process(args.trust)
    if args.processes < 1:
        raise ConfigError(f"--processes is {args.processes}; expected at least 1.")
    if args.processes > 1:
        begin_processes()
    if args.check is not None:
        check(args, args.check)
        return
    check_out(args.out)
    with hold_lock(args.out):
        grade_tables(args)


def grade_tables(args: Args) -> None:
    """Grade, write the tables and print the summary. Raises EpisodeError where a rollout could not be graded."""
    metrics = choose_metrics(args)
    check_weights(metrics)
    attributes = describe(settings(args), metrics)
    store = CellStore(path_beside(args.out, "cells"), baselines_folder(args.data, args.out))
    errors: list[str] = []
    codecs = find_codecs(args)
    if args.rollouts and codecs:
        attributes |= {"codecs": {model: [codec.key] for model, codec in sorted(codecs.items())}}
    jobs = find_jobs(args, tuple(BASELINES) if args.baselines else (), errors if args.keep_going else None, codecs)
    records = map(read_record, dict.fromkeys(job.episode for job in jobs))
    attributes["motion"] = demand_one_motion(args.data, records, args.mixed_motion)
    total = len(jobs) + len(errors)
    diagnostics = tuple(DIAGNOSTICS) if args.diagnostics else ()
    errors += grade_all(jobs, (*metrics, *diagnostics), args, store, codecs)
    cells = [job.cell for job in jobs]
    write_tables(args.out, attributes, cells, store)
    if diagnostics:
        write_diagnostics(path_beside(args.out, "diagnostics.parquet"), attributes, diagnostics, cells, store)
    rows = pd.read_parquet(args.out)
    write_bundle(path_beside(args.out, "bundle.json"), args.out, rows, cells)
    print(_write_summary(args, rows))
    if errors:
        raise EpisodeError(f"{len(errors)} of {total} could not be graded:\n  " + "\n  ".join(errors))


def _write_summary(args: Args, rows: pd.DataFrame) -> str:
    """Write the summary's files and return what is printed."""
    if rows.empty:
        return "no scores"
    summary = summarize(rows, args.resample, HELD_OUT_ROBOTS)
    write_whole(path_beside(args.out, "summary.md"), to_markdown(summary).encode())
    write_whole(path_beside(args.out, "summary.csv"), csv_text(summary.means).encode())
    write_whole(path_beside(args.out, "pairs.csv"), csv_text(summary.pairs).encode())
    write_whole(path_beside(args.out, "power.csv"), csv_text(summary.power).encode())
    if args.power_page:
        write_power(args.power_page, summary.power, rows)
    written = "\n".join(f"{path_beside(args.out, ending)}  {what}" for ending, what in WRITTEN.items())
    return f"{to_markdown(summary, with_pairs=False)}\n{written}"


def write_power(page: Path, power: pd.DataFrame, rows: pd.DataFrame) -> None:
    """Write what the metrics can tell on each task into a page. Raises ConfigError where the power is not known."""
    if power.empty:
        raise ConfigError("--power-page needs the frozen first frame and the true video in a metric of the suite strict.")
    try:
        write_section(page, HEADING, f"`{POWER_COMMAND}`.\n{power_section(power, rows)}")
    except OSError as error:
        raise EpisodeError(f"cannot write {page}: {error.strerror}. Choose another file with --power-page.") from error


def choose_metrics(args: Args) -> tuple[str, ...]:
    """Names of the metrics to grade, in the registry's order. Raises ConfigError for an unknown name, or if none is left."""
    wanted = {
        "metric": (args.metrics, tuple(METRICS)),
        "dimension": (args.dimensions, DIMENSIONS),
        "suite": (args.suite, tuple(SUITES)),
    }
    for kind, (names, known) in wanted.items():
        for name in names:
            if name not in known:
                raise ConfigError(f"unknown {kind} {name!r};{suggestion(name, known)} known: {', '.join(known)}.")
    chosen = tuple(
        name
        for name, metric in METRICS.items()
        if name in args.metrics and metric.dimension in args.dimensions and set(metric.suites) & set(args.suite)
    )
    if not chosen:
        raise ConfigError(
            f"no metric of {', '.join(args.metrics)} is of the dimensions {', '.join(args.dimensions)} and the suites "
            f"{', '.join(args.suite)}."
        )
    return chosen


def settings(args: Args) -> dict[str, Any]:
    """All choices that change a score, as they stand in a table's attributes and in the digest of each cell."""
    pick(MASKERS, args.masks, "masker")
    pick(TRACKERS, args.tracks, "tracker")
    return {
        "protocol": GRADING_PROTOCOL,
        "estimators": {
            "masks": _identity(args.masks, args.masks_checkpoint, "--masks-checkpoint"),
            "tracks": _identity(args.tracks, args.tracks_checkpoint, "--tracks-checkpoint"),
        },
        "frame_zero": args.frame_zero,
        "allowed": sorted(set(args.allow)),
    }


def _identity(name: str, checkpoint: Path | None, option: str) -> str:
    if checkpoint is not None and not checkpoint.exists():
        raise ConfigError(f"{option} is {checkpoint}, which does not exist.")
    return identity(name, checkpoint)


def find_codecs(args: Args) -> dict[str, ModelCodec]:
    """Codecs of the runs that are named, by model. Raises ConfigError as `open_codecs`."""
    return open_codecs(args.codec, args.codec_opener, find_models(args)) if args.codec else {}


def find_models(args: Args) -> frozenset[str] | None:
    """Names of the models whose rollouts are graded; None where baselines are graded before there is a model."""
    if args.baselines_of is not None:
        return None
    return frozenset(rollout.model for root in args.rollouts for rollout in find_rollouts(root, []))


def find_jobs(
    args: Args, baselines: Sequence[str], problems: list[str] | None = None, codecs: Mapping[str, ModelCodec] | None = None
) -> list[Job]:
    """All that is to be graded, with the baselines of these names and the truth through these models' codecs.

    Raises, or tells the problems, as `list_jobs`.
    """
    if args.frame_zero == "predicted" and (baselines or codecs):
        raise ConfigError(
            "frame 0 of the frozen first frame is the truth: with --frame-zero predicted say --no-baselines, and no --codec."
        )
    if args.baselines_of is None:
        workers = worker_count(args.workers)
        return list_jobs(args.rollouts, args.data, str(settings(args)), baselines, workers, problems, codecs)
    if args.rollouts or not baselines:
        raise ConfigError("--baselines-of grades baselines alone: leave out the rollouts, and --no-baselines.")
    episodes = [episode for episode in find_accepted(args.data) if seed_split(episode[1].seed) == args.baselines_of]
    return list_baseline_jobs(episodes, str(settings(args)), baselines, codecs or {}, args.max_frames)


def grade_all(
    jobs: list[Job], metrics: tuple[str, ...], args: Args, store: CellStore, codecs: Mapping[str, ModelCodec]
) -> list[str]:
    """Grade what is not in the store yet, and return what went wrong.

    Episodes are read and graded by threads or processes, a few ahead of each other, so that memory does not grow with their
    number; those with most to grade first, so that none is begun when all others are nearly done.

    Raises:
        RolloutError: a video cannot be graded, unless args.keep_going; what was graded before stays in the store.
    """
    wanted = [(job, metrics if args.overwrite else store.missing(job.cell, metrics)) for job in jobs]
    todo = [(job, names) for job, names in wanted if names]
    if len(todo) < len(jobs):
        print(f"{len(jobs) - len(todo)} of {len(jobs)} are graded already in {store.folder}")
    groups = [list(group) for _, group in itertools.groupby(todo, key=lambda pair: (pair[0].episode, pair[0].cell.frames))]
    groups.sort(key=lambda group: len(group) * group[0][0].cell.frames, reverse=True)
    errors: list[str] = []
    without_shapes: list[Path] = []
    with tqdm(total=len(jobs), initial=len(jobs) - len(todo), desc="evaluate", unit="video", disable=None) as bar:
        for group, graded in zip(groups, _grade_groups(groups, metrics, args, store, codecs), strict=True):
            errors += graded.errors
            without_shapes += [] if graded.has_shapes else [group[0][0].episode]
            bar.update(len(group))
    if without_shapes:
        print(
            f"the shapes of {len(without_shapes)} of {len(groups)} episodes are not known (imported, or of another version of "
            f"their task, such as {min(without_shapes)}): their strict metrics of points are of links' and objects' origins"
        )
    return errors


def _grade_groups(
    groups: Sequence[Group], metrics: tuple[str, ...], args: Args, store: CellStore, codecs: Mapping[str, ModelCodec]
) -> Iterator[Graded]:
    """What came out of each group, in their order, from threads of this process or from processes of their own.

    Processes open the codecs for themselves.
    """
    opener = make_grader_opener(args, metrics, store)
    if args.processes > 1 and len(groups) > 1:
        gpus = visible_gpus()
        choose_allocator(min(args.processes, len(groups)), free_gpu_memory(gpus))
        yield from map_in_processes(opener.open_in_process, groups, args.processes, IMPORTED, gpus)
        return
    stop = threading.Event()
    yield from map_in_order(opener.open(stop, codecs), groups, worker_count(args.workers), stop)


def begin_processes() -> None:
    """Begin to import what processes that grade need, with one thread for NumPy: they share the cores."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    begin_importing(IMPORTED)


def make_grader_opener(args: Args, metrics: Sequence[str], store: CellStore) -> GraderOpener:
    """What opens the graders that these arguments ask for."""
    return GraderOpener(
        metrics=tuple(metrics),
        masks=(args.masks, args.masks_checkpoint),
        tracks=(args.tracks, args.tracks_checkpoint),
        codecs=tuple(args.codec),
        codec_opener=args.codec_opener,
        models=find_models(args) if args.codec else None,
        surfaces=surfaces_folder(args.data, args.out),
        store=store,
        allow=args.allow,
        frame_zero=args.frame_zero,
        keep_going=args.keep_going,
        trust=args.trust,
    )


def _demand_codecs(path: Path, bundle: Bundle, args: Args) -> None:
    """Raise ConfigError where a bundle has the truth through codecs of runs that are not named."""
    if bundle.get("codecs") and not args.codec:
        raise ConfigError(
            f"{path} has the truth through the codecs of {', '.join(sorted(bundle['codecs']))}; name these runs: --codec RUN."
        )


def check(args: Args, path: Path) -> None:
    """Check a bundle against itself, against rollouts and data where they are named, and against scores graded anew.

    Raises:
        ConfigError: something does not hold; the message says what.
    """
    bundle = read_bundle(path)
    print(f"{path}: {len(bundle['samples'])} videos, whole, and its means are those of its values")
    if not args.rollouts:
        return
    held = {sample["model"] for sample in bundle["samples"]}  # a bundle of an earlier version has fewer baselines
    _demand_codecs(path, bundle, args)
    codecs = find_codecs(args)
    jobs = find_jobs(args, [name for name in BASELINES if name in held], codecs=codecs)
    raise_if_any(path, differences(bundle, settings(args), [job.cell for job in jobs]))
    print("made from these rollouts and this data, by their digests")
    picked = [jobs[i] for i in np.unique(np.linspace(0, len(jobs) - 1, args.regrade).astype(int))]
    metrics = tuple(name for name in bundle["metrics"] if name in METRICS)
    store = CellStore(path_beside(args.out, "cells"), baselines_folder(args.data, args.out))
    grader, found = make_grader_opener(args, metrics, store).open(threading.Event(), codecs), list[str]()
    for job in tqdm(picked, desc="grade anew", unit="video", disable=None):
        verify_episode(job.episode)
        truth = read_truth(job.episode, job.cell.frames, {input_kind(name) for name in metrics})
        found += disagreements(bundle, job.cell.key, grader.grade(job, truth, metrics).values)
    raise_if_any(path, found)
    if picked:
        print(f"{len(picked)} videos graded anew: the same scores")


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m xew.metrics.evaluate"))

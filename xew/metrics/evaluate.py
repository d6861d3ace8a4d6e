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

import gc
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from tqdm import tqdm

from xew.concurrency import begin_importing, call_in_processes, free_gpu_memory, map_in_order, visible_gpus
from xew.config import ConfigError, pick, suggestion, user_errors
from xew.dataset import demand_one_motion, find_accepted
from xew.episode import EpisodeError, read_record, verify_episode
from xew.files import hold_lock
from xew.metrics import METRICS
from xew.metrics.backends import MASKERS, TRACKERS, identity
from xew.metrics.grade import DIAGNOSTICS, input_kind
from xew.metrics.grading.baselines import BASELINES
from xew.metrics.grading.bundle import Bundle, differences, disagreements, raise_if_any, read_bundle
from xew.metrics.grading.codecs import OPENER, ModelCodec, open_codecs
from xew.metrics.grading.grader import Graded, GraderOpener, Group, prepare_process
from xew.metrics.grading.jobs import Job, list_baseline_jobs, list_jobs
from xew.metrics.grading.scores import CellStore, baselines_folder, check_out, describe, path_beside, surfaces_folder
from xew.metrics.grading.weights import check_weights
from xew.metrics.grading.workers import choose_allocator, reader_count, worker_count
from xew.metrics.metric import SUITES
from xew.metrics.truth import read_truth
from xew.protocol import GRADING_PROTOCOL, seed_split
from xew.rollout import find_rollouts

IMPORTED = ("xew.metrics.grading.grader", "xew.sim_warp.production.surfaces")
"""Modules that processes that grade need; the second is imported for points on surfaces, and takes as long as the first."""
GradeGroups = Callable[[Sequence[Group]], Iterator[Graded]]
"""Function of groups, each of one episode, that gives what came of grading each, in their order."""
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
    trust: tuple[str, ...] = ()
    """Modules of your own tasks and robots, such as my_lab.tasks, that the data may name."""


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
    from xew.metrics.grading.outcome import write_outcome  # here, while the process that others are forked from imports

    metrics = choose_metrics(args)
    check_weights(metrics)
    attributes = describe(settings(args), metrics)
    store = CellStore(path_beside(args.out, "cells"), baselines_folder(args.data, args.out))
    errors: list[str] = []
    diagnostics = tuple(DIAGNOSTICS) if args.diagnostics else ()
    with open_graders(args, (*metrics, *diagnostics), store) as (codecs, grade_groups):
        if args.rollouts and codecs:
            attributes |= {"codecs": {model: [codec.key] for model, codec in sorted(codecs.items())}}
        jobs = find_jobs(args, tuple(BASELINES) if args.baselines else (), errors if args.keep_going else None, codecs)
        records = map(read_record, dict.fromkeys(job.episode for job in jobs))
        attributes["motion"] = demand_one_motion(args.data, records)
        total = len(jobs) + len(errors)
        errors += grade_all(jobs, (*metrics, *diagnostics), args, store, grade_groups)
        cells = [job.cell for job in jobs]
        print(write_outcome(args.out, attributes, diagnostics, cells, store, args.resample, args.power_page))
    if errors:
        raise EpisodeError(f"{len(errors)} of {total} could not be graded:\n  " + "\n  ".join(errors))


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
        readers = reader_count(args.workers)
        return list_jobs(args.rollouts, args.data, str(settings(args)), baselines, readers, problems, codecs)
    if args.rollouts or not baselines:
        raise ConfigError("--baselines-of grades baselines alone: leave out the rollouts, and --no-baselines.")
    episodes = [episode for episode in find_accepted(args.data) if seed_split(episode[1].seed) == args.baselines_of]
    return list_baseline_jobs(episodes, str(settings(args)), baselines, codecs or {}, args.max_frames)


def grade_all(jobs: list[Job], metrics: tuple[str, ...], args: Args, store: CellStore, grade_groups: GradeGroups) -> list[str]:
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
        for group, graded in zip(groups, grade_groups(groups) if groups else (), strict=True):
            errors += graded.errors
            without_shapes += [] if graded.has_shapes else [group[0][0].episode]
            bar.update(len(group))
    if without_shapes:
        print(
            f"the shapes of {len(without_shapes)} of {len(groups)} episodes are not known (imported, or of another version of "
            f"their task, such as {min(without_shapes)}): their strict metrics of points are of links' and objects' origins"
        )
    return errors


@contextmanager
def open_graders(
    args: Args, metrics: tuple[str, ...], store: CellStore
) -> Iterator[tuple[Mapping[str, ModelCodec], GradeGroups]]:
    """Give the codecs, and what grades groups: threads of this process, or processes, which open the codecs for themselves.

    Processes begin here where there is no table yet, so that they get ready while this process opens the codecs and lists what
    there is to grade. A table says that an earlier run came to its end: then they begin with the first group, if there is one.
    """
    opener = make_grader_opener(args, metrics, store)
    with ExitStack() as stack:

        def begin(count: int) -> GradeGroups:
            gpus = visible_gpus()
            choose_allocator(count, free_gpu_memory(gpus))
            return stack.enter_context(call_in_processes(opener.open_in_process, count, IMPORTED, gpus))

        def grade_late(groups: Sequence[Group]) -> Iterator[Graded]:
            count = min(args.processes, len(groups))
            if count > 1:
                return begin(count)(groups)
            stop = threading.Event()
            return map_in_order(opener.open(stop, codecs), groups, worker_count(args.workers), stop)

        early = 0 if args.out.exists() and not args.overwrite else min(args.processes, most_groups(args))
        grade_groups = begin(early) if early > 1 else grade_late
        codecs = find_codecs(args)
        yield codecs, grade_groups


def most_groups(args: Args) -> int:
    """Largest number of episodes that there can be to grade, told by folders alone."""
    roots = args.rollouts if args.baselines_of is None else (args.data,)
    return sum(1 for root in roots for _ in root.glob("*/*/*"))


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
    gc.freeze()  # Python would go through all that is imported once more at its end, for nothing

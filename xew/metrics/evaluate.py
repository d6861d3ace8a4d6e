"""Stage 10 of 11: evaluate. Rollouts and the episodes they predict to scores.

Reads  <rollouts>/<task>/<seed>/<robot>/ (xew.rollout) and the same folders of the data set
Writes scores.parquet, one row per model, condition, task, seed, robot and metric; beside it
       scores.curves.parquet (the same by frame), scores.summary.md and .csv (means, intervals, noise), scores.pairs.csv
       (differences between models), scores.bundle.json (what others need to check all this), scores.cells/ (to go on from)

    python -m xew.metrics.evaluate demo/rollouts --data demo/data --out demo/scores.parquet
    python -m xew.metrics.evaluate demo/rollouts --data demo/data --check demo/scores.bundle.json --regrade 5
"""

import itertools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import cv2
import jax
import numpy as np
import pandas as pd
import tyro
from tqdm import tqdm

from xew.config import ConfigError, pick, user_errors
from xew.episode import EpisodeError, Record, episode_folder, read_record, verify_episode
from xew.metrics import METRICS
from xew.metrics.backends import MASKERS, TRACKERS, Masker, Tracker, identity, open_masker, open_tracker
from xew.metrics.bundle import demand_none, differences, disagreements, read_bundle, write_bundle
from xew.metrics.grade import DIAGNOSTICS, Comparison, Grades, compared, grade
from xew.metrics.scores import (
    Cell,
    CellStore,
    beside,
    check_out,
    describe,
    file_digest,
    write_diagnostics,
    write_tables,
    write_whole,
)
from xew.metrics.summary import summarise, to_markdown
from xew.metrics.truth import Truth, read_truth
from xew.protocol import HELD_OUT_ROBOTS
from xew.rollout import Rollout, RolloutError, find_rollouts, read_rollout_video

PROTOCOL = 2
"""Goes up when any number that evaluate writes would change; scores of another protocol are graded anew."""
DIMENSIONS = tuple(dict.fromkeys(metric.dimension for metric in METRICS.values()))
MOST_WORKERS = 32
"""A worker holds an episode and a prediction, a quarter of a gigabyte at full length."""


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
    """Of the metrics, those of these dimensions."""
    masks: str = "default"
    """Who finds the robot in a prediction: a name of xew.metrics.backends.MASKERS, or module:NAME."""
    masks_checkpoint: Path | None = None
    """Its weights, where it has some."""
    tracks: str = "default"
    """Who finds keypoints and objects in a prediction: a name of xew.metrics.backends.TRACKERS, or module:NAME."""
    tracks_checkpoint: Path | None = None
    """Its weights, where it has some."""
    frame_zero: Literal["given", "absent", "predicted"] = "given"
    """given: frame 0 of a video is the frame that the model was given, and is in no score. absent: videos begin with frame 1.
    predicted: frame 0 is scored like the others."""
    allow: tuple[Literal["resize", "trim", "rate"], ...] = ()
    """What is an error else. resize: videos of another size are brought to the episode's. trim: longer videos are cut.
    rate: containers may say any frame rate, their frames are the episode's one by one."""
    baselines: bool = True
    """Also grade, as models of their own, the frozen first frame, and the true video itself: the noise floor of the scores."""
    diagnostics: bool = False
    """Also write scores.diagnostics.parquet: contact F1, which is too unreliable in predicted video to be reported."""
    resample: Literal["scene", "task"] = "scene"
    """What the summary's intervals resample: scenes (what would other scenes of these tasks give?), or whole tasks."""
    keep_going: bool = False
    """Grade the rest when a rollout cannot be graded; the exit status still says so."""
    overwrite: bool = False
    """Grade everything anew."""
    workers: int = 0
    """Threads that read, estimate and grade, shared out to the devices; 0: one for each processor core."""
    check: Path | None = None
    """Grade nothing: check that a bundle is consistent, and, where rollouts are named, that it was made from them."""
    regrade: int = 0
    """With --check: grade so many of its videos anew and compare."""


BASELINES: dict[str, Callable[[Truth], np.ndarray]] = {
    "copy_first_frame": lambda truth: np.repeat(truth.rgb[:1], len(truth.rgb), axis=0),
    "ground_truth": lambda truth: truth.rgb,
}
"""What a score of nothing and a score of everything look like; the second is the noise floor of the estimators."""


WRITTEN = {
    "parquet": "scores",
    "curves.parquet": "the same by frame",
    "summary.md": "means and differences between models",
    "summary.csv": "means, intervals, noise",
    "pairs.csv": "differences between models",
    "bundle.json": "for others to check",
}
"""What lies beside each other, by the ending of the name."""


@user_errors
def main(args: Args) -> None:
    """Grade, write, and print what came out; or check a bundle."""
    compile_cache()
    if args.check is not None:
        check(args, args.check)
        return
    check_out(args.out)
    metrics = choose_metrics(args)
    attributes = describe(settings(args), metrics)
    store = CellStore(beside(args.out, "cells"))
    errors: list[str] = []
    jobs = plan(args, errors if args.keep_going else None)
    total = len(jobs) + len(errors)
    diagnostics = tuple(DIAGNOSTICS) if args.diagnostics else ()
    errors += grade_all(jobs, (*metrics, *diagnostics), args, store)
    cells = [job.cell for job in jobs]
    write_tables(args.out, attributes, cells, store)
    if diagnostics:
        write_diagnostics(beside(args.out, "diagnostics.parquet"), attributes, diagnostics, cells, store)
    rows = pd.read_parquet(args.out)
    write_bundle(beside(args.out, "bundle.json"), args.out, rows, cells)
    print(_write_summary(args, rows))
    if errors:
        raise EpisodeError(f"{len(errors)} of {total} could not be graded:\n  " + "\n  ".join(errors))


def _write_summary(args: Args, rows: pd.DataFrame) -> str:
    """Write the summary's files and return what is printed."""
    if rows.empty:
        return "no scores"
    summary = summarise(rows, args.resample, HELD_OUT_ROBOTS)
    write_whole(beside(args.out, "summary.md"), to_markdown(summary).encode())
    write_whole(beside(args.out, "summary.csv"), summary.means.to_csv(index=False).encode())
    write_whole(beside(args.out, "pairs.csv"), summary.pairs.to_csv(index=False).encode())
    written = "\n".join(f"{beside(args.out, ending)}  {what}" for ending, what in WRITTEN.items())
    return f"{to_markdown(summary, with_pairs=False)}\n{written}"


def choose_metrics(args: Args) -> tuple[str, ...]:
    """Names of the metrics to grade, in the registry's order. Raises ConfigError for an unknown name, or if none is left."""
    for name in args.metrics:
        pick(METRICS, name, "metric")
    known = dict.fromkeys(DIMENSIONS, "")
    for name in args.dimensions:
        pick(known, name, "dimension")
    chosen = tuple(name for name in METRICS if name in args.metrics and METRICS[name].dimension in args.dimensions)
    if not chosen:
        raise ConfigError(f"no metric of {', '.join(args.metrics)} is of the dimensions {', '.join(args.dimensions)}.")
    return chosen


def settings(args: Args) -> dict[str, Any]:
    """All choices that change a score, as they stand in a table's attributes and in the digest of each cell."""
    pick(MASKERS, args.masks, "masker")
    pick(TRACKERS, args.tracks, "tracker")
    return {
        "protocol": PROTOCOL,
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


@dataclass(frozen=True)
class Job:
    """One video to grade: a rollout, or a baseline on a rollout's episode and frames."""

    cell: Cell
    rollout: Rollout | None
    """None: the baseline that the cell names as its model."""
    episode: Path
    frame_rate: float
    """The episode's."""

    @property
    def place(self) -> Path:
        return self.rollout.folder if self.rollout else self.episode


def plan(args: Args, problems: list[str] | None = None) -> list[Job]:
    """All that is to be graded, each once, jobs of one episode together.

    Args:
        args: of the command.
        problems: where given, rollouts that cannot be graded are told here and left out.

    Raises:
        EpisodeError: a rollout cannot be graded. ConfigError: none is named.
    """
    if not args.rollouts:
        raise ConfigError("no rollouts named; give their folder: python -m xew.metrics.evaluate ROLLOUTS --data DATA")
    if args.frame_zero == "predicted" and args.baselines:
        raise ConfigError("frame 0 of the frozen first frame is the truth: with --frame-zero predicted say --no-baselines.")
    chosen = str(settings(args))
    rollouts = _unique(args.rollouts, problems)
    jobs: dict[Cell, Job] = {}
    with ThreadPoolExecutor(_workers(args)) as pool:
        found = pool.map(lambda rollout: _try_jobs(rollout, args, chosen), rollouts)
        for result in tqdm(found, total=len(rollouts), desc="read", unit="video", disable=None, leave=False):
            if isinstance(result, EpisodeError):
                _tell(problems, str(result))
            else:
                jobs |= {job.cell: job for job in result}
    _check_horizons(jobs.values())
    return sorted(jobs.values(), key=lambda job: (job.episode, job.rollout is None, job.cell.key))


def _try_jobs(rollout: Rollout, args: Args, chosen: str) -> list[Job] | EpisodeError:
    try:
        return list(_jobs(rollout, args, chosen))
    except EpisodeError as error:
        return error


def _jobs(rollout: Rollout, args: Args, chosen: str) -> Iterator[Job]:
    """The rollout's own job, then its baselines'."""
    episode = episode_folder(args.data, rollout.task, rollout.seed, rollout.robot)
    record = _find_record(rollout, episode, args.data)
    frames = rollout.frame_count or record.frame_count
    if not 1 < frames <= record.frame_count:
        raise RolloutError(
            f"{rollout.folder}: asks for {frames} frames, its episode has {record.frame_count}; at least 2 are needed and no "
            "more than there are."
        )
    try:
        digest = file_digest(rollout.video)
    except OSError as error:
        raise RolloutError(f"{rollout.folder} cannot be read: {error}.") from error
    rgb, states = (record.hashes.get(name, "") for name in ("rgb", "states"))
    key = (rollout.model, rollout.condition, rollout.task, rollout.seed, rollout.robot)
    cell = Cell(*key, frames, digest, rgb, states, chosen)
    yield Job(cell, rollout, episode, record.frame_rate)
    for name in BASELINES if args.baselines else ():
        yield Job(replace(cell, model=name, condition="", prediction=""), None, episode, record.frame_rate)


def _check_horizons(jobs: Iterable[Job]) -> None:
    """Raise RolloutError where models are graded over different numbers of frames of one episode: they do not compare."""
    first: dict[Path, Job] = {}
    for job in jobs:
        other = first.setdefault(job.episode, job)
        if other.cell.frames != job.cell.frames:
            raise RolloutError(
                f"{job.episode}: {other.cell.model} has {other.cell.frames} frames and {job.cell.model} {job.cell.frames}; "
                "scores over different horizons do not compare, grade them into separate tables (--out)."
            )


def _find_record(rollout: Rollout, folder: Path, data: Path) -> Record:
    if not folder.is_dir():
        raise RolloutError(
            f"{rollout.folder} predicts {rollout.task}, seed {rollout.seed}, {rollout.robot}, which {data} does not hold; name "
            "the data set that the rollout was made from: --data."
        )
    record = read_record(folder)
    if not record.success:
        raise RolloutError(f"{rollout.folder} predicts an episode that was rejected ({record.failure}); delete this rollout.")
    source = rollout.header.get("source_hash")
    if source is not None and source != record.hashes.get("rgb"):
        raise RolloutError(f"{rollout.folder} was made from another video than {folder} now holds; make this rollout again.")
    return record


def _unique(roots: tuple[Path, ...], problems: list[str] | None) -> list[Rollout]:
    """Rollouts of all trees. Raises RolloutError, or tells, when two claim to be the same model's video of one episode."""
    seen: dict[tuple[str, str, str, int, str], Rollout] = {}
    for rollout in (rollout for root in roots for rollout in find_rollouts(root, problems)):
        first = seen.setdefault((rollout.model, rollout.condition, rollout.task, rollout.seed, rollout.robot), rollout)
        if rollout.model in BASELINES:
            _tell(problems, f"{rollout.folder}: the name {rollout.model} is a baseline's; give the model another.")
        elif first is not rollout:
            _tell(
                problems,
                f"{first.folder} and {rollout.folder} are both model {rollout.model!r}, condition {rollout.condition!r}; "
                "give them different names in rollout.json.",
            )
    return [rollout for rollout in seen.values() if rollout.model not in BASELINES]


def _tell(problems: list[str] | None, message: str) -> None:
    """Raise RolloutError, or add to the problems where there is a list of them."""
    if problems is None:
        raise RolloutError(message)
    problems.append(message)


class Bench(threading.local):
    """What each worker thread has for itself: a device, and estimators that keep notes of the episode at hand."""

    def __init__(self, masker: Callable[[], Masker], tracker: Callable[[], Tracker], devices: Iterator[jax.Device]) -> None:
        self.masker, self.tracker, self.device = masker(), tracker(), next(devices)


def open_bench(args: Args, metrics: Sequence[str]) -> Bench:
    """A bench with the chosen estimators, as far as these metrics need them. Raises ConfigError if weights are missing."""
    kinds = {compared(name) for name in metrics}
    masker, tracker = _not_needed, _not_needed
    if "mask" in kinds:
        masker = _per_thread(args.masks, MASKERS, open_masker, args.masks_checkpoint)
    if kinds & {"keypoints", "objects", "contact"}:
        tracker = _per_thread(args.tracks, TRACKERS, open_tracker, args.tracks_checkpoint)
    return Bench(masker, tracker, itertools.cycle(jax.local_devices()))


def _not_needed() -> Any:
    """In place of an estimator that no metric asks."""


E = TypeVar("E", bound=Callable[..., np.ndarray])


def _per_thread(name: str, registry: Any, open_: Callable[[str, Path | None], E], checkpoint: Path | None) -> Callable[[], E]:
    """How a thread comes by an estimator: its own, or, of one with weights, the only one, which they use in turn."""
    if pick(registry, name, "estimator").needs is None:
        return lambda: open_(name, checkpoint)
    opened, turn = open_(name, checkpoint), threading.Lock()

    def in_turn(*arrays: np.ndarray) -> np.ndarray:
        with turn:
            return opened(*arrays)

    return lambda: in_turn  # type: ignore[return-value]


def grade_all(jobs: list[Job], metrics: tuple[str, ...], args: Args, store: CellStore) -> list[str]:
    """Grade what is not in the store yet, and return what went wrong.

    Episodes are read and graded by worker threads, a few ahead of each other, so that memory does not grow with their number.

    Raises:
        RolloutError: a video cannot be graded, unless args.keep_going; what was graded before stays in the store.
    """
    wanted = [(job, metrics if args.overwrite else store.missing(job.cell, metrics)) for job in jobs]
    todo = [(job, names) for job, names in wanted if names]
    if len(todo) < len(jobs):
        print(f"{len(jobs) - len(todo)} of {len(jobs)} are graded already in {store.folder}")
    bench = open_bench(args, metrics)
    groups = [list(group) for _, group in itertools.groupby(todo, key=lambda pair: (pair[0].episode, pair[0].cell.frames))]
    errors: list[str] = []
    with tqdm(total=len(jobs), initial=len(jobs) - len(todo), desc="evaluate", unit="video", disable=None) as bar:
        results = in_order(lambda group: _grade_group(group, args, bench, store), groups, _workers(args))
        for group, problems in zip(groups, results, strict=True):
            errors += problems
            bar.update(len(group))
    return errors


def _grade_group(group: list[tuple[Job, tuple[str, ...]]], args: Args, bench: Bench, store: CellStore) -> list[str]:
    """Grade jobs of one episode, which is read once; return what went wrong, or raise it as `grade_all` does."""
    errors: list[str] = []
    truth: Truth | None = None
    for job, metrics in group:
        try:
            needed = {compared(name) for _, names in group for name in names}
            truth = truth or read_truth(job.episode, job.cell.frames, needed)
            store.write(job.cell, _grade_job(job, truth, metrics, args, bench))
        except (EpisodeError, ValueError) as error:
            message = str(error) if str(job.place) in str(error) else f"{job.place}: {error}"
            if not args.keep_going:
                raise RolloutError(message) from error
            errors.append(message)
    return errors


def _grade_job(job: Job, truth: Truth, metrics: tuple[str, ...], args: Args, bench: Bench) -> Grades:
    prediction = read_prediction(job, truth, args) if job.rollout else BASELINES[job.cell.model](truth)
    first = 0 if args.frame_zero == "predicted" else 1
    with jax.default_device(bench.device):
        return grade(Comparison(prediction, truth, bench.masker, bench.tracker, first), metrics)


def read_prediction(job: Job, truth: Truth, args: Args) -> np.ndarray:
    """A rollout's frames, of the truth's shape. Raises RolloutError where they are not, and not allowed to be."""
    assert job.rollout is not None
    video = read_rollout_video(job.rollout, None if "rate" in args.allow else job.frame_rate)
    if "resize" in args.allow:
        video = _resized(video, truth.rgb.shape[1:3])
    if args.frame_zero == "absent" and video.shape[1:] == truth.rgb.shape[1:]:
        video = np.concatenate([truth.rgb[:1], video])
    if "trim" in args.allow:
        video = video[: len(truth.rgb)]
    if video.shape != truth.rgb.shape:
        raise RolloutError(
            f"{job.rollout.video[0]} is {_size(video)}, expected {_size(truth.rgb)} as in the episode; say in rollout.json how "
            'many frames were asked for ({"frame_count": n}), or allow what may be changed: --allow resize trim; a video '
            "without the given frame: --frame-zero absent."
        )
    return video


def _resized(video: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Frames of another height and width, by areas where that is smaller."""
    if video.shape[1:3] == size:
        return video
    method = cv2.INTER_AREA if video.shape[1] > size[0] else cv2.INTER_CUBIC
    return np.stack([cv2.resize(frame, size[::-1], interpolation=method) for frame in video])


def _size(video: np.ndarray) -> str:
    return f"{len(video)} frames of {video.shape[2]}x{video.shape[1]}"


def check(args: Args, path: Path) -> None:
    """Check a bundle against itself, against rollouts and data where they are named, and against scores graded anew.

    Raises:
        ConfigError: something does not hold; the message says what.
    """
    bundle = read_bundle(path)
    print(f"{path}: {len(bundle['samples'])} videos, whole, and its means are those of its values")
    if not args.rollouts:
        return
    jobs = plan(args)
    demand_none(path, differences(bundle, settings(args), [job.cell for job in jobs]))
    print("made from these rollouts and this data, by their digests")
    picked = [jobs[i] for i in np.unique(np.linspace(0, len(jobs) - 1, args.regrade).astype(int))]
    metrics = tuple(name for name in bundle["metrics"] if name in METRICS)
    bench, found = open_bench(args, metrics), list[str]()
    for job in tqdm(picked, desc="grade anew", unit="video", disable=None):
        verify_episode(job.episode)
        truth = read_truth(job.episode, job.cell.frames, {compared(name) for name in metrics})
        found += disagreements(bundle, job.cell.key, _grade_job(job, truth, metrics, args, bench).values)
    demand_none(path, found)
    if picked:
        print(f"{len(picked)} videos graded anew: the same scores")


def _workers(args: Args) -> int:
    if args.workers < 0:
        raise ConfigError(f"--workers is {args.workers}, expected a positive number, or 0 for one for each core.")
    return args.workers or max(len(jax.local_devices()), min(os.cpu_count() or 1, MOST_WORKERS))


Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(function: Callable[[Item], Result], items: Iterable[Item], workers: int) -> Iterator[Result]:
    """Results of a function over items, in their order, computed by threads that are at most a few items ahead.

    Where one raises, or whoever takes the results stops, nothing more is begun.
    """
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Result]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > 2 * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def compile_cache() -> None:
    """Keep compiled programs between runs in the user's cache folder, unless JAX was told otherwise."""
    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "xew" / "jax"
        jax.config.update("jax_compilation_cache_dir", str(cache))


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m xew.metrics.evaluate"))

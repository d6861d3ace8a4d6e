"""Second step of `evaluate`: open graders, in threads of this process or in several processes.

Threads share compiled programs, and decoding, OpenCV and XLA release Python's lock: one process keeps about six cores busy.
With more cores, or a GPU, several processes grade with one thread each.
"""

import functools
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing.queues import SimpleQueue
from typing import Any, TypeVar

import cv2
import jax
import numpy as np
from tqdm import tqdm

from xew.compilation import keep_compiled_programs, take_memory_as_needed
from xew.concurrency import (
    free_gpu_memory,
    map_in_order,
    map_in_processes,
    prepare_processes,
    queue_to,
    usable_cores,
    visible_gpus,
)
from xew.config import admit, pick
from xew.metrics.backends import MASKERS, TRACKERS, Masker, Tracker, open_masker, open_tracker
from xew.metrics.grade import JUDGED, input_kind
from xew.metrics.grading.codecs import ModelCodec, open_codecs
from xew.metrics.grading.grade_episodes import Grader, Group, GroupResult, ThreadResources, split_groups
from xew.metrics.grading.list_jobs import Job
from xew.metrics.grading.settings import GradingSettings
from xew.metrics.grading.warm_up import Part, missing_parts, note_compiled

PROCESSES = "XEW_EVALUATE_PROCESSES"
"""Environment variable by which tests set the number of processes."""
IMPORTED = ("xew.metrics.grading.open_graders", "xew.sim_warp.production.surfaces")
"""Modules that processes that grade need; the second is imported for points on surfaces, and takes as long as the first."""
MOST_PROCESSES = {"cpu": 32, "gpu": 12}
"""Largest number of processes of a machine without a GPU, and of each GPU."""
GPU_MEMORY_OF_PROCESS = 9.0
"""Memory of a GPU that a process may come to hold [GB]: with 8 for each of ten processes a card ran out of it
(docs/performance.md)."""
MEMORY_OF_PROCESS = 2.0
"""Memory that a process on a CPU may come to hold [GB]: an episode, a prediction, their optical flow, and features."""
MOST_THREADS = 6
"""Number of cores that the threads of one process keep busy, which wait for Python's lock a fifth of their time."""
FEWEST_VIDEOS = 48
"""Number of videos from which on processes pay on a CPU, each of which takes some ten seconds to start."""
POINT_KINDS = {"keypoints", "objects", "robot_points", "object_points", *JUDGED}
"""Kinds of a metric's input that a tracker finds."""


def prepare_process(trust: Sequence[str]) -> None:
    """Make a process ready to grade; `trust` names modules of your own that data may name."""
    admit(trust)
    take_memory_as_needed()
    keep_compiled_programs()
    cv2.setNumThreads(1)  # episodes are shared out; OpenCV's own threads would only get in the way


def prepare_graders() -> None:
    """Start importing what processes that grade need, while jobs are listed, on machines that grade in processes."""
    if visible_gpus() or usable_cores() > MOST_THREADS:
        _start_imports()


def _start_imports() -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read at the import of NumPy; processes share the cores
    prepare_processes(IMPORTED)


def grade_groups(
    settings: GradingSettings,
    codecs: Mapping[str, ModelCodec],
    groups: Sequence[Group],
    done: Callable[[], object] = lambda: None,
) -> Iterator[GroupResult]:
    """Results of all groups in their order, or of their parts, from as many processes or threads as suit the machine.

    `done` is called after each video.
    """
    processes, gpus = choose_processes(len(groups), sum(map(len, groups))), visible_gpus()
    if gpus and groups:
        warm_up(settings, [job for group in groups for job, _ in group], gpus)
    if processes > 1:
        _start_imports()
        with queue_to(lambda _: done()) as queue:
            opener = functools.partial(_open_in_process, settings, queue)
            yield from map_in_processes(opener, split_groups(groups, processes), processes, IMPORTED, gpus)
        return
    threads = 1 if jax.default_backend() != "cpu" or gpus else min(usable_cores(), MOST_THREADS)
    stop = threading.Event()
    yield from map_in_order(open_grader(settings, codecs, stop, done), groups, threads, stop)


def warm_up(settings: GradingSettings, jobs: Sequence[Job], gpus: Sequence[str]) -> None:
    """Compile what the machine's caches lack to grade these jobs, before any process grades."""
    parts = missing_parts(settings, jobs)
    if not parts:
        return
    print(f"kernels and programs for the GPU are compiled once on this machine, in {len(parts)} parts", flush=True)
    opener = functools.partial(_open_compiler, settings.args.trust)
    compiled = map_in_processes(opener, parts, min(len(parts), usable_cores()), IMPORTED, gpus)
    for _ in tqdm(compiled, desc="compile", unit="part", total=len(parts), disable=None, leave=False):
        pass
    note_compiled(settings, jobs)


def _open_compiler(trust: Sequence[str]) -> Callable[[Part], None]:
    prepare_process(trust)
    return lambda part: part.compile()


def choose_processes(episodes: int, videos: int) -> int:
    """Number of processes for these episodes and videos, by cores and memory; 1 if threads suffice."""
    if asked := os.environ.get(PROCESSES):
        return min(int(asked), episodes)
    cores, gpus = usable_cores(), visible_gpus()
    if gpus:
        free = min(free_gpu_memory(gpus), default=0.0)
        of_each = min(MOST_PROCESSES["gpu"], max(1, int(free / GPU_MEMORY_OF_PROCESS)))
        return min(max(1, cores - 1), len(gpus) * of_each, episodes)
    if cores <= MOST_THREADS or videos < FEWEST_VIDEOS:
        return 1
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return min(cores, MOST_PROCESSES["cpu"], max(1, int(memory / MEMORY_OF_PROCESS)), episodes)


def _open_in_process(settings: GradingSettings, queue: "SimpleQueue[bool]") -> Grader:
    prepare_process(settings.args.trust)
    return open_grader(settings, open_codecs(settings.args.codec), threading.Event(), lambda: queue.put(True))


def open_grader(
    settings: GradingSettings,
    codecs: Mapping[str, ModelCodec],
    stop: threading.Event,
    done: Callable[[], object] = lambda: None,
) -> Grader:
    """Open the estimators that the metrics need. Raises ConfigError.

    Args:
        stop: set when no further video is to start.
        done: called after each video.
    """
    args, kinds = settings.args, {input_kind(name) for name in settings.metrics}
    masker: Callable[[], Masker] = _open_nothing
    tracker: Callable[[], Tracker] = _open_nothing
    if "mask" in kinds:
        masker = _make_opener(MASKERS, args.masks, functools.partial(open_masker, args.masks, args.masks_checkpoint))
    if kinds & POINT_KINDS:
        tracker = _make_opener(TRACKERS, args.tracks, functools.partial(open_tracker, args.tracks, args.tracks_checkpoint))
    return Grader(settings, ThreadResources(masker, tracker), {codec.key: codec for codec in codecs.values()}, stop, done)


def _open_nothing() -> Any:

    def refuse(*arrays: np.ndarray) -> np.ndarray:
        raise AssertionError("no metric needs this estimator, so none was opened")

    return refuse


E = TypeVar("E", bound=Callable[..., np.ndarray])


def _make_opener(registry: Any, name: str, open_: Callable[[], E]) -> Callable[[], E]:
    """Function that opens an estimator for a thread: a new one, or one shared in turn if it has weights."""
    if pick(registry, name, "estimator").needs is None:
        return open_
    estimator = take_turns(open_())
    return lambda: estimator


def take_turns(estimator: E) -> E:
    """The same estimator, for one thread at a time."""
    turn = threading.Lock()

    def call(*arrays: np.ndarray) -> np.ndarray:
        with turn:
            return estimator(*arrays)

    return call  # type: ignore[return-value]

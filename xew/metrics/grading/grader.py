"""Grading the videos of one episode after another: what a process opens for it, and what it does with each.

Everything that opens a grader can be sent to another process, and so can videos to grade and what came of them.
"""

import itertools
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import jax

from xew.compilation import keep_compiled_programs, take_memory_as_needed
from xew.config import admit
from xew.episode import EpisodeError
from xew.metrics.backends import MASKERS, TRACKERS, Masker, Tracker, open_masker, open_tracker
from xew.metrics.grade import Comparison, Grades, grade, input_kind
from xew.metrics.grading.codecs import ModelCodec, open_codecs
from xew.metrics.grading.jobs import Job, estimator_view, read_prediction
from xew.metrics.grading.scores import CellStore
from xew.metrics.grading.workers import Bench, make_opener, open_nothing
from xew.metrics.truth import Truth, read_truth
from xew.rollout import RolloutError

Group = list[tuple[Job, tuple[str, ...]]]
"""Jobs of one episode, each with the names of the metrics that are still to be graded."""
POINT_KINDS = {"keypoints", "objects", "robot_points", "object_points", "contact"}
"""Kinds of a metric's input that a tracker finds."""


@dataclass(frozen=True)
class Graded:
    """What came of grading a group, beside the scores in the store."""

    errors: Sequence[str]
    """Messages about videos that could not be graded."""
    has_shapes: bool
    """Whether the shapes of the episode's bodies were known where they were needed."""


@dataclass(frozen=True)
class GraderOpener:
    """What opens a grader, in this process or another."""

    metrics: tuple[str, ...]
    """Names of the metrics and diagnostics that are graded."""
    masks: tuple[str, Path | None]
    tracks: tuple[str, Path | None]
    """Names of the estimators, and their weights where they have some."""
    codecs: tuple[Path, ...]
    """Runs whose codecs the truth goes through."""
    codec_opener: str
    """Function that opens them, as module:NAME."""
    models: frozenset[str] | None
    """Names of all models that are graded; None where codecs may be of others, too."""
    surfaces: Path
    """Folder that points on surfaces are kept in."""
    store: CellStore
    allow: tuple[str, ...] = ()
    frame_zero: str = "given"
    keep_going: bool = False
    trust: tuple[str, ...] = ()
    """Options of `xew.metrics.evaluate`."""

    def open(self, stop: threading.Event, codecs: Mapping[str, ModelCodec] | None = None) -> "Grader":
        """Open estimators, and codecs where they are not given, by model.

        Raises ConfigError if weights are missing or a codec cannot be opened.
        """
        if codecs is None:
            codecs = open_codecs(self.codecs, self.codec_opener, self.models) if self.codecs else {}
        return Grader(self, self._open_bench(), {codec.key: codec for codec in codecs.values()}, stop)

    def open_in_process(self) -> "Grader":
        """Open a grader in a process of its own."""
        prepare_process(self.trust)
        return self.open(threading.Event())

    def _open_bench(self) -> Bench:
        """A bench with the estimators, as far as the metrics need them."""
        kinds = {input_kind(name) for name in self.metrics}
        masker: Callable[[jax.Device], Masker] = open_nothing
        tracker: Callable[[jax.Device], Tracker] = open_nothing
        if "mask" in kinds:
            masker = make_opener(self.masks[0], MASKERS, open_masker, self.masks[1])
        if kinds & POINT_KINDS:
            tracker = make_opener(self.tracks[0], TRACKERS, open_tracker, self.tracks[1])
        return Bench(masker, tracker, itertools.cycle(jax.local_devices()))


@dataclass(frozen=True)
class Grader:
    """What the threads of a process grade videos with."""

    settings: GraderOpener
    bench: Bench
    codecs: Mapping[str, ModelCodec]
    """Codecs that the truth goes through, by key."""
    stop: threading.Event
    """Signal that no further video is to be begun."""

    def __call__(self, group: Group) -> Graded:
        """Grade jobs of one episode, which is read once, and enter the scores.

        Raises:
            RolloutError: a video cannot be graded, unless the settings say to keep going.
        """
        errors: list[str] = []
        truth: Truth | None = None
        needed = {input_kind(name) for _, names in group for name in names}
        for job, metrics in group:
            if self.stop.is_set():
                break
            try:
                truth = truth or read_truth(job.episode, job.cell.frames, needed, self.settings.surfaces)
                self.settings.store.write(job.cell, self.grade(job, truth, metrics))
            except (EpisodeError, ValueError) as error:
                message = str(error) if str(job.place) in str(error) else f"{job.place}: {error}"
                if not self.settings.keep_going:
                    raise RolloutError(message) from error
                errors.append(message)
        return Graded(errors, has_shapes=truth is None or truth.surfaces is None or truth.surfaces.known)

    def grade(self, job: Job, truth: Truth, metrics: Sequence[str]) -> Grades:
        """Scores of one video. Raises RolloutError, EpisodeError or ValueError where it cannot be graded."""
        prediction = read_prediction(job, truth, self.codecs, self.settings.allow, self.settings.frame_zero)
        first = 0 if self.settings.frame_zero == "predicted" else 1
        seen = estimator_view(job, truth)
        with jax.default_device(self.bench.device):
            return grade(Comparison(prediction, truth, self.bench.masker, self.bench.tracker, first, seen), metrics)


def prepare_process(trust: Sequence[str]) -> None:
    """Make a process ready to grade; `trust` names modules of one's own that data may name."""
    admit(trust)
    take_memory_as_needed()
    keep_compiled_programs()
    cv2.setNumThreads(1)  # episodes are shared out; OpenCV's own threads would only get in the way

"""The options of `evaluate`, and what they are resolved to before anything is read."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from xew.config import ConfigError, pick, suggestion
from xew.dataset import holds_faults, view_folder
from xew.metrics import METRICS, perceptual
from xew.metrics.backends import MASKERS, TRACKERS, identity
from xew.metrics.grading.scores import CellStore, baselines_folder, path_beside, surfaces_folder
from xew.metrics.metric import SUITES
from xew.metrics.networks import alexnet
from xew.protocol import GRADING_PROTOCOL, HEAD, OUTCOME

WITHOUT_OUTCOME = tuple(name for name, metric in METRICS.items() if metric.dimension != OUTCOME)
"""Metrics of data sets in which every episode is a success, so a video that always shows success is right."""


@dataclass(frozen=True)
class Args:
    """Grade rollouts against the episodes they predict. Done videos are kept: run it again to go on where it stopped."""

    rollouts: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Rollout trees; several are graded into one table."""
    data: Path = Path("data")
    """The data set that holds the true episodes."""
    out: Path = Path("scores.parquet")
    """Score table; all other files lie next to it."""
    metrics: tuple[str, ...] = tuple(METRICS)
    """Names of xew.metrics.METRICS. Left out: all; those of outcomes only if the data set holds faulty episodes."""
    suite: tuple[str, ...] = tuple(SUITES)
    """Suites whose metrics are graded: paper, strict, or both."""
    masks: str = "default"
    """Estimator of robot masks in a prediction: a name of xew.metrics.backends.MASKERS, or module:NAME."""
    masks_checkpoint: Path | None = None
    """Checkpoint of this estimator, if it needs one."""
    tracks: str = "default"
    """Estimator of keypoints and objects in a prediction: a name of xew.metrics.backends.TRACKERS, or module:NAME."""
    tracks_checkpoint: Path | None = None
    """Checkpoint of this estimator, if it needs one."""
    frame_zero: Literal["given", "absent", "predicted"] = "given"
    """given: frame 0 of a video is the frame that the model was given, and is in no score. absent: videos begin with frame 1.
    predicted: frame 0 is scored like the others."""
    allow: tuple[Literal["resize", "stretch", "trim", "rate"], ...] = ()
    """Changes to videos that are errors without it. resize: bring videos of another size and the same aspect ratio to the
    episode's. stretch: bring videos of any aspect ratio to it. trim: cut longer videos. rate: take any frame rate of a
    container, its frames being the episode's one by one."""
    baselines: bool = True
    """Also grade, as separate models, the frozen first frame, the robot's render pasted into it, another robot's episode,
    and the true video itself: the noise floor of the scores."""
    baselines_of: Literal["train", "validation", "test", "final"] | None = None
    """Grade the baselines on all episodes of these seeds, without rollouts."""
    max_frames: int = 0
    """With --baselines-of: grade this number of frames; 0 for whole episodes."""
    codec: tuple[Path, ...] = ()
    """Runs of `xew.model.train` that made some of the rollouts: the truth is graded through each of their codecs, and is the
    noise floor of all models with that codec. Other models have the floor of the true video. With --baselines-of a config of
    `xew.model.train` may be named instead of a run."""
    resample: Literal["scene", "task"] = "scene"
    """Unit that the summary's intervals resample: scenes within tasks, or whole tasks."""
    keep_going: bool = False
    """Continue when a rollout cannot be graded; the exit status is still an error."""
    overwrite: bool = False
    """Grade everything again."""
    check: Path | None = None
    """Grade nothing; check that a bundle is consistent and, if rollouts are named, that it is made from them."""
    regrade: int = 0
    """With --check: grade this number of its videos again and compare."""
    trust: tuple[str, ...] = ()
    """Modules with custom tasks and robots, such as my_lab.tasks, that the data may name."""
    view: str = HEAD
    """View of the data set that the rollouts predict, such as wrist_left."""


@dataclass(frozen=True)
class GradingSettings:
    """The options of one grading, checked, and what follows from them. It can be sent to another process."""

    args: Args
    metrics: tuple[str, ...]
    choices: dict[str, Any]
    """All choices that change a score, as they stand in a table's attributes and in the digest of each cell: protocol,
    estimators, frame_zero, allowed."""

    @property
    def first_frame(self) -> int:
        """The first graded frame."""
        return 0 if self.args.frame_zero == "predicted" else 1

    @cached_property
    def store(self) -> CellStore:
        """Where graded videos are kept."""
        return CellStore(path_beside(self.args.out, "cells"), baselines_folder(self.args.data, self.args.out))

    @property
    def surfaces(self) -> Path:
        """Folder of points on surfaces, which are rendered once a data set."""
        return surfaces_folder(self.args.data, self.args.out)


def resolve(args: Args) -> GradingSettings:
    """The settings that options ask for.

    Raises:
        ConfigError: a name is unknown, a checkpoint does not exist, no metric is left, or a metric lacks its weights.
        EpisodeError: the data set does not have the view.
    """
    args = replace(args, data=view_folder(args.data, args.view), view=HEAD)
    names = args.metrics if args.metrics != tuple(METRICS) or holds_faults(args.data) else WITHOUT_OUTCOME
    metrics = choose_metrics(names, args.suite)
    check_weights(metrics)
    estimators = {
        "masks": _identify(MASKERS, "masker", args.masks, args.masks_checkpoint),
        "tracks": _identify(TRACKERS, "tracker", args.tracks, args.tracks_checkpoint),
    }
    choices = {
        "protocol": GRADING_PROTOCOL,
        "estimators": estimators,
        "frame_zero": args.frame_zero,
        "allowed": sorted(set(args.allow)),
    }
    return GradingSettings(args, metrics, choices)


def choose_metrics(names: Sequence[str], suites: Sequence[str]) -> tuple[str, ...]:
    """Metrics of these names and suites, in the registry's order. Raises ConfigError for an unknown name or if none is left."""
    for kind, given, known in (("metric", names, tuple(METRICS)), ("suite", suites, tuple(SUITES))):
        for name in given:
            if name not in known:
                raise ConfigError(f"unknown {kind} {name!r};{suggestion(name, known)} known: {', '.join(known)}.")
    chosen = tuple(name for name, metric in METRICS.items() if name in names and set(metric.suites) & set(suites))
    if not chosen:
        raise ConfigError(f"no metric of {', '.join(names)} is of the suites {', '.join(suites)}.")
    return chosen


def _identify(registry: Any, kind: str, name: str, checkpoint: Path | None) -> str:
    pick(registry, name, kind)
    if checkpoint is not None and not checkpoint.exists():
        raise ConfigError(f"the checkpoint of the {kind} is {checkpoint}, which does not exist; name another, or leave it out.")
    return identity(name, checkpoint)


def check_weights(metrics: Iterable[str] = tuple(METRICS)) -> None:
    """Raise ConfigError unless what these metrics (keys of METRICS) need is installed; the message says what would bring it."""
    if any(METRICS[name].function.__module__ == perceptual.__name__ for name in metrics):
        try:
            alexnet.read_alexnet()
        except FileNotFoundError as error:
            raise ConfigError(str(error)) from error

"""Registries of estimators, which find the robot, its points and its motion in a predicted video.

Reads  local checkpoints; nothing is ever downloaded
To add one: its file, and one line in MASKERS, TRACKERS or FLOWS; from outside the repo, `module:NAME` of a `Backend`.

    masker = open_masker("sam2", Path("weights/sam2.1_hiera_large.pt"))
    masks = masker(prediction, target, target_mask)
"""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from xew.concurrency import PARSING
from xew.config import ConfigError, pick
from xew.files import digest_tree
from xew.metrics.estimators.cotracker import open_cotracker
from xew.metrics.estimators.flow import dis_flow, open_raft
from xew.metrics.estimators.masks import Episode, estimate_masks
from xew.metrics.estimators.sam2 import open_sam2
from xew.metrics.estimators.tapir import open_tapir
from xew.metrics.estimators.tracks import ReferenceTracker

T_co = TypeVar("T_co", covariant=True)


@runtime_checkable
class Masker(Protocol):
    """Robot masks in a predicted video.

    The attribute `compares_colors = True` says that the masker compares the two videos: it then gets them in the same exposure
    and colors (`appearance.TrueAppearance`). Others get the prediction as it is.
    """

    def __call__(self, prediction: np.ndarray, target: np.ndarray, target_mask: np.ndarray) -> np.ndarray:
        """Masks bool [t h w] of a prediction [t h w 3] uint8, from the true video [t h w 3] uint8 and masks [t h w] bool."""


@runtime_checkable
class Tracker(Protocol):
    """Positions of the true video's points in a predicted video.

    The attribute `pointwise = True` says that each point is found without regard to the others: points of all kinds then come
    in one call. `compares_colors = True` is as in `Masker`. An optional method `confirm` replaces `presence.confirm_tracks`,
    with the same arguments.
    """

    def __call__(self, prediction: np.ndarray, target: np.ndarray, points: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Pixels float32 [t k 2] in the prediction, NaN where a point is lost.

        Args:
            prediction, target: [t h w 3] uint8, predicted and true video.
            points: [t k 2] float32, true projections [pixels, x right, y down, center of the first pixel at 0].
            visible: [t k] bool, where a true point is seen.
        """


Flow = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of two [n h w 3] uint8 to the motion of each pixel of the first: float32 [n h w 2] pixels (x right, y down)."""


@dataclass(frozen=True)
class Backend(Generic[T_co]):
    """One entry of a registry: an estimator that is opened once and then called for many videos."""

    open: Callable[..., T_co]
    """Called with its checkpoint, or with nothing where it needs none. Raises ConfigError where something is missing."""
    needs: str | None
    """Checkpoint to get, from whom, under which license; None where the estimator needs none."""
    summary: str


def open_masker(name: str, checkpoint: Path | None = None, option: str = "--masks-checkpoint") -> Masker:
    """The masker of a name in MASKERS (or `module:NAME`). Raises ConfigError if it or its checkpoint is missing."""
    return _open(pick(MASKERS, name, "masker"), name, checkpoint, option)


def open_tracker(name: str, checkpoint: Path | None = None, option: str = "--tracks-checkpoint") -> Tracker:
    """The tracker of a name in TRACKERS (or `module:NAME`). Raises ConfigError if it or its checkpoint is missing."""
    return _open(pick(TRACKERS, name, "tracker"), name, checkpoint, option)


def open_flow(name: str, checkpoint: Path | None = None, option: str = "the argument checkpoint") -> Flow:
    """The optical flow of a name in FLOWS (or `module:NAME`). Raises ConfigError if it or its checkpoint is missing."""
    return _open(pick(FLOWS, name, "optical flow"), name, checkpoint, option)


def identity(name: str, checkpoint: Path | None = None) -> str:
    """An estimator's entry in score tables: its name, and file name and digest of its checkpoint, wherever it lies."""
    return name if checkpoint is None else f"{name} {checkpoint.name} sha256:{digest_tree(checkpoint)[:16]}"


T = TypeVar("T")


def _open(backend: Backend[T], name: str, checkpoint: Path | None, option: str) -> T:
    if backend.needs is None:
        if checkpoint is not None:
            raise ConfigError(f"{name} has no checkpoint, {option} names {checkpoint}; leave it out, or choose another.")
        return backend.open()
    if checkpoint is None:
        raise ConfigError(f"{name} needs a checkpoint: {backend.needs}. Name its path with {option}.")
    if not checkpoint.exists():
        raise ConfigError(
            f"there is no {checkpoint}; {name} needs a checkpoint: {backend.needs}. Put it there, or name one with {option}."
        )
    return backend.open(checkpoint)


class ReferenceMasker:
    """`estimate_masks`, which keeps an episode while predictions of the same episode follow each other."""

    compares_colors = True

    def __init__(self) -> None:
        self._episode: Episode | None = None

    def __call__(self, prediction: np.ndarray, target: np.ndarray, target_mask: np.ndarray) -> np.ndarray:
        """Masks bool [t h w] of a prediction [t h w 3] uint8, from the true video [t h w 3] uint8 and masks [t h w] bool."""
        if self._episode is None or not self._episode.is_of(target, target_mask):
            self._episode = Episode(target, target_mask)
        return estimate_masks(prediction, target, target_mask, self._episode)


def _open_default(on_gpu: str, on_cpu: Callable[[], T]) -> T:
    """The class `module:NAME` in xew.metrics.estimators.batched if there is a GPU, else the reference."""
    # Only here: the metrics load without Warp, whose kernels are parsed as they are imported.
    with PARSING:
        from xew.metrics.estimators.batched.devices import find_gpu

        if gpu := find_gpu():
            module, _, name = on_gpu.partition(":")
            opened: T = getattr(importlib.import_module(f"xew.metrics.estimators.batched.{module}"), name)(gpu)
            return opened
    return on_cpu()


MASKERS: Mapping[str, Backend[Masker]] = {
    "default": Backend(
        lambda: _open_default("masks:BatchedMasker", ReferenceMasker),
        None,
        "color, background and gated flow against the true video (xew.metrics.estimators.masks); in Warp kernels "
        "where there is a GPU, else opencv",
    ),
    "opencv": Backend(ReferenceMasker, None, "the default masker frame by frame, on the CPU"),
    "sam2": Backend(
        open_sam2,
        "sam2.1_hiera_{tiny,small,base_plus,large}.pt of github.com/facebookresearch/sam2, or a folder of Hugging Face's "
        "facebook/sam2.1-hiera-{tiny,small,base-plus,large} (config.json, model.safetensors); Apache-2.0",
        "SAM 2, prompted with the true mask of the frame where it is largest, propagated both ways",
    ),
}
TRACKERS: Mapping[str, Backend[Tracker]] = {
    "default": Backend(
        lambda: _open_default("tracks:BatchedTracker", ReferenceTracker),
        None,
        "template search against the true video (xew.metrics.estimators.tracks); in Warp kernels where there is a GPU, "
        "else opencv",
    ),
    "opencv": Backend(ReferenceTracker, None, "the default tracker frame by frame, on the CPU"),
    "cotracker3": Backend(
        open_cotracker,
        "scaled_offline.pth of Hugging Face's facebook/cotracker3; CC-BY-NC 4.0: not for commercial use",
        "CoTracker3 offline, queried at the frame with most visible points, both ways",
    ),
    "tapir": Backend(
        open_tapir,
        "tapir_checkpoint_panning.npy or bootstapir_checkpoint_v2.npy of github.com/google-deepmind/tapnet; Apache-2.0",
        "TAPIR, queried at the frame with most visible points",
    ),
}
FLOWS: Mapping[str, Backend[Flow]] = {
    "dis": Backend(lambda: dis_flow, None, "dense inverse search, medium preset, of OpenCV"),
    "raft": Backend(
        open_raft,
        "raft_large_C_T_SKHT_V2-ff5fadd5.pth or raft_small_C_T_V2-01064c6d.pth of torchvision; BSD-3-Clause",
        "RAFT of torchvision, 12 updates",
    ),
}

"""Shared parts of the adapters of other projects' networks: packages, checkpoints and queries.

PyTorch is imported on first use. Nothing is downloaded, and no file is unpickled freely.
"""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from xew.config import ConfigError
from xew.metrics.networks.pickles import first_line, read_torch_file


def import_package(module: str, user: str, install: str) -> ModuleType:
    """A package that only one adapter needs. Raises ConfigError that says who needs it and how it is installed."""
    try:
        return importlib.import_module(module)
    except (ImportError, RuntimeError) as error:  # torchvision beside a PyTorch of another build raises RuntimeError
        raise ConfigError(f"{user} needs the package {module.partition('.')[0]} ({first_line(error)}); {install}.") from error


def import_torch(user: str) -> ModuleType:
    """PyTorch. Raises ConfigError where it is not installed."""
    return import_package("torch", user, "pip install torch (pytorch.org says which build fits the machine)")


def read_state_dict(path: Path, user: str) -> Mapping[str, Any]:
    """The tensors of a .pt or .pth by key, on the CPU; what wraps them (`model`, `state_dict`) is taken off.

    Raises:
        ConfigError: PyTorch is absent, or the file is damaged or holds anything but tensors.
    """
    torch = import_torch(user)
    content = read_torch_file(path, user)
    for wrapper in ("model", "state_dict"):
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    if not isinstance(content, Mapping) or not all(isinstance(value, torch.Tensor) for value in content.values()):
        raise ConfigError(f"{path} holds a {type(content).__name__}, expected the tensors of {user} by name.")
    return content


def load_state_dict(network: Any, state: Mapping[str, Any], path: Path, user: str) -> None:
    """Fill a PyTorch network. Raises ConfigError where tensors are missing, left over or misshapen."""
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        faults = [line.strip() for line in str(error).splitlines()[1:3]]
        raise ConfigError(f"{path} is no checkpoint of {user}: {' '.join(faults)[:300]}") from error


def torch_device() -> str:
    """The first GPU that this process sees; the CPU where there is none."""
    return "cuda" if importlib.import_module("torch").cuda.is_available() else "cpu"


class PointTracker(ABC):
    """What trackers share that are given each point at one frame (`query_frames`) and then follow it in both directions."""

    def __call__(self, prediction: np.ndarray, target: np.ndarray, points: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Pixels float32 [t k 2] in the prediction, NaN where a point is lost.

        Args:
            prediction: [t h w 3] uint8, the predicted video.
            target: [t h w 3] uint8, the true video; not looked at.
            points: [t k 2] float32, true projections [pixels, x right, y down, center of the first pixel at 0].
            visible: [t k] bool, where a true point is seen; a point that is never seen is lost in all frames.
        """
        check_tracks(prediction, points, visible)
        tracks = np.full((*visible.shape, 2), np.nan, np.float32)
        frames = query_frames(visible)
        asked = np.flatnonzero(frames >= 0)
        if len(asked) == 0:
            return tracks
        followed, holds = self.follow(prediction, frames[asked], points[frames[asked], asked])
        tracks[:, asked] = np.where(holds[..., None], followed, np.nan)
        return tracks

    @abstractmethod
    def follow(self, video: np.ndarray, frames: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find points again in all frames of a video.

        Args:
            video: [t h w 3] uint8.
            frames: [n] int, the frame at which each point is given.
            points: [n 2] float32, where it is there [pixels, x right, y down, center of the first pixel at 0].

        Returns:
            Tracks [t n 2] float32 in the same pixels, and bool [t n] where they hold.
        """


def query_frames(visible: np.ndarray) -> np.ndarray:
    """The frame at which each point is given to a tracker: int [k], -1 for a point that is never visible.

    As in the paper it is the frame with most visible points (of `visible` [t k] bool), among the frames that show the point.
    """
    counts = visible.sum(axis=1)
    frames = np.where(visible, counts[:, None], 0).argmax(axis=0)
    return np.where(visible.any(axis=0), frames, -1)


def check_tracks(prediction: np.ndarray, points: np.ndarray, visible: np.ndarray) -> None:
    """Raise ValueError unless video [t h w 3] uint8, points [t k 2] and visibility [t k] bool go together."""
    if prediction.ndim != 4 or prediction.shape[-1] != 3 or prediction.dtype != np.uint8:
        raise ValueError(f"the video is {prediction.dtype} {prediction.shape}, expected uint8 [t h w 3].")
    if points.shape != (*visible.shape, 2) or visible.dtype != bool or len(points) != len(prediction):
        raise ValueError(
            f"points are {points.shape}, visibility {visible.dtype} {visible.shape}, the video has {len(prediction)} frames; "
            "expected [t k 2] and bool [t k] of its frames."
        )

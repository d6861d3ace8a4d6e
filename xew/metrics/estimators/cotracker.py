"""CoTracker3 as a tracker, as in the paper: the offline network, run forwards and backwards over a predicted video.

Code and weights are CC-BY-NC 4.0, not for commercial use, and are not included: install the package `cotracker` and bring the
checkpoint. The true points start the tracks, so a point is right by definition in its query frame.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from xew.config import ConfigError
from xew.metrics.estimators.adapters import (
    PointTracker,
    import_package,
    import_torch,
    read_state_dict,
    torch_device,
)

LICENSE = "CoTracker3, code and weights, is CC-BY-NC 4.0: scores that use it are not for commercial use"
INSTALL = "install it from the sources of github.com/facebookresearch/co-tracker, January 2025 or later (it is not on PyPI)"
SHORTEST_OFFLINE = 17
"""Frames of time embedding: the online network has 16, the offline one 60."""


def open_cotracker(checkpoint: Path) -> "CoTracker":
    """CoTracker3 offline from a local `scaled_offline.pth`, on a GPU or else the CPU; says its license on stderr.

    Raises:
        ConfigError: PyTorch or the package `cotracker` is absent, or the file is damaged or of another network.
    """
    window = _window(checkpoint)
    package = import_package("cotracker.predictor", "CoTracker3", INSTALL)
    try:
        predictor = package.CoTrackerPredictor(checkpoint=str(checkpoint), offline=True, v2=False, window_len=window)
    except RuntimeError as error:
        raise ConfigError(f"{checkpoint} is no checkpoint of CoTracker3 offline: {str(error)[:300]}") from error
    print(f"note: {LICENSE}", file=sys.stderr)
    return CoTracker(predictor.to(torch_device()))


class CoTracker(PointTracker):
    """The tracker: see `xew.metrics.backends.Tracker`. Lost is where the network's visibility is 0.9 or less."""

    def __init__(self, predictor: Callable[..., Any]) -> None:
        self._predictor = predictor
        self._torch = import_torch("CoTracker3")

    def follow(self, video: np.ndarray, frames: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tracks [t n 2] and where they hold [t n], of points [n 2] given at frames [n] of a video [t h w 3] uint8."""
        queries = np.column_stack([frames, points]).astype(np.float32)
        device = torch_device()
        images = self._torch.from_numpy(np.ascontiguousarray(video.transpose(0, 3, 1, 2))).to(device).float()
        with self._torch.inference_mode():
            tracks, seen = self._predictor(
                images[None], queries=self._torch.from_numpy(queries)[None].to(device), backward_tracking=True
            )
        return tracks[0].cpu().numpy(), seen[0].cpu().numpy()


def _window(checkpoint: Path) -> int:
    """Length of the network's time embedding; raises ConfigError unless the file is of CoTracker3 offline."""
    state = read_state_dict(checkpoint, "CoTracker3")
    embedding = state.get("time_emb")
    if embedding is None or embedding.ndim != 3 or not any(key.startswith("corr_mlp.") for key in state):
        raise ConfigError(f"{checkpoint} is no checkpoint of CoTracker3; expected scaled_offline.pth.")
    if embedding.shape[1] < SHORTEST_OFFLINE:
        raise ConfigError(f"{checkpoint} is CoTracker3 online, which sees no whole video; expected scaled_offline.pth.")
    return int(embedding.shape[1])

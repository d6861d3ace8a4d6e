"""Optical flow for video without exact motion vectors: DIS of OpenCV and RAFT of torchvision (`backends.open_flow`).

Tests validate both against the renderer's exact vectors (`rendering.streams`).
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from xew.config import ConfigError
from xew.metrics.estimators.adapters import import_package, import_torch, load_state_dict, read_state_dict, torch_device

RAFT_UPDATES = 12
"""Number of refinements, as torchvision has it."""
RAFT_BATCH = 8
"""Number of pairs at once: about 2 GB on a GPU at 320x240."""
RAFT_STRIDE, RAFT_SMALLEST = 8, 128
"""Sides [pixels] must be multiples of the one and at least the other; smaller frames are filled up with their rim."""
RAFT_WIDTHS = {64: "raft_large", 32: "raft_small"}
"""Networks of torchvision by the channels of the first layer, which a checkpoint is known by."""


def dis_flow(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Dense inverse search (Kroeger et al. 2016) of OpenCV, medium preset, on gray images.

    Flow [n h w 2] float32 from each pixel of `start` to its place in `end` [pixels, x right, y down]; both are [n h w 3] uint8
    RGB of at least 12 pixels a side.
    """
    _check_pairs(start, end)
    if min(start.shape[1:3]) < 12:
        raise ValueError(f"frames are {start.shape[1:3]}, DIS needs sides of at least 12 pixels.")
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    pairs = zip(start, end, strict=True)
    flow = [dis.calc(cv2.cvtColor(a, cv2.COLOR_RGB2GRAY), cv2.cvtColor(b, cv2.COLOR_RGB2GRAY), None) for a, b in pairs]
    return np.stack(flow) if flow else np.zeros((*start.shape[:3], 2), np.float32)


def open_raft(checkpoint: Path) -> "Raft":
    """RAFT (Teed and Deng 2020) of torchvision, large or small as the checkpoint is.

    Raises:
        ConfigError: torchvision is absent, or the file is no whole checkpoint of RAFT.
    """
    state = read_state_dict(checkpoint, "RAFT")
    models = import_package(
        "torchvision.models.optical_flow", "RAFT", "install the torchvision that belongs to the installed torch"
    )
    first = state.get("feature_encoder.convnormrelu.0.weight")
    if first is None or len(first) not in RAFT_WIDTHS:
        raise ConfigError(f"{checkpoint} is no checkpoint of torchvision's raft_large or raft_small.")
    network = getattr(models, RAFT_WIDTHS[len(first)])(weights=None)
    load_state_dict(network, state, checkpoint, "RAFT")
    return Raft(network.eval().to(torch_device()))


class Raft:
    """RAFT on uint8 images, with the arguments and results of `dis_flow`."""

    def __init__(self, network: Any) -> None:
        self._network = network
        self._torch = import_torch("RAFT")

    def __call__(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Flow [n h w 2] float32 from `start` to `end`, both [n h w 3] uint8 RGB."""
        _check_pairs(start, end)
        blocks = [slice(first, first + RAFT_BATCH) for first in range(0, len(start), RAFT_BATCH)]
        flow = [self._block(start[block], end[block]) for block in blocks]
        return np.concatenate(flow) if flow else np.zeros((*start.shape[:3], 2), np.float32)

    def _block(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        height, width = start.shape[1:3]
        with self._torch.inference_mode():
            flow = self._network(self._images(start), self._images(end), num_flow_updates=RAFT_UPDATES)[-1]
        return flow[:, :, :height, :width].permute(0, 2, 3, 1).float().cpu().numpy()

    def _images(self, frames: np.ndarray) -> Any:
        """Frames as the network reads them: [n 3 h w] in [-1, 1], filled up at the right and the bottom."""
        missing = [max(RAFT_SMALLEST, side + -side % RAFT_STRIDE) - side for side in frames.shape[1:3]]
        frames = np.pad(frames, ((0, 0), (0, missing[0]), (0, missing[1]), (0, 0)), mode="edge")
        device = next(self._network.parameters()).device
        images = self._torch.from_numpy(np.ascontiguousarray(frames.transpose(0, 3, 1, 2)))
        return images.to(device).float() / 127.5 - 1


def _check_pairs(start: np.ndarray, end: np.ndarray) -> None:
    if start.shape != end.shape or start.ndim != 4 or start.shape[-1] != 3 or {start.dtype, end.dtype} != {np.dtype(np.uint8)}:
        raise ValueError(
            f"images are {start.dtype} {start.shape} and {end.dtype} {end.shape}; expected two uint8 [n h w 3] of one shape."
        )

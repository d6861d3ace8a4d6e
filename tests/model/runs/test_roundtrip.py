"""Video through a codec and back, in pieces where the codec allows it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from xew.model.runs.roundtrip import LENGTH_BLOCK, RunRoundtrip


class Copy:
    """A codec that changes nothing but the first frame of what it is given, and notes how long that was."""

    def __init__(self, alone: bool) -> None:
        self.groups_independent = alone
        self.lengths: list[int] = []

    def encode(self, video: np.ndarray) -> np.ndarray:
        self.lengths.append(len(video))
        return np.concatenate([255 - video[:1], video[1:]])

    def decode(self, latents: np.ndarray, given: object = None) -> np.ndarray:
        return latents


def roundtrip(codec: Any) -> RunRoundtrip:
    experiment: Any = SimpleNamespace(clip=SimpleNamespace(height=240, width=320))
    return RunRoundtrip(experiment, codec)


@pytest.mark.parametrize("length", [1, 2, LENGTH_BLOCK + 1, LENGTH_BLOCK + 2, 3 * LENGTH_BLOCK])
@pytest.mark.parametrize("alone", [True, False])
def test_each_frame_is_that_of_its_own_piece(length: int, alone: bool) -> None:
    video = np.random.default_rng(length).integers(0, 256, (length, 240, 320, 3), dtype=np.uint8)
    codec = Copy(alone)
    left = roundtrip(codec)(video)
    assert (left[0] == 255 - video[0]).all() and (left[1:] == video[1:]).all()
    blocks = -(-(length - 1) // LENGTH_BLOCK)
    whole = [1 + blocks * LENGTH_BLOCK]
    assert codec.lengths == ([1 + LENGTH_BLOCK] * blocks if alone and blocks else whole), "all pieces have one program"

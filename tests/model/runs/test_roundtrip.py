"""Video through a codec and back, in pieces where the codec allows it."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests import synthetic
from xew.episode import read_record, read_video
from xew.model.conditions import CONDITIONS, list_conditions
from xew.model.episodes.commands import episode_command
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


class Seeing(Copy):
    """A codec whose decoded frames are the scene that it is given."""

    sees_render, decoder_hash = True, "seeing"

    def decode(self, latents: np.ndarray, given: Any = None) -> np.ndarray:
        return np.broadcast_to(given.scene, latents.shape)


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


@pytest.mark.parametrize("name", ["pasted_render", "carried_render"])
def test_a_decoder_is_given_the_scene_of_the_model_s_condition(name: str, tmp_path: Path) -> None:
    """Its first frame; or, of each frame, the scene with carried objects, and then the digest says so."""
    folder = synthetic.write_cell(tmp_path, "place_empty_cup", 0, "piper", frames=LENGTH_BLOCK + 4)
    command = episode_command(folder, read_record(folder))
    conditions = {condition.stream: condition for condition in list_conditions(CONDITIONS[name])}
    clip = SimpleNamespace(height=240, width=320)
    experiment: Any = SimpleNamespace(clip=clip, conditions=conditions)
    made = RunRoundtrip(experiment, Seeing(alone=True))
    scene = command.carried_scene if name == "carried_render" else command.read_first()
    np.testing.assert_array_equal(made(read_video(folder / "rgb.mkv"), folder), np.broadcast_to(scene, command.render.shape))
    assert made.digest == "seeing 240x320" + " carried" * (name == "carried_render")

"""Video through a codec and back, in pieces where the codec allows it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests import synthetic
from tests.model.codecs.test_render_head import make_head
from tests.networks import TINY_CODEC
from xew.episode import read_record, read_video
from xew.model.codecs.conv_autoencoder import HEAD_FILE, save_weights
from xew.model.conditions import CONDITIONS, list_conditions
from xew.model.episodes.commands import episode_command
from xew.model.runs.roundtrip import LENGTH_BLOCK, RunRoundtrip


class Copy:
    """A codec that changes nothing but the first frame of what it is given, and notes how long that was."""

    sees_render = False

    def __init__(self, alone: bool) -> None:
        self.groups_independent = alone
        self.lengths: list[int] = []

    def encode(self, video: np.ndarray) -> np.ndarray:
        self.lengths.append(len(video))
        return np.concatenate([255 - video[:1], video[1:]])

    def decode(self, latents: np.ndarray, given: object = None) -> np.ndarray:
        return latents


class Seeing(Copy):
    """A codec whose decoded frames are the scene that it is given; notes how much that was."""

    sees_render, decoder_hash = True, "seeing"

    def decode(self, latents: np.ndarray, given: Any = None) -> np.ndarray:
        self.given = [pictures.shape for pictures in given]
        return np.broadcast_to(given.scene, latents.shape)


def roundtrip(codec: Any) -> RunRoundtrip:
    experiment: Any = SimpleNamespace(clip=SimpleNamespace(height=240, width=320), conditions={})
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
    if length > 1:
        made = roundtrip(compiled := Copy(alone))
        made.compile(made.coded_length(length))
        assert compiled.lengths == codec.lengths[:1]


@pytest.mark.parametrize("name", ["pasted_render", "carried_render"])
def test_a_decoder_is_given_the_scene_of_the_model_s_condition(name: str, tmp_path: Path) -> None:
    """Its first frame; or, of each frame, the scene with carried objects, and then the digest says so."""
    folder = synthetic.write_cell(tmp_path, "place_empty_cup", 0, "piper", frames=LENGTH_BLOCK + 4)
    command = episode_command(folder, read_record(folder))
    conditions = {condition.stream: condition for condition in list_conditions(CONDITIONS[name])}
    clip = SimpleNamespace(height=240, width=320)
    experiment: Any = SimpleNamespace(clip=clip, conditions=conditions)
    made = RunRoundtrip(experiment, codec := Seeing(alone=True))
    scene = command.carried_scene if name == "carried_render" else command.read_first()
    np.testing.assert_array_equal(made(read_video(folder / "rgb.mkv"), folder), np.broadcast_to(scene, command.render.shape))
    assert made.digest == "seeing 240x320" + " carried" * (name == "carried_render")
    given, codec.given = codec.given, []
    made.compile(made.coded_length(LENGTH_BLOCK + 4))
    assert codec.given == given, "both have one program"


COMPILE = """
import sys
from pathlib import Path
from xew.metrics.grading import open_graders, warm_up
open_graders.prepare_process(())
warm_up.is_on_cpu = lambda: False
warm_up.CodecPrograms("", 25, Path(sys.argv[1])).compile()
"""
GRADE = """
import sys
from pathlib import Path
import jax
from xew.episode import read_video
from xew.metrics.grading import codecs, open_graders
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
open_graders.prepare_process(())
codec = codecs.open_codec(Path(sys.argv[1]))
for folder in map(Path, sys.argv[2:]):
    codec(read_video(folder / "rgb.mkv"), folder)
print(*(events.count(f"/jax/compilation_cache/cache_{kind}") for kind in ("hits", "misses")))
"""


def test_a_process_compiles_nothing_of_a_codec_that_another_has_compiled(tmp_path: Path) -> None:
    """The decoder sees the render, and episodes have several lengths."""
    weights = tmp_path / "weights"
    weights.mkdir()
    shutil.copy(TINY_CODEC, weights)
    save_weights(make_head(), weights / HEAD_FILE)
    config = tmp_path / "config.yaml"
    model = "model: {size: tiny, action: none, embodiment: carried_render}"
    clip = "clip: {frames: 5, height: 64, width: 80}"
    config.write_text(f"data: data\nout: run\n{clip}\ncodec: {{weights: {weights}}}\n{model}\n")
    folders = [
        str(synthetic.write_cell(tmp_path / "data", "place_empty_cup", seed, "piper", frames=frames))
        for seed, frames in ((0, LENGTH_BLOCK - 8), (1, LENGTH_BLOCK + 4))
    ]

    def run(script: str, *arguments: str) -> str:
        environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
        command = [sys.executable, "-c", script, str(config), *arguments]
        return subprocess.run(command, env=environment, check=True, capture_output=True, encoding="utf-8").stdout

    run(COMPILE)
    hits, misses = map(int, run(GRADE, *folders).split())
    assert hits >= 2 and misses == 0

"""What a run logs: the same numbers in metrics.jsonl and in TensorBoard, each step once, also where steps were lost."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import metadata

from xew.model.runs.log import RunLog

NAME = "loss/train"


def log(folder: Path, begin: int, values: dict[int, float]) -> None:
    """One try of a run that goes on from step `begin`."""
    written = RunLog(folder, begin)
    for step, value in values.items():
        written.scalars(step, {NAME: value})
    written.close()


def curves(folder: Path) -> tuple[list[tuple[int, float]], list[tuple[int, float]]]:
    """(step, value) of metrics.jsonl and of TensorBoard.

    TensorBoard reads files by name, which has the second and a number that a process counts up: of files of one second the
    tenth comes before the ninth, so that its events are put in order here.
    """
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    accumulator = EventAccumulator(str(folder))
    accumulator.Reload()
    return [(line["step"], line[NAME]) for line in lines], sorted((e.step, e.value) for e in accumulator.Scalars(NAME))


def test_a_run_that_goes_on_continues_both_curves(tmp_path: Path) -> None:
    log(tmp_path, 0, {10: 4.0, 20: 3.0})
    log(tmp_path, 20, {30: 2.0})
    assert curves(tmp_path) == ([(10, 4.0), (20, 3.0), (30, 2.0)],) * 2


def test_a_run_begins_with_its_settings(tmp_path: Path) -> None:
    """As TensorBoard's own readers of texts and HParams find them."""
    (tmp_path / "config.yaml").write_text(
        "data: data\nclip: {frames: 5}\ntrain: {rate: 1.0e-4, ema: true, of: [a, b], to: null}\n"
    )
    log(tmp_path, 0, {10: 4.0})
    accumulator = EventAccumulator(str(tmp_path))
    accumulator.Reload()
    (page,) = accumulator.Tensors("config/text_summary" if "config/text_summary" in accumulator.Tags()["tensors"] else "config")
    assert b"    clip: {frames: 5}" in page.tensor_proto.string_val[0]
    content = accumulator.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    found = metadata.parse_session_start_info_plugin_data(content).hparams
    assert {name: getattr(value, value.WhichOneof("kind")) for name, value in found.items()} == {
        "data": "data",
        "clip.frames": 5.0,
        "train.rate": 1e-4,
        "train.ema": True,
        "train.of": "['a', 'b']",
    }


@pytest.mark.parametrize(("rate", "milliseconds"), [(1000 / 60, 120), (25.0, 80)])
def test_sample_videos_play_at_half_their_rate(rate: float, milliseconds: int, tmp_path: Path) -> None:
    written = RunLog(tmp_path, 0)
    written.video(10, "sample", np.arange(3 * 8 * 8 * 3, dtype=np.uint8).reshape(3, 8, 8, 3), rate)
    written.close()
    accumulator = EventAccumulator(str(tmp_path))
    accumulator.Reload()
    with Image.open(io.BytesIO(accumulator.Images("sample")[0].encoded_image_string)) as animation:
        assert (animation.n_frames, animation.info["duration"]) == (3, milliseconds)


def test_sample_videos_keep_their_colors_in_all_frames(tmp_path: Path) -> None:
    """A square moves over a ramp of grays, and turns from red to green after the first frame."""
    video = np.broadcast_to(np.linspace(0, 255, 32).repeat(2)[:, None], (12, 48, 64, 3)).astype(np.uint8)
    for number, frame in enumerate(video):
        frame[8:24, 2 * number : 2 * number + 16] = (20, 200, 20) if number else (200, 20, 20)
    written = RunLog(tmp_path, 0)
    written.video(0, "sample", video, 25.0)
    written.close()
    accumulator = EventAccumulator(str(tmp_path))
    accumulator.Reload()
    with Image.open(io.BytesIO(accumulator.Images("sample")[0].encoded_image_string)) as animation:
        for number, frame in enumerate(video):
            animation.seek(number)
            assert np.abs(np.asarray(animation.convert("RGB")).astype(int) - frame).max() <= 2


def test_steps_that_were_lost_are_taken_back(tmp_path: Path) -> None:
    """Killed after step 30 with a checkpoint of step 20, in the middle of a line."""
    log(tmp_path, 0, {10: 4.0, 20: 3.0, 25: 8.0, 30: 9.0})
    with (tmp_path / "metrics.jsonl").open("a") as lines:
        lines.write('{"step": 3')
    log(tmp_path, 20, {25: 2.5, 40: 1.0})
    assert curves(tmp_path) == ([(10, 4.0), (20, 3.0), (25, 2.5), (40, 1.0)],) * 2

"""Training curves and sample videos in TensorBoard event files, and the same numbers in metrics.jsonl.

Event files also hold the run's config.yaml, as text and for the HParams page. TensorBoard's own writer needs neither TensorFlow
nor PyTorch.
"""

import io
import json
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.plugins.hparams.summary_v2 import hparams_pb
from tensorboard.plugins.text.summary_v2 import text_pb
from tensorboard.summary.writer.event_file_writer import EventFileWriter

from xew.config import parse_yaml
from xew.files import demand_regular, open_own, read_text, write_text


class RunLog:
    """Writes scalars and pictures of a run under its folder.

    Args:
        folder: of the run.
        step: at which the run continues; log lines of later steps are removed.
        recommended: config whose settings are left out of HParams.
    """

    def __init__(self, folder: Path, step: int, recommended: Any = None) -> None:
        path, config = folder / "metrics.jsonl", folder / "config.yaml"
        before = demand_regular(path).read_text(encoding="utf-8", errors="replace") if path.exists() else None
        settings = read_text(config) if config.exists() else None
        self.events = EventFileWriter(str(folder))
        if before is not None:
            self.events.add_event(Event(wall_time=time.time(), step=step + 1, session_log=SessionLog(status=SessionLog.START)))
        if settings is not None:
            self._settings(step, settings, flatten_settings(recommended))
        write_text(path, _lines_until(before or "", step), within=folder)
        self.lines = open_own(path, "a")

    def _settings(self, step: int, text: str, recommended: Mapping[str, bool | float | str]) -> None:
        """Log a config, given as YAML, as text, and its settings that are not recommended as HParams."""
        page = text_pb("config", "\n".join(f"    {line}" for line in text.splitlines()))  # indented as code in Markdown
        differing = dict(flatten_settings(parse_yaml(text)).items() - recommended.items())
        settings = hparams_pb(differing, start_time_secs=time.time())
        self._add(step, [*page.value, *settings.value])

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Log numbers by name, such as loss/train."""
        self._add(step, [Summary.Value(tag=name, simple_value=value) for name, value in values.items()])
        self.lines.write(json.dumps({"step": step, **values}) + "\n")
        self.lines.flush()

    def image(self, step: int, name: str, picture: np.ndarray) -> None:
        """Log a picture uint8 [h w 3]."""
        self._picture(step, name, Image.fromarray(picture), format="PNG")

    def video(self, step: int, name: str, video: np.ndarray, frame_rate: float) -> None:
        """Log a video uint8 [t h w 3] of a frame rate [Hz] as an animated GIF among the images, at half speed."""
        # One palette for all frames: without one, Pillow finds the best colors of each frame, which takes 25 times as long.
        palette = Image.fromarray(np.concatenate(list(video[::8, ::2, ::2]))).quantize()
        first, *rest = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in video)
        self._picture(
            step, name, first, format="GIF", save_all=True, append_images=rest, duration=round(2000 / frame_rate), loop=0
        )

    def close(self) -> None:
        self.lines.close()
        self.events.close()

    def _picture(self, step: int, name: str, picture: Image.Image, **saving: Any) -> None:
        buffer = io.BytesIO()
        picture.save(buffer, **saving)
        image = Summary.Image(height=picture.height, width=picture.width, colorspace=3, encoded_image_string=buffer.getvalue())
        self._add(step, [Summary.Value(tag=name, image=image)])

    def _add(self, step: int, values: list[Summary.Value]) -> None:
        self.events.add_event(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))
        self.events.flush()


def flatten_settings(content: Any, path: str = "") -> dict[str, bool | float | str]:
    """Settings of a config by path, such as train.steps, as numbers, flags or text for HParams."""
    if isinstance(content, Mapping):
        parts = (flatten_settings(value, f"{path}.{key}" if path else str(key)) for key, value in content.items())
        return {name: value for part in parts for name, value in part.items()}
    if content is None:
        return {}
    if isinstance(content, bool | str):
        return {path: content}
    return {path: float(content) if isinstance(content, int | float) else str(content)}


def _lines_until(text: str, step: int) -> str:
    """The whole lines of metrics.jsonl up to a step."""
    return "".join(line for line in text.splitlines(keepends=True) if line.endswith("\n") and _step_of(line) <= step)


def _step_of(line: str) -> float:
    """The step of a line; infinity if it cannot be read."""
    try:
        step = json.loads(line)["step"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return math.inf
    return step if isinstance(step, int) else math.inf

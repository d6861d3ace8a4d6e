"""Training curves and sample videos: TensorBoard event files, and the same numbers as plain metrics.jsonl.

Only TensorBoard's own writer is used, so that neither TensorFlow nor PyTorch is needed.
"""

import io
import json
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.event_file_writer import EventFileWriter

FRAME_MILLISECONDS = 120


class RunLog:
    """Writes scalars and pictures of a run under its folder."""

    def __init__(self, folder: Path) -> None:
        self.events = EventFileWriter(str(folder))
        self.lines = (folder / "metrics.jsonl").open("a")

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Log numbers by name, such as train/loss."""
        self._add(step, [Summary.Value(tag=name, simple_value=value) for name, value in values.items()])
        self.lines.write(json.dumps({"step": step, **values}) + "\n")
        self.lines.flush()

    def image(self, step: int, name: str, picture: np.ndarray) -> None:
        """Log a picture uint8 [h w 3]."""
        self._add(step, [Summary.Value(tag=name, image=_encoded([picture], "PNG"))])

    def video(self, step: int, name: str, video: np.ndarray) -> None:
        """Log uint8 [t h w 3] as an animated GIF, which TensorBoard plays among the images."""
        self._add(step, [Summary.Value(tag=name, image=_encoded(list(video), "GIF"))])

    def close(self) -> None:
        self.lines.close()
        self.events.close()

    def _add(self, step: int, values: list[Summary.Value]) -> None:
        self.events.add_event(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))
        self.events.flush()


def _encoded(frames: list[np.ndarray], kind: str) -> Summary.Image:
    buffer = io.BytesIO()
    pictures = [Image.fromarray(frame) for frame in frames]
    animation = (
        {"save_all": True, "append_images": pictures[1:], "duration": FRAME_MILLISECONDS, "loop": 0} if kind == "GIF" else {}
    )
    pictures[0].save(buffer, format=kind, **animation)
    height, width = frames[0].shape[:2]
    return Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=buffer.getvalue())

"""Writing of rollouts in threads, next to prediction."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from xew.concurrency import usable_cores
from xew.episode import Record
from xew.model.video.frames import Size, to_camera_size
from xew.rollout import write_rollout

WRITERS = min(8, usable_cores())
"""Number of threads that compress videos."""
WAITING = 16
"""Largest number of videos that wait for a writer."""


class RolloutWriter:
    """Writes rollouts in threads; the end of its `with` block waits for all. A failed write is raised by a later call.

    Args:
        out: root of the rollout tree.
        done: called in the caller's thread after each written rollout.
        resize: function of each video and the size of the camera's picture, applied before writing, or None.
    """

    def __init__(
        self, out: Path, done: Callable[[], Any], resize: Callable[[np.ndarray, Size], np.ndarray] | None = to_camera_size
    ) -> None:
        self.out, self.done, self.resize = out, done, resize
        self.threads = ThreadPoolExecutor(WRITERS)
        self.waiting: deque[Future[Path]] = deque()

    def write(self, record: Record, video: np.ndarray, header: dict[str, Any]) -> None:
        """Queue a video uint8 [t h w 3]."""
        self.waiting.append(self.threads.submit(self._write, record, video, header))
        while len(self.waiting) > WAITING or (self.waiting and self.waiting[0].done()):
            self._settle()

    def _write(self, record: Record, video: np.ndarray, header: dict[str, Any]) -> Path:
        resized = video if self.resize is None else self.resize(video, record.camera.size)
        name = record.task, record.seed, record.robot
        views, height = header.get("views", {}), resized.shape[1] // max(len(record.camera.parts), 1)
        for number, (view, source) in enumerate(views.items()):
            cut, own = resized[:, number * height : (number + 1) * height], header | {"source_hash": source}
            write_rollout(self.out.with_name(f"{self.out.name}-views") / view, *name, cut, own, record.frame_rate)
        return write_rollout(self.out, *name, resized, header, record.frame_rate)

    def _settle(self) -> None:
        self.waiting.popleft().result()
        self.done()

    def __enter__(self) -> "RolloutWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Write all queued videos, also after an error in the block."""
        self.threads.shutdown(wait=True)
        while kind is None and self.waiting:
            self._settle()

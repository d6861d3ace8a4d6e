"""Rolling out many episodes: reading, prediction and writing side by side, in one process a GPU."""

import functools
import itertools
import sys
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import jax
from tqdm import tqdm

from xew.concurrency import prepare_processes, usable_cores, visible_gpus
from xew.dataset import Episode
from xew.model.devices.parts import choose_readers, run_on_gpus
from xew.model.sampling import reading
from xew.model.sampling.predict import Prediction, Predictor
from xew.model.sampling.writing import RolloutWriter

Item = tuple[Episode, dict[str, Any]]
"""An episode to predict and the header of its rollout."""
MOST_READERS = 12
"""Largest number of processes that read for a GPU."""


def roll_out(open_predictor: Callable[[], Predictor], pending: Sequence[Item], out: Path) -> None:
    """Predict episodes and write them, with a progress bar. Several GPUs have a process each, which opens the predictor."""
    gpus = visible_gpus() if len(pending) > 1 and jax.default_backend() == "gpu" else ()
    progress = functools.partial(tqdm, total=len(pending), desc="rollout", unit="episode", file=sys.stderr)
    if len(gpus) > 1:
        with progress() as bar:
            roll_out_on_gpus(functools.partial(_open_part, open_predictor, out), pending, gpus, bar.update)
        return
    if readers := choose_readers(len(pending), _most_readers()):
        prepare_processes(reading.IMPORTED)
    predictor = open_predictor()
    with progress() as bar:
        predict_and_write(predictor, pending, RolloutWriter(out, bar.update), readers)


Part = Callable[[Sequence[Item]], object]
"""Function that rolls out some of the episodes."""


def roll_out_on_gpus(
    opener: Callable[[SimpleQueue, Event], Part], pending: Sequence[Item], gpus: Sequence[str], done: Callable[[], object]
) -> None:
    """`run_on_gpus` of episodes, of which each process gets as many of every length; `done` is called for every rollout."""
    run_on_gpus(opener, sorted(pending, key=_frames), gpus, lambda _: done(), (__name__, *reading.IMPORTED))


def _open_part(open_predictor: Callable[[], Predictor], out: Path, written: SimpleQueue, stop: Event) -> Part:
    prepare_processes(reading.IMPORTED)
    predictor = open_predictor()

    def roll_out_part(pending: Sequence[Item]) -> None:
        writer = RolloutWriter(out, lambda: written.put(1))
        predict_and_write(predictor, pending, writer, choose_readers(len(pending), _most_readers()), stop.is_set)

    return roll_out_part


def predict_and_write(
    predictor: Predictor,
    pending: Sequence[Item],
    writer: RolloutWriter,
    readers: int = 0,
    is_stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Roll out episodes in batches of similar length, and write them; two batches are read ahead of the devices.

    Args:
        predictor: the model.
        pending: episodes.
        writer: opened and closed here.
        readers: number of processes that read, 0 for threads.
        is_stopped: asked before each batch, whether to end early.
    """
    size = max(min(predictor.settings.batch, len(pending)), 1)
    ordered = sorted(pending, key=_frames)
    read = predictor.reader.read_ahead([episode for episode, _ in ordered], min(size, usable_cores()), readers)
    started: deque[tuple[list[Item], Prediction]] = deque()

    def write_oldest() -> None:
        items, prediction = started.popleft()
        for ((_, record), header), video in zip(items, prediction.fetch(), strict=True):
            writer.write(record, video[: header["frame_count"]], header | predictor.header)

    with writer:
        for start in range(0, len(ordered), size):
            if is_stopped():
                return
            items = ordered[start : start + size]
            inputs = list(itertools.islice(read, len(items)))
            started.append((items, predictor.begin(inputs, _frames(items[-1]), size)))
            if len(started) > 1:
                write_oldest()
        while started:
            write_oldest()


def _most_readers() -> int:
    return min(MOST_READERS, usable_cores() * 3 // 4)


def _frames(item: Item) -> int:
    return item[1]["frame_count"]

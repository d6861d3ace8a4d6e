"""Rolling out many episodes: reading, prediction and writing side by side, in one process a GPU."""

import functools
import itertools
import multiprocessing
import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import jax
from tqdm import tqdm

from xew.concurrency import (
    count_done,
    free_gpu_memory,
    map_in_order,
    map_in_processes,
    prepare_processes,
    usable_cores,
    visible_gpus,
)
from xew.dataset import Episode
from xew.model.sampling import reading
from xew.model.sampling.predict import Prediction, Predictor
from xew.model.sampling.writing import RolloutWriter

Item = tuple[Episode, dict[str, Any]]
"""An episode to predict and the header of its rollout."""
MOST_READERS = 8
"""Largest number of processes that read for a GPU."""
GPU_MEMORY_OF_READER = 2.5
"""GPU memory of a process that reads [GB]: 512 frames in flight and CUDA's own memory."""
EPISODES_OF_READER = 4
"""Number of episodes for which a process that reads is worth its start of a few seconds."""


def roll_out(open_predictor: Callable[[], Predictor], pending: Sequence[Item], out: Path) -> None:
    """Predict episodes and write them, with a progress bar. Several GPUs have a process each, which opens the predictor."""
    gpus = visible_gpus() if len(pending) > 1 and jax.default_backend() == "gpu" else ()
    progress = functools.partial(tqdm, total=len(pending), desc="rollout", unit="episode", file=sys.stderr)
    if len(gpus) > 1:
        with progress() as bar:
            roll_out_on_gpus(functools.partial(_open_part, open_predictor, out), pending, gpus, bar.update)
        return
    if readers := choose_readers(len(pending)):
        prepare_processes(reading.IMPORTED)
    predictor = open_predictor()
    with progress() as bar:
        predict_and_write(predictor, pending, RolloutWriter(out, bar.update), readers)


Part = Callable[[Sequence[Item]], object]
"""Function that rolls out some of the episodes."""


def roll_out_on_gpus(
    opener: Callable[[SimpleQueue, Event], Part], pending: Sequence[Item], gpus: Sequence[str], done: Callable[[], object]
) -> None:
    """Share episodes among processes, one a GPU. After an error the other processes end with their batch.

    Args:
        opener: called in each process with a queue, which gets an item for every written rollout, and an event that is set
            for the process to end early; returns the function that rolls out its part.
        pending: episodes; each process gets as many of every length.
        gpus: GPUs as CUDA_VISIBLE_DEVICES names them.
        done: called for every written rollout, in another thread.
    """
    ordered, context = sorted(pending, key=_frames), multiprocessing.get_context("forkserver")
    stop = context.Event()

    def run(written: SimpleQueue, number: int) -> None:
        opener_of_part, imported = functools.partial(opener, written, stop), (__name__, *reading.IMPORTED)
        try:
            list(map_in_processes(opener_of_part, [ordered[number :: len(gpus)]], 1, imported, gpus[number : number + 1]))
        except BaseException:
            stop.set()
            raise

    with count_done(done) as written:
        list(map_in_order(functools.partial(run, written), range(min(len(gpus), len(ordered))), len(gpus), stop))


def _open_part(open_predictor: Callable[[], Predictor], out: Path, written: SimpleQueue, stop: Event) -> Part:
    predictor = open_predictor()

    def roll_out_part(pending: Sequence[Item]) -> None:
        writer = RolloutWriter(out, lambda: written.put(1))
        predict_and_write(predictor, pending, writer, choose_readers(len(pending)), stop.is_set)

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
            writer.write(record, video[: header["frame_count"]], header)

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


def choose_readers(episodes: int) -> int:
    """Number of processes that read for the GPU of this process; 0 for threads, as on a CPU and for few episodes."""
    if jax.default_backend() != "gpu" or not hasattr(os, "memfd_create"):
        return 0
    memory = min(free_gpu_memory(visible_gpus()), default=0.0)
    most = min(MOST_READERS, usable_cores() // 2, int(memory / GPU_MEMORY_OF_READER))
    return most if most > 1 and episodes >= most * EPISODES_OF_READER else 0


def _frames(item: Item) -> int:
    return item[1]["frame_count"]

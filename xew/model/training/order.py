"""The order of training samples: endless shuffled batches, read ahead in threads, with a position that can be restored."""

from collections.abc import Callable

import grain
import numpy as np

from xew.concurrency import usable_cores
from xew.model.settings.settings import count_replayed
from xew.model.training.data import Batch, ClipSource, stack

PASSES = 2**40
"""Number of passes over the samples, never reached; Python cannot index Grain's endless data sets."""
THREADS = 8
"""Largest number of threads that read; two made 300 samples a second, which four GPUs waited for (docs/performance.md)."""


def make_dataset(
    source: ClipSource,
    batch: int,
    seed: int,
    replay: float = 0.0,
    own: np.ndarray | None = None,
    place: Callable[[Batch], Batch] = lambda batch: batch,
) -> grain.IterDataset:
    """Make endless shuffled batches, whose iterator has get_state and set_state; independent of the number of processes.

    Args:
        source: of the samples.
        batch: number of samples over all processes.
        seed: of the order.
        replay: part of each batch from the source's replayed episodes.
        own: [b] indices of the samples of each batch that this process loads, by default all.
        place: function that moves a batch to the devices, called in the threads that read.
    """
    count = count_replayed(batch, replay)
    fresh = _shuffle(range(source.fresh), seed, batch - count)
    others = _shuffle(range(source.fresh, len(source)), seed + 1, count) if count else None
    own = np.arange(batch) if own is None else own

    def load(number: int, indices: np.ndarray) -> Batch:
        if others is not None:
            indices = np.concatenate([indices, others[number]])
        return place(stack([source[int(index)] for index in indices[own]]))

    threads = min(THREADS, usable_cores())
    return fresh.map_with_index(load).to_iter_dataset(grain.ReadOptions(num_threads=threads, prefetch_buffer_size=threads))


def _shuffle(samples: range, seed: int, count: int) -> grain.MapDataset:
    """Make endless batches [count] of sample indices; each pass over the samples has its own order."""
    return grain.MapDataset.source(samples).seed(seed).shuffle().repeat(PASSES).batch(count)

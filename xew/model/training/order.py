"""The order of training samples: endless shuffled batches, read ahead in threads, with a position that can be restored."""

import grain
import numpy as np

from xew.model.settings.settings import count_mixed
from xew.model.training.data import Batch, ClipSource, stack

PASSES = 2**40
"""Number of passes over the samples, never reached; Python cannot index Grain's endless data sets."""


def make_dataset(
    source: ClipSource, batch: int, seed: int, mixed: float = 0.0, own: np.ndarray | None = None
) -> grain.IterDataset:
    """Make endless shuffled batches, whose iterator has get_state and set_state; independent of the number of processes.

    Args:
        source: of the samples.
        batch: number of samples over all processes.
        seed: of the order.
        mixed: part of each batch from the source's replayed or faulty episodes.
        own: [b] indices of the samples of each batch that this process loads, by default all.
    """
    count = count_mixed(batch, mixed)
    fresh = _shuffle(range(source.fresh), seed, batch - count)
    others = _shuffle(range(source.fresh, len(source)), seed + 1, count) if count else None
    own = np.arange(batch) if own is None else own

    def load(number: int, indices: np.ndarray) -> Batch:
        if others is not None:
            indices = np.concatenate([indices, others[number]])
        return stack([source[int(index)] for index in indices[own]])

    dataset = fresh.map_with_index(load)
    return dataset.to_iter_dataset(grain.ReadOptions(num_threads=2, prefetch_buffer_size=4))


def _shuffle(samples: range, seed: int, count: int) -> grain.MapDataset:
    """Make endless batches [count] of sample indices; each pass over the samples has its own order."""
    return grain.MapDataset.source(samples).seed(seed).shuffle().repeat(PASSES).batch(count)

"""The order of training samples: shuffled batches without end, read ahead in threads, which a resumed run continues.

Reads  `ClipSource`
Writes `Batch`
"""

import grain
import numpy as np

from xew.model.settings.settings import count_replayed
from xew.model.training.data import Batch, ClipSource, stack

PASSES = 2**40
"""Passes over the samples. Training ends before, and Grain, which rounds the length of an endless data set up to one more
than Python can index, can count them."""


def make_dataset(
    source: ClipSource, batch: int, seed: int, replay: float = 0.0, own: np.ndarray | None = None
) -> grain.IterDataset:
    """Make endless shuffled batches; the iterator's get_state and set_state carry its position.

    The order is that of whole batches, of which each process loads its own samples, so that neither the numbers nor the
    position depend on how many processes there are.

    Args:
        batch: samples over all processes.
        replay: part of each batch that comes from the source's replayed episodes.
        own: [b] numbers of the samples of each batch that this process loads; all where left out.
    """
    old = count_replayed(batch, replay)
    fresh = _shuffle(range(source.fresh), seed, batch - old)
    again = _shuffle(range(source.fresh, len(source)), seed + 1, old) if old else None
    own = np.arange(batch) if own is None else own

    def load(number: int, indices: np.ndarray) -> Batch:
        if again is not None:
            indices = np.concatenate([indices, again[number]])
        return stack([source[int(index)] for index in indices[own]])

    dataset = fresh.map_with_index(load)
    return dataset.to_iter_dataset(grain.ReadOptions(num_threads=2, prefetch_buffer_size=4))


def _shuffle(samples: range, seed: int, count: int) -> grain.MapDataset:
    """Make batches [count] of sample numbers without end; each pass over the samples has its own order."""
    return grain.MapDataset.source(samples).seed(seed).shuffle().repeat(PASSES).batch(count)

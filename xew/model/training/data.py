"""Batches for training: clips of the latent cache in an order that a resumed run continues.

Reads  the latent cache
Writes `Batch`
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import grain
import jax
import numpy as np

from xew.episode import Record
from xew.model.cache.scales import apply_scales
from xew.model.codecs.codec import latent_frames
from xew.model.experiment import Experiment, replayed
from xew.model.latents import Episode, LatentCache, load_scales, sample_starts
from xew.model.text.instructions import VOCABULARY
from xew.model.video.frames import TEMPORAL_FACTOR


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """What the network trains on."""

    latents: Any
    """[b t h w c] float32, the RGB stream."""
    conditions: dict[str, Any]
    """Stream or mechanism -> [b t' h' w' c] latents or [b t' n] numbers, scaled, float32."""
    text: Any
    """[b l e] float32, or [b l] int32 rows of the network's table of words; zero-padded."""
    shown: Any = None
    """[b t] float32, 1 where a latent frame shows the episode and 0 past its end; None where all do."""
    following: "Batch | None" = None
    """The next chunk, whose first frame is the last of this one; None where one chunk is trained. A sample whose episode
    ends before it has a following chunk of which nothing is shown."""


class ClipSource:
    """Random access to the training samples of the cache, for Grain: index -> Batch without its leading axis.

    Args:
        episodes: those to learn from.
        replay: episodes of which every batch has a part beside them.
    """

    def __init__(self, cache: LatentCache, episodes: Sequence[Episode], replay: Sequence[Episode] = ()) -> None:
        self.cache = cache
        self.samples = [sample for _, record in episodes for sample in self._samples(record)]
        self.fresh = len(self.samples)
        self.samples += [sample for _, record in replay for sample in self._samples(record)]
        every = [record for _, record in (*episodes, *replay)]
        self.scales = load_scales(cache.experiment, episodes)
        self.text = cache.experiment.encode_instructions(record.instruction for record in every)

    def _samples(self, record: Record) -> list[tuple[Record, tuple[int, ...]]]:
        experiment = self.cache.experiment
        starts = sample_starts(record.frame_count, experiment.clip.frames, experiment.train.chunks)
        return [(record, chunks) for chunks in starts]

    def __len__(self) -> int:
        return len(self.samples)

    def check(self) -> None:
        """Raise ConfigError unless every stream of every episode is in the cache and fits the data."""
        for record in {id(record): record for record, _ in self.samples}.values():
            for name in self.cache.streams:
                self.cache.read(record, name, 0)

    def __getitem__(self, index: int) -> Batch:
        record, starts = self.samples[index]
        first = self._chunk(record, starts[0])
        if self.cache.experiment.train.chunks == 1:
            return first
        if len(starts) == 2:
            return replace(first, following=self._chunk(record, starts[1]))
        return replace(first, following=replace(first, shown=np.zeros_like(first.shown)))

    def _chunk(self, record: Record, start: int) -> Batch:
        experiment = self.cache.experiment
        clip = self.cache.starts(record).index(start)
        arrays = {name: self.cache.read(record, name, clip).astype(np.float32) for name in self.cache.streams}
        shown = shown_frames(record.frame_count - start, experiment.clip.frames)
        latents = arrays.pop("rgb")
        conditions = apply_scales(self.scales, experiment.conditions, arrays)
        return Batch(latents, conditions, self.text[record.instruction], shown)


def shown_frames(left: int, frames: int) -> np.ndarray:
    """Which latent frames of a clip show anything of an episode that has `left` frames from there on: float32 [t]."""
    firsts = np.maximum(np.arange(latent_frames(frames)) * TEMPORAL_FACTOR - (TEMPORAL_FACTOR - 1), 0)
    return (firsts < left).astype(np.float32)


def make_dataset(
    source: ClipSource, batch: int, seed: int, replay: float = 0.0, rows: np.ndarray | None = None
) -> grain.IterDataset:
    """Endless shuffled batches; the iterator's get_state and set_state carry its position.

    The order is that of whole batches, of which each process loads its rows, so that neither the numbers nor the position
    depend on how many processes there are.

    Args:
        batch: samples over all processes.
        replay: part of each batch that comes from the source's replayed episodes.
        rows: which samples of each batch to load; all where left out.
    """
    old = replayed(batch, replay)
    fresh = _order(range(source.fresh), seed, batch - old)
    again = _order(range(source.fresh, len(source)), seed + 1, old) if old else None
    rows = np.arange(batch) if rows is None else rows

    def load(number: int, indices: np.ndarray) -> Batch:
        if again is not None:
            indices = np.concatenate([indices, again[number]])
        return stack([source[int(index)] for index in indices[rows]])

    dataset = fresh.map_with_index(load)
    return dataset.to_iter_dataset(grain.ReadOptions(num_threads=2, prefetch_buffer_size=4))


def _order(samples: range, seed: int, count: int) -> grain.MapDataset:
    """Batches of `count` sample numbers without end; each pass over the samples has its own order."""
    return grain.MapDataset.source(samples).seed(seed).shuffle().repeat().batch(count)


def stack(examples: Sequence[Batch]) -> Batch:
    """Examples to a batch."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *examples)


def fake_batch(experiment: Experiment, batch: int, seed: int = 0) -> Batch:
    """A batch of noise in the shapes that the experiment's data would have, for tests and compile checks."""
    rng = np.random.default_rng(seed)
    tokens, width = experiment.size.text_tokens, experiment.size.text_dim
    learned = experiment.text_encoder.learned

    def normal(*shape: int) -> np.ndarray:
        return rng.standard_normal((batch, *shape), np.float32)

    def chunk() -> Batch:
        conditions = {name: normal(*experiment.condition_shape(name)) for name in experiment.conditions}
        latents = normal(*experiment.latent_shape)
        text = rng.integers(1, VOCABULARY, (batch, tokens), np.int32) if learned else normal(tokens, width)
        return Batch(latents, conditions, text, np.ones(latents.shape[:2], np.float32))

    first = chunk()
    return replace(first, following=chunk()) if experiment.train.chunks == 2 else first

"""Batches for training: clips of the latent cache in an order that a resumed run continues.

Reads  the latent cache
Writes `Batch`
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import grain
import jax
import numpy as np

from xew.model.codec import latent_frames
from xew.model.dit import MODELS, STREAMS
from xew.model.experiment import Experiment
from xew.model.latents import Episode, LatentCache, clip_starts
from xew.model.text import TEXT_ENCODERS
from xew.protocol import ACTION_DIM


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """What the network trains on."""

    latents: Any
    """[b t h w c] float32, the RGB stream."""
    conditions: dict[str, Any]
    """Stream name -> [b t' h' w' c] latents or [b t' 16] joint positions, float32."""
    text: Any
    """[b l e] float32, zero-padded."""


class ClipSource:
    """Random access to the clips of the cache, for Grain: index -> Batch without its leading axis."""

    def __init__(self, cache: LatentCache, episodes: Sequence[Episode]) -> None:
        self.cache = cache
        frames = cache.experiment.clip.frames
        self.clips = [(record, i) for _, record in episodes for i in range(len(clip_starts(record.frame_count, frames)))]
        self.text = {record.instruction: encode_text(cache.experiment, record.instruction) for _, record in episodes}

    def __len__(self) -> int:
        return len(self.clips)

    def check(self) -> None:
        """Raise ConfigError unless every stream of every episode is in the cache and fits the data."""
        for record, clip in self.clips:
            if clip == 0:
                for name in self.cache.streams:
                    self.cache.read(record, name)

    def __getitem__(self, index: int) -> Batch:
        record, clip = self.clips[index]
        streams = {name: self.cache.read(record, name) for name in self.cache.streams}
        arrays = {name: stream[min(clip, len(stream) - 1)].astype(np.float32) for name, stream in streams.items()}
        return Batch(arrays.pop("rgb"), arrays, self.text[record.instruction])


def encode_text(experiment: Experiment, instruction: str) -> np.ndarray:
    """Embeddings of an instruction [l e] float32."""
    size = MODELS[experiment.model.size]
    return TEXT_ENCODERS[experiment.model.text](instruction, size.text_tokens, size.text_dim)


def make_dataset(source: ClipSource, batch: int, seed: int) -> grain.IterDataset:
    """Endless shuffled batches; the iterator's get_state and set_state carry its position."""
    dataset = grain.MapDataset.source(source).seed(seed).shuffle().repeat()
    return dataset.batch(batch, batch_fn=stack).to_iter_dataset(grain.ReadOptions(num_threads=2, prefetch_buffer_size=8))


def stack(examples: Sequence[Batch]) -> Batch:
    """Examples to a batch."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *examples)


def fake_batch(experiment: Experiment, batch: int, seed: int = 0) -> Batch:
    """A batch of noise in the shapes that the experiment's data would have, for tests and compile checks."""
    rng = np.random.default_rng(seed)
    size = MODELS[experiment.model.size]

    def normal(*shape: int) -> np.ndarray:
        return rng.standard_normal((batch, *shape), np.float32)

    joints_shape = (latent_frames(experiment.clip.frames), ACTION_DIM)
    shapes = {
        name: joints_shape if STREAMS[name].source == "joints" else experiment.latent_shape for name in experiment.conditions
    }
    conditions = {name: normal(*shape) for name, shape in shapes.items()}
    return Batch(normal(*experiment.latent_shape), conditions, normal(size.text_tokens, size.text_dim))

"""Training samples: clips of the latent cache with conditions and text; order.py makes batches of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from xew.dataset import Episode
from xew.episode import Record
from xew.model.cache.clips import sample_starts
from xew.model.cache.scales import Scale, apply_scales, load_scales
from xew.model.cache.store import LatentCache, open_cache
from xew.model.codecs.contract import latent_frames
from xew.model.settings.parts import ClipInputs, Encoding
from xew.model.text.instructions import VOCABULARY, Instructions
from xew.model.video.frames import TEMPORAL_FACTOR


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """Arrays of a training batch."""

    latents: Any
    """[b t h w c] float16 as stored, the RGB stream; a training step computes with float32."""
    conditions: dict[str, Any]
    """Arrays by stream or mechanism: [b t' h' w' c] float16 latents or [b t' n] float32 numbers, scaled."""
    text: Any
    """[b l e] float32, or [b l] int32 rows of the network's table of words; zero-padded."""
    valid: Any = None
    """[b t] float32 mask, 1 for latent frames of the episode and 0 past its end; None if all are valid."""
    following: "Batch | None" = None
    """Next chunk, whose first frame is the last of this one, or None; no frame is valid if the episode ends before it."""


class ClipSource:
    """Random access to the training samples of the cache, for Grain: index -> Batch without its leading axis.

    Samples of `episodes` come first, then those of `replayed`. Text is [l e] float32 or [l] int32 by instruction.
    """

    def __init__(
        self,
        cache: LatentCache,
        text: Mapping[str, np.ndarray],
        scales: Mapping[str, Scale],
        episodes: Sequence[Episode],
        replayed: Sequence[Episode] = (),
    ) -> None:
        self.cache, self.text, self.scales = cache, text, scales
        self.samples = [sample for _, record in episodes for sample in self._list_samples(record)]
        self.fresh = len(self.samples)
        self.samples += [sample for _, record in replayed for sample in self._list_samples(record)]

    @classmethod
    def open(
        cls, encoding: Encoding, instructions: Instructions, episodes: Sequence[Episode], replayed: Sequence[Episode] = ()
    ) -> "ClipSource":
        """Open the cache of these episodes. Raises ConfigError if scales were never fitted on them."""
        text = instructions.encode(record.instruction for _, record in (*episodes, *replayed))
        return cls(open_cache(encoding), text, load_scales(encoding, episodes), episodes, replayed)

    def _list_samples(self, record: Record) -> list[tuple[Record, tuple[int, ...]]]:
        inputs = self.cache.encoding.inputs
        return [(record, chunks) for chunks in sample_starts(record.frame_count, inputs.clip.frames, inputs.chunks)]

    def __len__(self) -> int:
        return len(self.samples)

    def check(self) -> None:
        """Raise ConfigError unless every stream of every episode is in the cache and fits the data."""
        for record in {id(record): record for record, _ in self.samples}.values():
            for name in self.cache.streams:
                self.cache.read(record, name, 0)

    def __getitem__(self, index: int) -> Batch:
        record, starts = self.samples[index]
        first = self._read_chunk(record, starts[0])
        if self.cache.encoding.inputs.chunks == 1:
            return first
        if len(starts) == 2:
            return replace(first, following=self._read_chunk(record, starts[1]))
        return replace(first, following=replace(first, valid=np.zeros_like(first.valid)))

    def _read_chunk(self, record: Record, start: int) -> Batch:
        inputs = self.cache.encoding.inputs
        clip = self.cache.starts(record).index(start)
        arrays = {name: self.cache.read(record, name, clip) for name in self.cache.streams}
        valid = valid_frames(record.frame_count - start, inputs.clip.frames)
        latents = arrays.pop("rgb")
        conditions = apply_scales(self.scales, inputs.conditions, arrays)
        return Batch(latents, conditions, self.text[record.instruction], valid)


def valid_frames(left: int, frames: int) -> np.ndarray:
    """Mask [t] float32 of the latent frames of a clip that show any of the `left` remaining frames of its episode."""
    firsts = np.maximum(np.arange(latent_frames(frames)) * TEMPORAL_FACTOR - (TEMPORAL_FACTOR - 1), 0)
    return (firsts < left).astype(np.float32)


def stack(examples: Sequence[Batch]) -> Batch:
    """Stack samples to a batch with a leading axis [b]."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *examples)


def fake_batch(inputs: ClipInputs, batch: int, seed: int = 0) -> Batch:
    """Make a batch [b ...] of noise in the shapes of an experiment's data, for tests and benchmarks."""
    rng = np.random.default_rng(seed)
    text_shape = inputs.shapes["text"]

    def draw(*shape: int) -> np.ndarray:
        return rng.standard_normal((batch, *shape), np.float32)

    def draw_chunk() -> Batch:
        conditions = {name: draw(*inputs.shapes[name]) for name in inputs.conditions}
        latents = draw(*inputs.latent_shape)
        text = draw(*text_shape) if len(text_shape) == 2 else rng.integers(1, VOCABULARY, (batch, *text_shape), np.int32)
        return Batch(latents, conditions, text, np.ones(latents.shape[:2], np.float32))

    first = draw_chunk()
    return replace(first, following=draw_chunk()) if inputs.chunks == 2 else first

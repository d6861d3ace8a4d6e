"""Encoding episodes into the latent cache: pixels are read or rendered ahead, in threads or processes, the codec works in
batches."""

import os
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import jax
import numpy as np
from tqdm import tqdm

from xew.compilation import keep_compiled_programs
from xew.concurrency import map_in_order, map_in_processes
from xew.dataset import Episode
from xew.episode import Record
from xew.model.cache.clips import cut_clip, needed_pixels, read_streams
from xew.model.cache.store import LatentCache, open_cache
from xew.model.codecs.contract import Codec, check_clip_shape, encode_pictures
from xew.model.settings.parts import Encoding
from xew.model.video.pixels import PixelSource, rendered_pixels, stored_pixels

ENCODERS = 3
"""Number of episodes that an accelerator encodes side by side: one computes while others are copied to it and back."""


@dataclass(frozen=True)
class Encoder:
    """What encodes the streams that the cache has not of an episode, for one thread or several."""

    cache: LatentCache
    source: PixelSource = stored_pixels
    batch: int = 4
    """Number of clips that the codec encodes at once."""
    turns: threading.BoundedSemaphore = field(
        default_factory=lambda: threading.BoundedSemaphore(1 if jax.default_backend() == "cpu" else ENCODERS)
    )

    def __call__(self, episode: Episode) -> int:
        """Encode what is missing of an episode, and return the number of bytes written."""
        inputs, missing = self.cache.encoding.inputs, self.cache.missing(episode[1])
        pixels = self.source(*episode, needed_pixels(inputs.conditions, missing))
        videos = read_streams(inputs.conditions, inputs.clip, *episode, missing, pixels)
        with self.turns:
            return _encode_streams(self.cache, episode[1], videos, self.batch)


@dataclass(frozen=True)
class EncoderOpener:
    """What opens an encoder in a process of its own; it can be sent there."""

    encoding: Encoding
    training: Sequence[Episode]
    """Episodes that the codec, where it is a fitted one, was fitted on."""
    from_states: bool
    batch: int

    def __call__(self) -> Encoder:
        keep_compiled_programs()
        source = rendered_pixels() if self.from_states else stored_pixels
        return Encoder(open_cache(self.encoding, self.training), source, self.batch)


def encode_episodes(encoder: Encoder, episodes: Sequence[Episode]) -> int:
    """Encode what is missing of some episodes in threads of this process, and return the number of bytes written."""
    pending = [episode for episode in episodes if encoder.cache.missing(episode[1])]
    return _follow(map_in_order(encoder, pending), len(pending), len(episodes))


def encode_in_processes(opener: EncoderOpener, cache: LatentCache, episodes: Sequence[Episode], processes: int) -> int:
    """The same in so many processes, each of which reads, encodes and writes one episode after another.

    Threads wait for Python's lock in most of what reads an episode and draws its conditions. Processes that share a GPU take
    its memory as they need it.
    """
    pending = [episode for episode in episodes if cache.missing(episode[1])]
    if not pending:
        return 0
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    return _follow(map_in_processes(opener, pending, processes, (__name__,)), len(pending), len(episodes))


def _follow(sizes: Iterator[int], pending: int, total: int) -> int:
    """Sum of the sizes [bytes], with a line of progress."""
    bar = tqdm(sizes, initial=total - pending, total=total, desc="encode", unit="episode", file=sys.stderr)
    return sum(bar)


def _encode_streams(cache: LatentCache, record: Record, videos: dict[str, np.ndarray], batch: int) -> int:
    """Encode some streams of one episode, and write each as a whole."""
    pieces = {name: _cut_stream(cache, record, name, video) for name, video in videos.items()}
    pictures = [piece for clips in pieces.values() for clip in clips for piece in clip if piece.dtype == np.uint8]
    encoded = iter(encode_many(cache.codec, pictures, batch))
    written = 0
    for name, clips in pieces.items():
        arrays = [np.concatenate([next(encoded) if p.dtype == np.uint8 else p for p in clip]) for clip in clips]
        written += cache.write(record, name, np.stack(arrays))
    return written


def _cut_stream(cache: LatentCache, record: Record, name: str, video: np.ndarray) -> list[list[np.ndarray]]:
    """What each clip of a stream is made from, see `cut_clip`."""
    condition, inputs = cache.streams[name], cache.encoding.inputs
    starts = cache.starts(record) if condition is None or condition.aligned else (0,)
    return [cut_clip(condition, video, start, inputs.clip.frames, inputs.history) for start in starts]


def encode_many(codec: Codec, clips: Sequence[np.ndarray], batch: int) -> list[np.ndarray]:
    """Encode clips [t h w 3] uint8 to latents [t' h' w' c] float32, `batch` of equal shape at once.

    The last batch is filled up.
    """
    encoded: dict[int, np.ndarray] = {}
    shapes = sorted({clip.shape for clip in clips})
    for shape in shapes:
        check_clip_shape(shape, codec.spatial_factor)
        same = [index for index, clip in enumerate(clips) if clip.shape == shape]
        for group in (same[first : first + batch] for first in range(0, len(same), batch)):
            filled = group + group[-1:] * (batch - len(group))
            latents = np.asarray(encode_pictures(codec, np.stack([clips[index] for index in filled])))
            encoded |= dict(zip(group, latents, strict=False))
    return [encoded[index] for index in range(len(clips))]

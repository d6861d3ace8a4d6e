"""Encoding episodes into the latent cache: threads read or render pixels ahead, the codec encodes in batches."""

import functools
import sys
import threading
from collections.abc import Callable, Sequence

import jax
import numpy as np
from tqdm import tqdm

from xew.compilation import keep_compiled_programs
from xew.concurrency import map_in_order, map_in_processes, usable_cores, visible_gpus
from xew.dataset import Episode
from xew.episode import Record
from xew.model.cache.clips import cut_clip, needed_pixels, read_streams
from xew.model.cache.store import LatentCache
from xew.model.codecs.contract import Codec, encode_pictures
from xew.model.video.pixels import PixelSource, stored_pixels

ENCODERS = 3
"""Number of episodes that one process encodes at once on an accelerator, to overlap copies and computation."""
CORES_PER_PROCESS = 8
"""Number of cores for each process: its threads keep about six busy, limited by Python's lock."""
GROUP = 16
"""Number of episodes in a process's work item."""


def default_processes() -> int:
    """Number of processes that use this machine fully; one on a CPU, where it already uses all cores."""
    return 1 if jax.default_backend() == "cpu" else max(len(jax.local_devices()), usable_cores() // CORES_PER_PROCESS)


def encode_episodes(
    cache: LatentCache,
    episodes: Sequence[Episode],
    source: PixelSource = stored_pixels,
    batch: int = 4,
    processes: int = 1,
) -> int:
    """Encode the missing streams of episodes, `batch` clips at once, and return the number of bytes written.

    Several processes share the episodes, each with its own threads and codec; they are assigned to the GPUs in turn.
    """
    pending = [episode for episode in episodes if cache.missing(episode[1])]
    if processes > 1:
        groups = [pending[first : first + GROUP] for first in range(0, len(pending), GROUP)]
        opener = functools.partial(_open_encoder, cache, source, batch, processes)
        sizes, counts = map_in_processes(opener, groups, processes, (__name__,), visible_gpus()), list(map(len, groups))
    else:
        sizes, counts = map_in_order(_Encoder(cache, source, batch).encode, pending), [1] * len(pending)
    written, done = 0, len(episodes) - len(pending)
    with tqdm(total=len(episodes), initial=done, desc="encode", unit="episode", file=sys.stderr) as progress:
        for size, count in zip(sizes, counts, strict=True):
            written += size
            progress.update(count)
    return written


class _Encoder:
    """Encodes episodes in the threads of one process; a semaphore limits concurrent use of the codec."""

    def __init__(self, cache: LatentCache, source: PixelSource, batch: int, processes: int = 1) -> None:
        self.cache, self.source, self.batch = cache, source, batch
        self._threads = -(-usable_cores() // processes)
        self._turns = threading.BoundedSemaphore(ENCODERS if processes == 1 and jax.default_backend() != "cpu" else 1)

    def encode(self, episode: Episode) -> int:
        """Encode the missing streams of one episode; returns the number of bytes written."""
        missing, inputs = self.cache.missing(episode[1]), self.cache.encoding.inputs
        pixels = self.source(*episode, needed_pixels(inputs.conditions, missing))
        videos = read_streams(inputs.conditions, inputs.clip, *episode, missing, pixels)
        with self._turns:
            return _encode_streams(self.cache, episode[1], videos, self.batch)

    def encode_group(self, episodes: Sequence[Episode]) -> int:
        """Encode episodes in parallel; returns the number of bytes written."""
        return sum(map_in_order(self.encode, episodes, self._threads))


def _open_encoder(cache: LatentCache, source: PixelSource, batch: int, processes: int) -> Callable[[Sequence[Episode]], int]:
    keep_compiled_programs()
    return _Encoder(cache, source, batch, processes).encode_group


def _encode_streams(cache: LatentCache, record: Record, videos: dict[str, np.ndarray], batch: int) -> int:
    """Encode streams of one episode and write each."""
    inputs, pieces = cache.encoding.inputs, {}
    for name, video in videos.items():
        condition = cache.streams[name]
        starts = cache.starts(record) if condition is None or condition.aligned else (0,)
        pieces[name] = [cut_clip(condition, video, start, inputs.clip.frames, inputs.history) for start in starts]
    pictures = [piece for clips in pieces.values() for clip in clips for piece in clip if piece.dtype == np.uint8]
    encoded = iter(encode_many(cache.codec, pictures, batch))
    written = 0
    for name, clips in pieces.items():
        arrays = [np.concatenate([next(encoded) if p.dtype == np.uint8 else p for p in clip]) for clip in clips]
        written += cache.write(record, name, np.stack(arrays))
    return written


def encode_many(codec: Codec, clips: Sequence[np.ndarray], batch: int) -> list[np.ndarray]:
    """Encode clips [t h w 3] uint8 to latents [t' h' w' c] float32, `batch` of equal shape at once."""
    encoded: dict[int, np.ndarray] = {}
    for shape in sorted({clip.shape for clip in clips}):
        same = [index for index, clip in enumerate(clips) if clip.shape == shape]
        for group in (same[first : first + batch] for first in range(0, len(same), batch)):
            filled = group + group[-1:] * (batch - len(group))
            latents = np.asarray(encode_pictures(codec, np.stack([clips[index] for index in filled])))
            encoded |= dict(zip(group, latents, strict=False))
    return [encoded[index] for index in range(len(clips))]

"""Encoding episodes into the latent cache: threads or processes read, render and cut ahead, the codec encodes in batches."""

import functools
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event

import jax
import numpy as np
from tqdm import tqdm

from xew.compilation import keep_compiled_programs
from xew.concurrency import map_in_order, prepare_processes, usable_cores, visible_gpus
from xew.dataset import Episode
from xew.episode import Record
from xew.model.cache.clips import clip_starts, cut_clip, needed_pixels, read_streams
from xew.model.cache.store import LatentCache
from xew.model.codecs.contract import Codec, encode_pictures
from xew.model.devices.parts import EPISODES_OF_READER, RENDERERS, choose_readers, read_ahead, run_on_gpus
from xew.model.settings.parts import ClipInputs
from xew.model.video.pixels import PixelSource, stored_pixels

ENCODERS = 4
"""Number of episodes that one process encodes at once on an accelerator, to overlap copies, computation and writing."""
MOST_READERS = 16
"""Largest number of processes that read for a GPU."""
BUSY_CORES = 2
"""Number of cores that a GPU's own process keeps busy."""
IMPORTED = (__name__, *RENDERERS)
"""Modules that the processes need."""

Missing = tuple[Episode, list[str]]
"""An episode, and its streams that are not encoded yet."""
Pieces = dict[str, list[list[np.ndarray]]]
"""Pieces of each clip of each stream: uint8 [t h w 3] to encode and join, or numbers float32 [t n]."""


@dataclass(frozen=True)
class Cutter:
    """Reads or renders episodes and cuts their streams into clips; threads and processes may call it."""

    inputs: ClipInputs
    source: PixelSource

    def cut(self, missing: Missing) -> tuple[Record, Pieces]:
        """The clips of the missing streams of an episode."""
        (folder, record), streams = missing
        inputs = self.inputs
        pixels = self.source(folder, record, needed_pixels(inputs.conditions, streams))
        videos = read_streams(inputs.conditions, inputs.clip, folder, record, streams, pixels)
        return record, {name: self._cut_stream(record, name, video) for name, video in videos.items()}

    def _cut_stream(self, record: Record, name: str, video: np.ndarray) -> list[list[np.ndarray]]:
        inputs, condition = self.inputs, self.inputs.conditions.get(name)
        aligned = condition is None or condition.aligned
        starts = clip_starts(record.frame_count, inputs.clip.frames, inputs.chunks) if aligned else (0,)
        return [cut_clip(condition, video, start, inputs.clip.frames, inputs.history) for start in starts]


@dataclass(frozen=True)
class _Encoder:
    """Encodes episodes in one process."""

    cache: LatentCache
    source: PixelSource
    batch: int

    def encode(self, pending: Sequence[Missing], readers: int) -> Iterator[int]:
        """Encode episodes and write them; yields the number of bytes of each. Processes read, or threads if there are none."""
        cutter, turns = Cutter(self.cache.encoding.inputs, self.source), threading.BoundedSemaphore(_encoders())

        def encode(record: Record, pieces: Pieces) -> int:
            with turns:
                return _encode_pieces(self.cache, record, pieces, self.batch)

        if not readers:
            return map_in_order(lambda missing: encode(*cutter.cut(missing)), pending)
        cut = read_ahead(cutter.cut, pending, processes=readers, imported=(__name__,))
        return map_in_order(lambda episode: encode(*episode), cut, _encoders())


def encode_episodes(
    cache: LatentCache,
    episodes: Sequence[Episode],
    source: PixelSource = stored_pixels,
    batch: int = 4,
    processes: int = 1,
) -> int:
    """Encode the missing streams of episodes, `batch` clips at once, and return the number of bytes written.

    Args:
        cache: where they are written.
        episodes: to encode; several GPUs share them.
        source: of their pixels; for processes it must support pickle.
        batch: number of clips.
        processes: number of processes that read for each GPU or for the CPU; 1 for threads, 0 to choose by the machine.
    """
    streams = [(episode, cache.missing(episode[1])) for episode in episodes]
    pending = sorted((missing for missing in streams if missing[1]), key=_frames, reverse=True)
    gpus = visible_gpus() if processes != 1 and jax.default_backend() == "gpu" else ()
    written, encoder = 0, _Encoder(cache, source, batch)
    with tqdm(total=len(episodes), initial=len(episodes) - len(pending), desc="encode", unit="episode", file=sys.stderr) as bar:

        def count(size: int) -> None:
            nonlocal written
            written += size
            bar.update()

        if len(gpus) > 1 and len(pending) > 1:
            run_on_gpus(functools.partial(_open_part, encoder, processes, len(gpus)), pending, gpus, count, IMPORTED)
        else:
            for size in encoder.encode(pending, count_readers(processes, len(pending), 1)):
                count(size)
    return written


def prepare_for_gpus() -> None:
    """Let the processes that a machine with GPUs needs import their modules while this one starts."""
    if visible_gpus():
        prepare_processes(IMPORTED)


def _open_part(
    encoder: _Encoder, processes: int, gpus: int, results: SimpleQueue, stop: Event
) -> Callable[[Sequence[Missing]], object]:
    keep_compiled_programs()
    prepare_processes(IMPORTED)  # while this process finds its GPU

    def encode_part(pending: Sequence[Missing]) -> None:
        for size in encoder.encode(pending, count_readers(processes, len(pending), gpus)):
            results.put(size)
            if stop.is_set():
                return

    return encode_part


def count_readers(processes: int, episodes: int, gpus: int) -> int:
    """Number of processes that read for one of some GPUs, or for the CPU; 0 for threads."""
    if processes:
        return processes if processes > 1 else 0
    return choose_readers(episodes, min(MOST_READERS, usable_cores() // gpus - BUSY_CORES, episodes // EPISODES_OF_READER))


def _frames(missing: Missing) -> int:
    return missing[0][1].frame_count


def _encoders() -> int:
    return 1 if jax.default_backend() == "cpu" else ENCODERS


def _encode_pieces(cache: LatentCache, record: Record, pieces: Pieces, batch: int) -> int:
    """Encode the pieces of one episode, and write each stream."""
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

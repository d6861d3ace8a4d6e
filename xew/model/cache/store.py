"""The latent cache on disk: one file for each stream of each episode, written once and read clip by clip."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from xew.config import ConfigError
from xew.episode import Record
from xew.files import demand_regular, replacing
from xew.model.cache.clips import clip_starts
from xew.model.cache.keys import stream_path
from xew.model.codecs.codec import RUN_CODEC, RUN_REMEDY, load_kept_codec
from xew.model.codecs.contract import Codec
from xew.model.conditions import Condition
from xew.model.settings.parts import Encoding
from xew.names import path_below

CLIPS = "clips"
"""Name of the array in a cached stream's file; safetensors, because NumPy cannot parse .npy headers in parallel threads."""


@dataclass(frozen=True)
class LatentCache:
    """Encoded streams of an experiment's episodes."""

    encoding: Encoding
    codec: Codec

    @property
    def streams(self) -> dict[str, Condition | None]:
        """The streams of an experiment: rgb (no condition) and its conditions."""
        return {"rgb": None} | dict(self.encoding.inputs.conditions)

    def path(self, record: Record, stream: str) -> Path:
        """The file of one stream of one episode."""
        return stream_path(self.encoding, self.codec.hash, record, stream)

    def starts(self, record: Record) -> tuple[int, ...]:
        """First frames of the clips of an episode."""
        inputs = self.encoding.inputs
        return clip_starts(record.frame_count, inputs.clip.frames, inputs.chunks)

    def read(self, record: Record, stream: str, clip: int) -> np.ndarray:
        """Read one clip of a stream: latents [t h w c] float16 or numbers [t n] float32; unaligned streams have one clip.

        Raises:
            ConfigError: it was never encoded, or from other data, codec or clips.
        """
        path = self.path(record, stream)
        try:
            with safe_open(demand_regular(path), framework="np") as stored:
                clips = stored.get_slice(CLIPS)
                self._check_shape(record, stream, clips.get_shape())
                return clips[min(clip, clips.get_shape()[0] - 1)]
        except FileNotFoundError:
            stale = list(path.parent.glob(f"{path.stem.rpartition('-')[0]}-*.safetensors"))
            fault = "was encoded from other data, with another codec or other clips" if stale else "is not in the cache"
            raise ConfigError(f"{path.parent}: the stream {stream} {fault}; {self.encoding.remedy}.") from None
        except (OSError, SafetensorError, ValueError) as error:
            raise ConfigError(f"{path} is damaged ({error}); delete it and {self.encoding.remedy}.") from error

    def _check_shape(self, record: Record, stream: str, shape: list[int]) -> None:
        """Raise ValueError unless a file of a stream has the clips of the episode and the shape of the network's input."""
        condition, (frames, *frame) = self.streams[stream], self.encoding.inputs.shapes[stream]
        if condition is None or condition.aligned:
            expected = [len(self.starts(record)), frames, *frame]
        else:  # one clip, whose number of frames is the condition's own
            expected = [1, *shape[1:2], *frame]
        if shape != expected:
            raise ValueError(f"its shape is {shape}, expected {expected}")

    def write(self, record: Record, stream: str, clips: np.ndarray) -> int:
        """Write all clips of a stream atomically, and return their size in bytes.

        Args:
            clips: latents [clips t h w c], stored as float16, or numbers [clips t n], stored as float32.

        Raises:
            EpisodeError: a link leads out of the cache.
        """
        clips = clips.astype(np.float32 if clips.ndim == 3 else np.float16)
        path = self.path(record, stream)
        path_below(self.encoding.folder, *path.relative_to(self.encoding.folder).parts)
        with replacing(path, within=self.encoding.folder) as temporary:
            save_file({CLIPS: clips}, temporary)
        return clips.nbytes

    def missing(self, record: Record) -> list[str]:
        """Streams of an episode that are not encoded yet."""
        return [name for name in self.streams if not self.path(record, name).exists()]


def open_cache(encoding: Encoding) -> LatentCache:
    """Open the cache with its codec. Raises ConfigError as `load_codec`."""
    return LatentCache(encoding, load_codec(encoding))


def load_codec(encoding: Encoding) -> Codec:
    """The codec of an encoding. Raises ConfigError if its weights are missing, damaged or of another kind."""
    if encoding.start_from is None:
        return encoding.kind.open(encoding.codec)
    return load_kept_codec(encoding.kind, encoding.start_from / RUN_CODEC, RUN_REMEDY)

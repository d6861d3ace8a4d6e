"""Codecs of the graded models: true video through a codec gives the noise floor of its model.

The metrics import nothing of the model: OPENER names the function that opens a run's codec. True video through a codec is
graded like a prediction, as the baseline CODEC_TRUTH, once for each codec and episode. All models with that codec share it.
"""

import hashlib
import importlib
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from xew.config import ConfigError
from xew.rollout import CODEC, Rollout

OPENER = "xew.model.runs.roundtrip:open_roundtrip"
"""Function of a run's folder that opens its codec."""


class Roundtrip(Protocol):
    """True video through a codec and back."""

    @property
    def model(self) -> str:
        """Name of the model whose codec it is, as its rollouts name it."""

    @property
    def digest(self) -> str:
        """Text that changes whenever the video would; rollouts that were made with the codec may hold it (CODEC)."""

    def coded_length(self, frames: int) -> int:
        """Number of frames of the shortest video with the compiled programs of a video of `frames` frames, at least 2."""

    def compile(self, frames: int) -> None:
        """Compile the programs for videos of a `coded_length`."""

    def __call__(self, video: np.ndarray, episode: Path) -> np.ndarray:
        """Video [t h w 3] uint8 of the episode in a folder to what the codec leaves of it.

        Decoders that are given what a rollout is given read it from the folder.
        """


@dataclass(frozen=True)
class ModelCodec:
    """A codec, by the name that score tables give it."""

    roundtrip: Roundtrip = field(compare=False, repr=False)
    digest: str
    run: Path = field(compare=False)
    """Folder of a run with this codec."""
    _turn: threading.Lock = field(default_factory=threading.Lock, compare=False, repr=False)

    @property
    def key(self) -> str:
        """Condition of its rows in score tables; two models with one codec share them."""
        return f"codec {hashlib.sha256(self.digest.encode()).hexdigest()[:8]}"

    def reconstruct(self, episode: Path, video: np.ndarray) -> np.ndarray:
        """What the codec leaves of an episode's video [t h w 3] uint8; in one thread at a time, since some take much memory."""
        with self._turn:
            return self.roundtrip(video, episode)


def open_codec(run: Path) -> Roundtrip:
    """The codec of the run in a folder. Raises ConfigError where there is none."""
    module, _, name = OPENER.partition(":")
    roundtrip: Roundtrip = getattr(importlib.import_module(module), name)(run)
    return roundtrip


def open_codecs(runs: Sequence[Path]) -> dict[str, ModelCodec]:
    """The codecs of runs by the name of their model; runs with one codec share it.

    Raises:
        ConfigError: a run cannot be opened, or two runs are of one model.
    """
    codecs: dict[str, ModelCodec] = {}
    by_digest: dict[str, ModelCodec] = {}
    for run in runs:
        roundtrip = open_codec(run)
        if roundtrip.model in codecs:
            raise ConfigError(f"--codec names two runs of {roundtrip.model!r}, the second is {run}; name one.")
        codecs[roundtrip.model] = by_digest.setdefault(roundtrip.digest, ModelCodec(roundtrip, roundtrip.digest, run))
    return codecs


def match_codecs(codecs: Mapping[str, ModelCodec], rollouts: Sequence[Rollout]) -> dict[str, ModelCodec]:
    """The codecs that made rollouts, by the name of the graded model.

    A rollout's header has the digest of its codec. Rollouts that do not have it belong to the codec of the run of their name.

    Args:
        codecs: by the name of the runs' model.
        rollouts: all that are graded.

    Raises:
        ConfigError: a codec made no rollout, or two of them made rollouts of one model.
    """
    by_digest = {codec.digest: codec for codec in codecs.values()}
    matched: dict[str, ModelCodec] = {}
    for rollout in rollouts:
        digest = rollout.header.get(CODEC)
        codec = by_digest.get(digest) if isinstance(digest, str) else codecs.get(rollout.model)
        if codec is not None and matched.setdefault(rollout.model, codec) != codec:
            raise ConfigError(f"rollouts of {rollout.model!r} were made with two codecs of --codec; make them again with one.")
    for model, codec in codecs.items():
        if codec not in matched.values():
            raise ConfigError(
                f"--codec {codec.run} is the run of {model!r}, and no graded rollout was made with its codec; graded are "
                f"{', '.join(sorted({rollout.model for rollout in rollouts}))}. Name the runs that these rollouts were made by."
            )
    return matched

"""Codecs of the graded models: true video through a codec gives the noise floor of its model.

The metrics import nothing of the model: OPENER names the function that opens a run's codec. True video through a codec is
graded like a prediction, as the baseline CODEC_TRUTH, once for each codec and episode.
"""

import hashlib
import importlib
import threading
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from xew.config import ConfigError

OPENER = "xew.model.runs.roundtrip:open_roundtrip"
"""Function of a run's folder that opens its codec."""


class Roundtrip(Protocol):
    """True video through a codec and back."""

    @property
    def model(self) -> str:
        """Name of the model whose codec it is, as its rollouts name it."""

    @property
    def digest(self) -> str:
        """Text that changes whenever the video would."""

    def __call__(self, video: np.ndarray, episode: Path) -> np.ndarray:
        """Video [t h w 3] uint8 of the episode in a folder to what the codec leaves of it.

        Decoders that are given what a rollout is given read it from the folder.
        """


@dataclass(frozen=True)
class ModelCodec:
    """A codec, by the name that score tables give it."""

    roundtrip: Roundtrip = field(compare=False, repr=False)
    digest: str
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


def open_codecs(runs: Sequence[Path], models: Collection[str] | None = None) -> dict[str, ModelCodec]:
    """The codecs of runs by the name of their model.

    Args:
        runs: folders of the runs.
        models: names of the graded models; None admits any.

    Raises:
        ConfigError: a run cannot be opened or is of a model that is not graded, or two runs are of one model.
    """
    codecs: dict[str, ModelCodec] = {}
    for run in runs:
        roundtrip = open_codec(run)
        if models is not None and roundtrip.model not in models:
            raise ConfigError(
                f"--codec {run} is the run of {roundtrip.model!r}, of which no rollout is graded; graded are "
                f"{', '.join(sorted(models))}. Name the runs that these rollouts were made by."
            )
        if roundtrip.model in codecs:
            raise ConfigError(f"--codec names two runs of {roundtrip.model!r}, the second is {run}; name one.")
        codecs[roundtrip.model] = ModelCodec(roundtrip, roundtrip.digest)
    return codecs

"""Reconstruction of video by a run's codec, the ceiling of a model with this codec."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xew.model.cache.store import load_codec
from xew.model.codecs.contract import Codec
from xew.model.experiment import Experiment, load_experiment
from xew.model.runs.folder import load_run
from xew.model.video.frames import to_camera_size, to_model_size

LENGTH_BLOCK = 24
"""Number of frames after the first in a piece; a multiple of four."""


@dataclass(frozen=True)
class RunRoundtrip:
    """The codec of a run, at the size of its clips."""

    experiment: Experiment
    codec: Codec

    @property
    def model(self) -> str:
        """Name of the model in its rollouts."""
        return self.experiment.out.name

    @property
    def digest(self) -> str:
        """Identifier of the codec and its picture size."""
        return f"{self.codec.hash} {self.experiment.clip.height}x{self.experiment.clip.width}"

    def __call__(self, video: np.ndarray) -> np.ndarray:
        """Reconstruct a video [t h w 3] uint8 of any length: [t h w 3] uint8.

        Videos are padded to a multiple of LENGTH_BLOCK frames after the first, to share compiled programs. A codec of
        independent groups takes LENGTH_BLOCK frames at a time.
        """
        clip = self.experiment.clip
        padded = np.concatenate([video, np.repeat(video[-1:], -(len(video) - 1) % LENGTH_BLOCK, axis=0)])
        small = to_model_size(padded, clip.height, clip.width)
        first, later = small[:1], small[1:]
        ends = range(LENGTH_BLOCK, len(later), LENGTH_BLOCK) if self.codec.groups_independent else ()
        pieces = [np.concatenate([first, piece]) for piece in np.split(later, ends)]
        coded = [self.codec.decode(self.codec.encode(piece)) for piece in pieces]
        return to_camera_size(np.concatenate([coded[0][:1], *(piece[1:] for piece in coded)])[: len(video)])


def open_roundtrip(run: Path) -> RunRoundtrip:
    """The roundtrip of a run's codec, or of a config's. Raises ConfigError if the run or its codec is missing."""
    if run.suffix != ".yaml":
        return RunRoundtrip(*load_run(run))
    experiment = load_experiment(run)
    return RunRoundtrip(experiment, load_codec(experiment.encoding))

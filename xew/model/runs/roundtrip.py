"""Video through a run's codec and back: the most that a model with this codec can reach."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xew.model.cache.store import load_codec
from xew.model.codecs.contract import Codec
from xew.model.experiment import Experiment, load_experiment
from xew.model.runs.folder import load_run
from xew.model.video.frames import to_camera_size, to_model_size

LENGTH_BLOCK = 24
"""Number of frames behind the first that a piece has, or that a video is filled up to multiples of: groups of four, as codecs
take them."""


@dataclass(frozen=True)
class RunRoundtrip:
    """The codec of a run, at the size of its clips."""

    experiment: Experiment
    codec: Codec

    @property
    def model(self) -> str:
        """Name of the model, as its rollouts name it."""
        return self.experiment.out.name

    @property
    def digest(self) -> str:
        """Text that changes whenever the video would: the codec and the size at which it works."""
        return f"{self.codec.hash} {self.experiment.clip.height}x{self.experiment.clip.width}"

    def __call__(self, video: np.ndarray) -> np.ndarray:
        """Video [t h w 3] uint8 to what the codec leaves of it, [t h w 3] uint8.

        Videos of all lengths share compiled programs. They are filled up to a multiple of LENGTH_BLOCK frames behind the first,
        which changes no frame before; a codec of independent groups takes so many at a time.
        """
        clip = self.experiment.clip
        filled = np.concatenate([video, np.repeat(video[-1:], -(len(video) - 1) % LENGTH_BLOCK, axis=0)])
        small = to_model_size(filled, clip.height, clip.width)
        first, later = small[:1], small[1:]
        ends = range(LENGTH_BLOCK, len(later), LENGTH_BLOCK) if self.codec.groups_independent else ()
        pieces = [np.concatenate([first, piece]) for piece in np.split(later, ends)]
        coded = [self.codec.decode(self.codec.encode(piece)) for piece in pieces]
        return to_camera_size(np.concatenate([coded[0][:1], *(piece[1:] for piece in coded)])[: len(video)])


def open_roundtrip(run: Path) -> RunRoundtrip:
    """The codec of a run, or of the config of one that has not been trained, as a function of video to video.

    Raises:
        ConfigError: there is no such run, or it has lost its codec; of a config, see `load_codec`.
    """
    if run.suffix != ".yaml":
        return RunRoundtrip(*load_run(run))
    experiment = load_experiment(run)
    return RunRoundtrip(experiment, load_codec(experiment.encoding))

"""Reconstruction of video by a run's codec, the ceiling of a model with this codec."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xew.episode import read_record
from xew.model.cache.clips import codec_digest, gives_render
from xew.model.cache.store import load_codec
from xew.model.codecs.contract import Codec, given_frames
from xew.model.conditions import shown_scene, shows_carried
from xew.model.episodes.commands import episode_command
from xew.model.experiment import Experiment, load_experiment
from xew.model.runs.folder import load_run
from xew.model.video.frames import picture_size, to_camera_size, to_model_size

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
        """Identifier of the codec, its picture size and what its decoder is given, as in the headers of rollouts."""
        return codec_digest(self.codec, self.experiment.clip, self.experiment.conditions)

    @property
    def sees_render(self) -> bool:
        """Whether the model's decoder is given the commanded robot's render."""
        return gives_render(self.codec, self.experiment.conditions)

    def coded_length(self, frames: int) -> int:
        """Number of frames of the shortest video with the compiled programs of a video of `frames` frames, at least 2."""
        return 1 + LENGTH_BLOCK * (1 if self.codec.groups_independent else -(-(frames - 1) // LENGTH_BLOCK))

    def compile(self, frames: int) -> None:
        """Compile the programs for videos of a `coded_length`, with black pictures."""
        clip, conditions = self.experiment.clip, self.experiment.conditions.values()
        black = np.zeros((frames, clip.height, clip.width, 3), np.uint8)
        given = (black, black if shows_carried(conditions) else black[:1]) if self.sees_render else None
        self._code(black, given, 0, frames - 1)

    def __call__(self, video: np.ndarray, episode: Path | None = None) -> np.ndarray:
        """Reconstruct a video [t h w 3] uint8 of any length: [t h w 3] uint8.

        Videos are padded to a multiple of LENGTH_BLOCK frames after the first, to share compiled programs. A codec of
        independent groups takes LENGTH_BLOCK frames at a time.

        Args:
            video: of the episode.
            episode: its folder, from which the render and the scene are read if `sees_render`.
        """
        clip = self.experiment.clip
        padded = np.concatenate([video, np.repeat(video[-1:], -(len(video) - 1) % LENGTH_BLOCK, axis=0)])
        small = to_model_size(padded, clip.height, clip.width)
        block = LENGTH_BLOCK if self.codec.groups_independent else len(small) - 1
        given = self._read_given(episode) if episode is not None and self.sees_render else None
        coded = [self._code(small, given, start, block) for start in range(0, max(len(small) - 1, 1), max(block, 1))]
        joined = np.concatenate([coded[0][:1], *(piece[1:] for piece in coded)])
        return to_camera_size(joined[: len(video)], picture_size(video))

    def _read_given(self, episode: Path) -> tuple[np.ndarray, np.ndarray]:
        """Render [t h w 3] and scene [t h w 3] or [1 h w 3] of an episode, uint8 at the model's size."""
        command = episode_command(episode, read_record(episode))
        videos = command.render, shown_scene(self.experiment.conditions.values(), command)
        render, scene = (to_model_size(video, self.experiment.clip.height, self.experiment.clip.width) for video in videos)
        return render, scene

    def _code(self, video: np.ndarray, given: tuple[np.ndarray, np.ndarray] | None, start: int, block: int) -> np.ndarray:
        """Code frame 0 and `block` frames [t h w 3] after frame `start`: [block+1 h w 3]."""
        pictures = None if given is None else given_frames(*given, start, block + 1)
        piece = np.concatenate([video[:1], video[start + 1 : start + 1 + block]])
        return self.codec.decode(self.codec.encode(piece), pictures)


def open_roundtrip(run: Path) -> RunRoundtrip:
    """The roundtrip of a run's codec, or of a config's. Raises ConfigError if the run or its codec is missing."""
    if run.suffix != ".yaml":
        return RunRoundtrip(*load_run(run))
    experiment = load_experiment(run)
    return RunRoundtrip(experiment, load_codec(experiment.encoding))

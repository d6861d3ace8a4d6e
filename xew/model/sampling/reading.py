"""Reading what a rollout is given of its episodes: first frame, conditions, and the pictures of decoders that use them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from xew.dataset import Episode
from xew.episode import Record, read_pixels
from xew.model.cache.clips import needed_pixels, read_streams
from xew.model.conditions import Command, Condition, shown_scene
from xew.model.devices.parts import RENDERERS, read_ahead
from xew.model.episodes.commands import episode_command
from xew.model.settings.settings import Clip
from xew.model.video.frames import to_model_size
from xew.model.video.pixels import stored_pixels

FIRST = "first frame"
RENDER = "render"
SCENE = "scene"
Streams = dict[str, np.ndarray]
"""Inputs of one whole episode by stream: uint8 [t h w 3] or float32 [t n]; with FIRST and, for some decoders, RENDER, SCENE."""
EpisodeInputs = tuple[Record, Streams]
"""An episode that was read."""
IMPORTED = (__name__, *RENDERERS)
"""Modules that processes that read need."""


@dataclass(frozen=True)
class EpisodeReader:
    """Reads the inputs of whole episodes."""

    conditions: Mapping[str, Condition]
    clip: Clip
    gives_render: bool
    """Whether the decoder is given the render and the scene (`clips.gives_render`)."""

    def read(self, episode: Episode) -> EpisodeInputs:
        """Read the first frame of an episode and its conditions; threads may call it."""
        folder, record = episode
        pixels = stored_pixels(folder, record, needed_pixels(self.conditions, self._names))
        first = read_pixels(folder, "rgb", most=1, record=record)
        return self.make(episode, episode_command(folder, record, pixels.get("robot"), first), first)

    def make(self, episode: Episode, command: Command, first: np.ndarray) -> EpisodeInputs:
        """The inputs of an episode with its first frame [1 h w 3] uint8 under a command, not necessarily the recorded one."""
        (folder, record), clip = episode, self.clip
        given = {FIRST: first}
        if self.gives_render:
            given |= {RENDER: command.render, SCENE: shown_scene(self.conditions.values(), command)}
        resized = {name: to_model_size(video, clip.height, clip.width) for name, video in given.items()}
        return record, resized | read_streams(self.conditions, clip, folder, record, self._names, {}, command)

    @property
    def _names(self) -> list[str]:
        """Streams of conditions that are made from commands."""
        return [name for name, condition in self.conditions.items() if condition.make is not None]

    def read_ahead(
        self, episodes: Sequence[Episode], threads: int | None = None, processes: int = 0
    ) -> Iterator[EpisodeInputs]:
        """Inputs of episodes in their order, read ahead in threads, by default one a core, or in processes if there are any."""
        return read_ahead(self.read, episodes, threads, processes, (__name__,))

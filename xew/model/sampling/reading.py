"""Reading what a rollout is given of its episodes: first frame, conditions, and the pictures of decoders that use them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from xew.dataset import Episode
from xew.episode import Record, read_pixels
from xew.model.cache.clips import needed_pixels, read_streams
from xew.model.conditions import Condition, shows_carried
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
        (folder, record), clip = episode, self.clip
        names = [name for name, condition in self.conditions.items() if condition.make is not None]
        pixels = stored_pixels(folder, record, needed_pixels(self.conditions, names))
        given = {FIRST: read_pixels(folder, "rgb", most=1, record=record)}
        command = episode_command(folder, record, pixels.get("robot"), given[FIRST])
        if self.gives_render:
            scene = command.carried_scene if shows_carried(self.conditions.values()) else given[FIRST]
            given |= {RENDER: pixels["robot"], SCENE: scene}
        resized = {name: to_model_size(video, clip.height, clip.width) for name, video in given.items()}
        return record, resized | read_streams(self.conditions, clip, folder, record, names, pixels, command)

    def read_ahead(
        self, episodes: Sequence[Episode], threads: int | None = None, processes: int = 0
    ) -> Iterator[EpisodeInputs]:
        """Inputs of episodes in their order, read ahead in threads, by default one a core, or in processes if there are any."""
        return read_ahead(self.read, episodes, threads, processes, (__name__,))

"""The commands of an episode, the input of conditions: as recorded, or new ones in its scene."""

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from xew.config import ConfigError
from xew.episode import Record, States, read_states
from xew.model.conditions import Command, make_command


def episode_command(
    folder: Path, record: Record, rendered: np.ndarray | None = None, scene: np.ndarray | None = None
) -> Command:
    """Read the command of an episode.

    Args:
        folder: of the episode.
        record: of the episode.
        rendered: [t 240 320 3] uint8, the robot alone, if in memory; otherwise its video is read when needed.
        scene: [n 240 320 3] uint8, the first frames of the episode's video, if in memory; conditions see one alone.
    """
    return make_command(folder, record, read_states(folder, record), rendered, scene)


class NewCommand(Command):
    """A command that no data set holds; its render is made when a condition asks for it."""

    @cached_property
    def render(self) -> np.ndarray:
        """The robot-only video [t h w 3] uint8."""
        from xew.sim_warp.rendering.streams import command_renders

        return command_renders([(self.robot_spec, self.action)], self.camera)[0]


def new_command(folder: Path, record: Record, states: States, action: np.ndarray, first: np.ndarray) -> NewCommand:
    """The command that gives other actions in the scene of an episode.

    Args:
        folder, record, states: of the episode.
        action: [t 16] float32 canonical commands, from frame 0 on.
        first: [1 h w 3] uint8, first frame.

    Raises:
        ConfigError: the episode is of a tiled view.
    """
    if record.camera.parts:
        raise ConfigError(f"{folder} is of a tiled view, which takes recorded commands only; choose a model of one view.")
    return NewCommand(**vars(make_command(folder, record, replace(states, action=action), scene=first)))

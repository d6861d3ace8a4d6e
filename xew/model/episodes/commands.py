"""The commands of an episode, the input of conditions: as recorded, or new ones in its scene."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xew.config import ConfigError
from xew.episode import Record, States, read_states
from xew.model.conditions import Command, make_command

if TYPE_CHECKING:
    from xew.sim_warp.geometry.camera import Camera
    from xew.sim_warp.rendering.streams import CommandStreams

Pictures = tuple[np.ndarray, ...]
"""Pictures [t h w ...] of the same frames."""


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


@dataclass(frozen=True)
class NewCommand(Command):
    """A command that no data set holds; its pictures are rendered when a condition asks for them."""

    rendered_before: dict[str, Pictures] = field(default_factory=dict)
    """Pictures of the same commands up to an earlier frame, by name; those of later frames are added."""

    @cached_property
    def render(self) -> np.ndarray:
        """The robot-only video [t h w 3] uint8."""
        from xew.sim_warp.rendering.streams import command_renders

        def make(action: np.ndarray, camera: "Camera") -> Pictures:
            return (command_renders([(self.robot_spec, action)], camera, self.table)[0],)

        return self._fill_up("render", make)[0]

    @cached_property
    def streams(self) -> "CommandStreams":
        """Mask and optical flow of the commands."""
        from xew.sim_warp.rendering.streams import CommandStreams, command_streams

        def make(action: np.ndarray, camera: "Camera") -> Pictures:
            made = command_streams(self.robot_spec, action, camera, self.table, colors=False)
            return made.mask, made.optical_flow

        return CommandStreams(np.empty(0), *self._fill_up("streams", make))

    @cached_property
    def shadows(self) -> np.ndarray:
        """The robot's shadows under three lamps [t h w 3] uint8."""
        return self._fill_up("shadows", lambda action, camera: (self.draw_shadows(action, camera),))[0]

    def _fill_up(self, name: str, make: Callable[[np.ndarray, "Camera"], Pictures]) -> Pictures:
        """Pictures of all commands, of which `make` renders those that were not rendered before.

        The last known frame is rendered again: its optical flow is the motion to the next frame.
        """
        known = self.rendered_before.get(name)
        start = len(known[0]) - 1 if known else 0
        if known is None or start + 1 < len(self.action):
            moves = self.extrinsics.ndim == 3
            camera = replace(self.camera, extrinsics=self.extrinsics[start:]) if moves else self.camera
            later = make(self.action[start:], camera)
            known = tuple(np.concatenate([old[:start], new]) for old, new in zip(known or later, later, strict=True))
            self.rendered_before[name] = known
        return known


def new_command(
    folder: Path,
    record: Record,
    states: States,
    action: np.ndarray,
    first: np.ndarray,
    rendered_before: dict[str, Pictures] | None = None,
) -> NewCommand:
    """The command that gives other actions in the scene of an episode.

    Args:
        folder, record, states: of the episode.
        action: [t 16] float32 canonical commands, from frame 0 on.
        first: [1 h w 3] uint8, first frame.
        rendered_before: as of `NewCommand`, shared by commands that continue each other.

    Raises:
        ConfigError: the episode is of a tiled view.
    """
    if record.camera.parts:
        raise ConfigError(f"{folder} is of a tiled view, which takes recorded commands only; choose a model of one view.")
    command = make_command(folder, record, replace(states, action=action), scene=first)
    return NewCommand(**vars(command), rendered_before={} if rendered_before is None else rendered_before)

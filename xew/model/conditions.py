"""What the model is told of a robot's motion (ACTIONS) and looks (CONDITIONS), made from commands alone.

Reads  a `Command`: which robot, its commanded joints, the camera, and the robot-only render of those commands
Writes uint8 [t h w 3] pictures for the codec, or float32 [t 16] numbers
To add one: a function of a Command and one line in ACTIONS or CONDITIONS; from outside the repo, `module:NAME` of a
`Condition`.

A Command holds nothing that was measured or seen in the scene, so that no condition can show the future.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from xew.episode import Record, States, read_video

if TYPE_CHECKING:
    from xew.sim_warp.camera import Camera
    from xew.sim_warp.streams import CommandStreams


@dataclass(frozen=True)
class Command:
    """Everything a condition may be made from."""

    robot: str
    action: np.ndarray
    """[t 16] float32, commanded joints."""
    intrinsics: np.ndarray
    """[3 3] head camera's K."""
    extrinsics: np.ndarray
    """[4 4] world to camera."""
    render_path: Path
    """The stored robot-only video, posed by `action` on a white ground."""

    @cached_property
    def render(self) -> np.ndarray:
        """uint8 [t h w 3], the stored robot-only video."""
        return read_video(self.render_path)

    @cached_property
    def streams(self) -> "CommandStreams":
        """Render, mask and optical flow of the commands; Warp is imported when first asked for."""
        from xew.sim_warp.streams import command_streams

        return command_streams(self.robot, self.action, self.camera)

    @property
    def camera(self) -> "Camera":
        """The simulator's own camera object."""
        from xew.sim_warp.camera import Camera

        return Camera(self.intrinsics, self.extrinsics)


@dataclass(frozen=True)
class Condition:
    """One kind of condition and the stream of the network that it feeds."""

    name: str
    """Also its name in the latent cache."""
    stream: Literal["action", "embodiment", "joints"]
    make: Callable[[Command], np.ndarray]
    """uint8 [t h w 3], or float32 [t 16] for the stream joints."""
    aligned: bool = True
    """One frame for each frame of the episode; else a short description (4 k + 1 frames) that every chunk reuses."""


def command_of(folder: Path, record: Record, states: States) -> Command:
    """The part of an episode that conditions may see."""
    return Command(record.robot, states.action, states.intrinsics, states.extrinsics, folder / "robot.mkv")


def joints(command: Command) -> np.ndarray:
    """The canonical 16 commanded joint positions and grippers of every frame."""
    return command.action


def robot_render(command: Command) -> np.ndarray:
    """The robot alone at every frame."""
    return command.render


def robot_mask(command: Command) -> np.ndarray:
    """The robot's silhouette at every frame, white on black."""
    return np.repeat(command.streams.mask[..., None], 3, axis=-1).astype(np.uint8) * 255


def optical_flow(command: Command) -> np.ndarray:
    """The robot's exact motion as a colour wheel; white where nothing moves."""
    from xew.sim_warp.streams import flow_to_rgb

    return flow_to_rgb(command.streams.optical_flow)


def ray_map(command: Command) -> np.ndarray:
    """The commanded tool frames drawn into the image."""
    from xew.sim_warp import streams

    return streams.ray_map(command.robot, command.action, command.camera)


def reference_image(command: Command) -> np.ndarray:
    """One front view of the robot at home."""
    from xew.sim_warp import streams

    return streams.reference_image(command.robot)[None]


def nine_views(command: Command) -> np.ndarray:
    """The robot at home from nine sides."""
    from xew.sim_warp import streams

    return streams.nine_views(command.robot)


def articulation_clip(command: Command) -> np.ndarray:
    """A clip of the robot that moves all its joints."""
    from xew.sim_warp import streams

    return streams.articulation_clip(command.robot)


ACTIONS: dict[str, Condition | None] = {
    "none": None,
    "optical_flow": Condition("optical_flow", "action", optical_flow),
    "mask": Condition("mask", "action", robot_mask),
    "ray_map": Condition("ray_map", "action", ray_map),
    "joints": Condition("joints", "joints", joints),
}
CONDITIONS: dict[str, Condition | None] = {
    "none": None,
    "reference_image": Condition("reference_image", "embodiment", reference_image, aligned=False),
    "nine_views": Condition("nine_views", "embodiment", nine_views, aligned=False),
    "articulation_clip": Condition("articulation_clip", "embodiment", articulation_clip, aligned=False),
    "robot_render": Condition("robot_render", "embodiment", robot_render),
}

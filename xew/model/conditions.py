"""What the model is told of a robot's motion (ACTIONS) and looks (CONDITIONS), made from commands alone.

Reads  a `Command`: which robot, its commanded joints, the camera, and the robot-only render of those commands
Writes uint8 [t h w 3] pictures for the codec, or float32 [t n] numbers
To add one: a function of a Command and one line in ACTIONS or CONDITIONS; from outside the repo, `module:NAME` of a
`Condition`, or of a tuple of them. The last entries of ACTIONS are the paper's other systems: each is a combination of
mechanisms (mechanisms.py) in the same network.

A Command holds nothing that was measured or seen in the scene, so that no condition can show the future.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from xew.episode import Record, States, data_folder, read_video
from xew.model.network.mechanisms import GROUP
from xew.protocol import ARMS

if TYPE_CHECKING:
    from xew.sim_warp.embodiment.spec import RobotSpec
    from xew.sim_warp.geometry.camera import Camera
    from xew.sim_warp.rendering.streams import CommandStreams


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
    rendered: np.ndarray | None = None
    """The same [t h w 3] uint8, where it is at hand."""
    data: Path | None = None
    """Data set of the episode, which keeps robots of a user's own."""

    @cached_property
    def render(self) -> np.ndarray:
        """uint8 [t h w 3], the robot-only video."""
        return read_video(self.render_path) if self.rendered is None else self.rendered

    @cached_property
    def streams(self) -> "CommandStreams":
        """Render, mask and optical flow of the commands; Warp is imported when first asked for."""
        from xew.sim_warp.rendering.streams import command_streams

        return command_streams(self.robot_spec, self.action, self.camera)

    @cached_property
    def tools(self) -> np.ndarray:
        """float64 [t 2 7], commanded world poses of the left and right tool, x y z w quaternions, by forward kinematics."""
        from xew.sim_warp.kinematics.forward import tool_poses

        return tool_poses(self.robot_spec, self.action)

    @cached_property
    def robot_spec(self) -> "RobotSpec":
        """The simulator's description of the robot: of the registry, or kept beside the data."""
        from xew.sim_warp.robots import get_robot

        return get_robot(self.robot, self.data)

    @property
    def camera(self) -> "Camera":
        """The simulator's own camera object."""
        from xew.sim_warp.geometry.camera import Camera

        return Camera(self.intrinsics, self.extrinsics)


def unchanged(numbers: np.ndarray) -> np.ndarray:
    """Numbers as they are."""
    return numbers


@dataclass(frozen=True)
class Condition:
    """One kind of condition and where it enters the network."""

    name: str
    """Also its name in the latent cache."""
    stream: str
    """A stream of the network (`dit.STREAMS`) or a mechanism (`mechanisms.MECHANISMS`)."""
    make: Callable[[Command], np.ndarray] | None
    """uint8 [t h w 3], or float32 [t n]. None is the scene's own earlier frames, which no command knows."""
    aligned: bool = True
    """One frame for each frame of the episode; else a short description (4 k + 1 frames) that every chunk reuses."""
    change: Callable[[np.ndarray], np.ndarray] = unchanged
    """Numbers of the frames of a clip [t n] -> what is told of them [t n], in which later frames change nothing."""
    group: bool = False
    """A latent frame is told the numbers of its four frames [t' 4*n], else those of its last [t' n]."""
    scale: Literal["none", "percentiles", "standard"] = "none"
    """How numbers are brought to a common size by those of the training episodes (scales.py)."""
    with_history: bool = False
    """Earlier frames (`model.history`) are told theirs too, before the clip's."""


def clip_numbers(condition: Condition, numbers: np.ndarray, start: int, frames: int, history: Sequence[int] = ()) -> np.ndarray:
    """What is told of one clip: float32 [rows n].

    Args:
        numbers: of the whole episode [t n]; before its start and past its end the nearest frame counts.
        start, frames: of the clip.
        history: earlier frames, counted from the clip's first.
    """

    def told(frames: np.ndarray) -> np.ndarray:
        return condition.change(numbers[np.clip(frames, 0, len(numbers) - 1)]).astype(np.float32)

    rows = told(np.arange(start, start + frames))
    if condition.group:
        rows = np.concatenate([rows[:1].repeat(GROUP - 1, 0), rows]).reshape(-1, GROUP * rows.shape[1])
    else:
        rows = rows[::GROUP]
    return np.concatenate([told(start + np.asarray(history)), rows]) if condition.with_history and len(history) else rows


def command_of(folder: Path, record: Record, states: States, rendered: np.ndarray | None = None) -> Command:
    """The part of an episode that conditions may see."""
    data = data_folder(folder)
    return Command(record.robot, states.action, states.intrinsics, states.extrinsics, folder / "robot.mkv", rendered, data)


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
    """The robot's exact motion as a color wheel; white where nothing moves."""
    from xew.sim_warp.rendering.streams import flow_to_rgb

    return flow_to_rgb(command.streams.optical_flow)


def ray_map(command: Command) -> np.ndarray:
    """The commanded tool frames drawn into the image."""
    from xew.sim_warp.rendering import streams

    return streams.ray_map(command.robot_spec, command.action, command.camera)


def reference_image(command: Command) -> np.ndarray:
    """One front view of the robot at home."""
    from xew.sim_warp.rendering import streams

    return streams.reference_image(command.robot_spec)[None]


def nine_views(command: Command) -> np.ndarray:
    """The robot at home from nine sides."""
    from xew.sim_warp.rendering import streams

    return streams.nine_views(command.robot_spec)


def articulation_clip(command: Command) -> np.ndarray:
    """A clip of the robot that moves all its joints."""
    from xew.sim_warp.rendering import streams

    return streams.articulation_clip(command.robot_spec)


POINTING_DOWN = Rotation.from_matrix([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])
"""A tool frame whose approach (x) points to the ground and whose y axis points to the left, as at home: its z axis points
away from the robot, so that yaw is the heading."""


def tool_poses(command: Command) -> np.ndarray:
    """Commanded position [m], roll, pitch, yaw [rad] and gripper of both tools, world frame: float32 [t 14].

    The angles are those of the turn from `POINTING_DOWN`, where tools mostly are: there none of them jumps.
    """
    sides = []
    for pose, (_, gripper) in zip(command.tools.swapaxes(0, 1), ARMS, strict=True):
        angles = (Rotation.from_quat(pose[:, 3:]) * POINTING_DOWN.inv()).as_euler("xyz")
        sides += [pose[:, :3], angles, command.action[:, gripper, None]]
    return np.concatenate(sides, axis=1).astype(np.float32)


def camera(command: Command) -> np.ndarray:
    """The camera's 16 numbers (`mechanisms.CAMERA`) at every frame: float32 [t 16]."""
    k, rotation, offset = command.intrinsics, command.extrinsics[:3, :3], command.extrinsics[:3, 3]
    numbers = np.concatenate([[k[0, 0], k[1, 1], k[0, 2], k[1, 2]], rotation.ravel(), -rotation.T @ offset])
    return np.tile(numbers.astype(np.float32), (len(command.action), 1))


RELATIVE_SCALE = 20.0
"""IRASim's factor on relative positions [m] and angles [rad]."""


def relative_tool_poses(poses: np.ndarray) -> np.ndarray:
    """IRASim's actions [t 14] of tool poses [t 14]: the motion since the frame before, in that frame's tool frame, times 20.

    Grippers stay as they are. The first frame has no motion.
    """
    before, sides = np.concatenate([poses[:1], poses[:-1]]), []
    for side in (slice(0, 7), slice(7, 14)):
        now, then = poses[:, side], before[:, side]
        turned, was = (Rotation.from_euler("xyz", poses[:, 3:6]) * POINTING_DOWN for poses in (now, then))
        moved = was.inv().apply(now[:, :3] - then[:, :3])
        angles = (was.inv() * turned).as_euler("xyz")
        sides += [RELATIVE_SCALE * moved, RELATIVE_SCALE * angles, now[:, 6:]]
    return np.concatenate(sides, axis=1)


def tool_deltas(poses: np.ndarray) -> np.ndarray:
    """EnerVerse-AC's actions [t 14] of tool poses [t 14]: the change of position and angles in the world, and the gripper."""
    delta = np.diff(poses, axis=0, prepend=poses[:1])
    angles = [column for side in (0, 7) for column in range(side + 3, side + 6)]
    delta[:, angles] = (delta[:, angles] + np.pi) % (2 * np.pi) - np.pi
    delta[:, [6, 13]] = poses[:, [6, 13]]
    return delta


System = tuple[Condition, ...]
"""Conditions that belong together."""
ACTIONS: dict[str, Condition | System | None] = {
    "none": None,
    "optical_flow": Condition("optical_flow", "action", optical_flow),
    "mask": Condition("mask", "action", robot_mask),
    "ray_map": Condition("ray_map", "action", ray_map),
    "joints": Condition("joints", "joints", joints),
    "irasim": (Condition("relative_tool_poses", "relative_time", tool_poses, change=relative_tool_poses, group=True),),
    "ctrl_world": (Condition("tool_poses", "pose_frame", tool_poses, scale="percentiles", with_history=True),),
    "enerverse_ac": (
        Condition("ray_map", "map_channels", ray_map),
        Condition("camera", "ray_channels", camera),
        Condition("tool_deltas", "pooled_context", tool_poses, change=tool_deltas, group=True, scale="standard"),
    ),
    "bwm": (
        Condition("grouped_tool_poses", "pose_time", tool_poses, group=True, scale="percentiles"),
        Condition("grouped_tool_poses", "pose_context", tool_poses, group=True, scale="percentiles"),
    ),
}
CONDITIONS: dict[str, Condition | None] = {
    "none": None,
    "reference_image": Condition("reference_image", "embodiment", reference_image, aligned=False),
    "nine_views": Condition("nine_views", "embodiment", nine_views, aligned=False),
    "articulation_clip": Condition("articulation_clip", "embodiment", articulation_clip, aligned=False),
    "robot_render": Condition("robot_render", "embodiment", robot_render),
}
HISTORY = Condition("history", "history", None)
"""Earlier frames of the scene, sparse, each encoded alone (`model.history`): recorded ones in training, predicted ones in a
rollout."""

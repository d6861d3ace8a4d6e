"""Conditions of the model: a robot's motion (ACTIONS) and appearance (CONDITIONS), made from commands alone.

Reads  a `Command`: robot, commanded joints, camera, the robot-only render of those commands, and the scene's first frame
Writes uint8 [t h w 3] pictures for the codec, or float32 [t n] numbers
To add one: a function of a Command and one line in ACTIONS or CONDITIONS; from outside the repo, `module:NAME` of a
`Condition` or of a tuple of them. Entries in _channels join a picture to the video's channels; it has no tokens of its own.

Tables and figures take titles and labels from here, so this file imports neither JAX nor Warp. The last entries of ACTIONS are
other systems of the paper, as combinations of mechanisms (network/mechanisms.py) in the same network. A Command holds no
measurement and no frame of the scene after the first, so no condition can show the future.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt8
from scipy.spatial.transform import Rotation

from xew.config import ConfigError
from xew.dataset import is_stale, view_episode
from xew.episode import EpisodeError, Record, States, data_folder, read_pixels, read_record, read_states
from xew.model.video.frames import TEMPORAL_FACTOR
from xew.protocol import ARMS, CAMERA_SIZE, parse_change

if TYPE_CHECKING:
    import xew.sim_warp.embodiment.spec
    import xew.sim_warp.geometry.camera
    import xew.sim_warp.rendering.streams

Video = UInt8[np.ndarray, "t h w 3"]
Poses = Float[np.ndarray, "t 14"]
"""Position [m, world], roll, pitch, yaw [rad] and gripper of the left tool, then of the right."""


@dataclass(frozen=True)
class Command:
    """The input of a condition."""

    robot: str
    action: Float[np.ndarray, "t 16"]
    """Commanded joints [t 16] float32, in the canonical layout."""
    intrinsics: Float[np.ndarray, "3 3"]
    """Matrix K [3 3] of the camera [pixels]."""
    extrinsics: Float[np.ndarray, "*t 4 4"]
    """Matrix [4 4] from the world to the camera's frame, or [t 4 4] of a camera that the commands move."""
    render_path: Path
    """Path of the robot-only video, posed by `action` on white."""
    rendered: Video | None = None
    """The same video [t h w 3] uint8, if it is in memory."""
    data: Path | None = None
    """Data set of the episode, which may hold custom robots."""
    read_first: Callable[[], Video] | None = None
    """Function that reads the first frame of the scene [1 h w 3] uint8."""
    size: tuple[int, int] = CAMERA_SIZE
    """Width and height of the camera's picture [pixels]."""
    table: float | None = None
    """Height of the table [m] that hides what lies behind it, as of `Record.table`."""
    parts: tuple["Command", ...] = ()
    """The same commands in each view of a tiled picture, from top to bottom."""
    change: str = ""
    """The scene's change, as of `Record.change`."""

    @cached_property
    def render(self) -> Video:
        """The robot-only video [t h w 3] uint8."""
        return read_pixels(self.render_path.parent, self.render_path.stem) if self.rendered is None else self.rendered

    @cached_property
    def streams(self) -> "xew.sim_warp.rendering.streams.CommandStreams":
        """Mask and optical flow of the commands; imports Warp."""
        from xew.sim_warp.rendering.streams import CommandStreams, command_streams

        if self.parts:
            names = ("mask", "optical_flow")
            return CommandStreams(
                self.render, *(np.concatenate([getattr(part.streams, name) for part in self.parts], axis=1) for name in names)
            )
        return command_streams(self.robot_spec, self.action, self.camera, self.table, colors=False)

    @cached_property
    def shadows(self) -> Video:
        """The robot's shadows on the bare table under three standard lamps [t h w 3] uint8; imports Warp."""
        if self.parts:
            return np.concatenate([part.shadows for part in self.parts], axis=1)
        return self.draw_shadows(self.action, self.camera)

    def draw_shadows(self, action: Float[np.ndarray, "t 16"], camera: "xew.sim_warp.geometry.camera.Camera") -> Video:
        """The shadows of other commands [t 16] before another camera, on the table of this scene: [t h w 3] uint8."""
        from xew.sim_warp.changes.looks import stage_of
        from xew.sim_warp.rendering.streams import three_shadows

        return three_shadows(self.robot_spec, action, camera, stage_of(parse_change(self.change)).raised)

    @cached_property
    def tools(self) -> Float[np.ndarray, "t 2 7"]:
        """Commanded poses [t 2 7] float64 of the left and right tool in the world: position [m], quaternion x y z w."""
        from xew.sim_warp.kinematics.forward import tool_poses

        return tool_poses(self.robot_spec, self.action)

    @cached_property
    def carried_scene(self) -> Video:
        """The scene without the robot, where closed grippers carry objects of the first frame: [t h w 3] uint8."""
        from xew.model.video.carried_scene import View, carry

        if self.parts or self.extrinsics.ndim == 3:
            raise ConfigError(
                "carried_render needs one camera that stands still, and this view is tiled or moves with the robot; use "
                "--model.embodiment pasted_render or robot_render."
            )
        assert self.read_first is not None
        grippers = self.action[:, [gripper for _, gripper in ARMS]]
        return carry(self.read_first()[0], self.render, self.tools, grippers, View(self.intrinsics, self.extrinsics))

    @cached_property
    def robot_spec(self) -> "xew.sim_warp.embodiment.spec.RobotSpec":
        """The simulator's robot, from the registry or stored with the data."""
        from xew.sim_warp.robots import recorded_robot

        return recorded_robot(self.robot, self.data)

    @property
    def camera(self) -> "xew.sim_warp.geometry.camera.Camera":
        """The simulator's camera."""
        from xew.sim_warp.geometry.camera import Camera

        return Camera(self.intrinsics, self.extrinsics, *self.size)


def keep_numbers(numbers: Shaped[np.ndarray, "t n"]) -> Shaped[np.ndarray, "t n"]:
    """Numbers [t n] as they are."""
    return numbers


@dataclass(frozen=True)
class Condition:
    """One condition and its place in the network."""

    name: str
    """Unique name in the latent cache."""
    stream: str
    """A stream of the network (`dit.STREAMS`) or a mechanism (`mechanisms.MECHANISMS`)."""
    make: Callable[[Command], np.ndarray] | None
    """Function that makes uint8 [t h w 3] or float32 [t n]; None for earlier frames of the scene."""
    aligned: bool = True
    """Whether it has one frame for each frame of the episode. Otherwise it has 4 k + 1 frames that every chunk reuses."""
    change: Callable[[np.ndarray], np.ndarray] = keep_numbers
    """Causal transform of the numbers of a clip's frames [t n] -> [t n]."""
    group: bool = False
    """Whether a latent frame gets the numbers of its four frames [t' 4*n], or of its last frame [t' n]."""
    scale: Literal["none", "percentiles", "standard"] = "none"
    """Normalization of numbers by the training episodes (cache/scales.py)."""
    with_history: bool = False
    """Whether numbers of the earlier frames (`model.history`) precede the clip's."""
    is_guess: bool = False
    """Whether it is a first guess of the video, from which residuals (`model.prediction`) are predicted."""
    title: str = ""
    """Name in tables and figures."""
    label: str = ""
    """Short description of the network's input."""


@dataclass(frozen=True)
class System:
    """A combination of conditions, at most one for each stream or mechanism."""

    conditions: tuple[Condition, ...]
    title: str
    label: str

    def __iter__(self) -> Iterator[Condition]:
        return iter(self.conditions)


def list_conditions(entry: Condition | System | Sequence[Condition]) -> tuple[Condition, ...]:
    """The conditions of a registry entry or of a user's object."""
    return (entry,) if isinstance(entry, Condition) else tuple(entry)


def clip_numbers(
    condition: Condition, numbers: Shaped[np.ndarray, "t n"], start: int, frames: int, history: Sequence[int] = ()
) -> Float32[np.ndarray, "latent_frames numbers"]:
    """Numbers of one clip for the network: [t' n], or grouped [t' 4*n], float32, a row for each latent frame.

    Rows of earlier frames come first if the condition has them (`with_history`).

    Args:
        condition: grouping, transform and history.
        numbers: [t n] of the whole episode; its first and last frame are repeated beyond its ends.
        start: first frame of the clip.
        frames: number of its frames, 4 k + 1.
        history: earlier frames, relative to the clip's first.
    """

    def take_frames(frames: np.ndarray) -> np.ndarray:
        return condition.change(numbers[np.clip(frames, 0, len(numbers) - 1)]).astype(np.float32)

    clip = take_frames(np.arange(start, start + frames))
    if condition.group:
        clip = np.concatenate([clip[:1].repeat(TEMPORAL_FACTOR - 1, 0), clip]).reshape(-1, TEMPORAL_FACTOR * clip.shape[1])
    else:
        clip = clip[::TEMPORAL_FACTOR]
    if not condition.with_history or not len(history):
        return clip
    return np.concatenate([take_frames(start + np.asarray(history)), clip])


def make_command(
    folder: Path,
    record: Record,
    states: States,
    rendered: Video | None = None,
    scene: UInt8[np.ndarray, "n h w 3"] | None = None,
) -> Command:
    """The command of an episode; videos [t h w 3] and [n h w 3] as in `episodes.commands.episode_command`.

    Raises:
        EpisodeError: the episode is of a view that was rendered when no table hid the robot.
    """
    render, data = folder / "robot.mkv", data_folder(folder)
    if is_stale(record):
        raise EpisodeError(
            f"{folder} was rendered by an earlier xew, where no table hides the robot; run `inspect DATA --render --cameras …` "
            "(with --tile for a tiled view) or the import again."
        )
    first = partial(read_pixels, folder, "rgb", most=1, record=record) if scene is None else partial(np.copy, scene[:1])
    extrinsics = _move_camera(record, states, data) if record.camera.moves else states.extrinsics
    size = states.robot_mask.shape[2], states.robot_mask.shape[1]
    parts = tuple(_part_command(view_episode(folder, part)) for part in record.camera.parts)
    return Command(
        record.robot,
        states.action,
        states.intrinsics,
        extrinsics,
        render,
        rendered,
        data,
        first,
        size,
        table=record.table,
        parts=parts,
        change=record.change,
    )


def _part_command(folder: Path) -> Command:
    """The command of a view that is part of a tiled picture. Raises EpisodeError if it is tiled itself."""
    record = read_record(folder)
    if record.camera.parts:
        raise EpisodeError(f"{folder} is part of a tiled view and is tiled itself; delete it, or tile other views.")
    return make_command(folder, record, read_states(folder, record))


def _move_camera(record: Record, states: States, data: Path) -> Float[np.ndarray, "t 4 4"]:
    """World to camera [t 4 4] as the commands move it: what was measured is not known in advance."""
    from xew.sim_warp.cameras import commanded_camera
    from xew.sim_warp.robots import recorded_robot

    return commanded_camera(record.camera, recorded_robot(record.robot, data), states).extrinsics


def joints(command: Command) -> Float[np.ndarray, "t 16"]:
    """Commanded joint positions [rad or m] and grippers of every frame, in the canonical layout: [t 16] float32."""
    return command.action


def robot_render(command: Command) -> Video:
    """The robot alone at every frame: [t h w 3] uint8."""
    return command.render


def pasted_render(command: Command) -> Video:
    """The robot alone at every frame, pasted into the first frame of the scene: [t h w 3] uint8, the no-learning baseline."""
    from xew.metrics.grading.baselines import paste_render

    assert command.read_first is not None
    return paste_render(command.read_first()[0], command.render)


def carried_render(command: Command) -> Video:
    """The robot alone at every frame, pasted into the scene in which its grippers carry objects: [t h w 3] uint8."""
    from xew.model.video.carried_scene import paste

    assert command.read_first is not None
    return paste(command.read_first()[0], command.carried_scene, command.render)


SHOW_RENDER = (robot_render, pasted_render, carried_render)
"""Conditions that hold the commanded robot's render."""


def shown_scene(conditions: Iterable[Condition], command: Command) -> Video:
    """The scene of a decoder: [t h w 3] uint8 with carried objects if a condition holds it, else its first frame."""
    assert command.read_first is not None
    return command.carried_scene if shows_carried(conditions) else command.read_first()


def shows_carried(conditions: Iterable[Condition]) -> bool:
    """Whether a condition holds the scene with carried objects."""
    return any(condition.make is carried_render for condition in conditions)


def robot_mask(command: Command) -> Video:
    """The robot's silhouette at every frame, white on black: [t h w 3] uint8."""
    mask = command.streams.mask
    rows = mask.reshape(-1, mask.shape[-1]).view(np.uint8) * 255  # all frames below each other, for one call of OpenCV
    return cv2.cvtColor(rows, cv2.COLOR_GRAY2RGB).reshape(*mask.shape, 3)


def optical_flow(command: Command) -> Video:
    """The robot's exact optical flow as colors, white where nothing moves: [t h w 3] uint8."""
    from xew.sim_warp.rendering.streams import flow_to_rgb

    return flow_to_rgb(command.streams.optical_flow)


def ray_map(command: Command) -> Video:
    """The commanded tool frames, drawn into the image: [t h w 3] uint8."""
    from xew.sim_warp.rendering import streams

    parts = command.parts or (command,)
    return np.concatenate([streams.ray_map(part.robot_spec, part.action, part.camera) for part in parts], axis=1)


def three_shadows(command: Command) -> Video:
    """The robot's shadows on the bare table under three standard lamps, red, green and blue: [t h w 3] uint8."""
    return command.shadows


def reference_image(command: Command) -> Video:
    """One front view of the robot at home: [1 h w 3] uint8."""
    from xew.sim_warp.rendering import streams

    return streams.reference_image(command.robot_spec)[None]


def nine_views(command: Command) -> Video:
    """The robot at home from nine sides: [9 h w 3] uint8."""
    from xew.sim_warp.rendering import streams

    return streams.nine_views(command.robot_spec)


def articulation_clip(command: Command) -> Video:
    """A clip of the robot that moves all its joints: [17 h w 3] uint8."""
    from xew.sim_warp.rendering import streams

    return streams.articulation_clip(command.robot_spec)


POINTING_DOWN = Rotation.from_matrix([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])
"""Tool frame at home: x points to the ground, y to the left, z away from the robot, so yaw is the heading."""


def tool_poses(command: Command) -> Poses:
    """Commanded position [m], roll, pitch, yaw [rad] and gripper of both tools, in the world: [t 14] float32.

    The angles are relative to `POINTING_DOWN`, near which none of them jumps.
    """
    sides = []
    for pose, (_, gripper) in zip(command.tools.swapaxes(0, 1), ARMS, strict=True):
        angles = (Rotation.from_quat(pose[:, 3:]) * POINTING_DOWN.inv()).as_euler("xyz")
        sides += [pose[:, :3], angles, command.action[:, gripper, None]]
    return np.concatenate(sides, axis=1).astype(np.float32)


def camera(command: Command) -> Float[np.ndarray, "t 16"]:
    """The camera's 16 numbers (`mechanisms.CAMERA`) at every frame, for 320x240 pixels: [t 16] float32."""
    if command.parts or command.size[0] * CAMERA_SIZE[1] != command.size[1] * CAMERA_SIZE[0]:
        raise ConfigError("the condition camera is of one picture of 4:3, such as 640x480; {}x{} is not.".format(*command.size))
    frames = len(command.action)
    scale = CAMERA_SIZE[0] / command.size[0]
    k = command.intrinsics * scale
    k[:2, 2] += (scale - 1) / 2  # (0, 0) is the center of a pixel
    extrinsics = np.broadcast_to(command.extrinsics, (frames, 4, 4))
    rotation, offset = extrinsics[:, :3, :3], extrinsics[:, :3, 3]
    lens = np.tile([k[0, 0], k[1, 1], k[0, 2], k[1, 2]], (frames, 1))
    position = -np.einsum("tji,tj->ti", rotation, offset)
    return np.concatenate([lens, rotation.reshape(frames, 9), position], axis=1).astype(np.float32)


RELATIVE_SCALE = 20.0
"""Factor of IRASim on relative positions [m] and angles [rad]."""


def relative_tool_poses(poses: Poses) -> Poses:
    """IRASim's actions: the motion since the previous frame, in that frame's tool frame, times 20.

    Poses [t 14] (see `Poses`) -> [t 14], positions [m / 20], angles [rad / 20] and unchanged grippers; frame 0 has no motion.
    """
    before, sides = np.concatenate([poses[:1], poses[:-1]]), []
    for side in (slice(0, 7), slice(7, 14)):
        now, then = poses[:, side], before[:, side]
        turned, was = (Rotation.from_euler("xyz", poses[:, 3:6]) * POINTING_DOWN for poses in (now, then))
        moved = was.inv().apply(now[:, :3] - then[:, :3])
        angles = (was.inv() * turned).as_euler("xyz")
        sides += [RELATIVE_SCALE * moved, RELATIVE_SCALE * angles, now[:, 6:]]
    return np.concatenate(sides, axis=1)


def tool_deltas(poses: Poses) -> Poses:
    """EnerVerse-AC's actions: the change of position and angles in the world since the previous frame, and the gripper.

    Poses [t 14] (see `Poses`) -> [t 14], positions [m] and angles [rad].
    """
    delta = np.diff(poses, axis=0, prepend=poses[:1])
    angles = [column for side in (0, 7) for column in range(side + 3, side + 6)]
    delta[:, angles] = (delta[:, angles] + np.pi) % (2 * np.pi) - np.pi
    delta[:, [6, 13]] = poses[:, [6, 13]]
    return delta


ACTIONS: dict[str, Condition | System] = {
    "none": System((), title="No action", label="nothing"),
    "optical_flow": Condition("optical_flow", "action", optical_flow, title="Optical flow", label="optical flow"),
    "mask": Condition("mask", "action", robot_mask, title="Mask", label="mask"),
    "ray_map": Condition("ray_map", "action", ray_map, title="Ray map", label="ray map"),
    "mask_channels": System(
        (Condition("mask", "mask_channels", robot_mask),), title="Mask as channels", label="mask as channels"
    ),
    "optical_flow_channels": System(
        (Condition("optical_flow", "flow_channels", optical_flow),),
        title="Optical flow as channels",
        label="optical flow as channels",
    ),
    "ray_map_channels": System(
        (Condition("ray_map", "map_channels", ray_map),), title="Ray map as channels", label="ray map as channels"
    ),
    "mask_and_flow_channels": System(
        (Condition("mask", "mask_channels", robot_mask), Condition("optical_flow", "flow_channels", optical_flow)),
        title="Mask and optical flow as channels",
        label="mask and optical flow as channels",
    ),
    "joints": Condition("joints", "joints", joints, title="Joint pose", label="joint pose"),
    "irasim": System(
        (Condition("relative_tool_poses", "relative_time", tool_poses, change=relative_tool_poses, group=True),),
        title="IRASim",
        label="relative tool poses",
    ),
    "ctrl_world": System(
        (Condition("tool_poses", "pose_frame", tool_poses, scale="percentiles", with_history=True),),
        title="Ctrl-World",
        label="absolute tool poses",
    ),
    "enerverse_ac": System(
        (
            Condition("ray_map", "map_channels", ray_map),
            Condition("camera", "ray_channels", camera),
            Condition("tool_deltas", "pooled_context", tool_poses, change=tool_deltas, group=True, scale="standard"),
        ),
        title="EnerVerse-AC",
        label="tool poses + ray maps",
    ),
    "bwm": System(
        (
            Condition("grouped_tool_poses", "pose_time", tool_poses, group=True, scale="percentiles"),
            Condition("grouped_tool_poses", "pose_context", tool_poses, group=True, scale="percentiles"),
        ),
        title="BWM",
        label="tool poses",
    ),
}
CARRIED_RENDER = Condition("carried_render", "map_channels", carried_render, is_guess=True)
CONDITIONS: dict[str, Condition | System] = {
    "none": System((), title="No description", label="flow only"),
    "reference_image": Condition(
        "reference_image",
        "embodiment",
        reference_image,
        aligned=False,
        title="Reference image",
        label="+ reference image",
    ),
    "nine_views": Condition("nine_views", "embodiment", nine_views, aligned=False, title="Nine views", label="+ nine views"),
    "articulation_clip": Condition(
        "articulation_clip",
        "embodiment",
        articulation_clip,
        aligned=False,
        title="Articulation clip",
        label="+ articulation clip",
    ),
    "robot_render": Condition("robot_render", "embodiment", robot_render, title="Per-frame render", label="per-frame render"),
    "robot_render_channels": System(
        (Condition("robot_render", "map_channels", robot_render),),
        title="Per-frame render as channels",
        label="per-frame render as channels",
    ),
    "pasted_render": System(
        (Condition("pasted_render", "map_channels", pasted_render, is_guess=True),),
        title="Per-frame render in the first frame",
        label="per-frame render pasted into the first frame",
    ),
    "carried_render": System(
        (CARRIED_RENDER,),
        title="Per-frame render in a scene with carried objects",
        label="per-frame render pasted into the first frame, with carried objects",
    ),
    "carried_render_and_shadows": System(
        (CARRIED_RENDER, Condition("three_shadows", "shadow_channels", three_shadows)),
        title="Per-frame render in a scene with carried objects, and its shadows",
        label="per-frame render pasted into the first frame, with carried objects, and its shadows",
    ),
}
HISTORY = Condition("history", "history", None, title="Earlier frames", label="earlier frames")
"""Sparse earlier frames of the scene (`model.history`), each encoded alone: recorded in training, predicted in a rollout."""

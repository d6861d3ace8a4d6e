"""Reader of RoboTwin's HDF5 files: `read_robotwin(path)` gives one episode in xew's conventions.

It reads the legacy layout (observation/, joint_action/, endpose/) and the layout of version 1.0 (vision/, state/), which
RoboDojo and other projects of XPolicyLab share. Its quaternions are w x y z. What a file does not say can be given by
`ReadOptions`.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from xew.episode import WIDTH, EpisodeError
from xew.exchange.pictures import Colors, read_pictures
from xew.files import demand_regular, parse_json, read_text
from xew.protocol import FRAME_RATE

TOOL_OFFSET = 0.12
"""Distance of RoboTwin's end pose behind the tool center point, along the approach [m], for all robots."""
STEPS_PER_SECOND = 250
"""Rate of RoboTwin's simulation [Hz]. The key `frequency` of its files is the number of steps between frames: 15."""
FREQUENCY = "additional_info/frequency"
"""Name of the frame rate: steps of RoboTwin's simulation between frames, in other projects' files frames per second."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera frame (y up, z backward) to OpenCV's (y down, z forward), and back."""
LARGEST_ARRAY = 16_000_000
"""Largest size of an array of numbers or texts [bytes]: two hours of 16 numbers at 16.67 Hz."""
LARGEST_GROWTH = 500
"""Largest ratio of the decoded or declared size of pictures to their file's size; a JPEG of one color grows 150 times."""
INSTRUCTIONS = ("seen", "unseen", "instructions", "instruction")
"""Keys of instructions in RoboTwin's JSON files; the first that holds a text is read."""
LARGEST_ANGLE = 4 * math.pi
"""Angle of a joint [rad] above which it is in degrees."""
GRIPPER_MARGIN = 0.1
"""Largest value by which a gripper's command leaves the range from 0 to 1."""
TABLE_CENTER = (0.0, 0.0, 0.74)
"""Point that every head camera sees, world frame [m]."""


@dataclass(frozen=True)
class OtherCamera:
    """What another camera than the head camera recorded."""

    rgb: np.ndarray
    """[t h w 3] uint8."""
    intrinsics: np.ndarray
    """[3 3] pixels, (0, 0) the center of the upper left one."""
    extrinsics: np.ndarray
    """[t 4 4] world to camera."""


@dataclass(frozen=True)
class Recorded:
    """One RoboTwin episode in xew's units, frames and orders."""

    layout: str
    """Layout of the file: "legacy" or "1.0"."""
    arms: np.ndarray
    """[t 2 d] drive targets of the left and right arm [rad]."""
    grippers: np.ndarray
    """[t 2] commanded, 0 closed to 1 open."""
    tool_pose: np.ndarray | None
    """[t 2 7] measured tool center points, world [m] and quaternion x y z w; None if the file has no end poses."""
    rgb: np.ndarray
    """[t h w 3] uint8, the head camera."""
    intrinsics: np.ndarray
    """[3 3] pixels, (0, 0) the center of the upper left one."""
    extrinsics: np.ndarray
    """[4 4] world to camera."""
    instruction: str
    """Instruction; empty if there is none."""
    frame_rate: float
    """Frames per second."""
    cameras: dict[str, OtherCamera]
    """Other cameras of the file, by xew's names."""


@dataclass(frozen=True)
class ReadOptions:
    """What a file does not say, or says wrongly; None reads it from the file."""

    frame_rate: float | None = None
    """Frames per second."""
    colors: Colors = "marked"
    """Encoding of the pictures."""
    instruction: str | None = None
    """The text; it may be empty."""


READ_ALL = ReadOptions()


@dataclass(frozen=True)
class Layout:
    """Names of the datasets of a layout; for arms, grippers and end poses left and right."""

    name: str
    arms: tuple[str, str]
    grippers: tuple[str, str]
    end_poses: tuple[str, str]
    pictures: str
    intrinsics: str
    extrinsics: tuple[str, ...]
    """Alternatives; the first that a file has is read."""
    cameras: dict[str, str]
    """Groups of the other cameras by xew's names; their datasets are named as the head camera's."""


LEGACY = Layout(
    "legacy",
    arms=("joint_action/left_arm", "joint_action/right_arm"),
    grippers=("joint_action/left_gripper", "joint_action/right_gripper"),
    end_poses=("endpose/left_endpose", "endpose/right_endpose"),
    pictures="observation/head_camera/rgb",
    intrinsics="observation/head_camera/intrinsic_cv",
    extrinsics=("observation/head_camera/extrinsic_cv", "observation/head_camera/cam2world_gl"),
    cameras={
        "wrist_left": "observation/left_camera",
        "wrist_right": "observation/right_camera",
        "front": "observation/front_camera",
    },
)
MODERN = Layout(
    "1.0",
    arms=("state/left_arm_joint_states", "state/right_arm_joint_states"),
    grippers=("state/left_ee_joint_states", "state/right_ee_joint_states"),
    end_poses=("state/left_ee_poses", "state/right_ee_poses"),
    pictures="vision/cam_head/colors",
    intrinsics="vision/cam_head/intrinsic_matrix",
    extrinsics=("vision/cam_head/extrinsic_matrix", "vision/cam_head/extrinsics_matrix"),
    cameras={
        "wrist_left": "vision/cam_left_wrist",
        "wrist_right": "vision/cam_right_wrist",
        "front": "vision/cam_third_view",
    },
)
"""Version 1.0: `state` is in force at a frame; `action` is the state of the next frame and is not read."""


FOREIGN = {
    "an episode of ALOHA or ACT": ("observations/qpos", "observations/images"),
    "demonstrations of robomimic or LIBERO": ("data/demo_0", "data/demo_1"),
}
"""Contents of other projects' HDF5 files, and datasets or groups of which one shows them."""


def read_robotwin(path: Path, options: ReadOptions = READ_ALL) -> Recorded:
    """Read an episode of either layout.

    Raises:
        EpisodeError: the file is not HDF5, truncated, incomplete or of another project, an array has a wrong shape, or the file
            does not say what an option must then say.
    """
    try:
        with h5py.File(demand_regular(path), "r") as file:
            demand_whole(path, file)
            reader = _Reader(path, file)
            return _read(reader, _find_layout(path, file), options)
    except EpisodeError:
        raise
    except BlockingIOError as error:
        raise EpisodeError(f"{path} is open in another program, which may still write it; close it there.") from error
    except Exception as error:  # h5py raises OSError, RuntimeError and others for damaged files
        raise EpisodeError(f"{path} cannot be read as HDF5 ({' '.join(str(error).split())}); copy it again.") from error


def demand_whole(path: Path, file: h5py.File) -> None:
    """Check, before reading, that a file holds all of its data itself.

    HDF5 can refer to other files by external links, external storage and virtual datasets, and its library would open any file
    of this machine.

    Raises:
        EpisodeError: the file refers to another file.
    """
    problems: list[str] = []

    def check(name: str, link: Any) -> None:
        if not isinstance(link, (h5py.HardLink, h5py.SoftLink)):
            problems.append(f"{name} is a link to another file")
            return
        stored = file[name] if isinstance(link, h5py.HardLink) else None
        if isinstance(stored, h5py.Dataset) and stored.is_virtual:
            problems.append(f"{name} is put together from other files (a virtual dataset)")
        elif isinstance(stored, h5py.Dataset) and stored.external:
            problems.append(f"{name} is stored in another file")

    file.visititems_links(check)
    if problems:
        raise EpisodeError(f"{path}: {problems[0]}; expected a file that holds all of its data itself.")


def _find_layout(path: Path, file: h5py.File) -> Layout:
    for content, names in FOREIGN.items():
        if any(name in file for name in names):
            raise EpisodeError(
                f"{path} holds {content}, expected an episode of RoboTwin; to train on both, convert it and xew's episodes "
                "to LeRobot's format, as docs/exchange.md says."
            )
    return MODERN if "state" in file else LEGACY


def _read(reader: "_Reader", layout: Layout, options: ReadOptions) -> Recorded:
    arms = [reader.numbers(name, 2) for name in layout.arms]
    grippers = [reader.column(name) for name in layout.grippers]
    poses = (
        [reader.numbers(name, 2) for name in layout.end_poses] if all(name in reader.file for name in layout.end_poses) else []
    )
    frames = len(arms[0])
    if not frames or any(len(array) != frames for array in (*arms, *grippers, *poses)):
        counts = ", ".join(str(len(array)) for array in (*arms, *grippers, *poses))
        raise reader.error(f"arms, grippers and end poses have {counts} frames", "as many of each, at least one")
    if arms[0].shape != arms[1].shape or arms[0].shape[1] not in (6, 7):
        raise reader.error(f"the arms have {arms[0].shape[1]} and {arms[1].shape[1]} joints", "six or seven each")
    if (angle := np.abs(arms).max()) > LARGEST_ANGLE:
        raise reader.error(f"the arms' joints reach {angle:.0f}", "radians")
    if np.min(grippers) < -GRIPPER_MARGIN or np.max(grippers) > 1 + GRIPPER_MARGIN:
        raise reader.error(f"the grippers go from {np.min(grippers):g} to {np.max(grippers):g}", "0 (closed) to 1 (open)")
    if any(pose.shape[1] != 7 for pose in poses):
        raise reader.error("the end poses have another shape", "[frames 7]")
    rgb, width = reader.pictures(layout.pictures, frames, options.colors)
    if any(np.abs(np.linalg.norm(pose[:, 3:], axis=1) - 1).max() > 0.01 for pose in poses):
        raise reader.error("the end poses hold quaternions that are not of length 1", "x y z and a unit quaternion w x y z")
    matrix = _intrinsics(reader, layout.intrinsics, width)
    extrinsics = next((name for name in layout.extrinsics if name in reader.file), layout.extrinsics[0])
    reading = _find_reading(reader, extrinsics)
    return Recorded(
        layout.name,
        np.stack(arms, 1),
        np.stack(grippers, 1),
        np.stack([tool_center(pose) for pose in poses], 1) if poses else None,
        rgb,
        matrix,
        _world_to_camera(reader.constant(extrinsics, None), reading),
        reader.instruction() if options.instruction is None else options.instruction,
        reader.frame_rate(layout) if options.frame_rate is None else options.frame_rate,
        _other_cameras(reader, layout, frames, options.colors, (extrinsics.rpartition("/")[2], reading)),
    )


def _intrinsics(reader: "_Reader", name: str, width: int) -> np.ndarray:
    """K [3 3] of pictures that had this width and were brought to `WIDTH`."""
    matrix = reader.constant(name, (3, 3))
    if min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise reader.error(f"{name} has the focal lengths {matrix[0, 0]:g} and {matrix[1, 1]:g}", "numbers of pixels over 0")
    return _center_pixels(matrix, width / WIDTH)


def _other_cameras(
    reader: "_Reader", layout: Layout, frames: int, colors: Colors, extrinsics: tuple[str, int]
) -> dict[str, OtherCamera]:
    """The other cameras of a file, whose extrinsics have the name and the reading of the head camera's."""
    pictures, intrinsics = (name.rpartition("/")[2] for name in (layout.pictures, layout.intrinsics))
    cameras, (name, reading) = {}, extrinsics
    for camera, group in layout.cameras.items():
        if f"{group}/{pictures}" not in reader.file:
            continue
        rgb, width = reader.pictures(f"{group}/{pictures}", frames, colors)
        stored = reader.matrices(f"{group}/{name}", None)
        if len(stored) not in (1, frames) or stored.shape[1:] not in ((3, 4), (4, 4)):
            raise reader.error(f"{group}/{name} has shape {stored.shape}", f"one matrix for each of {frames} frames")
        poses = np.stack([_world_to_camera(matrix, reading) for matrix in np.broadcast_to(stored, (frames, *stored.shape[1:]))])
        cameras[camera] = OtherCamera(rgb, _intrinsics(reader, f"{group}/{intrinsics}", width), poses)
    return cameras


def tool_center(end_pose: np.ndarray) -> np.ndarray:
    """Tool frames [t 7] (quaternion x y z w) at the tool center point, from RoboTwin's end poses [t 7] (w x y z)."""
    w, x, y, z = end_pose[:, 3:].T
    approach = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
    return np.concatenate([end_pose[:, :3] + TOOL_OFFSET * approach, end_pose[:, [4, 5, 6, 3]]], 1)


def _center_pixels(intrinsics: np.ndarray, scale: float) -> np.ndarray:
    """K [3 3] with the origin at the center of the first pixel; RoboTwin's origin is its upper left corner."""
    centered = intrinsics.copy()
    centered[:2] /= scale
    centered[:2, 2] -= 0.5
    return centered


def _world_to_camera(stored: np.ndarray, reading: int) -> np.ndarray:
    """World to camera [4 4] m, from a matrix [3 4] or [4 4] of either direction, in OpenCV's or OpenGL's frame (0 to 3)."""
    matrix = np.eye(4)
    matrix[:3] = stored[:3]
    direct = matrix if reading % 2 == 0 else np.linalg.inv(matrix)
    return direct if reading < 2 else OPENGL @ direct


def _find_reading(reader: "_Reader", name: str) -> int:
    """Number of the reading (`_world_to_camera`) of the head camera's matrix.

    Of the four readings, the camera must be above the table, see it, and face +y as the robot does. (The inverse of the head
    camera's matrix sees the table too, from the other side.)
    """
    stored = reader.constant(name, None)
    if stored.shape not in ((3, 4), (4, 4)):
        raise reader.error(f"{name} has shape {stored.shape}", "[3 4] or [4 4]")
    if not np.allclose(stored[:3, :3] @ stored[:3, :3].T, np.eye(3), atol=1e-3):
        raise reader.error(f"{name} holds no rotation", "a rigid transform between world and camera (z forward)")
    for reading in range(4):
        candidate = _world_to_camera(stored, reading)
        x, y, z, _ = candidate @ [*TABLE_CENTER, 1]
        height = -candidate[:3, 2] @ candidate[:3, 3]
        faces_ahead = candidate[2, 1] > 0
        if height > TABLE_CENTER[2] and faces_ahead and z > 0 and max(abs(x), abs(y)) < z:
            return reading
    raise reader.error(
        f"{name} does not see the table", "the head camera in OpenCV's frame (y down, z forward) or OpenGL's (y up)"
    )


@dataclass(frozen=True)
class _Reader:
    """Checked access to the arrays of a file."""

    path: Path
    file: h5py.File

    @property
    def size(self) -> int:
        """Size of the file [bytes]."""
        return self.path.stat().st_size

    def dataset(self, name: str, largest: int = LARGEST_ARRAY) -> h5py.Dataset:
        """A dataset of at most `largest` bytes, because one without stored data can declare any size."""
        dataset = self.file.get(name)
        if not isinstance(dataset, h5py.Dataset):
            known = ", ".join(sorted(self.file)) or "nothing"
            raise EpisodeError(
                f"{self.path} has no {name} (at its top: {known}); expected a RoboTwin episode of the legacy or the 1.0 layout."
            )
        declared = max(dataset.nbytes, math.prod(dataset.chunks or (0,)) * dataset.dtype.itemsize)  # a chunk is read whole
        if declared > largest:
            raise self.error(f"{name} declares {declared:,} bytes, of a file of {self.size:,}", f"at most {largest:,}")
        return dataset

    def numbers(self, name: str, dimensions: int) -> np.ndarray:
        """Finite numbers [...] float64 of a number of dimensions."""
        stored = self.dataset(name)
        if stored.ndim != dimensions or stored.dtype.kind not in "fiu":
            raise self.error(f"{name} is {stored.dtype} of shape {stored.shape}", f"numbers in {dimensions} dimensions")
        array = np.asarray(stored[()], np.float64)
        if not np.isfinite(array).all():
            raise self.error(f"{name} holds numbers that are not finite", "finite ones")
        return array

    def column(self, name: str) -> np.ndarray:
        """Numbers [t], stored as [t] or [t 1]."""
        array = self.numbers(name, 2 if self.dataset(name).ndim == 2 else 1)
        if array.ndim != 1 and array.shape[1:] != (1,):
            raise self.error(f"{name} has shape {array.shape}", "[frames 1]: a gripper of one number")
        return array.reshape(len(array))

    def frame_rate(self, layout: Layout) -> float:
        """Frames per second by `FREQUENCY`; RoboTwin's default rate without it."""
        counts_steps = layout is LEGACY or self.is_robotwin
        if FREQUENCY not in self.file:
            if not counts_steps:
                raise self.error(f"there is no {FREQUENCY}, and the file is not RoboTwin's", "--frame-rate HZ")
            return FRAME_RATE
        stored = self.numbers(FREQUENCY, self.dataset(FREQUENCY).ndim).reshape(-1)
        if len(stored) != 1 or not 1 <= stored[0] <= STEPS_PER_SECOND:
            raise self.error(f"{FREQUENCY} is {stored.tolist()}", f"one number from 1 to {STEPS_PER_SECOND}")
        number = float(stored[0])
        if not counts_steps and "instruction" not in self.file:
            raise self.error(
                f"{FREQUENCY} is {number:g}, which may count steps of {1000 / STEPS_PER_SECOND:g} ms between frames, or frames",
                f"--frame-rate {STEPS_PER_SECOND / number:g} or --frame-rate {number:g}",
            )
        return STEPS_PER_SECOND / number if counts_steps else number

    @property
    def is_robotwin(self) -> bool:
        """Whether RoboTwin's converter wrote the file: it says so, or has `instructions` where others have `instruction`."""
        return str(self.file.attrs.get("source_format")) == "RoboTwin" or "instructions" in self.file

    def constant(self, name: str, shape: tuple[int, ...] | None) -> np.ndarray:
        """A matrix [r c], stored once or equal for every frame."""
        stored = self.matrices(name, shape)
        if not np.allclose(stored, stored[0], atol=1e-4):
            raise self.error(f"{name} changes during the episode", "a camera that stands still")
        return stored[0]

    def matrices(self, name: str, shape: tuple[int, ...] | None) -> np.ndarray:
        """Matrices [n r c], stored once or for every frame."""
        stored = self.numbers(name, self.dataset(name).ndim)
        if stored.ndim not in (2, 3) or not len(stored) or (shape is not None and stored.shape[-2:] != shape):
            raise self.error(f"{name} has shape {stored.shape}", f"a matrix {list(shape or (4, 4))}, or one a frame")
        return stored.reshape(-1, *stored.shape[-2:])

    def pictures(self, name: str, frames: int, colors: Colors) -> tuple[np.ndarray, int]:
        """`read_pictures` of a dataset, if its header promises no more than the file can hold."""
        largest = max(LARGEST_GROWTH * self.size, LARGEST_ARRAY)
        stored = self.dataset(name, largest)
        if stored.ndim == 0 or len(stored) != frames:
            raise self.error(f"{name} has {stored.size} pictures", f"one for each of {frames} frames")
        if stored.dtype.itemsize > self.size:
            raise self.error(
                f"{name} promises pictures of {stored.dtype.itemsize:,} bytes", f"at most the file's {self.size:,}"
            )
        try:
            return read_pictures(stored, colors, largest)
        except ValueError as error:
            raise EpisodeError(f"{self.path}: {name} {error}.") from error

    def instruction(self) -> str:
        """The first instruction in the file, or in the episode's separate instruction file."""
        beside = f"instructions/{self.path.stem}.json"
        texts = [self.texts("instructions"), self.texts("instruction"), text_beside(self.path, beside)]
        for text in texts:
            if found := _first_instruction(text):
                return found
        raise self.error(
            "there is no text in its datasets instructions and instruction, nor in its file ../" + beside,
            "a text in one of them, or --instruction TEXT ('' for none)",
        )

    def texts(self, name: str) -> str:
        """The first text of a dataset; empty if there is none."""
        if name not in self.file:
            return ""
        stored = self.dataset(name)
        value = stored[()] if stored.ndim == 0 else next(iter(stored[:1].reshape(-1)), b"")
        if not isinstance(value, (bytes, str)):
            raise self.error(f"{name} is {stored.dtype} {stored.shape}", "texts")
        try:
            return value.decode() if isinstance(value, bytes) else str(value)
        except UnicodeDecodeError as error:
            raise self.error(f"{name} holds a text that is not UTF-8", "UTF-8") from error

    def error(self, problem: str, expected: str) -> EpisodeError:
        return EpisodeError(f"{self.path}: {problem}; expected {expected}.")


def text_beside(episode: Path, name: str) -> str:
    """Text of a file next to RoboTwin's data/ folder, empty if there is none."""
    path = episode.absolute().parent.parent / name
    try:
        return read_text(path) if path.exists() else ""
    except (OSError, UnicodeDecodeError) as error:
        raise EpisodeError(f"{path} cannot be read as text ({error}); copy it again, or remove it.") from error


def _first_instruction(text: str) -> str:
    """The first text of a JSON list, of RoboTwin's {"seen": […], "unseen": […]}, or plain text; empty if there is none."""
    try:
        content = parse_json(text)
    except (ValueError, RecursionError):
        return text.strip()
    if isinstance(content, dict):
        content = [entry for key in INSTRUCTIONS for entry in _as_list(content.get(key))]
    return next((entry.strip() for entry in _as_list(content) if isinstance(entry, str) and entry.strip()), "")


def _as_list(content: Any) -> list[Any]:
    return content if isinstance(content, list) else [content]

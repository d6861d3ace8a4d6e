"""The contract between rooms: what an episode holds, and how it is written, read and verified (`xew.dataset` finds them).

An episode is a folder `<data>/<task>/<seed>/<robot>/`:
    episode.json   who, how long, success or the reason of failure, versions, hashes (always there)
    states.npz     the arrays of `States` (accepted episodes only)
    rgb.mkv        the head camera, lossless (H.264 in RGB, Matroska)
    robot.mkv      the robot alone, posed by the commanded joints, on a white ground, lossless
Folders appear under their final name only when complete. A rejected cell keeps its episode.json and nothing else.

Shape letters, here and everywhere: t frames, h w c image, j joints, a action, o objects, k keypoints, n worlds, b batch.
Quaternions are x y z w; the world frame has its origin under the table's center, x right, y away from the robot, z up.
"""

import hashlib
import itertools
import json
import math
import os
import secrets
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from xew.concurrency import PARSING
from xew.config import ConfigError, parse
from xew.files import demand_regular, read_json, sweep
from xew.names import EpisodeError as EpisodeError
from xew.names import check_label, check_name, folder_name, path_below
from xew.protocol import MOTIONS, SHARED_MOTION

SCHEMA_VERSION = 2
WIDTH, HEIGHT = 320, 240
FAILURES = ("plan", "grasp", "slip", "timeout", "physics", "overflow")
"""plan: no joint path. grasp: never held. slip: held and lost. timeout: the plan ended short of success.
physics: an object sank into something, fell off the table or crept in a hand. overflow: a physics buffer was too small."""
HELD = ("episode.json", "states.npz", "rgb.mkv", "robot.mkv")
"""Names of the files of an episode. A folder that holds anything else is never replaced by one."""
SEED_END = 2**63
"""End of the range of seeds; tables store them in 64 bits."""
FORMATS = "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2"
"""Containers that are read, by FFmpeg's names. Others, such as playlists, name further files, which FFmpeg would open."""
TEMPORARY = ".writing-"
"""Beginning of the name of a folder that is not complete yet."""


@dataclass(frozen=True)
class States:
    """Everything recorded of an episode: the truth of which all pixels are a view."""

    action: np.ndarray
    """[t 16] float32, commanded joint positions [rad] and grippers [0 closed, 1 open] in force at each frame."""
    joint_pos: np.ndarray
    """[t 16] float32, measured, in the same layout."""
    joint_vel: np.ndarray
    """[t 16] float32, measured [rad/s; 1/s for the grippers]."""
    tool_pose: np.ndarray
    """[t 2 7] float32, measured pose of the left and right tool frame, world."""
    object_pose: np.ndarray
    """[t o 7] float32, pose of each object's body, world."""
    object_joint: np.ndarray
    """[t o] float32, hinge angle [rad] of objects that have a hinge, else 0."""
    contact: np.ndarray
    """[t 2 o] bool, does any finger of the left, right arm touch the object."""
    penetration: np.ndarray
    """[t o] float32, how deep the object and anything else, a finger, the table or another object, are in each other [m]."""
    keypoints: np.ndarray
    """[t k 2] float32, origins of the robot's links by forward kinematics of `joint_pos`, pixels (x right, y down,
    (0, 0) the center of the upper left pixel)."""
    keypoint_visible: np.ndarray
    """[t k] bool, in the image and not hidden by an object or by another link."""
    robot_mask: np.ndarray
    """[t h w] bool, pixels in which the robot is what the head camera sees."""
    intrinsics: np.ndarray
    """[3 3] float64, the head camera's K [pixels]."""
    extrinsics: np.ndarray
    """[4 4] float64, world to camera (x right, y down, z forward)."""

    @property
    def frame_count(self) -> int:
        return len(self.action)


@dataclass(frozen=True)
class Record:
    """episode.json: the header of one (task, seed, robot) cell."""

    task: str
    seed: int
    robot: str
    success: bool
    failure: str | None = None
    """One of `FAILURES` where success is false."""
    failure_detail: str = ""
    """The same in words."""
    instruction: str = ""
    frame_count: int = 0
    frame_rate: float = 1000 / 60
    object_names: tuple[str, ...] = ()
    keypoint_names: tuple[str, ...] = ()
    scene_hash: str = ""
    """SHA-256 of the scene, which is the same for all robots."""
    hashes: dict[str, str] = field(default_factory=dict)
    """SHA-256 of states, rgb and robot (decoded bytes, so that a container's padding does not count)."""
    versions: dict[str, str] = field(default_factory=dict)
    device: str = ""
    source: str = ""
    """Format that an episode was imported from, if it was not simulated here."""
    unknown: tuple[str, ...] = ()
    """Arrays of `States` of which the source says nothing: their numbers are NaN, their truth values False."""
    schema_version: int = SCHEMA_VERSION
    videos: bool = True
    """Are rgb and robot stored? Where not, `python -m xew.sim_warp.inspect --render` makes them from the states."""
    motion: str = SHARED_MOTION
    """Kind of motion, one of `xew.protocol.MOTIONS`."""


def episode_folder(data: Path, task: str, seed: int, robot: str) -> Path:
    """The folder of an episode, or of what belongs to it in a tree of the same form.

    Raises:
        EpisodeError: a name or the seed could not be that of a folder (`xew.names.check_name`).
    """
    folder = Path(data).joinpath(*_folder_names(task, seed, robot))
    earlier = Path(data, task, f"{seed:07d}", robot)
    return earlier if ":" in f"{task}{robot}" and earlier.is_dir() else folder


def place_episode(root: Path, task: str, seed: int, robot: str) -> Path:
    """`episode_folder` for who writes there: links out of the tree are not followed but raise EpisodeError, too."""
    return path_below(root, *_folder_names(task, seed, robot))


def _folder_names(task: str, seed: int, robot: str) -> tuple[str, str, str]:
    if not 0 <= seed < SEED_END:
        raise EpisodeError(f"the seed is {seed}, expected a whole number from 0 to 2^63 - 1.")
    return folder_name(check_name(task, "task")), f"{seed:07d}", folder_name(check_name(robot, "robot"))


def data_folder(episode: Path) -> Path:
    """The folder of the data set that the folder of an episode lies in."""
    return episode.absolute().parents[2]


def array_hash(*arrays: np.ndarray) -> str:
    """SHA-256, in hexadecimal, over dtype, shape and bytes of arrays [...] of any dtype, in order."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def states_hash(states: States) -> str:
    return array_hash(*(getattr(states, f.name) for f in fields(States)))


def write_episode(
    data: Path,
    record: Record,
    states: States | None = None,
    rgb: np.ndarray | None = None,
    robot: np.ndarray | None = None,
    videos: bool = True,
) -> Path:
    """Write one cell atomically and return its folder.

    Args:
        data: root of the data set.
        record: the header; hashes are filled in here.
        states, rgb [t h w 3] uint8, robot [t h w 3] uint8: what an accepted episode holds; leave out what is not stored.
        videos: whether rgb and robot are stored, or only their hashes.

    Raises:
        EpisodeError: the folder cannot be written or the disk is full; nothing half-written remains.
    """
    folder = place_episode(data, record.task, record.seed, record.robot)
    try:
        with complete_folder(folder, HELD) as temporary:
            hashes = {}
            if states is not None:
                hashes["states"] = states_hash(states)
                np.savez_compressed(temporary / "states.npz", **_pack(states))  # type: ignore[arg-type]
            for name, video in (("rgb", rgb), ("robot", robot)):
                if video is not None:
                    hashes[name] = array_hash(video)
                    if videos:
                        write_video(temporary / f"{name}.mkv", video, record.frame_rate)
            header = asdict(record) | {"hashes": hashes, "videos": videos}
            (temporary / "episode.json").write_text(json.dumps(header, indent=1) + "\n")
    except OSError as error:
        raise EpisodeError(f"cannot write the episode {folder}: {error}. Free some space or choose another --out.") from error
    return folder


@contextmanager
def complete_folder(folder: Path, held: Collection[str] = ()) -> Iterator[Path]:
    """Give a temporary folder to fill, which takes the name `folder` when the block ends well and else is removed.

    Args:
        folder: to make.
        held: names of what is written there. A folder of that name that holds nothing else is replaced.

    Raises:
        EpisodeError: the folder holds something else, which is left as it is.
    """
    _demand_replaceable(folder, held)
    folder.parent.mkdir(parents=True, exist_ok=True)
    sweep(folder, TEMPORARY, ending="-.*")
    temporary = folder.with_name(f"{TEMPORARY}{folder.name}.{os.getpid()}-{secrets.token_hex(4)}")
    temporary.mkdir()  # by the user's own mask, and not for the user alone as tempfile does
    replaced = temporary.with_name(f"{temporary.name}-replaced")
    try:
        yield temporary
        if folder.exists():
            os.rename(folder, replaced)  # whoever reads it finds it whole or not at all
        os.rename(temporary, folder)
    finally:
        for left in (temporary, replaced):
            shutil.rmtree(left, ignore_errors=True)


def _demand_replaceable(folder: Path, held: Collection[str]) -> None:
    """Raise EpisodeError where something is in a folder's place that was not written here."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise EpisodeError(f"{folder} is no folder but stands where one is to be written; move it away.")
    others = sorted(entry.name for entry in folder.iterdir() if entry.name not in held) if folder.is_dir() else []
    if others:
        raise EpisodeError(
            f"{folder} is to be replaced and holds {', '.join(others[:3])}, which xew did not write there; move that away, or "
            "choose another --out."
        )


def _pack(states: States) -> dict[str, np.ndarray]:
    """Bring arrays to the form in which they are stored: the mask with eight pixels a byte."""
    arrays = {f.name: getattr(states, f.name) for f in fields(States)}
    arrays["robot_mask"] = np.packbits(states.robot_mask, axis=-1)
    return arrays


def read_record(folder: Path) -> Record:
    """The header of an episode folder. Raises EpisodeError if there is none or it cannot be understood."""
    path = Path(folder) / "episode.json"
    try:
        header = read_json(path)
        version = header.get("schema_version") if isinstance(header, dict) else None
        if isinstance(version, int) and version != SCHEMA_VERSION:
            raise EpisodeError(f"{path} has schema version {version}, this xew reads {SCHEMA_VERSION}; generate the data anew.")
        return _check_record(parse(Record, header, "its header"))
    except FileNotFoundError as error:
        raise EpisodeError(f"{path} does not exist; `python -m xew.sim_warp.generate` makes episodes.") from error
    except (OSError, ValueError, ConfigError) as error:
        raise EpisodeError(f"{path} is damaged ({_one_line(error)}); delete its folder and run generate again.") from error


def _check_record(record: Record) -> Record:
    """The same header. Raises ValueError for names that could lead elsewhere and for numbers that mean nothing."""
    try:
        _folder_names(record.task, record.seed, record.robot)
        for name in (*record.object_names, *record.keypoint_names):
            check_label(name, "name of an object or keypoint")
    except EpisodeError as error:
        raise ValueError(str(error).rstrip(".")) from error
    if record.motion not in MOTIONS:
        raise ValueError(f"its motion is {record.motion!r}, expected {' or '.join(MOTIONS)}")
    if not (math.isfinite(record.frame_rate) and record.frame_rate > 0 and record.frame_count >= 0):
        raise ValueError(f"it has {record.frame_count} frames at {record.frame_rate} a second")
    return record


def _one_line(error: Exception) -> str:
    return "; ".join(str(error).splitlines())


def demand_known(folder: Path, *names: str) -> None:
    """Raises EpisodeError if one of these arrays of `States` is unknown in an episode that was imported."""
    record = read_record(folder)
    if missing := [name for name in names if name in record.unknown]:
        raise EpisodeError(
            f"{folder} was imported from {record.source}, which does not record {', '.join(missing)}; leave it out, or use "
            "episodes made by `python -m xew.sim_warp.generate`."
        )


def read_states(folder: Path) -> States:
    """The recorded states of an accepted episode. Raises EpisodeError if they are missing or damaged."""
    path = Path(folder) / "states.npz"
    try:
        arrays = read_npz(path)
        arrays["robot_mask"] = np.unpackbits(arrays["robot_mask"], axis=-1).astype(bool)
        return _check_camera(States(**arrays))
    except FileNotFoundError as error:
        raise EpisodeError(f"{path} does not exist: the cell was rejected or its folder is damaged.") from error
    except Exception as error:  # zipfile, zlib and NumPy each have their own
        raise EpisodeError(f"{path} is damaged ({error}); delete its folder and run generate again.") from error


def _check_camera(states: States) -> States:
    """The same states. Raises ValueError where their camera could see nothing."""
    intrinsics, extrinsics = states.intrinsics, states.extrinsics
    if intrinsics.shape != (3, 3) or extrinsics.shape != (4, 4):
        raise ValueError(f"its camera has intrinsics {intrinsics.shape} and extrinsics {extrinsics.shape}")
    if not (np.isfinite(intrinsics).all() and np.isfinite(extrinsics).all() and intrinsics[0, 0] * intrinsics[1, 1] != 0):
        raise ValueError("its camera has a focal length of 0, or numbers that are not finite")
    return states


def project(points: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images of points of the world by the pinhole camera of all episodes, without distortion or skew.

    Pixels: x right, y down, (0, 0) is the center of the upper left pixel. Camera frame: x right, y down, z forward.

    Args:
        points: [... 3] m, world frame.
        intrinsics: [3 3] K [pixels].
        extrinsics: [4 4] world to camera [m].

    Returns:
        Pixels [... 2] and depths along the optical axis [...] m, both float64 where an argument is. A point at or behind the
        camera (depth <= 0) has no image; its pixels are NaN.
    """
    in_camera = points @ extrinsics[:3, :3].T + extrinsics[:3, 3]
    depth = in_camera[..., 2]
    focal = intrinsics[[0, 1], [0, 1]]
    front = np.where(depth > 0, depth, np.nan)
    return focal * in_camera[..., :2] / front[..., None] + intrinsics[:2, 2], depth


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an .npz by name [any shapes]; threads may call it. Raises what zipfile, zlib and NumPy raise."""
    # Opened here, since np.load leaves a file that is no archive open.
    with PARSING, demand_regular(path).open("rb") as file, np.load(file) as stored:
        return {name: stored[name] for name in stored.files}


def write_video(path: Path, video: np.ndarray, frame_rate: float = 1000 / 60) -> None:
    """Write uint8 RGB [t h w 3] losslessly: H.264 in RGB at quantizer 0, in Matroska.

    Scenes stand still but for the robot, which a codec that looks at the frame before writes in a quarter of the time that
    FFV1 takes, at 1.3 times the size.

    Raises:
        OSError: it cannot be written there, or the disk is full.
    """
    height, width = video.shape[1:3]
    # bitexact: no random identifiers, the same frames give the same file
    with av.open(str(path), "w", format="matroska", container_options={"fflags": "+bitexact"}) as container:
        rate = Fraction(frame_rate).limit_denominator(1000)
        stream = container.add_stream("libx264rgb", rate=rate, options={"preset": "ultrafast", "qp": "0"})
        stream.width, stream.height, stream.pix_fmt = width, height, "rgb24"
        stream.codec_context.thread_count = 1  # episodes are written side by side
        for frame in video:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def encode_png(image: np.ndarray) -> bytes:
    """The PNG file of an RGB image [h w 3] uint8."""
    return cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def open_video(path: Path) -> Any:
    """Open a video as a PyAV container, which reads no other file than this one.

    Raises:
        OSError: it is no regular file. av.FFmpegError (an OSError, too): it is no Matroska or MP4.
    """
    options = {"format_whitelist": FORMATS, "protocol_whitelist": "file"}
    return av.open(str(demand_regular(path).absolute()), container_options=options)


def take_pixels(frame: av.VideoFrame, pixels: str = "rgb24") -> np.ndarray:
    """A decoded frame as uint8 [h w c], converted by this thread: PyAV would start one a core for every frame anew.

    Args:
        pixels: name of FFmpeg's format with c channels, such as rgb24 or rgba.
    """
    return frame.to_ndarray(format=pixels, threads=1)


def read_video(path: Path, most: int | None = None) -> np.ndarray:
    """Read a video, or its first `most` frames, as uint8 RGB [t h w 3].

    Raises EpisodeError if it is missing or holds no readable frame.
    """
    try:
        with open_video(path) as container:
            container.streams.video[0].codec_context.thread_count = 1
            frames = [take_pixels(frame) for frame in itertools.islice(container.decode(video=0), most)]
    except (av.FFmpegError, OSError, IndexError):  # IndexError: a file without a video in it
        frames = []
    if not frames:
        raise EpisodeError(
            f"{path} is missing or holds no readable frame. Data made with --states-only get their videos by "
            f"`python -m xew.sim_warp.inspect DATA --render`; else delete its folder and run generate again."
        )
    return np.stack(frames)


def verify_episode(folder: Path) -> Record:
    """Read all of an accepted episode and compare with its hashes. Raises EpisodeError at the first difference."""
    folder = Path(folder)
    record = read_record(folder)
    readers = {
        "states": lambda: states_hash(read_states(folder)),
        "rgb": lambda: array_hash(read_video(folder / "rgb.mkv")),
        "robot": lambda: array_hash(read_video(folder / "robot.mkv")),
    }
    stored = {name: expected for name, expected in record.hashes.items() if record.videos or name == "states"}
    for name, expected in stored.items():
        if name not in readers:
            raise EpisodeError(
                f"{folder} names a hash of {name!r}, expected {', '.join(readers)}; delete it and run generate again."
            )
        found = readers[name]()
        if found != expected:
            raise EpisodeError(
                f"{folder}: {name} has hash {found[:12]}, expected {expected[:12]}; delete it and run generate again."
            )
    return record


def remove_left_overs(data: Path) -> None:
    """Remove what a run that was killed left half-written: episodes and, one folder up, robots."""
    for folder in [*Path(data).glob(f"*/*/{TEMPORARY}*"), *Path(data).glob(f"*/{TEMPORARY}*")]:
        shutil.rmtree(folder, ignore_errors=True)

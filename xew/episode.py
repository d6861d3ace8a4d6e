"""The contract between packages: what an episode holds, and how it is written, read and verified.

An episode is a folder `<data>/<task>/<seed>/<robot>/`:
    episode.json   who, how long, success or the reason of failure, versions, hashes (always there)
    states.npz     the arrays of `States` (accepted episodes only)
    rgb.mkv        the head camera, lossless (H.264 in RGB, Matroska)
    robot.mkv      the robot alone, posed by the commanded joints, on a white ground, lossless
Folders appear under their final name only when complete. A rejected cell has only its episode.json.

Another camera's view of the data is a data set of the same form below it, `<data>/views/<view>/<task>/<seed>/<robot>/`
(`xew.dataset.view_folder`). Its states are the episode's, with that camera's keypoints, mask and matrices.

Shape letters, here and everywhere: t frames, h w c image, j joints, a action, o objects, k keypoints, n worlds, b batch.
Quaternions are x y z w; the world frame has its origin under the table's center, x right, y away from the robot, z up.
"""

import hashlib
import io
import itertools
import json
import os
import secrets
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from xew.concurrency import PARSING
from xew.config import ConfigError, parse
from xew.files import LoadedFile, file_digest, load_file, read_json, sweep
from xew.names import EpisodeError as EpisodeError
from xew.names import check_label, check_name, folder_name, name_of_folder, path_below
from xew.protocol import CAMERA_SIZE, FRAME_RATE, HEAD_SPEC, MOTIONS, SHARED_MOTION, CameraSpec, parse_change

SCHEMA_VERSION = 2
WIDTH, HEIGHT = CAMERA_SIZE
FAILURES = ("plan", "grasp", "slip", "timeout", "physics", "overflow")
"""plan: no joint path. grasp: never held. slip: held and lost. timeout: the plan ended without success.
physics: an object sank into something, fell off the table or slid in a hand. overflow: a physics buffer was too small."""
HELD = ("episode.json", "states.npz", "rgb.mkv", "robot.mkv")
"""Names of the files of an episode. A folder with any other file is never replaced."""
SEED_END = 2**63
"""End of the range of seeds; tables store them in 64 bits."""
FORMATS = "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi"
"""Containers that are read, by FFmpeg's names. Others, such as playlists, may make FFmpeg open further files."""
SLOWEST, FASTEST = 1.0, 1000.0
"""Range of frame rates [Hz]."""
WHITE = 250
"""Least level of all channels of the white ground that robots are rendered on alone, as in robot.mkv."""
TEMPORARY = ".writing-"
"""Prefix of the name of an incomplete folder."""
UNPACKED_BYTES, UNPACKED_RATIO = 2**27, 100
"""Largest size of the unpacked arrays of an .npz: a number of bytes, and this many times the size of the file."""
MOST_PIXELS = 4096 * 4096
"""Largest number of pixels of a frame of an episode's video."""
PROBED_STREAMS = 8
"""Number of streams of a container to which MOST_PIXELS applies while it is opened."""
FORMS = {
    "action": "float32 t 16",
    "joint_pos": "float32 t 16",
    "joint_vel": "float32 t 16",
    "tool_pose": "float32 t 2 7",
    "object_pose": "float32 t o 7",
    "object_joint": "float32 t o",
    "contact": "bool t 2 o",
    "penetration": "float32 t o",
    "keypoints": "float32 t k 2",
    "keypoint_visible": "bool t k",
    "robot_mask": "bool t h w",
    "intrinsics": "float64 3 3",
    "extrinsics": "float64 4 4",
}
"""Type and shape of each array of `States`."""
MOVING_FORMS = FORMS | {"extrinsics": "float64 t 4 4"}
"""The same of a camera that moves."""
NEW_FIELDS = ("camera", "change", "fault", "progress", "table")
"""Fields of a header that are written only if they are not their default: headers without them keep their bytes."""


@dataclass(frozen=True)
class States:
    """The recorded states of an episode; all pixels are rendered from them."""

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
    """[t 2 o] bool, whether a finger of the left, right arm touches the object."""
    penetration: np.ndarray
    """[t o] float32, deepest penetration between the object and a finger, the table or another object [m]."""
    keypoints: np.ndarray
    """[t k 2] float32, origins of the robot's links by forward kinematics of `joint_pos`, in the pixels of `project`."""
    keypoint_visible: np.ndarray
    """[t k] bool, in the image and not hidden by an object or by another link."""
    robot_mask: np.ndarray
    """[t h w] bool, pixels in which the camera sees the robot."""
    intrinsics: np.ndarray
    """[3 3] float64, the camera's K [pixels]."""
    extrinsics: np.ndarray
    """[4 4] float64, world to camera (x right, y down, z forward), or [t 4 4] of a camera that moves with the robot."""

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
    """The failure in words."""
    instruction: str = ""
    frame_count: int = 0
    frame_rate: float = FRAME_RATE
    object_names: tuple[str, ...] = ()
    keypoint_names: tuple[str, ...] = ()
    scene_hash: str = ""
    """SHA-256 of the scene, which is the same for all robots."""
    hashes: dict[str, str] = field(default_factory=dict)
    """SHA-256 of states, rgb and robot (decoded bytes, independent of the container)."""
    versions: dict[str, str] = field(default_factory=dict)
    device: str = ""
    source: str = ""
    """Format from which the episode was imported; empty for simulated episodes."""
    unknown: tuple[str, ...] = ()
    """Arrays of `States` that the source does not record: numbers are NaN, truth values False."""
    schema_version: int = SCHEMA_VERSION
    videos: bool = True
    """Whether rgb and robot are stored. If not, `python -m xew.sim_warp.inspect --render` renders them."""
    motion: str = SHARED_MOTION
    """Kind of motion, one of `xew.protocol.MOTIONS`."""
    change: str = ""
    """The scene's one change as `FACTOR:LEVEL` (`xew.protocol.parse_change`); empty for an unchanged scene."""
    files: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the files as they were written, by name. The decoded bytes of such a file need not be compared."""
    camera: CameraSpec = HEAD_SPEC
    """The camera, with the place that it has on this robot."""
    fault: str = ""
    """The commands' fault, such as grasp_offset:20; empty for the expert. A faulty episode has a failure only if refused."""
    progress: float | None = None
    """The task's progress at the end, from 0 to 1, of a kept faulty episode."""
    table: float | None = None
    """Height of the table [m] that hides parts of the robot in robot.mkv; None for the head camera, where nothing does."""

    @property
    def is_kept(self) -> bool:
        """Whether it is an episode and not a refused cell: an expert's success, or what physics made of a fault."""
        return self.failure is None if self.fault else self.success

    @property
    def is_recorded(self) -> bool:
        """Whether its states and hashes exist: a kept cell has none where another robot's failure came first."""
        return self.is_kept and bool(self.hashes)


def episode_folder(data: Path, task: str, seed: int, robot: str) -> Path:
    """The folder of an episode in a data set or in a tree of the same form.

    Raises:
        EpisodeError: a name or the seed is not valid for a folder (`xew.names.check_name`).
    """
    folder = Path(data).joinpath(*_folder_names(task, seed, robot))
    earlier = Path(data, task, f"{seed:07d}", robot)
    return earlier if ":" in f"{task}{robot}" and earlier.is_dir() else folder


def place_episode(root: Path, task: str, seed: int, robot: str) -> Path:
    """`episode_folder` for writing; a link that leads out of the tree raises EpisodeError, too."""
    return path_below(root, *_folder_names(task, seed, robot))


def _folder_names(task: str, seed: int, robot: str) -> tuple[str, str, str]:
    if not 0 <= seed < SEED_END:
        raise EpisodeError(f"the seed is {seed}, expected a whole number from 0 to 2^63 - 1.")
    return folder_name(check_name(task, "task")), f"{seed:07d}", folder_name(check_name(robot, "robot"))


def data_folder(episode: Path) -> Path:
    """The root of the data set of an episode's folder."""
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
        record: the header; hashes and digests of files are filled in here.
        states, rgb [t h w 3] uint8, robot [t h w 3] uint8: content of an accepted episode; None is not stored.
        videos: whether to store rgb and robot or only their hashes.

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
            written = {path.name: file_digest(path) for path in sorted(temporary.iterdir())}
            header = _plain_header(replace(record, hashes=hashes, files=written, videos=videos))
            (temporary / "episode.json").write_text(json.dumps(header, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        reason = error.strerror or error  # without the temporary name
        raise EpisodeError(f"cannot write the episode {folder}: {reason}. Free some space or choose another --out.") from error
    return folder


def _plain_header(record: Record) -> dict[str, Any]:
    """The content of episode.json."""
    defaults = {f.name: f.default for f in fields(Record) if f.name in NEW_FIELDS}
    unchanged = {name for name, value in defaults.items() if getattr(record, name) == value}
    return {name: value for name, value in asdict(record).items() if name not in unchanged}


@contextmanager
def complete_folder(folder: Path, held: Collection[str] = ()) -> Iterator[Path]:
    """Yield a temporary folder, which is renamed to `folder` at the end of the block, or removed after an error.

    Args:
        folder: path of the complete folder.
        held: names of the files in it. An existing folder with no other files is replaced.

    Raises:
        EpisodeError: the existing folder holds other files; it is left unchanged.
    """
    _demand_replaceable(folder, held)
    folder.parent.mkdir(parents=True, exist_ok=True)
    sweep(folder, TEMPORARY, ending="-.*")
    temporary = folder.with_name(f"{TEMPORARY}{folder.name}.{os.getpid()}-{secrets.token_hex(4)}")
    temporary.mkdir()  # with the user's umask; tempfile would make it private
    replaced = temporary.with_name(f"{temporary.name}-replaced")
    try:
        yield temporary
        if folder.exists():
            os.rename(folder, replaced)  # a reader finds a complete folder or none
        os.rename(temporary, folder)
    finally:
        for left in (temporary, replaced):
            shutil.rmtree(left, ignore_errors=True)


def _demand_replaceable(folder: Path, held: Collection[str]) -> None:
    """Raise EpisodeError if the path exists and holds files that xew did not write."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise EpisodeError(f"{folder} is not a folder; expected a folder or nothing. Move it away.")
    others = sorted(entry.name for entry in folder.iterdir() if entry.name not in held) if folder.is_dir() else []
    if others:
        raise EpisodeError(
            f"{folder} is to be replaced and holds {', '.join(others[:3])}, which xew did not write; move these files away, "
            "or choose another --out."
        )


def _pack(states: States) -> dict[str, np.ndarray]:
    """Arrays in their stored form: the mask with eight pixels per byte."""
    arrays = {f.name: getattr(states, f.name) for f in fields(States)}
    arrays["robot_mask"] = np.packbits(states.robot_mask, axis=-1)
    return arrays


def read_record(folder: Path) -> Record:
    """The header of an episode folder. Raises EpisodeError if it is missing or invalid, or names another folder."""
    path = Path(folder) / "episode.json"
    try:
        header = read_json(path)
        version = header.get("schema_version") if isinstance(header, dict) else None
        if isinstance(version, int) and version != SCHEMA_VERSION:
            raise EpisodeError(f"{path} has schema version {version}, expected {SCHEMA_VERSION}; generate the data again.")
        record = _check_record(parse(Record, header, "its header"))
    except FileNotFoundError as error:
        raise EpisodeError(f"{path} does not exist; `python -m xew.sim_warp.generate` makes episodes.") from error
    except (OSError, ValueError, ConfigError) as error:
        reason = "; ".join(str(error).splitlines())
        raise EpisodeError(f"{path} is damaged ({reason}); delete its folder and run generate again.") from error
    own = f"{record.task}/{record.seed:07d}/{record.robot}"
    if not f"/{name_of_folder(os.path.abspath(path.parent))}".endswith(f"/{own}"):
        raise EpisodeError(
            f"{path} is the header of {own}, in a folder that was copied or renamed; give the folder that name, or delete it "
            "and run generate again."
        )
    return record


def _check_record(record: Record) -> Record:
    """The same header. Raises ValueError for names that are paths and for invalid numbers."""
    try:
        _folder_names(record.task, record.seed, record.robot)
        for name in (*record.object_names, *record.keypoint_names):
            check_label(name, "name of an object or keypoint")
        check_name(record.camera.name, "name of a camera")
    except EpisodeError as error:
        raise ValueError(str(error).rstrip(".")) from error
    if record.camera.problem:
        raise ValueError(record.camera.problem)
    if record.motion not in MOTIONS:
        raise ValueError(f"its motion is {record.motion!r}, expected {' or '.join(MOTIONS)}")
    if record.change != (change := str(parse_change(record.change) or "")):
        raise ValueError(f"its change is {record.change!r}, expected {change!r}")
    for name, most in (("progress", 1), ("table", 2)):
        if not 0 <= (getattr(record, name) or 0) <= most:
            raise ValueError(f"its {name} is {getattr(record, name)}, expected a number from 0 to {most}")
    if not SLOWEST <= record.frame_rate <= FASTEST or record.frame_count < 0:
        raise ValueError(f"it has {record.frame_count} frames at {record.frame_rate} a second")
    return record


def demand_known(folder: Path, *names: str, record: Record | None = None) -> None:
    """Raise EpisodeError if one of these arrays of `States` is unknown in an imported episode; its header is read if None."""
    record = record or read_record(folder)
    if missing := [name for name in names if name in record.unknown]:
        raise EpisodeError(
            f"{folder} was imported from {record.source}, which does not record {', '.join(missing)}; exclude it, or use "
            "episodes made by `python -m xew.sim_warp.generate`."
        )


def read_states(folder: Path, record: Record | None = None) -> States:
    """The recorded states of an accepted episode.

    Args:
        folder: of the episode.
        record: its header, which is read if None.

    Raises:
        EpisodeError: they are missing or damaged, or are not those of the header.
    """
    path = Path(folder) / "states.npz"
    try:
        file = load_file(path)
        record = record or read_record(folder)
        arrays = read_npz(file)
        arrays["robot_mask"] = np.unpackbits(arrays["robot_mask"], axis=-1).view(bool)
        states = States(**arrays)
        _check_states(states, record)
    except FileNotFoundError as error:
        raise EpisodeError(f"{path} does not exist: the cell was rejected or its folder is damaged.") from error
    except EpisodeError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy each have their own
        raise EpisodeError(f"{path} is damaged ({error}); delete its folder and run generate again.") from error
    if not _is_known(file, "states", record):
        _compare(file, "states", record, states_hash(states))
    return states


def _check_states(states: States, record: Record) -> None:
    """Raise ValueError unless the arrays have their types, shapes and, where they are known, finite numbers."""
    sizes = check_forms(vars(states), MOVING_FORMS if record.camera.moves else FORMS)
    counts = {"t": record.frame_count, "o": len(record.object_names), "k": len(record.keypoint_names)}
    for letter, what in (("t", "frames"), ("o", "objects"), ("k", "keypoints")):
        if sizes[letter] != counts[letter]:
            raise ValueError(f"it has {sizes[letter]} {what}, its header {counts[letter]}")
    visible = {"keypoints": states.keypoints[states.keypoint_visible]}  # behind the camera they are NaN
    for name in (name for name, form in FORMS.items() if form.startswith("float") and name not in record.unknown):
        if not np.isfinite(visible.get(name, getattr(states, name))).all():
            raise ValueError(f"{name} has NaN or infinite numbers")
    if states.intrinsics[0, 0] * states.intrinsics[1, 1] == 0:
        raise ValueError("its camera has a focal length of 0")


def check_forms(arrays: Mapping[str, np.ndarray], forms: Mapping[str, str]) -> dict[str, int]:
    """Check types and shapes of arrays, and return the sizes by shape letter.

    Args:
        arrays: [...] by name.
        forms: type and shape by name, such as `float32 t 16`; a letter has one size in all arrays.

    Raises:
        ValueError: an array has another type or shape.
    """
    sizes: dict[str, int] = {}
    for name, form in forms.items():
        array, (dtype, *letters) = np.asarray(arrays[name]), form.split()
        for letter, size in zip(letters, array.shape, strict=False):
            sizes.setdefault(letter, int(letter) if letter.isdecimal() else size)
        expected = [sizes.get(letter, letter) for letter in letters]
        if array.dtype != dtype or list(array.shape) != expected:
            raise ValueError(f"{name} is {array.dtype} {list(array.shape)}, expected {dtype} {expected}")
    return sizes


_COMPARED: set[tuple[str, str]] = set()
"""Hashes of content that this process has compared, each with the digest of the file that held it."""


def _is_known(file: LoadedFile, name: str, record: Record) -> bool:
    """Whether a file is as it was written, or was compared before, so its content is that of the header."""
    return record.files.get(file.path.name) == file.digest or (record.hashes.get(name, ""), file.digest) in _COMPARED


def _compare(file: LoadedFile, name: str, record: Record, found: str) -> None:
    """Remember the file if its content has the header's hash. Raises EpisodeError if not."""
    expected = record.hashes.get(name, "")
    if found != expected:
        raise EpisodeError(
            f"{file.path.parent}: {name} has hash {found[:12]}, expected {expected[:12] or 'none'} as in its header; it is "
            "damaged or was exchanged. Delete the folder and run generate again."
        )
    _COMPARED.add((expected, file.digest))


def project(points: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project world points by a pinhole camera without distortion or skew.

    Pixels: x right, y down, (0, 0) is the center of the upper left pixel. Camera frame: x right, y down, z forward.

    Args:
        points: [... 3] m, world frame; [t n 3] for a camera that moves.
        intrinsics: [3 3] K [pixels].
        extrinsics: [4 4] world to camera [m], or [t 4 4] of a camera that moves.

    Returns:
        Pixels [... 2] and depths along the optical axis [...] m, both float64 if an argument is. Pixels of points at or behind
        the camera (depth <= 0) are NaN.
    """
    offset = extrinsics[:3, 3] if extrinsics.ndim == 2 else extrinsics[:, None, :3, 3]
    in_camera = points @ extrinsics[..., :3, :3].swapaxes(-1, -2) + offset
    depth = in_camera[..., 2]
    front = np.where(depth > 0, depth, np.nan)
    return intrinsics[[0, 1], [0, 1]] * in_camera[..., :2] / front[..., None] + intrinsics[:2, 2], depth


def read_npz(path: Path | LoadedFile) -> dict[str, np.ndarray]:
    """All arrays of an .npz by name [any shapes]; thread-safe.

    Raises the errors of zipfile, zlib and NumPy, and ValueError if it unpacks to far more bytes than it has.
    """
    content = load_file(path).content
    with PARSING, np.load(io.BytesIO(content)) as stored:
        unpacked = sum(entry.file_size for entry in stored.zip.infolist())
        if unpacked > UNPACKED_BYTES + UNPACKED_RATIO * len(content):
            raise ValueError(f"{len(content)} bytes unpack to {unpacked}")
        return {name: stored[name] for name in stored.files}


def exact_rate(frame_rate: float) -> Fraction:
    """A frame rate [Hz] as the fraction that containers store. Raises EpisodeError unless it is from 1 to 1000."""
    if not SLOWEST <= frame_rate <= FASTEST:
        raise EpisodeError(f"the frame rate is {frame_rate:g}, expected {SLOWEST:g} to {FASTEST:g} frames per second.")
    return Fraction(frame_rate).limit_denominator(1000)


def write_video(path: Path, video: np.ndarray, frame_rate: float = FRAME_RATE) -> None:
    """Write uint8 RGB [t h w 3] losslessly: H.264 in RGB at quantizer 0, in Matroska.

    For these videos it takes a quarter of FFV1's time, at 1.3 times the size.

    Raises:
        OSError: the file cannot be written, or the disk is full.
    """
    height, width = video.shape[1:3]
    # bitexact: without random identifiers, equal frames give equal files
    with av.open(str(path), "w", format="matroska", container_options={"fflags": "+bitexact"}) as container:
        stream = container.add_stream("libx264rgb", rate=exact_rate(frame_rate), options={"preset": "ultrafast", "qp": "0"})
        stream.width, stream.height, stream.pix_fmt = width, height, "rgb24"
        stream.codec_context.thread_count = 1  # several episodes are written in parallel
        for frame in np.ascontiguousarray(video):
            container.mux(stream.encode(av.VideoFrame.from_numpy_buffer(frame, format="rgb24")))
        container.mux(stream.encode())


def open_video(path: Path | LoadedFile) -> Any:
    """Open a video, of which the whole file is read, as a PyAV container that reads no other file.

    Raises:
        OSError: it is not a regular file. av.FFmpegError (an OSError, too): it is not Matroska, MP4 or AVI.
    """
    options = {"format_whitelist": FORMATS, "protocol_whitelist": "file"}
    # FFmpeg decodes a frame of each stream to know it
    probing: Any = [{"max_pixels": str(MOST_PIXELS)}] * PROBED_STREAMS
    return av.open(io.BytesIO(load_file(path).content), container_options=options, stream_options=probing)


def take_pixels(frame: av.VideoFrame, pixels: str = "rgb24") -> np.ndarray:
    """A decoded frame as uint8 [h w c], converted by this thread; by default PyAV starts a thread per core for every frame.

    Args:
        pixels: FFmpeg's name of a format with c channels, such as rgb24 or rgba.
    """
    return frame.to_ndarray(format=pixels, threads=1)


def read_pixels(folder: Path, name: str, most: int | None = None, record: Record | None = None) -> np.ndarray:
    """The stored video rgb or robot of an episode, or its first `most` frames, as uint8 RGB [t h w 3].

    A file as it was written is known by its digest. Another, of earlier data or encoded again, is decoded whole and compared
    with the hash of its frames, once in a process.

    Args:
        folder: of the episode.
        name: rgb or robot.
        most: number of frames; None for all.
        record: its header, which is read if None.

    Raises:
        EpisodeError: the video is missing or damaged, or is not that of the header.
    """
    file = _load_video(Path(folder) / f"{name}.mkv")
    record = record or read_record(folder)
    if _is_known(file, name, record):
        video = read_video(file, most)
    else:
        video = read_video(file, record.frame_count + 1)
        _compare(file, name, record, array_hash(video))
    if len(video[:most]) != len(range(record.frame_count)[:most]):
        raise EpisodeError(f"{file} has {len(video)} frames, its header says {record.frame_count}; run generate again.")
    return video[:most]


def read_video(path: Path | LoadedFile, most: int | None = None) -> np.ndarray:
    """A video, or its first `most` frames, as uint8 RGB [t h w 3]. Raises EpisodeError if it is missing or damaged."""
    file = _load_video(path)
    try:
        with open_video(file) as container:
            decoder = container.streams.video[0].codec_context
            if decoder.width * decoder.height > MOST_PIXELS:
                raise ValueError(f"frames of {decoder.width}x{decoder.height} pixels")
            decoder.thread_count = 1
            decoder.options = {"err_detect": "explode"}  # otherwise FFmpeg conceals what is damaged
            return np.stack([take_pixels(frame) for frame in itertools.islice(container.decode(video=0), most)])
    except (av.FFmpegError, OSError, ValueError, IndexError, MemoryError) as error:  # IndexError: a file without a video in it
        reason = getattr(error, "strerror", None) or error
        raise EpisodeError(
            f"{file} is damaged: it holds no readable frame, or only some ({reason}); delete its folder and run generate again."
        ) from error


def _load_video(path: Path | LoadedFile) -> LoadedFile:
    try:
        return load_file(path)
    except OSError as error:
        raise EpisodeError(
            f"{path} is missing or cannot be read ({error.strerror}). For data made with --states-only, run "
            "`python -m xew.sim_warp.inspect DATA --render`; otherwise delete its folder and run generate again."
        ) from error


def verify_episode(folder: Path) -> Record:
    """Read all of an accepted episode and compare it with its hashes. Raises EpisodeError at the first difference."""
    record = read_record(folder)
    decoded = replace(record, files={})  # so the content is compared, not the files that hold it
    for name in record.hashes:
        if name not in ("states", "rgb", "robot"):
            raise EpisodeError(f"{folder} names a hash of {name!r}, expected states, rgb, robot; delete and generate it again.")
        if name == "states":
            read_states(folder, decoded)
        elif record.videos:
            read_pixels(folder, name, record=decoded)
    return record

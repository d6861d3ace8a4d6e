"""The contract for rollouts: a rollout is a model's video of one episode.

A rollout tree mirrors the data set, `<rollouts>/<task>/<seed>/<robot>/`. Each folder holds
    one video       rgb.mkv as xew's own model writes it (lossless), one file of VIDEO_SUFFIXES (an .npz holds one array
                    [t h w 3] uint8), or PNG files, one a frame, numbered as 0.png or frame_000.png; RGB of 8 bits, native
                    size, constant rate, frame 0 the given frame
    rollout.json    optional: model, condition, frame_count (requested frames), source_hash (of the episode's rgb), codec
                    (digest of the model's codec, by which `evaluate` finds its noise floor), and any further keys
Without rollout.json the model is named after the tree's folder, and the video must be as long as its episode.
Trees may be of unknown origin: files outside a tree are not read, and a video that is incomplete or mislabeled is an error.
"""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from xew.episode import SEED_END, EpisodeError, complete_folder, place_episode, read_npz, write_video
from xew.files import LoadedFile, demand_regular, join_digests, load_file, read_json
from xew.names import check_label, check_name, name_of_folder, path_below
from xew.protocol import FRAME_RATE
from xew.video.checks import MOST_BYTES, Fit, check_video
from xew.video.checks import RolloutError as RolloutError
from xew.video.containers import read_container
from xew.video.frame_files import order_frames, read_frames

VIDEO_SUFFIXES = (".mkv", ".mp4", ".mov", ".webm", ".avi", ".npz")
"""Endings of videos' names, in lower case; upper case is read, too."""
HELD = ("rgb.mkv", "rollout.json")
"""Names of the files of a rollout that xew writes. A folder with any other file is never replaced."""

CODEC = "codec"
"""Key of rollout.json with the digest of the codec that a video was decoded with."""


@dataclass(frozen=True)
class Rollout:
    """One rollout on disk: its episode, its model and the files of its frames."""

    folder: Path
    task: str
    seed: int
    robot: str
    model: str
    condition: str
    frame_count: int | None
    """Number of requested frames, counted from the episode's first; None: all."""
    video: tuple[Path, ...]
    """One video file, or one PNG file per frame."""
    header: dict[str, Any] = field(default_factory=dict, repr=False)
    """Content of rollout.json."""


def write_rollout(
    root: Path,
    task: str,
    seed: int,
    robot: str,
    video: np.ndarray,
    header: dict[str, Any],
    frame_rate: float = FRAME_RATE,
) -> Path:
    """Write one rollout atomically and return its folder.

    Args:
        root: of the rollout tree.
        task, seed, robot: the predicted episode.
        video: [t h w 3] uint8 RGB at the camera's size, with the given first frame.
        header: content of rollout.json, with model and condition; frame_count is filled in.
        frame_rate: of the episode [Hz]; the default is the rate of simulated episodes.

    Raises:
        RolloutError: the folder cannot be written or the disk is full; nothing half-written remains.
    """
    folder = place_episode(root, task, seed, robot)
    try:
        with complete_folder(folder, HELD) as temporary:
            write_video(temporary / "rgb.mkv", video, frame_rate)
            text = json.dumps(header | {"frame_count": len(video)}, indent=1) + "\n"
            (temporary / "rollout.json").write_text(text, encoding="utf-8")
    except OSError as error:
        reason = error.strerror or error  # without the temporary name
        raise RolloutError(f"cannot write the rollout {folder}: {reason}. Free some space or choose another --out.") from error
    return folder


def find_rollouts(root: Path, problems: list[str] | None = None) -> list[Rollout]:
    """All rollouts of a tree, sorted by task, seed and robot.

    Args:
        root: of the tree.
        problems: list to which one message is added for each invalid folder, which is then left out.

    Raises:
        RolloutError: there is no rollout, or a folder is invalid and `problems` is None.
    """
    root = Path(root)
    folders = [folder for folder in sorted(root.glob("*/*/*")) if folder.is_dir() and not folder.name.startswith(".")]
    if not folders:
        raise RolloutError(
            f"no rollout under {root}, expected <task>/<seed>/<robot>/; make some: python -m xew.model.rollout RUN --out {root}"
        )
    rollouts = []
    for folder in folders:
        try:
            rollouts.append(read_rollout(folder))
        except RolloutError as error:
            if problems is None:
                raise
            problems.append(str(error))
    return rollouts


def read_rollout(folder: Path) -> Rollout:
    """The rollout in a folder `<root>/<task>/<seed>/<robot>`, without its frames. Raises RolloutError as `find_rollouts`."""
    folder = Path(folder)
    path = folder / "rollout.json"
    video, root = _find_video(folder), folder.parents[2]
    try:
        for file in (path, *video):
            path_below(root, str(file.relative_to(root)))
        header = _read_header(path)
        frame_count = header.get("frame_count")
        if frame_count is not None and (not isinstance(frame_count, int) or isinstance(frame_count, bool) or frame_count < 1):
            raise RolloutError(f"{path.name}: frame_count is {frame_count!r}, expected a positive whole number.")
        seed = folder.parts[-2]
        if not seed.isdecimal() or int(seed) >= SEED_END:
            raise RolloutError(f"the folder above it is {seed!r}, expected a seed; the tree is <task>/<seed>/<robot>/.")
        return Rollout(
            folder=folder,
            task=check_name(name_of_folder(folder.parts[-3]), "task"),
            seed=int(seed),
            robot=check_name(name_of_folder(folder.name), "robot"),
            model=check_label(header.get("model", root.resolve().name), "model in rollout.json"),
            condition=check_label(header.get("condition", ""), "condition in rollout.json"),
            frame_count=frame_count,
            video=video,
            header=header,
        )
    except EpisodeError as error:
        raise RolloutError(f"{folder}: {error}") from error


def read_rollout_video(
    rollout: Rollout,
    frame_rate: float | None = None,
    digest: str | None = None,
    most: int | None = None,
    fit: Fit | None = None,
) -> np.ndarray:
    """The frames as players show them, uint8 RGB [t h w 3].

    Args:
        rollout: the rollout.
        frame_rate: required frame rate of a container [Hz]; None accepts any.
        digest: required `files.digest_files` of the video; None accepts any.
        most: number of frames after which reading ends; None for all.
        fit: what is done with each frame before it is kept, such as `resize_frame`.

    Raises:
        RolloutError: a frame cannot be read, the video is not RGB of 8 bits or too large, its rate is wrong or variable, or it
            has another digest.
    """
    files = _load(rollout.video)
    first = files[0]
    if digest is not None and join_digests([file.digest for file in files]) != digest:
        raise RolloutError(f"{first} was replaced while this command ran; run it again.")
    suffix = first.path.suffix.lower()
    if suffix == ".png":
        video = read_frames(files, most, fit)
    elif suffix == ".npz":
        video = check_video(first, _read_npz(first))[:most]
        video = video if fit is None else np.stack([fit(frame) for frame in video])
    else:
        video = read_container(first, frame_rate, most, fit)
    return check_video(first, video)


def read_as_graded(rollout: Rollout, truth: np.ndarray, given: bool) -> np.ndarray:
    """A rollout's video at the size and frames of its episode, as `evaluate` graded it: uint8 [t h w 3].

    Args:
        rollout: the rollout.
        truth: [t h w 3] uint8, the true video.
        given: whether the video holds frame 0; otherwise it begins with frame 1.

    Raises:
        RolloutError: as `read_rollout_video`.
    """
    video = read_rollout_video(rollout, most=len(truth), fit=partial(resize_frame, size=truth.shape[1:3]))
    return video if given else np.concatenate([truth[:1], video])[: len(truth)]


def resize_frame(frame: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Resize a frame [h w 3] uint8 to a height and width as for grading: by areas to a smaller size, else bicubic."""
    if frame.shape[:2] == size:
        return frame
    method = cv2.INTER_AREA if frame.shape[0] > size[0] else cv2.INTER_CUBIC
    return cv2.resize(frame, size[::-1], interpolation=method)


def _read_header(path: Path) -> dict[str, Any]:
    try:
        header = read_json(path)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise RolloutError(f"{path.name} is damaged ({error}); make this rollout again, or delete the file.") from error
    if not isinstance(header, dict):
        raise RolloutError(f"{path.name} holds {type(header).__name__}, expected an object with model, condition, frame_count.")
    return header


def _find_video(folder: Path) -> tuple[Path, ...]:
    """The only video of a folder, or the PNG files of its frames. Hidden files are left out, such as `._0.png` of macOS."""
    files = sorted(
        path for path in folder.rglob("*") if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )
    videos = [path for path in files if path.suffix.lower() in VIDEO_SUFFIXES]
    images = [path for path in files if path.suffix.lower() == ".png"]
    if len(videos) == 1 and not images:
        return (videos[0],)
    if images and not videos:
        return order_frames(folder, images)
    names = ", ".join(str(path.relative_to(folder)) for path in videos) or "none"
    others = Counter(path.suffix for path in files if path.suffix and path not in {*videos, *images, folder / "rollout.json"})
    found = "".join(f", {count} {suffix}" for suffix, count in sorted(others.items()))
    raise RolloutError(
        f"{folder}: found videos {names} and {len(images)} PNG files{found}; expected one video "
        f"({', '.join(VIDEO_SUFFIXES)}), or PNG frames alone."
    )


def _load(paths: Sequence[Path]) -> list[LoadedFile]:
    """The files of a video in memory. Raises RolloutError if one cannot be read, or they are too large."""
    files: list[LoadedFile] = []
    size = 0
    for path in paths:
        try:
            size += demand_regular(path).stat().st_size
            if size > MOST_BYTES:
                raise RolloutError(f"{path} brings its video to {size} bytes, expected at most {MOST_BYTES}; write it smaller.")
            files.append(load_file(path))
        except OSError as error:
            raise RolloutError(f"{path} cannot be read ({error.strerror}); make this rollout again.") from error
    return files


def _read_npz(file: LoadedFile) -> np.ndarray:
    """The only array of an .npz."""
    try:
        arrays = read_npz(file)
    except Exception as error:  # zipfile, zlib and NumPy each have their own
        raise RolloutError(f"{file} is damaged ({error}); make this rollout again.") from error
    if len(arrays) != 1:
        raise RolloutError(f"{file} holds the arrays {sorted(arrays)}, expected one: the video [t h w 3] uint8.")
    return next(iter(arrays.values()))

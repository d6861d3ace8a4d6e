"""The other contract between rooms: a rollout, which is a model's video of one episode.

A rollout tree mirrors the data set, `<rollouts>/<task>/<seed>/<robot>/`, and holds in each folder
    one video       rgb.mkv as our own model writes it (lossless), or any one *.mkv, *.mp4 or *.npz (one array
                    [t h w 3] uint8), or PNG files whose sorted names are the frames; native size, frame 0 the given frame
    rollout.json    optional: model, condition, frame_count (frames that were asked for), source_hash (of the episode's rgb),
                    and what else the model wants to say
Without rollout.json the model is named after the tree's folder and the video must be as long as its episode.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from xew.episode import EpisodeError, complete_folder, episode_folder, read_npz, read_video, write_video

VIDEO_SUFFIXES = (".mkv", ".mp4", ".npz")


class RolloutError(EpisodeError):
    """A rollout is missing or is not as it should be; the message says what to do."""


@dataclass(frozen=True)
class Rollout:
    """One rollout on disk: which episode it predicts, who made it, and where its frames are."""

    folder: Path
    task: str
    seed: int
    robot: str
    model: str
    condition: str
    frame_count: int | None
    """Frames that were asked for, counted from the episode's first; None: all of them."""
    video: tuple[Path, ...]
    """One file of many frames, or the PNG files of one frame each."""
    header: dict[str, Any] = field(default_factory=dict, repr=False)
    """rollout.json as it is."""


def write_rollout(root: Path, task: str, seed: int, robot: str, video: np.ndarray, header: dict[str, Any]) -> Path:
    """Write one rollout atomically and return its folder.

    Args:
        root: of the rollout tree.
        task, seed, robot: the episode that is predicted.
        video: [t h w 3] uint8 RGB at the camera's size, the given first frame included.
        header: goes to rollout.json; model and condition belong there, frame_count is filled in.

    Raises:
        RolloutError: the folder cannot be written or the disk is full; nothing half-written remains.
    """
    folder = episode_folder(root, task, seed, robot)
    try:
        with complete_folder(folder) as temporary:
            write_video(temporary / "rgb.mkv", video)
            (temporary / "rollout.json").write_text(json.dumps(header | {"frame_count": len(video)}, indent=1) + "\n")
    except OSError as error:
        raise RolloutError(f"cannot write the rollout {folder}: {error}. Free some space or choose another --out.") from error
    return folder


def find_rollouts(root: Path) -> list[Rollout]:
    """All rollouts of a tree, sorted by task, seed and robot.

    Raises:
        RolloutError: there is none, or a folder cannot be understood.
    """
    root = Path(root)
    folders = [folder for folder in sorted(root.glob("*/*/*")) if folder.is_dir() and not folder.name.startswith(".")]
    if not folders:
        raise RolloutError(
            f"no rollout under {root}, expected <task>/<seed>/<robot>/; make some: python -m xew.model.rollout RUN --out {root}"
        )
    return [read_rollout(folder) for folder in folders]


def read_rollout(folder: Path) -> Rollout:
    """The rollout in a folder `<root>/<task>/<seed>/<robot>`, without its frames. Raises RolloutError as `find_rollouts`."""
    folder = Path(folder)
    header = _read_header(folder / "rollout.json")
    frame_count = header.get("frame_count")
    if frame_count is not None and (not isinstance(frame_count, int) or frame_count < 1):
        raise RolloutError(f"{folder / 'rollout.json'}: frame_count is {frame_count!r}, expected a positive whole number.")
    task, seed = folder.parts[-3:-1]
    if not seed.isdecimal():
        raise RolloutError(f"{folder}: the folder above it is {seed!r}, expected a seed; the tree is <task>/<seed>/<robot>/.")
    return Rollout(
        folder=folder,
        task=task,
        seed=int(seed),
        robot=folder.name,
        model=str(header.get("model", folder.parents[2].name)),
        condition=str(header.get("condition", "")),
        frame_count=frame_count,
        video=_find_video(folder),
        header=header,
    )


def read_rollout_video(rollout: Rollout) -> np.ndarray:
    """The frames, uint8 RGB [t h w 3]. Raises RolloutError if they cannot be read or are no RGB video."""
    first = rollout.video[0]
    if first.suffix == ".png":
        video = _read_pngs(rollout.video)
    elif first.suffix == ".npz":
        video = _read_npz(first)
    else:
        try:
            video = read_video(first)
        except EpisodeError as error:
            raise RolloutError(f"{first} holds no readable frame; make this rollout again.") from error
    if video.dtype != np.uint8 or video.ndim != 4 or video.shape[-1] != 3:
        raise RolloutError(f"{first}: found {video.dtype} {video.shape}, expected uint8 [t h w 3]; convert before grading.")
    return video


def _read_header(path: Path) -> dict[str, Any]:
    try:
        header = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise RolloutError(f"{path} is damaged ({error}); make this rollout again, or delete the file.") from error
    if not isinstance(header, dict):
        raise RolloutError(f"{path} holds {type(header).__name__}, expected an object with model, condition, frame_count.")
    return header


def _find_video(folder: Path) -> tuple[Path, ...]:
    files = sorted(file for file in folder.rglob("*") if file.suffix in VIDEO_SUFFIXES)
    images = sorted(folder.rglob("*.png"))
    if len(files) == 1 and not images:
        return (files[0],)
    if images and not files:
        return tuple(images)
    found = ", ".join(str(file.relative_to(folder)) for file in files) or "none"
    raise RolloutError(
        f"{folder}: found videos {found} and {len(images)} PNG files; expected one *.mkv, *.mp4 or *.npz, or PNG frames alone."
    )


def _read_pngs(paths: tuple[Path, ...]) -> np.ndarray:
    frames: list[np.ndarray] = []
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise RolloutError(f"{path} is no readable PNG; make this rollout again.")
        if frames and image.shape != frames[0].shape:
            raise RolloutError(
                f"{path} is {image.shape[:2]}, the frames before it are {frames[0].shape[:2]}; sizes must be one."
            )
        frames.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    return np.stack(frames)


def _read_npz(path: Path) -> np.ndarray:
    try:
        arrays = read_npz(path)
    except Exception as error:  # zipfile, zlib and NumPy each have their own
        raise RolloutError(f"{path} is damaged ({error}); make this rollout again.") from error
    if len(arrays) != 1:
        raise RolloutError(f"{path} holds the arrays {sorted(arrays)}, expected one: the video [t h w 3] uint8.")
    return next(iter(arrays.values()))

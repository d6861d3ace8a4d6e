"""Store of surface tracks, <folder>/<task>/<seed>/<robot>.npz: an episode's tracks are rendered once.

A file holds a key of its inputs. Damaged files and files with another key are ignored.
"""

import hashlib
import threading
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from xew.episode import Record, States, array_hash, check_forms, episode_folder, read_npz
from xew.files import digest_files, replacing
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.rendering.surfaces import SurfaceTracks

_SAVING = threading.Lock()
"""Lock for writing: threads may grade the same episode over different frames."""
CODE = ("embodiment", "geometry", "kinematics", "production", "rendering")
"""Packages whose code, with the stage, determines the tracks."""


FORMS = {
    "pixels": "float32 t p 2",
    "visible": "bool t p",
    "body": "int32 p",
    "local": "float32 p 3",
    "shown": "int16 t h w",
    "is_robot": "bool b",
    "displacement": "float32 t b",
    "step": "float32 t b",
}
"""Type and shape of each array of `SurfaceTracks`."""


def tracks_path(folder: Path, record: Record) -> Path:
    """The file of an episode's tracks in a store."""
    path = episode_folder(folder, record.task, record.seed, record.robot)
    return path.with_name(f"{path.name}.npz")


def tracks_key(robot: RobotSpec, scene_hash: str, states: States) -> str:
    """SHA-256 over all inputs of an episode's tracks: the robot, the scene, recorded motion, the camera, and the code."""
    inputs = (scene_hash, repr(replace(robot, urdf=Path())), _digest_urdf(robot.urdf), _digest_code())
    image = repr(states.robot_mask.shape)
    arrays = (states.joint_pos, states.object_pose, states.object_joint, states.intrinsics, states.extrinsics)
    return hashlib.sha256("\n".join((*inputs, image, *map(array_hash, arrays))).encode()).hexdigest()


def load_tracks(path: Path, key: str, shape: tuple[int, ...]) -> SurfaceTracks | None:
    """The stored tracks with a key, of a video with this shape [t h w], or None."""
    try:
        stored = read_npz(path)
        if str(stored["key"]) != key:
            return None
        check_forms(stored, FORMS)
        arrays: dict[str, Any] = {field.name: stored[field.name] for field in fields(SurfaceTracks)}
        names = tuple(str(name) for name in arrays.pop("names"))
        bodies, count = np.append(arrays["body"], arrays["shown"].max(initial=-1)), len(arrays["is_robot"])
        whole = arrays["shown"].shape == shape and len(names) == count and -1 <= bodies.min() <= bodies.max() < count
    except Exception:  # zipfile, zlib and NumPy each have their own
        return None
    return SurfaceTracks(names=names, **arrays) if whole else None


def save_tracks(path: Path, key: str, tracks: SurfaceTracks) -> None:
    """Store tracks under a key; errors of the disk are ignored."""
    arrays = {field.name: getattr(tracks, field.name) for field in fields(tracks)}
    arrays["names"] = np.array(tracks.names)
    try:
        with _SAVING, replacing(path, within=path.parents[3]) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, key=np.array(key), **arrays)
    except OSError:
        return


@lru_cache(maxsize=256)
def _digest_urdf(path: Path) -> str:
    return digest_files(load_urdf(path).files)


@lru_cache(maxsize=1)
def _digest_code() -> str:
    package = Path(__file__).parents[1]
    files = [file for folder in CODE for file in sorted((package / folder).rglob("*.py"))] + [package / "stage.py"]
    return f"{digest_files(files)} {np.__version__} {wp.__version__}"

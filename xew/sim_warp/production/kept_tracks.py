"""Points on surfaces, kept on disk, so that an episode's are rendered once and not in every run that compares them.

Reads  <folder>/<task>/<seed>/<robot>.npz
Writes the same; a file says what it was made from, and one that was made from anything else, or is damaged, is not taken
"""

import hashlib
import threading
import zipfile
import zlib
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from xew.episode import Record, States, array_hash, episode_folder, read_npz
from xew.files import digest_files, replacing
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.rendering.surfaces import SurfaceTracks

_SAVING = threading.Lock()
"""Lock of the file of a process that is being written: threads may grade the same episode over different frames."""
CODE = ("embodiment", "geometry", "kinematics", "production", "rendering")
"""Packages of the room whose code, with the stage, decides where points are and what is seen of them."""


def tracks_path(folder: Path, record: Record) -> Path:
    """The file of an episode's tracks below the folder that keeps them."""
    place = episode_folder(folder, record.task, record.seed, record.robot)
    return place.with_name(f"{place.name}.npz")


def tracks_key(robot: RobotSpec, scene_hash: str, states: States) -> str:
    """SHA-256 over all that an episode's tracks depend on: the robot, the scene, recorded motion, the camera, and the code."""
    made_from = (scene_hash, repr(replace(robot, urdf=Path())), _digest_urdf(robot.urdf), _digest_code())
    image = repr(states.robot_mask.shape)
    arrays = (states.joint_pos, states.object_pose, states.object_joint, states.intrinsics, states.extrinsics)
    return hashlib.sha256("\n".join((*made_from, image, *map(array_hash, arrays))).encode()).hexdigest()


def load_tracks(path: Path, key: str) -> SurfaceTracks | None:
    """The tracks that were kept under a key; None where there are none, or others."""
    try:
        stored = read_npz(path)
        if str(stored["key"]) != key:
            return None
        arrays: dict[str, Any] = {field.name: stored[field.name] for field in fields(SurfaceTracks)}
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error):
        return None
    names = tuple(str(name) for name in arrays.pop("names"))
    return SurfaceTracks(names=names, **arrays)


def save_tracks(path: Path, key: str, tracks: SurfaceTracks) -> None:
    """Keep tracks under a key; where the disk does not take them, they are made again next time."""
    arrays = {field.name: getattr(tracks, field.name) for field in fields(tracks)}
    arrays["names"] = np.array(tracks.names)
    try:
        with _SAVING, replacing(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, key=np.array(key), **arrays)
    except OSError:
        return


@lru_cache(maxsize=256)
def _digest_urdf(path: Path) -> str:
    return digest_files(load_urdf(path).files)


@lru_cache(maxsize=1)
def _digest_code() -> str:
    room = Path(__file__).parents[1]
    files = [file for folder in CODE for file in sorted((room / folder).rglob("*.py"))] + [room / "stage.py"]
    return f"{digest_files(files)} {np.__version__} {wp.__version__}"

"""Metrics, the true side of a comparison: what an episode's files say of its pixels, its robot and its objects.

Reads  <data>/<task>/<seed>/<robot>/ (xew.episode)
"""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xew.episode import EpisodeError, States, demand_known, read_states, read_video

NEEDS = {
    "video": (),
    "mask": ("robot_mask",),
    "region": ("robot_mask",),
    "keypoints": ("keypoints", "keypoint_visible"),
    "objects": ("object_pose", "extrinsics", "intrinsics"),
}
"""What is compared, and the arrays of an episode that it rests on; imported episodes may not know some."""


@dataclass(frozen=True)
class Truth:
    """One episode as it happened, cut to the frames that were asked for."""

    rgb: np.ndarray
    """[t h w 3] uint8."""
    mask: np.ndarray
    """[t h w] bool, the robot."""
    keypoints: np.ndarray
    """[t k 2] float32 pixels, the robot's links."""
    keypoint_visible: np.ndarray
    """[t k] bool."""
    objects: np.ndarray
    """[t o 2] float32 pixels, origins of the objects' recorded poses, projected; NaN behind the camera."""
    object_visible: np.ndarray
    """[t o] bool: in the image and not behind the robot. What hides behind another object counts as visible: episodes hold
    no depth."""


def read_truth(folder: Path, frames: int, compared: Collection[str]) -> Truth:
    """The first frames of an episode.

    Args:
        folder: of the episode.
        frames: how many are asked for.
        compared: keys of NEEDS; an array that none of them rests on may be unknown.

    Raises:
        EpisodeError: a file is missing or damaged, files contradict each other, or the episode does not know what is compared.
    """
    demand_known(folder, *sorted({name for kind in compared for name in NEEDS[kind]}))
    states = read_states(folder)
    rgb = read_video(folder / "rgb.mkv")
    if rgb.shape[:3] != states.robot_mask.shape:
        raise EpisodeError(f"{folder}: video {rgb.shape[:3]} and masks {states.robot_mask.shape} differ; generate it anew.")
    objects = project(states.object_pose[..., :3], states.intrinsics, states.extrinsics)
    return Truth(
        rgb=rgb[:frames],
        mask=states.robot_mask[:frames],
        keypoints=states.keypoints[:frames],
        keypoint_visible=states.keypoint_visible[:frames],
        objects=objects[:frames],
        object_visible=_uncovered(objects, states)[:frames],
    )


def project(points: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray) -> np.ndarray:
    """Pixels [... 2] float32 of world points [... 3] m; NaN where a point is not before the camera."""
    seen = points @ extrinsics[:3, :3].T + extrinsics[:3, 3]
    depth = np.where(seen[..., 2:] > 0, seen[..., 2:], np.nan)
    return ((seen / depth) @ intrinsics[:2].T).astype(np.float32)


def _uncovered(points: np.ndarray, states: States) -> np.ndarray:
    """[t o] bool, is each point [t o 2] in the image, in a pixel that does not show the robot."""
    frames, height, width = states.robot_mask.shape
    pixels = np.nan_to_num(np.round(points), nan=-1).astype(int)
    x, y = pixels[..., 0], pixels[..., 1]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    covered = states.robot_mask[np.arange(frames)[:, None], np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return inside & ~covered

"""Baselines: videos of an episode that no model made, graded like a model's.

Reads  the episode (xew.metrics.truth), its robot.mkv, and the same scene's episodes of other robots

A model is worth its training if it beats `pasted_render`, the no-learning baseline: it uses only the first frame and the
robot's commands. To add a baseline, write a function of an episode and one line in BASELINES.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from xew.dataset import Episode
from xew.episode import WHITE, Record, read_pixels, read_record
from xew.metrics.truth import Truth
from xew.protocol import COPY_FIRST_FRAME, GROUND_TRUTH, OTHER_ROBOT, PASTED_RENDER

GROWN = 1
"""Number of pixels by which the robot of the first frame is grown before it is filled in, for its soft outline."""
FILL_RADIUS = 5
"""Radius [pixels] of the neighborhood that a filled pixel is computed from."""


@dataclass(frozen=True)
class Baseline:
    """One baseline: how its video is made, and what it is made from."""

    make: Callable[[Path, Truth], np.ndarray]
    """Function of an episode's folder and truth to the video, uint8 [t h w 3] of the truth's shape."""
    source: Callable[[Path, Record], str | None] = lambda folder, record: ""
    """Function of an episode's folder and header to the digest of what the video is made from besides the truth; None where
    the data set does not hold that, and the baseline is left out."""


def copy_first_frame(folder: Path, truth: Truth) -> np.ndarray:
    """The first frame, frozen: uint8 [t h w 3]."""
    return np.repeat(truth.rgb[:1], len(truth.rgb), axis=0)


def pasted_render(folder: Path, truth: Truth) -> np.ndarray:
    """`paste_render` of an episode: uint8 [t h w 3]. No frame of the truth but the first is looked at."""
    return paste_render(truth.rgb[0], read_pixels(folder, "robot")[: len(truth.rgb)])


def paste_render(first: np.ndarray, render: np.ndarray) -> np.ndarray:
    """The first frame with its robot inpainted (Telea 2004) and the render of the robot's commands pasted on it.

    Args:
        first: [h w 3] uint8, first frame of an episode.
        render: [t h w 3] uint8, its robot alone on a white ground.

    Returns:
        [t h w 3] uint8, which begins with the first frame unchanged.
    """
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * GROWN + 1, 2 * GROWN + 1))
    hole = cv2.dilate(cv2.bitwise_not(_white_ground(render[0])), disk)
    scene = cv2.inpaint(first, hole, FILL_RADIUS, cv2.INPAINT_TELEA)
    pasted = render.copy()
    for frame in pasted[1:]:  # by OpenCV, which takes a fifth of NumPy's time for a mask of channels
        cv2.copyTo(scene, _white_ground(frame), frame)
    pasted[0] = first
    return pasted


def _white_ground(frame: np.ndarray) -> np.ndarray:
    """Where a render [h w 3] shows no robot: [h w] uint8, 255 there and 0 elsewhere."""
    return cv2.inRange(frame, (WHITE,) * 3, (255,) * 3)


def other_robot(folder: Path, truth: Truth) -> np.ndarray:
    """The true episode of the next robot by name in the same scene: uint8 [t h w 3]; a shorter one stands still at its end."""
    other = find_other_robot(folder, read_record(folder))
    assert other is not None, "BASELINES asks before"
    video = read_pixels(other[0], "rgb", record=other[1])
    return video[np.minimum(np.arange(len(truth.rgb)), len(video) - 1)]


def find_other_robot(folder: Path, record: Record) -> Episode | None:
    """The next robot's episode by name, in a circle, that is of the same scene and has its video.

    `record` is the header of the episode in the folder.
    """
    names = sorted(path.name for path in folder.parent.iterdir() if (path / "episode.json").exists())
    place = names.index(folder.name)
    for name in names[place + 1 :] + names[:place]:
        candidate = read_record(folder.parent / name)
        if candidate.is_recorded and candidate.videos and candidate.scene_hash == record.scene_hash:
            return folder.parent / name, candidate
    return None


def _render_digest(folder: Path, record: Record) -> str | None:
    return record.hashes.get("robot") if (folder / "robot.mkv").exists() else None


def _other_digest(folder: Path, record: Record) -> str | None:
    other = find_other_robot(folder, record)
    return None if other is None else other[1].hashes["rgb"]


BASELINES: dict[str, Baseline] = {
    COPY_FIRST_FRAME: Baseline(copy_first_frame),
    PASTED_RENDER: Baseline(pasted_render, _render_digest),
    OTHER_ROBOT: Baseline(other_robot, _other_digest),
    GROUND_TRUTH: Baseline(lambda folder, truth: truth.rgb),
}

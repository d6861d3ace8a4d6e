"""Ground truth: what an episode's files say of its pixels, its robot and its objects.

Reads  <data>/<task>/<seed>/<robot>/ (xew.episode)
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from xew.episode import EpisodeError, Record, States, demand_known, project, read_pixels, read_record, read_states
from xew.metrics.estimators.appearance import REST as SCENE
from xew.metrics.outcome.judge import Outcome, know_outcome
from xew.metrics.outcome.variants import find_variants

OUTCOME_NEEDS = ("action", "tool_pose", "object_pose", "object_joint", "contact", "extrinsics", "intrinsics")
NEEDS = {
    "video": (),
    "mask": ("robot_mask",),
    "region": ("robot_mask",),
    "robot": ("robot_mask",),
    "bodies": ("robot_mask",),
    "keypoints": ("keypoints", "keypoint_visible"),
    "objects": ("object_pose", "extrinsics", "intrinsics"),
    "robot_points": ("keypoints", "keypoint_visible"),
    "object_points": ("object_pose", "extrinsics", "intrinsics"),
    "outcome": OUTCOME_NEEDS,
    "variants": OUTCOME_NEEDS,
    "variant_videos": OUTCOME_NEEDS,
}
"""Arrays of an episode that each kind of comparison rests on; imported episodes may not know some."""
OF_OUTCOME = frozenset({"outcome", "variants", "variant_videos"})
"""Kinds of comparison that rest on `Truth.outcome`, which asks for points on objects."""
WITH_SURFACES = frozenset(NEEDS) - {"video", "region", "robot"}
"""Kinds of comparison that look for bodies, which surfaces tell apart."""

REST = 1.0
"""Largest distance [pixels] by which a resting object's point may move."""
MOVED = 0.01
"""Distance from its first place [m] from which on an object has moved, so points on it count."""
PATCH = 2
"""Number of pixels to each side of a point whose mean is the color of its place."""
OTHER_COLOR = 40
"""Least difference [levels of a channel] that is another color. A shadow on a bright object may be one too: then its frames
are left out, which costs little."""


@dataclass(frozen=True)
class Points:
    """Points whose paths in the image are known."""

    pixels: np.ndarray
    """[t k 2] float32 pixels; NaN behind the camera."""
    visible: np.ndarray
    """[t k] bool."""
    body: np.ndarray | None = None
    """[k] int, index of the body that each point lies on, as in `Surfaces.body_id`; None where bodies are not known."""
    finger: np.ndarray | None = None
    """[k] int, the finger of each point: 0 and 1 of the left hand, 2 and 3 of the right, else -1; None if not known."""
    local: np.ndarray | None = None
    """[k 3] float32, place of each point in the frame of its body [m]; None where bodies are not known."""


@dataclass(frozen=True)
class Surfaces:
    """Points on the surfaces of the robot's moving links, and of the objects and lids that move."""

    robot: Points
    objects: Points
    body_id: np.ndarray | None
    """[t h w] int16, index of the body that a pixel shows, -1 for any other; None where the shapes are not known."""
    known: bool
    """False where the episode's shapes are not known, as of an imported one: the points are then links' and objects'
    origins."""
    resting: Points | None = None
    """Points on objects and lids that do not move; None where the shapes are not known."""
    names: tuple[str, ...] = ()
    """Names of the bodies of known shapes, in the order of their indices."""


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
    """[t o] bool: in the image, not behind the robot, and, where the object rests, not behind another (`_has_changed_at_rest`).
    A moving object that is behind another counts as visible: episodes hold no depth."""
    surfaces: Surfaces | None = None
    """Points on surfaces; None where they were not asked for."""
    outcome: Outcome | None = None
    """Knowledge of a judge of the outcome; None where it was not asked for or is not known."""

    @cached_property
    def labels(self) -> np.ndarray:
        """[t h w] int16, 0 for the robot, numbers from 1 for objects of known shapes, SCENE for the rest."""
        labels = np.full(self.mask.shape, SCENE, np.int16)
        if self.surfaces is not None and self.surfaces.body_id is not None:
            np.copyto(labels, self.surfaces.body_id + 1, casting="unsafe", where=self.surfaces.body_id >= 0)
        labels[self.mask] = 0
        return labels

    @cached_property
    def keypoint_diagonal(self) -> np.ndarray:
        """[t] float32, diagonal [pixels] of the box of all keypoints inside the image, occluded or not; 0 without any."""
        inside = is_inside(self.keypoints, self.rgb.shape)[..., None]
        low = np.where(inside, self.keypoints, np.inf).min(axis=1, initial=np.inf)
        high = np.where(inside, self.keypoints, -np.inf).max(axis=1, initial=-np.inf)
        return np.linalg.norm(np.where(inside.any(axis=1), high - low, 0), axis=-1).astype(np.float32)


def read_truth(
    folder: Path, frames: int, compared: Collection[str], cache: Path | None = None, record: Record | None = None
) -> Truth:
    """The first frames of an episode.

    Args:
        folder: of the episode.
        frames: how many are asked for.
        compared: keys of NEEDS; an array that none of them rests on may be unknown.
        cache: folder of points on surfaces, which are rendered once and kept there; None renders them again.
        record: the episode's header, which is read if None.

    Raises:
        EpisodeError: a file is missing or damaged, files contradict each other, or the episode does not know what is compared.
    """
    record = record or read_record(folder)
    demand_known(folder, *sorted({name for kind in compared for name in NEEDS[kind]}), record=record)
    states = read_states(folder, record)
    rgb = read_pixels(folder, "rgb", record=record)
    if rgb.shape[:3] != states.robot_mask.shape:
        raise EpisodeError(f"{folder}: video {rgb.shape[:3]} and masks {states.robot_mask.shape} differ; generate it again.")
    objects = project(states.object_pose[..., :3], states.intrinsics, states.extrinsics)[0].astype(np.float32)
    visible = _find_visible(objects, rgb, states.robot_mask)
    surfaces = outcome = None
    if WITH_SURFACES & set(compared):
        surfaces = _find_surfaces(folder, states, frames, cache) or Surfaces(
            Points(states.keypoints[:frames], states.keypoint_visible[:frames]),
            _of_moving(states.object_pose[..., :3], Points(objects, visible), frames),
            body_id=None,
            known=False,
        )
    if surfaces is not None and surfaces.resting is not None and OF_OUTCOME & set(compared):
        points = surfaces.objects, surfaces.resting
        body, local = (np.concatenate([getattr(some, name) for some in points]) for name in ("body", "local"))
        names = [surfaces.names[number] for number in body]
        outcome = know_outcome(record, states, names, local)
        if outcome is not None:
            variants, own = find_variants(folder, record, frames, cache)
            outcome = replace(outcome, variants=variants, own=own)
    return Truth(
        rgb=rgb[:frames],
        mask=states.robot_mask[:frames],
        keypoints=states.keypoints[:frames],
        keypoint_visible=states.keypoint_visible[:frames],
        objects=objects[:frames],
        object_visible=visible[:frames],
        surfaces=surfaces,
        outcome=outcome,
    )


def _find_surfaces(folder: Path, states: States, frames: int, cache: Path | None) -> Surfaces | None:
    # Only here: the metrics load without Warp.
    from xew.sim_warp.production.surfaces import find_fingers, read_surfaces

    tracks = read_surfaces(folder, cache, states)
    if tracks is None:
        return None
    finger = find_fingers(folder, tracks.names)
    of_robot = tracks.is_robot[tracks.body]
    moves = (tracks.displacement[:frames].max(axis=0) > MOVED)[tracks.body]
    robot, objects, resting = (
        Points(
            tracks.pixels[:frames, some],
            tracks.visible[:frames, some],
            tracks.body[some],
            finger[tracks.body[some]],
            tracks.local[some],
        )
        for some in (of_robot, ~of_robot & moves, ~of_robot & ~moves)
    )
    return Surfaces(robot, objects, tracks.shown[:frames], True, resting, tracks.names)


def _of_moving(places: np.ndarray, points: Points, frames: int) -> Points:
    """The first frames of the points [t o] of objects that move, by their origins' places [t o 3] m."""
    moves = np.linalg.norm(places[:frames] - places[:1], axis=-1).max(axis=0, initial=0) > MOVED
    return Points(points.pixels[:frames, moves], points.visible[:frames, moves])


def _find_visible(points: np.ndarray, rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[t o] bool, as `Truth.object_visible` says."""
    free = is_inside(points, rgb.shape) & ~_is_covered(points, mask)
    return free & ~_has_changed_at_rest(points, free, rgb)


def _has_changed_at_rest(points: np.ndarray, free: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """[t o] bool: the object is where it was when it was first free, and its place has another color since.

    This distinguishes what a robot puts on something, a cup on its coaster, from what lies under it.
    """
    t, o = free.shape
    first, objects = free.argmax(axis=0), np.arange(o)
    at_rest = np.linalg.norm(np.nan_to_num(points - points[first, objects]), axis=-1) < REST
    around = np.arange(-PATCH, PATCH + 1)
    x, y = np.moveaxis(_pixels(points), -1, 0)[..., None]
    rows = np.clip(y + around, 0, rgb.shape[1] - 1)[..., :, None]
    columns = np.clip(x + around, 0, rgb.shape[2] - 1)[..., None, :]
    color = rgb[np.arange(t)[:, None, None, None], rows, columns].mean(axis=(2, 3))
    changed = np.abs(color - color[first, objects]).max(axis=-1) > OTHER_COLOR
    return at_rest & changed & free.any(axis=0)


def is_inside(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """[t n] bool, is each point [t n 2] in a pixel of a video of this shape [t h w 3]."""
    x, y = np.moveaxis(_pixels(points), -1, 0)
    return (x >= 0) & (x < shape[2]) & (y >= 0) & (y < shape[1])


def _is_covered(points: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[t n] bool, does the pixel of each point [t n 2] belong to the mask [t h w]; of points outside, the nearest pixel."""
    x, y = np.moveaxis(_pixels(points), -1, 0)
    frames, height, width = mask.shape
    return mask[np.arange(frames)[:, None], np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]


def _pixels(points: np.ndarray) -> np.ndarray:
    return np.nan_to_num(np.round(points), nan=-1).astype(int)

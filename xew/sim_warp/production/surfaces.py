"""Surface points of episodes on disk, and their visibility.

Points are computed from recorded states and the shapes of the robot and objects; kept_tracks.py can store them.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xew.config import ConfigError, UntrustedError
from xew.episode import Record, States, data_folder, read_record, read_states
from xew.sim_warp.changes.scenes import make_scene
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.geometry.camera import Camera
from xew.sim_warp.production.kept_tracks import load_tracks, save_tracks, tracks_key, tracks_path
from xew.sim_warp.rendering.bodies import SIDES
from xew.sim_warp.rendering.observe import scene_recording
from xew.sim_warp.rendering.streams import default_renderer
from xew.sim_warp.rendering.surfaces import MOVED, MOVING, SurfaceTracks, track_surfaces
from xew.sim_warp.robots import recorded_robot
from xew.sim_warp.scene import Scene, scene_hash
from xew.sim_warp.stage import Stage
from xew.sim_warp.tasks import recorded_task


@dataclass(frozen=True)
class Seen:
    """Visibility of one object or the robot in some frames."""

    points: np.ndarray
    """[m] int, visible points on it."""
    pixels: np.ndarray
    """[m] int, its pixels."""


@dataclass(frozen=True)
class Visibility:
    """Visibility of an episode's surfaces."""

    robot: Seen
    """In all frames."""
    things: dict[str, Seen]
    """Moving objects in their moving frames, by name."""


def scene_names(scene: Scene) -> tuple[str, ...]:
    """Names of the bodies of `rendering.observe.scene_things`: the objects, then the lids of hinged objects, then clutter."""
    lids = (f"{thing.name} lid" for thing in scene.objects if thing.hinge is not None)
    return *scene.names, *lids, *(thing.name for thing in scene.clutter)


def read_surfaces(folder: Path, keep: Path | None = None, states: States | None = None) -> SurfaceTracks | None:
    """Surface tracks of an accepted episode.

    Args:
        folder: of the episode.
        keep: store that they are read from or written to.
        states: of the episode, which are read if None.

    Returns:
        None if the shapes are unknown: the episode was imported, its task now makes another scene of its seed, its task or
        robot does not exist, or several views are tiled into one picture.

    Raises:
        EpisodeError: a file is missing or damaged.
        UntrustedError: the task or robot is of a module that the user has not admitted.
    """
    record = read_record(folder)
    try:
        scene = None if record.source or record.camera.parts else find_scene(record)
        robot = recorded_robot(record.robot, data_folder(folder))
    except UntrustedError:
        raise
    except ConfigError:  # unknown task or robot
        scene = None
    if scene is None:
        return None
    states = states or read_states(folder, record)
    if keep is None:
        return _render_surfaces(robot, scene, states)
    path, key = tracks_path(keep, record), tracks_key(robot, record.scene_hash, states)
    tracks = load_tracks(path, key, states.robot_mask.shape)
    if tracks is None:
        tracks = _render_surfaces(robot, scene, states)
        save_tracks(path, key, tracks)
    return tracks


def find_fingers(folder: Path, names: Sequence[str]) -> np.ndarray:
    """The finger that each body of an episode's surface tracks belongs to.

    Args:
        folder: of an episode whose robot is known.
        names: of the bodies, as `SurfaceTracks.names`.

    Returns:
        [b] int: 0 and 1 for the fingers of the left hand, 2 and 3 for those of the right, -1 for all others.
    """
    robot = recorded_robot(read_record(folder).robot, data_folder(folder))
    urdf = load_urdf(robot.urdf)
    fingers: dict[str, int] = {}
    for side, (name, arm) in enumerate(zip(SIDES, robot.arms, strict=True)):
        for index, joint in enumerate(arm.fingers):
            links = [link.name for link in urdf.moved_links(joint)]
            fingers |= {link if robot.one_urdf_holds_both_arms else f"{name}/{link}": 2 * side + index for link in links}
    return np.array([fingers.get(name, -1) for name in names])


def _render_surfaces(robot: RobotSpec, scene: Scene, states: States) -> SurfaceTracks:
    """The tracks of an episode from its states."""
    recording = scene_recording(robot, scene, states.joint_pos, states.object_pose, states.object_joint)
    height, width = states.robot_mask.shape[1:]
    camera = Camera(states.intrinsics, states.extrinsics, width, height)
    return track_surfaces([recording], [scene_names(scene)], default_renderer(), camera, Stage(raised=scene.raised))[0]


def find_scene(record: Record) -> Scene | None:
    """The scene of an episode; None if its task now makes another scene of its seed."""
    scene = make_scene(recorded_task(record.task), record.task, record.seed, record.change)
    return scene if scene.names == record.object_names and scene_hash(scene) == record.scene_hash else None


def count_visible(tracks: SurfaceTracks) -> Visibility:
    """Visible points and pixels of the robot by frame, and of each moving object by moving frame."""
    bodies = range(len(tracks.names))
    points = np.stack([tracks.visible[:, tracks.body == b].sum(axis=1) for b in bodies], axis=1)
    pixels = np.stack([np.sum(tracks.shown == b, axis=(1, 2)) for b in bodies], axis=1)
    things = np.flatnonzero(~tracks.is_robot & (tracks.displacement.max(axis=0) > MOVED))
    moving = tracks.step > MOVING
    of_robot = Seen(*(counts[:, tracks.is_robot].sum(axis=1) for counts in (points, pixels)))
    return Visibility(of_robot, {tracks.names[b]: Seen(points[moving[:, b], b], pixels[moving[:, b], b]) for b in things})


def read_visibility(folders: Sequence[Path], keep: Path | None = None) -> dict[tuple[str, str], list[Visibility]]:
    """Visibility of episodes with known shapes, by task and robot. Raises as `read_surfaces`."""
    visibility: dict[tuple[str, str], list[Visibility]] = defaultdict(list)
    for folder in folders:
        tracks = read_surfaces(folder, keep=keep)
        if tracks is not None:
            record = read_record(folder)
            visibility[record.task, record.robot].append(count_visible(tracks))
    return dict(sorted(visibility.items()))

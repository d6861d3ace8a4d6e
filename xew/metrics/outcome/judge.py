"""A judge of outcomes without weights: objects' poses in a predicted video, and the progress of a task that they mean.

The judge knows what a model was given: the scene at first, the camera, and the commands. The hands' paths are those that the
commands had in the simulator; a hand touches what it is near to. Objects are where a variant of the commands has them, if the
video shows them there (`variants.py`), else where their points are tracked (`poses.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from xew.episode import Record, States
from xew.metrics.metric import fill_up
from xew.metrics.outcome.poses import REACH, Body, Hands, Lens, follow_body
from xew.metrics.outcome.variants import CommandVariants, Variant
from xew.protocol import ARMS

if TYPE_CHECKING:
    from xew.sim_warp.scene import Hinge, Scene
    from xew.sim_warp.tasks import Task

FRAME_BLOCK, POINT_BLOCK = 64, 16
"""Numbers of frames and points that tracks are filled up to multiples of, so they share a few compiled programs."""
OPEN = 0.8
"""Command of a gripper from which on it holds nothing."""
UNJUDGED = ("place_dual_shoes", "place_mouse_pad", "press_stapler")
"""Tasks of which the judge says nothing, by the rule of docs/metrics.md."""


@dataclass(frozen=True)
class Part:
    """A free object or a lid, whose pose is estimated."""

    index: int
    """Number of its object in the scene."""
    hinge: "Hinge | None"
    """The hinge of a lid."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What is known of an episode besides its video."""

    task: "Task"
    scene: "Scene"
    states: States
    """Of all frames. Of objects after the first frame, only the functions of the truth ask."""
    local: np.ndarray
    """[k 3] places of tracked points in the frames of their parts [m]."""
    part: np.ndarray
    """[k] int, the part of each, -1 for none."""
    variants: CommandVariants | None = None
    """All variants of the commands in this scene, these among them; None if there are no others."""
    own: int = 0
    """The number of these commands among the variants."""

    @property
    def is_judged(self) -> bool:
        """Whether the judge says something of its task."""
        return self.task.name not in UNJUDGED

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """What can move, in the order of `poses`."""
        return _parts(self.scene)

    def poses(self, tracks: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Poses [t p 4 4] of the parts, world, from the first frame on.

        Args:
            tracks: [t k 2] pixels, NaN where a point is lost.
            visible: [t k] bool, where it should be seen.
        """
        with jax.default_device(jax.local_devices(backend="cpu")[0]):  # tracks are small
            hands, lens = self._known(len(tracks))
            parts = range(len(self.parts))
            poses = [follow_body(*self._points_of(part, tracks, visible), self._body(part), hands, lens) for part in parts]
        return np.stack(poses, axis=1)[: len(tracks)]

    def _points_of(self, part: int, tracks: np.ndarray, visible: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tracks [t k 2] pixels, visibility [t k] and places [k 3] m of the points on a part, filled up."""
        own = self.part == part
        tracks, visible = (fill_up(array[:, own], 1, POINT_BLOCK, 0) for array in (tracks, visible))
        local = fill_up(self.local[own], 0, POINT_BLOCK, 0)
        return fill_up(tracks, 0, FRAME_BLOCK, 0), fill_up(visible, 0, FRAME_BLOCK, 0), local

    def true_poses(self, frames: int) -> np.ndarray:
        """Poses [t p 4 4] of the parts in the simulator."""
        return self.poses_of(self.states)[:frames]

    def progress(self, poses: np.ndarray, frame: int) -> float:
        """Progress in a frame in which the parts have these poses [p 4 4]."""
        object_pose, object_joint = self.place(poses)
        hands = self.states.tool_pose[frame, :, :3]
        contact = np.linalg.norm(hands[:, None] - object_pose[None, :, :3], axis=-1) < REACH
        return self._measure(object_pose, object_joint, contact, frame)

    def true_progress(self, frame: int) -> float:
        """Progress in a frame in the simulator."""
        states = self.states
        return self._measure(states.object_pose[frame], states.object_joint[frame], states.contact[frame], frame)

    def place(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses [o 7] and hinge angles [o] rad of the scene's objects, if the parts have these poses [p 4 4]."""
        from xew.sim_warp.geometry.poses import matrix_from_pose, pose_from_matrix  # only here: the metrics load without Warp

        object_pose, object_joint = (array[0].astype(float) for array in (self.states.object_pose, self.states.object_joint))
        for pose, part in zip(poses, self.parts, strict=True):
            if part.hinge is None:
                object_pose[part.index] = pose_from_matrix(pose)
            else:
                object_joint[part.index] = _angle(matrix_from_pose(object_pose[part.index]), pose, part.hinge)
        return object_pose, object_joint

    def distances(self, poses: np.ndarray, frames: slice) -> np.ndarray:
        """Mean distance [v] m float32 of points on the parts from where they are under each variant of the commands.

        Args:
            poses: [t p 4 4] of the parts.
            frames: which of them count; a variant that ends earlier stands still.
        """
        assert self.variants is not None, "asked for by read_truth"
        own = self._points_at(poses)[frames]
        count = np.arange(len(poses))
        others = (self.poses_of(variant) for variant in self.variants.variants)
        there = (self._points_at(other[np.minimum(count, len(other) - 1)])[frames] for other in others)
        return np.array([np.linalg.norm(own - points, axis=-1).mean() for points in there], np.float32)

    def _points_at(self, poses: np.ndarray) -> np.ndarray:
        """Places [t k 3] of the points on parts with these poses [t p 4 4], world."""
        matrix = poses[:, self.part[self.part >= 0]]
        return np.einsum("tkij,kj->tki", matrix[..., :3, :3], self.local[self.part >= 0]) + matrix[..., :3, 3]

    def poses_of(self, states: States | Variant) -> np.ndarray:
        """Poses [t p 4 4] of the parts in states of the scene."""
        from xew.sim_warp.geometry.poses import matrix_from_pose
        from xew.sim_warp.rendering.observe import scene_things

        _, pose = scene_things(self.scene, states.object_pose, states.object_joint)
        lids = [part.index for part in self.parts if part.hinge is not None]
        bodies = [part.index if part.hinge is None else len(self.scene.objects) + lids.index(part.index) for part in self.parts]
        return matrix_from_pose(pose[:, bodies])

    def _body(self, part: int) -> Body:
        """What the poses of a part rest on."""
        from xew.sim_warp.geometry.poses import matrix_from_pose

        start, hinge = self._start[part], self.parts[part].hinge
        if hinge is None:
            return Body(start, np.array(False), *np.zeros((2, 3)))
        base = matrix_from_pose(self.states.object_pose[0, self.parts[part].index])
        anchor, axis = base[:3, :3] @ hinge.anchor + base[:3, 3], base[:3, :3] @ hinge.axis
        return Body(start, np.array(True), anchor, axis / np.linalg.norm(hinge.axis))

    @cached_property
    def _start(self) -> np.ndarray:
        """Poses [p 4 4] of the parts in the first frame, world."""
        return self.poses_of(self.states)[0]

    def _known(self, frames: int) -> tuple[Hands, Lens]:
        """Hands and camera in the first frames, filled up."""
        from xew.sim_warp.geometry.poses import matrix_from_pose

        states, frame = self.states, fill_up(np.arange(frames), 0, FRAME_BLOCK)
        extrinsics = np.broadcast_to(states.extrinsics, (len(states.action), 4, 4))[frame]
        hands = Hands(matrix_from_pose(states.tool_pose[frame]), self._gripper[frame] < OPEN)
        return hands, Lens(states.intrinsics, extrinsics)

    @property
    def _gripper(self) -> np.ndarray:
        """[t 2] commands of the grippers."""
        return self.states.action[:, [column for _, column in ARMS]]

    def _measure(self, object_pose: np.ndarray, object_joint: np.ndarray, contact: np.ndarray, frame: int) -> float:
        """Progress with the hands of a frame and objects at poses [o 7] and angles [o], in contact where `contact` [2 o]."""
        from xew.sim_warp.changes.scenes import measure_progress
        from xew.sim_warp.tasks import Moment

        states, gripper = self.states, self._gripper
        first = Moment(states.object_pose[0], states.object_joint[0], states.tool_pose[0], gripper[0], states.contact[0])
        now = Moment(object_pose, object_joint, states.tool_pose[frame], gripper[frame], contact)
        return measure_progress(self.task, self.scene, first, now)


def know_outcome(record: Record, states: States, body: Sequence[str], local: np.ndarray) -> Outcome | None:
    """What a judge knows of an episode, without the variants of its commands.

    Args:
        record, states: of the episode.
        body: [k] names of the bodies that points on its objects lie on.
        local: [k 3] places of these points in the frames of their bodies [m].

    Returns:
        None if its scene is unknown or nothing in it can move.
    """
    from xew.sim_warp.production.surfaces import find_scene
    from xew.sim_warp.tasks import recorded_task

    scene = find_scene(record)
    if scene is None or not _parts(scene):
        return None
    part_names = [scene.names[part.index] + " lid" * (part.hinge is not None) for part in _parts(scene)]
    part = np.array([part_names.index(name) if name in part_names else -1 for name in body], int)
    return Outcome(recorded_task(record.task), scene, states, local, part)


def _parts(scene: "Scene") -> tuple[Part, ...]:
    free = [Part(index, None) for index, thing in enumerate(scene.objects) if not thing.is_fixed]
    return *free, *(Part(index, thing.hinge) for index, thing in enumerate(scene.objects) if thing.hinge is not None)


def _angle(base: np.ndarray, lid: np.ndarray, hinge: "Hinge") -> float:
    """The angle [rad] of a hinge, from the poses [4 4] of its base and its lid."""
    turn = Rotation.from_matrix(base[:3, :3].T @ lid[:3, :3]).as_rotvec()
    return float(turn @ hinge.axis / np.linalg.norm(hinge.axis))

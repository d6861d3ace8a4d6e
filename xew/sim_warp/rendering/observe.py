"""The head camera's observations, pure functions of recorded states."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.geometry.camera import HEAD_CAMERA, Camera, project
from xew.sim_warp.geometry.poses import matrix_from_pose, pose_from_matrix
from xew.sim_warp.kinematics.forward import link_poses
from xew.sim_warp.rendering.bodies import body_names, keypoint_links, nearby_links, robot_bodies, robot_pose
from xew.sim_warp.rendering.render import Body, Frames, Renderer, World
from xew.sim_warp.scene import Hinge, Scene
from xew.sim_warp.stage import STANDARD, Stage

VISIBILITY_MARGIN = 0.02
"""Distance in front of a link's origin beyond which another surface hides the link [m]."""


@dataclass(frozen=True)
class Recording:
    """One episode to render: a robot and objects, posed as measured."""

    robot: RobotSpec
    joint_pos: np.ndarray
    """[t 16] measured canonical joint positions [rad] and grippers [0 closed, 1 open]."""
    things: Sequence[Body] = ()
    """All bodies that are not the robot; equal `Mesh` objects are stored once."""
    thing_pose: np.ndarray | None = None
    """[t o 7] their measured poses, xyz [m] and quaternion xyzw, world, if any."""


@dataclass(frozen=True)
class Observation:
    """The camera's observation of one episode, with the names of `xew.episode.States`."""

    rgb: np.ndarray
    """[t h w 3] uint8, sRGB."""
    robot_mask: np.ndarray
    """[t h w] bool."""
    keypoints: np.ndarray
    """[t k 2] float32 x right, y down [pixels]."""
    keypoint_visible: np.ndarray
    """[t k] bool."""


def observe(
    renderer: Renderer, recordings: Sequence[Recording], camera: Camera = HEAD_CAMERA, stage: Stage = STANDARD
) -> list[Observation]:
    """Observe many episodes at once; the result of each does not depend on the others."""
    points = [keypoint_positions(recording.robot, recording.joint_pos) for recording in recordings]
    worlds = [recording_world(recording, at) for recording, at in zip(recordings, points, strict=True)]
    frames = renderer.render_batch(worlds, camera, stage=stage)
    return [_observation(*seen, camera) for seen in zip(recordings, points, frames, strict=True)]


def scene_recording(
    robot: RobotSpec, scene: Scene, joint_pos: np.ndarray, object_pose: np.ndarray, object_joint: np.ndarray
) -> Recording:
    """A recording from recorded states.

    Args:
        joint_pos: [t 16] canonical joint positions [rad] and grippers [0 closed, 1 open].
        object_pose: [t o 7] xyz [m] and quaternion xyzw, world.
        object_joint: [t o] hinge angles [rad].
    """
    things, thing_pose = scene_things(scene, object_pose, object_joint)
    return Recording(robot, joint_pos, things, thing_pose)


def scene_things(scene: Scene, object_pose: np.ndarray, object_joint: np.ndarray) -> tuple[list[Body], np.ndarray]:
    """The objects of a scene, then their lids and the clutter, as bodies with poses.

    Args:
        object_pose: [t o 7] recorded poses of the objects, xyz [m] and quaternion xyzw, world.
        object_joint: [t o] recorded hinge angles [rad].

    Returns:
        The bodies, and their poses [t b 7], world.
    """
    bodies = [Body(thing.shape.mesh, is_robot=False) for thing in scene.objects]
    poses = [object_pose]
    for index, thing in enumerate(scene.objects):
        if thing.hinge is not None:
            bodies.append(Body(thing.hinge.lid.mesh, is_robot=False))
            swing = _swing(thing.hinge, object_joint[:, index])
            poses.append(pose_from_matrix(matrix_from_pose(object_pose[:, index]) @ swing)[:, None])
    for thing in scene.clutter:
        bodies.append(Body(thing.shape.mesh, is_robot=False))
        poses.append(np.tile(np.array(thing.pose, object_pose.dtype), (len(object_pose), 1, 1)))
    return bodies, np.concatenate(poses, 1)


def _swing(hinge: Hinge, angle: np.ndarray) -> np.ndarray:
    """[t 4 4] motion of a lid in its object's frame at angles [t]."""
    motion = np.tile(np.eye(4), (len(angle), 1, 1))
    axis = np.array(hinge.axis) / np.linalg.norm(hinge.axis)
    motion[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
    motion[:, :3, 3] = np.array(hinge.anchor) - motion[:, :3, :3] @ np.array(hinge.anchor)
    return motion


def keypoint_names(robot: RobotSpec) -> tuple[str, ...]:
    """Names of the keypoints, such as left/link3: the moving links of the left arm, its fingers, then the right's."""
    return tuple(name for _, _, name in keypoint_links(robot))


def keypoint_positions(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[t k 3] float64 origins of the moving links [m], world, at canonical joint positions [t 16] rad."""
    poses = link_poses(robot, joint_pos)
    return np.stack([poses[copy][link][:, :3] for copy, link, _ in keypoint_links(robot)], 1)


def keypoint_visibility(robot: RobotSpec, points: np.ndarray, frames: Frames, camera: Camera) -> np.ndarray:
    """Visibility bool [t k] of keypoints [t k 3] m, world, which were given to the renderer with the frames.

    A keypoint is visible if its pixel shows its link or a neighboring link, or a surface at most `VISIBILITY_MARGIN` in front.
    """
    _, depth = project(camera, points)
    shown = frames.point_body
    own = _own_table(robot)
    own_body = np.where((shown >= 0) & (shown < own.shape[1] - 1), shown, -1)
    seen_depth = np.where(frames.point_depth > 0, frames.point_depth, np.inf)
    near = seen_depth >= depth - VISIBILITY_MARGIN
    return (shown != -2) & (depth > 0) & (near | own[np.arange(points.shape[1]), own_body])


def _own_table(robot: RobotSpec) -> np.ndarray:
    """[k b+1] bool, whether a body is the link of a keypoint or next to it; the last column, body -1, is False."""
    urdf = load_urdf(robot.urdf)
    bodies = body_names(robot)
    table = np.zeros((len(keypoint_links(robot)), len(bodies) + 1), bool)
    for row, (copy, link, _) in enumerate(keypoint_links(robot)):
        near = nearby_links(urdf, link)
        table[row, :-1] = [body_copy == copy and name in near for body_copy, name in bodies]
    return table


def recording_world(recording: Recording, points: np.ndarray | None = None) -> World:
    """A recording as the renderer takes it, the robot's bodies first; `points` [t k 3] m, world, are looked up."""
    bodies = [*robot_bodies(recording.robot), *recording.things]
    pose = robot_pose(recording.robot, recording.joint_pos)
    if recording.thing_pose is not None:
        pose = np.concatenate([pose, recording.thing_pose], 1)
    return World(bodies, pose, points)


def _observation(recording: Recording, points: np.ndarray, frames: Frames, camera: Camera) -> Observation:
    pixels, _ = project(camera, points)
    visible = keypoint_visibility(recording.robot, points, frames, camera)
    return Observation(frames.rgb, frames.robot_mask, pixels.astype(np.float32), visible)

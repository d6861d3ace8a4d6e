"""Renderings that are wrong in a known way, with their true masks, keypoints and object places.

Reads  an episode's recorded states
Writes `Perturbation`s: the same scene with robot and objects moved otherwise, as a model that errs would show it

An estimator sees the pixels only; what it says of them can be held against the truth that the renderer knows. The
simulation is asked to render when a case is made, so this module loads without Warp. Frame 0 is every model's given
frame and stays as it was.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from xew.episode import States, data_folder, demand_known, read_record, read_states
from xew.protocol import ARMS, parse_change


@dataclass(frozen=True)
class Perturbation:
    """What a wrong motion looks like, and where everything truly is in it."""

    rgb: np.ndarray
    """[t h w 3] uint8."""
    mask: np.ndarray
    """[t h w] bool, the robot."""
    keypoints: np.ndarray
    """[t k 2] float32 [pixels], as `States.keypoints`."""
    objects: np.ndarray
    """[t o 2] float32 [pixels], projected origins of the objects' poses."""


def delay(states: States, frames: int) -> States:
    """States in which everything happens some frames too late."""
    late = np.maximum(np.arange(states.frame_count) - frames, 0)
    return _replace_motion(states, states.joint_pos[late], states.object_pose[late], states.object_joint[late])


def freeze(states: States) -> States:
    """States in which nothing ever moves."""
    return delay(states, states.frame_count)


def bias_joints(states: States, angle: float) -> States:
    """States in which every joint of both arms is off by an angle [rad] after frame 0; the objects are where they belong."""
    joints = states.joint_pos.copy()
    for arm, _ in ARMS:
        used = np.any(states.joint_pos[:, arm] != 0, axis=0)  # arms of six joints leave their seventh at zero
        joints[1:, arm] += np.float32(angle) * used
    return _replace_motion(states, joints, states.object_pose, states.object_joint)


def halve_motion(states: States) -> States:
    """States in which robot and objects move half as far from where they began."""
    joints, hinges = (0.5 * (values[:1] + values) for values in (states.joint_pos, states.object_joint))
    poses = states.object_pose.copy()
    poses[..., :3] = 0.5 * (poses[:1, :, :3] + poses[..., :3])
    for index in range(poses.shape[1]):
        first, turned = (Rotation.from_quat(states.object_pose[rows, index, 3:]) for rows in (0, slice(None)))
        poses[:, index, 3:] = (Rotation.from_rotvec(0.5 * (turned * first.inv()).as_rotvec()) * first).as_quat()
    return _replace_motion(states, joints, poses, hinges)


MOTIONS: dict[str, Callable[[States], States]] = {
    "as recorded": lambda states: states,
    "3 frames late": lambda states: delay(states, 3),
    "8 frames late": lambda states: delay(states, 8),
    "joints off by 0.05 rad": lambda states: bias_joints(states, 0.05),
    "joints off by 0.12 rad": lambda states: bias_joints(states, 0.12),
    "half the motion": halve_motion,
    "frozen": freeze,
}
"""Perturbations of recorded states, by the name of the case."""


def render_perturbations(folder: Path) -> Iterator[tuple[str, Perturbation]]:
    """Every case of MOTIONS on one episode, rendered as soon as it is asked for.

    Raises:
        EpisodeError: the episode was imported and lacks the states to render from.
    """
    demand_known(folder, "joint_pos", "object_pose", "object_joint")
    states = read_states(folder)
    for name, motion in MOTIONS.items():
        yield name, render_perturbation(folder, motion(states))


def render_perturbation(folder: Path, states: States) -> Perturbation:
    """The scene of an episode with its robot and objects where other states have them."""
    from xew.sim_warp.changes.looks import stage_of
    from xew.sim_warp.changes.scenes import make_scene
    from xew.sim_warp.devices.workers import quiet_warp
    from xew.sim_warp.geometry.camera import project, spec_camera
    from xew.sim_warp.rendering.observe import observe, scene_recording
    from xew.sim_warp.rendering.streams import default_renderer
    from xew.sim_warp.robots import recorded_robot
    from xew.sim_warp.tasks import recorded_task

    quiet_warp()
    record = read_record(folder)
    scene = make_scene(recorded_task(record.task), record.task, record.seed, record.change)
    robot = recorded_robot(record.robot, data_folder(folder))
    seen = scene_recording(robot, scene, states.joint_pos, states.object_pose, states.object_joint)
    camera = spec_camera(record.camera)
    view = observe(default_renderer(), [seen], camera, stage_of(parse_change(record.change)))[0]
    objects, _ = project(camera, states.object_pose[..., :3].astype(np.float64))
    return Perturbation(view.rgb, view.robot_mask, view.keypoints, objects.astype(np.float32))


def _replace_motion(states: States, joints: np.ndarray, poses: np.ndarray, hinges: np.ndarray) -> States:
    return replace(states, joint_pos=joints, object_pose=poses, object_joint=hinges)

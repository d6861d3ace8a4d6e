"""Re-rendering of episodes from recorded states, missing videos, and the plausibility check of their motion."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from xew.episode import (
    EpisodeError,
    Record,
    array_hash,
    data_folder,
    demand_known,
    read_record,
    read_states,
    states_hash,
    write_episode,
)
from xew.protocol import OWN_MOTION
from xew.sim_warp.kinematics.own_motion import own_commands
from xew.sim_warp.physics.plausibility import find_implausible
from xew.sim_warp.rendering.observe import observe, scene_recording
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.rendering.streams import command_renders
from xew.sim_warp.robots import recorded_robot
from xew.sim_warp.scene import Scene, scene_hash, scene_rng
from xew.sim_warp.tasks import recorded_task


def render_again(folder: Path, renderer: Renderer) -> tuple[np.ndarray, np.ndarray]:
    """Render an episode's pixels, mask and keypoints again from its recorded joints, objects and commands.

    Returns:
        The head camera's and the robot's video [t h w 3] uint8, whose hashes agree with the recorded ones.

    Raises:
        EpisodeError: the scene or a hash differs from the recorded one.
    """
    record = read_record(folder)
    robot = recorded_robot(record.robot, data_folder(folder))
    demand_known(folder, "joint_pos", "object_pose")
    states, scene = read_states(folder), _sample_again(folder, record)
    view = observe(renderer, [scene_recording(robot, scene, states.joint_pos, states.object_pose, states.object_joint)])[0]
    render = command_renders([(robot, states.action)], renderer=renderer)[0]
    again = replace(states, keypoints=view.keypoints, keypoint_visible=view.keypoint_visible, robot_mask=view.robot_mask)
    hashes = {"states": states_hash(again), "rgb": array_hash(view.rgb), "robot": array_hash(render)}
    hashes["scene"] = scene_hash(scene)
    for name, recorded in (record.hashes | {"scene": record.scene_hash}).items():
        if hashes[name] != recorded:
            raise EpisodeError(
                f"{folder}: rendered again on {renderer.device.name}, {name} has hash {hashes[name][:12]}, expected "
                f"{recorded[:12]} as recorded on {record.device}. Use the same device and versions as for the recording."
            )
    return view.rgb, render


def add_videos(folder: Path, renderer: Renderer) -> None:
    """Make and store the videos of an episode without videos. Raises EpisodeError as `render_again`."""
    record = read_record(folder)
    if not record.videos:
        rgb, robot = render_again(folder, renderer)
        write_episode(data_folder(folder), replace(record, videos=True), read_states(folder), rgb, robot)


def demand_plausible(folder: Path) -> None:
    """Raise EpisodeError if an accepted episode's motion is implausible (plausibility.py)."""
    record, states = read_record(folder), read_states(folder)
    scene = _sample_again(folder, record)
    plan = recorded_task(record.task).plan(scene)
    robot = recorded_robot(record.robot, data_folder(folder)) if record.motion == OWN_MOTION else None
    holds = (own_commands(robot, [plan])[0][0] if robot else plan.path()).holds
    problem = find_implausible(
        scene, holds, states.object_pose, states.penetration, states.contact, states.tool_pose, record.frame_rate
    )
    if problem:
        raise EpisodeError(f"{folder}: {problem}; delete it and run generate again.")


def _sample_again(folder: Path, record: Record) -> Scene:
    """The scene of an episode. Raises EpisodeError if its task has other objects now."""
    scene = recorded_task(record.task).sample(scene_rng(record.task, record.seed), record.seed)
    if scene.names != record.object_names:
        raise EpisodeError(
            f"{folder} has the objects {', '.join(record.object_names)}, {record.task} now makes {', '.join(scene.names)}: "
            "the task has changed. Use the version of xew that made the episode, or delete it and run generate again."
        )
    return scene

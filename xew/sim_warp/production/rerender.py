"""Re-rendering of episodes from recorded states: missing videos and other views; and the plausibility check of motion."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from xew.dataset import VIEWS, is_stale, view_episode
from xew.episode import (
    EpisodeError,
    Record,
    States,
    array_hash,
    data_folder,
    demand_known,
    episode_folder,
    place_episode,
    read_pixels,
    read_record,
    read_states,
    states_hash,
    write_episode,
)
from xew.names import path_below
from xew.protocol import HEAD, OWN_MOTION, CameraSpec, parse_change
from xew.sim_warp.cameras import fix_camera, place_camera
from xew.sim_warp.changes.looks import camera_of, stage_of
from xew.sim_warp.changes.scenes import change_of, demand_change, make_plan, make_scene
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.kinematics.own_motion import own_commands
from xew.sim_warp.physics.plausibility import find_implausible
from xew.sim_warp.plan import Hold
from xew.sim_warp.production.outcome import find_obstruction
from xew.sim_warp.rendering.observe import observe, scene_recording
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.rendering.streams import command_renders
from xew.sim_warp.robots import recorded_robot
from xew.sim_warp.scene import Scene, scene_hash
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks import recorded_task


def render_again(folder: Path, renderer: Renderer) -> tuple[np.ndarray, np.ndarray]:
    """Render an episode's pixels, mask and keypoints again from its recorded joints, objects and commands.

    Returns:
        The camera's and the robot's video [t h w 3] uint8, whose hashes agree with the recorded ones.

    Raises:
        EpisodeError: the scene or a hash differs from the recorded one.
    """
    record = read_record(folder)
    if record.camera.parts:
        raise EpisodeError(f"{folder} is tiled of {', '.join(record.camera.parts)}; render these again instead.")
    robot = recorded_robot(record.robot, data_folder(folder))
    demand_known(folder, "joint_pos", "object_pose")
    scene = _sample_again(folder, record)
    again, rgb, render = _render_view(robot, scene, read_states(folder, record), record, renderer)
    hashes = {"states": states_hash(again), "rgb": array_hash(rgb), "robot": array_hash(render)}
    hashes["scene"] = scene_hash(scene)
    for name, recorded in (record.hashes | {"scene": record.scene_hash}).items():
        if hashes[name] != recorded:
            raise EpisodeError(
                f"{folder}: rendered again on {renderer.device.name}, {name} has hash {hashes[name][:12]}, expected "
                f"{recorded[:12]} as recorded on {record.device}. Use the same device and versions as for the recording."
            )
    return rgb, render


def _render_view(
    robot: RobotSpec, scene: Scene, states: States, header: Record, renderer: Renderer
) -> tuple[States, np.ndarray, np.ndarray]:
    """The states as the header's camera sees them with its change, its video and the robot's, both [t h w 3] uint8.

    A camera on the robot is moved by the measured joints for the scene, and by the commanded joints for the robot alone.
    """
    camera = place_camera(header.camera, robot, states.joint_pos)
    recording = scene_recording(robot, scene, states.joint_pos, states.object_pose, states.object_joint)
    view = observe(renderer, [recording], camera, stage_of(parse_change(header.change)))[0]
    commanded = place_camera(header.camera, robot, states.action)
    render = command_renders([(robot, states.action)], commanded, header.table, renderer)[0]
    seen = replace(
        states,
        keypoints=view.keypoints,
        keypoint_visible=view.keypoint_visible,
        robot_mask=view.robot_mask,
        intrinsics=camera.intrinsics,
        extrinsics=camera.extrinsics,
    )
    return seen, view.rgb, render


def add_view(folder: Path, spec: CameraSpec, renderer: Renderer) -> bool:
    """Render and write the view of a camera of an accepted episode; returns whether it was missing.

    Raises:
        EpisodeError: the episode was imported without its objects, or its task has changed.
        ConfigError: the robot does not have the link that the camera is fixed to.
    """
    record = read_record(folder)
    data = data_folder(folder)
    robot = recorded_robot(record.robot, data)
    demand_known(folder, "joint_pos", "object_pose", record=record)
    change = parse_change(record.change)
    table = None if spec.name == HEAD else TABLE_TOP + stage_of(change).raised
    header = replace(record, camera=camera_of(change, fix_camera(spec, robot)), table=table, device=renderer.device.name)
    states, root = read_states(folder, record), data / VIEWS / spec.view
    if _shows(episode_folder(root, record.task, record.seed, record.robot), header, states):
        return False
    seen, rgb, render = _render_view(robot, _sample_again(folder, record), states, header, renderer)
    write_episode(path_below(data, VIEWS, spec.view), header, seen, rgb, render)
    return True


def _shows(folder: Path, header: Record, states: States) -> bool:
    """Whether a view has the camera and table of this header, and is of these states."""
    if not (folder / "episode.json").exists():
        return False
    record = read_record(folder)
    seen = read_states(folder, record)
    same = (np.array_equal(getattr(seen, name), getattr(states, name)) for name in ("action", "joint_pos", "object_pose"))
    return (record.camera, record.table) == (header.camera, header.table) and record.videos and all(same)


def add_tiled(folder: Path, views: Sequence[str]) -> bool:
    """Write the view that tiles others into one picture, from top to bottom; returns whether it was missing.

    Its camera, keypoints and objects are the first view's, which is at the upper left; videos and mask are of all.

    Raises:
        EpisodeError: the episode lacks a view, or the views have several sizes.
    """
    parts = [view_episode(folder, view) for view in views]
    records = [read_record(part) for part in parts]
    sizes = {record.camera.size for record in records}
    if len(sizes) > 1 or any(record.camera.parts for record in records):
        raise EpisodeError(f"{folder}: the views {', '.join(views)} have the sizes {sorted(sizes)}; tile cameras of one size.")
    first, ((width, height),) = records[0], sizes
    root = path_below(data_folder(folder), VIEWS, "+".join(views))
    camera = replace(first.camera, name="+".join(views), size=(width, height * len(views)))
    tables = [] if any(map(is_stale, records)) else [record.table for record in records if record.table]
    header = replace(first, camera=camera, table=tables[0] if tables else None)
    states = [read_states(part) for part in parts]
    if _shows(episode_folder(root, first.task, first.seed, first.robot), header, states[0]):
        return False
    seen = replace(states[0], robot_mask=np.concatenate([of_part.robot_mask for of_part in states], axis=1))
    rgb, robot = (np.concatenate([read_pixels(part, name) for part in parts], axis=1) for name in ("rgb", "robot"))
    write_episode(root, header, seen, rgb, robot)
    return True


def render_changed(folder: Path, name: str, out: Path, renderer: Renderer) -> Record:
    """Write an unchanged episode with a change, from its states, to another data set; returns its header.

    Args:
        folder: of the accepted episode.
        name: a change that needs no physics.
        out: root of the other data set.
        renderer: of this process.

    Raises:
        EpisodeError: the episode is changed already, was imported, or stands in the other data set with another change.
    """
    record = read_record(folder)
    change = change_of(name, record.task, record.seed)
    place = place_episode(out, record.task, record.seed, record.robot)
    if (place / "episode.json").is_file():
        there = read_record(place)
        demand_change(place, there, name)
        return there
    if record.change or record.source:
        origin = f"was imported from {record.source}" if record.source else f"has the change {record.change}"
        raise EpisodeError(f"{folder} {origin}; expected an unchanged episode that `python -m xew.sim_warp.generate` made.")
    robot, states = recorded_robot(record.robot, data_folder(folder)), read_states(folder, record)
    scene = make_scene(recorded_task(record.task), record.task, record.seed, change)
    camera = camera_of(parse_change(change), record.camera)
    changed = replace(record, change=change, camera=camera, scene_hash=scene_hash(scene), device=renderer.device.name)
    if failure := find_obstruction(
        scene, scene_recording(robot, scene, states.joint_pos, states.object_pose, states.object_joint)
    ):
        reason, detail = failure
        refused = replace(changed, success=False, failure=reason, failure_detail=detail, progress=None)
        failed = replace(refused, hashes={}, files={})
        return read_record(write_episode(out, failed))
    seen, rgb, render = _render_view(robot, scene, states, changed, renderer)
    return read_record(write_episode(out, changed, seen, rgb, render))


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
    problem = find_implausible(
        scene,
        () if record.fault else _expert_holds(folder, record, scene),
        states.object_pose,
        states.penetration,
        states.contact,
        states.tool_pose,
        record.frame_rate,
    )
    if problem:
        raise EpisodeError(f"{folder}: {problem}; delete it and run generate again.")


def _expert_holds(folder: Path, record: Record, scene: Scene) -> tuple[Hold, ...]:
    """The time spans in which the expert of an episode holds objects; a faulty hand may lose them."""
    plan = make_plan(recorded_task(record.task), scene)
    robot = recorded_robot(record.robot, data_folder(folder)) if record.motion == OWN_MOTION else None
    return (own_commands(robot, [plan])[0][0] if robot else plan.path()).holds


def _sample_again(folder: Path, record: Record) -> Scene:
    """The scene of an episode. Raises EpisodeError if its task has other objects now."""
    scene = make_scene(recorded_task(record.task), record.task, record.seed, record.change)
    if scene.names != record.object_names:
        raise EpisodeError(
            f"{folder} has the objects {', '.join(record.object_names)}, {record.task} now makes {', '.join(scene.names)}: "
            "the task has changed. Use the version of xew that made the episode, or delete it and run generate again."
        )
    return scene

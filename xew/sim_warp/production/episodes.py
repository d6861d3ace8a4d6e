"""Write simulated cells as episodes, in the format of xew/episode.py; for a rejected seed only the headers."""

from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np
import warp as wp

import xew
from xew.config import ConfigError
from xew.episode import Record, States, read_record, write_episode
from xew.protocol import CameraSpec, parse_change
from xew.sim_warp.changes.looks import camera_of, stage_of
from xew.sim_warp.faults import get_fault
from xew.sim_warp.geometry.camera import spec_camera
from xew.sim_warp.production.cells import Cell
from xew.sim_warp.rendering.observe import Observation, keypoint_names, observe
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.rendering.streams import command_renders
from xew.sim_warp.scene import Scene, scene_hash
from xew.sim_warp.tasks import Task

Pixels = tuple[Observation, np.ndarray]
"""Images of a cell: the camera's observation, and the robot alone [t h w 3] uint8."""


def render_cells(cells: Sequence[Cell], renderer: Renderer) -> list[Pixels]:
    """The camera's observation of each cell of a scene, and the robot alone by its commands [t h w 3] uint8."""
    camera = spec_camera(_camera(cells[0]))
    views = observe(renderer, [cell.recording for cell in cells], camera, stage_of(parse_change(cells[0].change)))
    renders = command_renders([(cell.robot, cell.commands.action) for cell in cells], camera, renderer=renderer)
    return list(zip(views, renders, strict=True))


def write_cell(cell: Cell, pixels: Pixels | None, out: Path, device: wp.Device, videos: bool = True) -> Record:
    """Write a cell, with its episode if there are pixels, and return the header as it is on disk."""
    record = header(cell, device)
    if pixels is None:
        return read_record(write_episode(out, record))
    view, render = pixels
    return read_record(write_episode(out, record, _states(cell, view), view.rgb, render, videos=videos))


def header(cell: Cell, device: wp.Device) -> Record:
    """The header of a cell without hashes."""
    reason, detail = cell.failure or (None, "")
    success, progress = cell.outcome or (True, None)
    return Record(
        task=cell.task_name,
        seed=cell.seed,
        robot=cell.robot_name,
        success=reason is None and success,
        failure=reason,
        failure_detail=detail,
        instruction=fill_instruction(cell.task, cell.scene),
        frame_count=cell.path.frame_count,
        object_names=cell.scene.names,
        keypoint_names=keypoint_names(cell.robot),
        scene_hash=scene_hash(cell.scene),
        versions=_versions(),
        device=device.name,
        motion=cell.motion_kind,
        change=cell.change,
        camera=_camera(cell),
        fault=str(get_fault(cell.fault) or ""),
        progress=None if reason else progress,
    )


def fill_instruction(task: Task, scene: Scene) -> str:
    """The instruction of a task with a scene's words. Raises ConfigError if the scene has no word for a slot."""
    try:
        return task.instruction.format(**scene.words)
    except (KeyError, IndexError, ValueError) as error:
        raise ConfigError(
            f"the instruction of {scene.task}, {task.instruction!r}, cannot be filled ({error}) from the words of its scene "
            f"({', '.join(scene.words) or 'none'}); add the words in braces to Scene.words."
        ) from error


@cache
def _versions() -> dict[str, str]:
    return {"xew": xew.__version__} | {name: version(name) for name in ("newton", "mujoco", "mujoco-warp", "warp-lang")}


def _camera(cell: Cell) -> CameraSpec:
    """The head camera as the change of the cell's scene has it."""
    return camera_of(parse_change(cell.change))


def _states(cell: Cell, view: Observation) -> States:
    assert cell.tool_pose is not None, "a cell that is rendered has been simulated"
    camera = spec_camera(_camera(cell))
    return States(
        action=cell.commands.action,
        joint_pos=cell.known_motion.joint_pos,
        joint_vel=cell.known_motion.joint_vel,
        tool_pose=cell.tool_pose,
        object_pose=cell.known_motion.object_pose,
        object_joint=cell.known_motion.object_joint,
        contact=cell.known_motion.contact,
        penetration=cell.known_motion.penetration,
        keypoints=view.keypoints,
        keypoint_visible=view.keypoint_visible,
        robot_mask=view.robot_mask,
        intrinsics=camera.intrinsics,
        extrinsics=camera.extrinsics,
    )

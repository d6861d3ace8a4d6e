"""Stages 1 to 5 for a batch of seeds: scene, expert, physics, rendering, episodes.

Reads  `Job`s: (task, seed) and the robots that still lack it
Writes episodes and, for what did not succeed, their headers with the reason

The robots of a seed are made together, because a seed counts only when all of them succeed; only then it is rendered.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path

import numpy as np
import warp as wp

import xew
from xew.config import ConfigError
from xew.episode import (
    EpisodeError,
    Record,
    States,
    array_hash,
    data_folder,
    demand_known,
    read_record,
    read_states,
    states_hash,
    write_episode,
)
from xew.protocol import ARMS
from xew.sim_warp.geometry.camera import HEAD_CAMERA
from xew.sim_warp.kinematics.forward import tool_poses
from xew.sim_warp.physics import Motion, World, simulate
from xew.sim_warp.physics.plausibility import implausible
from xew.sim_warp.plan import ToolPath
from xew.sim_warp.production.expert import Commands, joint_commands
from xew.sim_warp.rendering.observe import Observation, Recording, keypoint_names, observe, scene_things
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.rendering.streams import command_renders
from xew.sim_warp.robots import RobotSpec, get_robot
from xew.sim_warp.scene import Scene, scene_hash, scene_rng
from xew.sim_warp.tasks import Moment, Task, get_task

DEEPEST_IN_TABLE = 0.0015
"""How deep an arm may press into the table before its episode is refused [m]: a finger that brushes it passes."""
DEEPEST_IN_ARM = 0.0002
"""How deep the arms may press into each other [m]: next to nothing, for a hand driven into the other is 0.4 mm deep."""
FRAMES_AT_ONCE = 4096
"""Frames of one group of seeds: about half a megabyte of pixels each."""


@dataclass(frozen=True)
class Job:
    """One scene, to be done by the robots that do not have it yet."""

    task: str
    seed: int
    robots: tuple[str, ...]
    rejected: bool = False
    """Has another robot failed on it already? Then nothing is rendered."""


@dataclass(frozen=True)
class Cell:
    """One (task, seed, robot) on its way."""

    task_name: str
    """As asked for: a key of the registry or module:NAME."""
    task: Task
    scene: Scene
    path: ToolPath
    robot_name: str
    robot: RobotSpec
    commands: Commands
    motion: Motion | None = None
    """None where the robot cannot follow the plan."""

    @property
    def moved(self) -> Motion:
        """The motion of a cell that is known to have one."""
        assert self.motion is not None, f"{self.robot.key} cannot follow the plan of {self.scene.task}/{self.scene.seed}"
        return self.motion

    @cached_property
    def tool_pose(self) -> np.ndarray:
        """[t 2 7] measured tool poses, world."""
        return measured_tools(self.robot, self.moved.joint_pos)

    @property
    def recording(self) -> Recording:
        """What the camera looks at."""
        return recording(self.robot, self.scene, self.moved.joint_pos, self.moved.object_pose, self.moved.object_joint)

    @cached_property
    def failure(self) -> tuple[str, str] | None:
        """Why it does not count: one of `episode.FAILURES` and a sentence; None if it succeeded."""
        return _failure(self)


Pixels = tuple[Observation, np.ndarray]
"""What the camera sees, and the robot alone [t h w 3] uint8."""


def produce(
    jobs: Sequence[Job], out: Path, renderer: Renderer, batch: int | None = None, videos: bool = True
) -> list[list[Record]]:
    """Make all episodes of some seeds and write them under `out`; the headers of each job in the order of its robots.

    Seeds are rendered a group at a time while the group before is being written: that bounds the pixels in memory.

    Args:
        batch: worlds that a GPU steps together, None for all.
        videos: store them; without, an episode has all states and hashes, and `add_videos` makes its videos.
    """
    seeds = simulate_cells(plan_cells(jobs, out), renderer.device.alias, batch)
    rejected = {(job.task, job.seed) for job in jobs if job.rejected}
    records: list[list[Record]] = []
    writing: list[list[Future[Record]]] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # codecs, zlib and hashes let go of the interpreter's lock
        for group in _groups(seeds):
            accepted = [cell for cells in group if _accepted(cells, rejected) for cell in cells]
            pixels = dict(zip(map(id, accepted), render_cells(accepted, renderer), strict=True))
            records += [[future.result() for future in cells] for cells in writing]
            writing = [
                [pool.submit(write_cell, cell, pixels.get(id(cell)), out, renderer.device, videos) for cell in cells]
                for cells in group
            ]
        return records + [[future.result() for future in cells] for cells in writing]


def _accepted(cells: Sequence[Cell], rejected: set[tuple[str, int]]) -> bool:
    return not any((cell.task_name, cell.scene.seed) in rejected or cell.failure for cell in cells)


def _groups(seeds: list[list[Cell]]) -> Iterator[list[list[Cell]]]:
    """The seeds in order, about `FRAMES_AT_ONCE` frames at a time."""
    group: list[list[Cell]] = []
    for cells in seeds:
        group.append(cells)
        if sum(cell.path.frame_count for others in group for cell in others) >= FRAMES_AT_ONCE:
            yield group
            group = []
    if group:
        yield group


def plan_cells(jobs: Sequence[Job], data: Path | None = None) -> list[list[Cell]]:
    """Scene, plan and commands of every cell; the commands of all cells of a robot are solved together.

    Args:
        data: data set whose own robots count too.
    """
    tasks = [get_task(job.task) for job in jobs]
    scenes = [task.sample(scene_rng(job.task, job.seed), job.seed) for job, task in zip(jobs, tasks, strict=True)]
    paths = [task.plan(scene).path() for task, scene in zip(tasks, scenes, strict=True)]
    seeds: list[list[Cell]] = [[] for _ in jobs]
    for name in dict.fromkeys(robot for job in jobs for robot in job.robots):
        mine = [index for index, job in enumerate(jobs) if name in job.robots]
        robot = get_robot(name, data)
        for index, commands in zip(mine, joint_commands(robot, [paths[index] for index in mine]), strict=True):
            seeds[index].append(Cell(jobs[index].task, tasks[index], scenes[index], paths[index], name, robot, commands))
    return seeds


def simulate_cells(seeds: list[list[Cell]], device: str | None = None, batch: int | None = None) -> list[list[Cell]]:
    """The same cells with their motion, where the robot can follow the plan."""
    cells = [cell for cells in seeds for cell in cells if cell.commands.problem is None]
    worlds = [World(cell.robot, cell.scene, cell.commands.action) for cell in cells]
    motions = {id(cell): motion for cell, motion in zip(cells, simulate(worlds, device, batch), strict=True)}
    return [[replace(cell, motion=motions.get(id(cell))) for cell in cells] for cells in seeds]


def render_cells(cells: Sequence[Cell], renderer: Renderer) -> list[Pixels]:
    """What the camera sees of each cell, and the robot alone by its commands."""
    views = observe(renderer, [cell.recording for cell in cells])
    renders = command_renders([(cell.robot, cell.commands.action) for cell in cells], renderer=renderer)
    return list(zip(views, renders, strict=True))


def measured_tools(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[t 2 7] tool poses at canonical joint positions [t 16], world."""
    return tool_poses(robot, joint_pos).astype(np.float32)


def moment(action: np.ndarray, motion: Motion, tools: np.ndarray, frame: int) -> Moment:
    """One frame as a success test sees it."""
    gripper = action[frame, [column for _, column in ARMS]]
    return Moment(motion.object_pose[frame], motion.object_joint[frame], tools[frame], gripper, motion.contact[frame])


def _failure(cell: Cell) -> tuple[str, str] | None:
    if cell.commands.problem is not None:
        return "plan", cell.commands.problem
    motion = cell.moved
    if motion.overflow:
        return "overflow", "a contact or constraint buffer was too small, or the state was not finite"
    if motion.table_overlap > DEEPEST_IN_TABLE:
        return "plan", f"an arm pressed {1000 * motion.table_overlap:.1f} mm into the table"
    if motion.arm_overlap > DEEPEST_IN_ARM:
        return "plan", f"the arms pressed {1000 * motion.arm_overlap:.1f} mm into each other"
    first, last = (moment(cell.commands.action, motion, cell.tool_pose, frame) for frame in (0, -1))
    if cell.task.success(cell.scene, first):
        return "plan", "the scene is solved before it begins"
    if not cell.task.success(cell.scene, last):
        return _lost(cell)
    problem = implausible(
        cell.scene, cell.path.holds, motion.object_pose, motion.penetration, cell.tool_pose, cell.path.frame_rate
    )
    return ("physics", problem) if problem else None


def _lost(cell: Cell) -> tuple[str, str]:
    """Which hold did not come about or did not last."""
    for hold in cell.path.holds:
        frames = slice(int(hold.start * cell.path.frame_rate), int(hold.end * cell.path.frame_rate) + 1)
        touched = cell.moved.contact[frames, hold.arm, cell.scene.index(hold.name)]
        side = ("left", "right")[hold.arm]
        if not touched.any():
            return "grasp", f"the {side} hand never touched the {hold.name}"
        if not touched[-3:].any():
            return "slip", f"the {side} hand lost the {hold.name}"
    return "timeout", "the plan ended short of success"


def recording(
    robot: RobotSpec, scene: Scene, joint_pos: np.ndarray, object_pose: np.ndarray, object_joint: np.ndarray
) -> Recording:
    """What the camera looks at, from recorded states."""
    things, thing_pose = scene_things(scene, object_pose, object_joint)
    return Recording(robot, joint_pos, things, thing_pose)


def write_cell(cell: Cell, pixels: Pixels | None, out: Path, device: wp.Device, videos: bool = True) -> Record:
    """Write a cell, with its episode if there are pixels, and return the header as it is on disk."""
    record = header(cell, device)
    if pixels is None:
        return read_record(write_episode(out, record))
    view, render = pixels
    return read_record(write_episode(out, record, _states(cell, view), view.rgb, render, videos=videos))


def header(cell: Cell, device: wp.Device) -> Record:
    """What is known of a cell but its hashes: who, how long, success or the reason of failure."""
    reason, detail = cell.failure or (None, "")
    return Record(
        task=cell.task_name,
        seed=cell.scene.seed,
        robot=cell.robot_name,
        success=reason is None,
        failure=reason,
        failure_detail=detail,
        instruction=_instruction(cell.task, cell.scene),
        frame_count=cell.path.frame_count,
        object_names=cell.scene.names,
        keypoint_names=keypoint_names(cell.robot),
        scene_hash=scene_hash(cell.scene),
        versions=_versions(),
        device=device.name,
    )


def _instruction(task: Task, scene: Scene) -> str:
    """What the robot is told to do in this scene. Raises ConfigError where the scene has no word for a slot."""
    try:
        return task.instruction.format(**scene.words)
    except (KeyError, IndexError, ValueError) as error:
        raise ConfigError(
            f"the instruction of {scene.task}, {task.instruction!r}, cannot be filled ({error}) from the words of its scene "
            f"({', '.join(scene.words) or 'none'}); add to Scene.words what it has in braces."
        ) from error


@cache
def _versions() -> dict[str, str]:
    return {"xew": xew.__version__} | {name: version(name) for name in ("newton", "mujoco", "mujoco-warp", "warp-lang")}


def _states(cell: Cell, view: Observation) -> States:
    return States(
        action=cell.commands.action,
        joint_pos=cell.moved.joint_pos,
        joint_vel=cell.moved.joint_vel,
        tool_pose=cell.tool_pose,
        object_pose=cell.moved.object_pose,
        object_joint=cell.moved.object_joint,
        contact=cell.moved.contact,
        penetration=cell.moved.penetration,
        keypoints=view.keypoints,
        keypoint_visible=view.keypoint_visible,
        robot_mask=view.robot_mask,
        intrinsics=HEAD_CAMERA.intrinsics,
        extrinsics=HEAD_CAMERA.extrinsics,
    )


def add_videos(folder: Path, renderer: Renderer) -> None:
    """Make and store the videos of an episode that was written without. Raises EpisodeError as `render_again`."""
    record = read_record(folder)
    if not record.videos:
        rgb, robot = render_again(folder, renderer)
        write_episode(folder.parents[2], replace(record, videos=True), read_states(folder), rgb, robot)


def demand_plausible(folder: Path) -> None:
    """Raises EpisodeError if an accepted episode's states hold what could not have happened (plausibility.py)."""
    record, states = read_record(folder), read_states(folder)
    scene = _scene_again(folder, record)
    holds = get_task(record.task).plan(scene).path().holds
    problem = implausible(scene, holds, states.object_pose, states.penetration, states.tool_pose, record.frame_rate)
    if problem:
        raise EpisodeError(f"{folder}: {problem}; delete it and run generate again.")


def _scene_again(folder: Path, record: Record) -> Scene:
    """The scene of an episode. Raises EpisodeError if its task has other objects now."""
    scene = get_task(record.task).sample(scene_rng(record.task, record.seed), record.seed)
    if scene.names != record.object_names:
        raise EpisodeError(
            f"{folder} has the objects {', '.join(record.object_names)}, {record.task} makes {', '.join(scene.names)} of its "
            "seed now: the task has changed. Use the xew that made the episode, or delete it and run generate again."
        )
    return scene


def render_again(folder: Path, renderer: Renderer) -> tuple[np.ndarray, np.ndarray]:
    """Make an episode's pixels, mask and keypoints anew from its recorded joints, objects and commands.

    Returns:
        The head camera's and the robot's video [t h w 3], whose hashes agree with the recorded ones.

    Raises:
        EpisodeError: the scene or anything rendered differs from what is recorded.
    """
    demand_known(folder, "joint_pos", "object_pose")
    record, states = read_record(folder), read_states(folder)
    robot = get_robot(record.robot, data_folder(folder))
    scene = _scene_again(folder, record)
    view = observe(renderer, [recording(robot, scene, states.joint_pos, states.object_pose, states.object_joint)])[0]
    render = command_renders([(robot, states.action)], renderer=renderer)[0]
    again = replace(states, keypoints=view.keypoints, keypoint_visible=view.keypoint_visible, robot_mask=view.robot_mask)
    found = {"states": states_hash(again), "rgb": array_hash(view.rgb), "robot": array_hash(render)}
    found["scene"] = scene_hash(scene)
    for name, expected in (record.hashes | {"scene": record.scene_hash}).items():
        if found[name] != expected:
            raise EpisodeError(
                f"{folder}: rendered again on {renderer.device.name}, {name} has hash {found[name][:12]}, recorded on "
                f"{record.device} was {expected[:12]}; with the same device and versions they must agree."
            )
    return view.rgb, render

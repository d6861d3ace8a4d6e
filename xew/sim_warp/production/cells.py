"""Cells, one (task, seed, robot) each: planned by `plan_cells`, then simulated by `simulate_cells`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from xew.protocol import OWN_MOTION, SHARED_MOTION, join_fault, split_fault
from xew.sim_warp.changes.scenes import make_plan, make_scene
from xew.sim_warp.kinematics.expert import Commands, joint_commands
from xew.sim_warp.kinematics.forward import tool_poses
from xew.sim_warp.kinematics.own_motion import own_commands
from xew.sim_warp.physics import Motion, World, simulate
from xew.sim_warp.plan import Timeline, ToolPath
from xew.sim_warp.production.outcome import find_failure, find_obstruction, find_refusal, measure_outcome
from xew.sim_warp.rendering.observe import Recording, scene_recording
from xew.sim_warp.robots import ROBOTS, RobotSpec
from xew.sim_warp.scene import Scene
from xew.sim_warp.tasks import Task, get_task


@dataclass(frozen=True)
class Job:
    """One scene and its missing robots."""

    task: str
    """Key of the registry or module:NAME."""
    seed: int
    """Seed of the scene, with the number of a fault (`protocol.join_fault`)."""
    robots: tuple[str, ...]
    """Their names in episodes."""
    rejected: bool = False
    """Whether another robot has failed; then nothing is rendered."""
    motion: str = SHARED_MOTION
    """Kind of motion, one of `xew.protocol.MOTIONS`."""
    change: str = ""
    """The scene's change, as `Record.change`."""


@dataclass(frozen=True)
class Cell:
    """One (task, seed, robot): planned, and simulated if the robot can follow the plan."""

    task_name: str
    """Key of the registry or module:NAME."""
    scene: Scene
    path: ToolPath
    """Path of both tools, shared by all robots or the robot's own."""
    robot_name: str
    robot: RobotSpec
    commands: Commands
    motion: Motion | None = None
    """Simulated motion; None before the simulation, or if the robot cannot follow the plan."""
    motion_kind: str = SHARED_MOTION
    """Kind of motion, one of `xew.protocol.MOTIONS`."""
    change: str = ""
    """The scene's change, as `Record.change`."""
    tool_pose: np.ndarray | None = None
    """[t 2 7] float32 measured tool poses, xyz [m] and quaternion xyzw, world; None without motion."""
    failure: tuple[str, str] | None = None
    """One of `episode.FAILURES` and a sentence; None for success, or for a faulty motion that physics allows."""
    fault: int = 0
    """Number of the commands' fault (`faults.FAULTS`); 0 for the expert's."""
    outcome: tuple[bool, float] | None = None
    """Success and progress of a faulty motion at its end; None for the expert, whose failure says it."""

    @property
    def seed(self) -> int:
        """The seed of the episode: that of the scene, with the fault."""
        return join_fault(self.fault, self.scene.seed)

    @property
    def task(self) -> Task:
        """The task. It is not a field: its functions may be lambdas, which cannot be pickled."""
        return get_task(self.task_name)

    @property
    def known_motion(self) -> Motion:
        """The motion of a simulated cell."""
        assert self.motion is not None, f"{self.robot.key} cannot follow the plan of {self.scene.task}/{self.scene.seed}"
        return self.motion

    @property
    def recording(self) -> Recording:
        """The recording for the renderer."""
        motion = self.known_motion
        return scene_recording(self.robot, self.scene, motion.joint_pos, motion.object_pose, motion.object_joint)


def plan_cells(jobs: Sequence[Job], robots: Mapping[str, RobotSpec] = ROBOTS, device: str | None = None) -> list[list[Cell]]:
    """Scene, plan and commands of every cell, by job; the commands of all cells of a robot are solved together on a device."""
    tasks = [get_task(job.task) for job in jobs]
    scenes = [make_scene(task, job.task, job.seed, job.change) for job, task in zip(jobs, tasks, strict=True)]
    faults = [split_fault(job.seed)[0] for job in jobs]
    plans = [make_plan(task, scene, fault) for task, scene, fault in zip(tasks, scenes, faults, strict=True)]
    seeds: list[list[Cell]] = [[] for _ in jobs]
    for name, kind in dict.fromkeys((robot, job.motion) for job in jobs for robot in job.robots):
        mine = [index for index, job in enumerate(jobs) if name in job.robots and job.motion == kind]
        robot = robots[name]
        planned = plan_motion(robot, [plans[index] for index in mine], kind, device)
        for index, (path, commands) in zip(mine, planned, strict=True):
            failure = None if commands.problem is None else ("plan", commands.problem)
            job, fault = jobs[index], faults[index]
            cell = Cell(job.task, scenes[index], path, name, robot, commands, motion_kind=kind, failure=failure, fault=fault)
            seeds[index].append(replace(cell, change=job.change))
    return seeds


def plan_motion(
    robot: RobotSpec, plans: Sequence[Timeline], kind: str, device: str | None = None
) -> list[tuple[ToolPath, Commands]]:
    """A robot's tool paths and commands for many plans, in one kind of motion (`xew.protocol.MOTIONS`)."""
    if kind == OWN_MOTION:
        return own_commands(robot, plans, device)
    paths = [plan.path() for plan in plans]
    return list(zip(paths, joint_commands(robot, paths, device), strict=True))


def simulate_cells(seeds: list[list[Cell]], device: str | None = None, batch: int | None = None) -> list[list[Cell]]:
    """The same cells with their motion, if the robot can follow the plan; arguments as of `physics.simulate`."""
    cells = [cell for cells in seeds for cell in cells if cell.commands.problem is None]
    worlds = [World(cell.robot, cell.scene, cell.commands.action) for cell in cells]
    simulated = {
        id(cell): with_motion(cell, motion) for cell, motion in zip(cells, simulate(worlds, device, batch), strict=True)
    }
    return [[simulated.get(id(cell), cell) for cell in cells] for cells in seeds]


def with_motion(cell: Cell, motion: Motion) -> Cell:
    """A planned cell with its simulated motion and its failure, if any."""
    tools = measured_tools(cell.robot, motion.joint_pos)
    task, scene, path, action = cell.task, cell.scene, cell.path, cell.commands.action
    if cell.fault:
        failure = find_refusal(scene, path, motion, tools)
        outcome = None if failure else measure_outcome(task, scene, action, motion, tools)
    else:
        failure, outcome = find_failure(task, scene, path, action, motion, tools), None
    moved = replace(cell, motion=motion, tool_pose=tools, failure=failure, outcome=outcome)
    return moved if failure else replace(moved, failure=find_obstruction(moved.scene, moved.recording))


def measured_tools(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[t 2 7] float32 tool poses, xyz [m] and quaternion xyzw, world, at canonical joint positions [t 16] rad."""
    return tool_poses(robot, joint_pos).astype(np.float32)

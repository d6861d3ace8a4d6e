"""Scenes with one change, their plans, with a fault or none, and their success: tasks know only the standard table.

A table of another height moves the objects and the plan's waypoints up or down; the robots stand as before, so their joints are
solved again. The clock stays the same.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from xew.episode import EpisodeError, Record
from xew.protocol import FACTORS, MOST_LEVEL, RANDOM_CHANGE, STRENGTHS, Change, parse_change, split_fault
from xew.sim_warp.changes.clutter import scatter
from xew.sim_warp.faults import get_fault, make_faulty
from xew.sim_warp.plan import ASIDE, HOME, Segment, Timeline, Tool
from xew.sim_warp.scene import Scene, SceneObject, scene_rng
from xew.sim_warp.tasks import Moment, Task

HEIGHT_STEP = 0.01
"""Height by which a step of strength lowers or raises the table [m]; RoboTwin 2.0 lowers it by up to 3 cm."""


def change_rng(change: Change) -> np.random.Generator:
    """The random stream of a change, the same for its three strengths."""
    return scene_rng(f"change {change.factor}", change.draw)


def change_of(name: str, task: str, seed: int) -> str:
    """The change of a scene by the data set's: the same, or drawn if that is `random`. Raises ValueError as `parse_change`."""
    if name != RANDOM_CHANGE:
        return str(parse_change(name) or "")
    rng = scene_rng(f"change of {task}", split_fault(seed)[1])
    return str(Change(str(rng.choice(FACTORS)), int(rng.integers(STRENGTHS + 1, MOST_LEVEL + 1))))


def check_change(name: str) -> None:
    """Raise EpisodeError unless `change_of` accepts a data set's change."""
    try:
        change_of(name, "", 0)
    except ValueError as error:
        raise EpisodeError(f"--change: {error}, or {RANDOM_CHANGE}.") from error


def demand_change(folder: Path, record: Record, name: str) -> None:
    """Raise EpisodeError if a cell does not have the change that a data set of this change has."""
    expected = change_of(name, record.task, record.seed)
    if record.change != expected:
        found, wanted = (f"the change {change}" if change else "no change" for change in (record.change, expected))
        raise EpisodeError(
            f"{folder} has {found}, expected {wanted}: a data set has one change or none. Pass its own --change, or "
            "choose another --out."
        )


def make_scene(task: Task, name: str, seed: int, change: str = "") -> Scene:
    """The scene of a task, by its name in episodes, and a seed, with a change (`Record.change`); faults do not change it."""
    _, seed = split_fault(seed)
    scene, wanted = task.sample(scene_rng(name, seed), seed), parse_change(change)
    if wanted and wanted.factor == "height":
        return _raise_scene(scene, raised_by(wanted))
    if wanted and wanted.factor == "clutter":
        rng = scene_rng(f"{wanted.factor} {wanted.draw} of {name}", seed)
        return replace(scene, clutter=scatter(rng, scene, task.plan(scene).path(), wanted.strength))
    return scene


def make_plan(task: Task, scene: Scene, fault: int = 0) -> Timeline:
    """The plan of a changed scene with a fault, by its number. Raises EpisodeError if the plan cannot have it."""
    plan = make_faulty(task.plan, _raise_scene(scene, -scene.raised), fault)
    if plan is None:
        raise EpisodeError(f"the plan of {scene.task}, seed {scene.seed}, cannot have the fault {get_fault(fault)}.")
    return _raise_plan(plan, scene.raised) if scene.raised else plan


def is_solved(task: Task, scene: Scene, moment: Moment) -> bool:
    """Whether a task is solved in a changed scene."""
    return task.success(_raise_scene(scene, -scene.raised), _lower_moment(moment, scene.raised))


def measure_progress(task: Task, scene: Scene, first: Moment, moment: Moment) -> float:
    """Progress of a task in a changed scene, as `Task.progress`."""
    moments = (_lower_moment(one, scene.raised) for one in (first, moment))
    return task.progress(_raise_scene(scene, -scene.raised), *moments)


def raised_by(change: Change) -> float:
    """Height of the table's top over the standard one [m]: below it, and in every second draw above it."""
    return (2 * (change.draw % 2) - 1) * change.strength * HEIGHT_STEP


def _lower_moment(moment: Moment, height: float) -> Moment:
    """The moment with its objects and tools moved down by `height` [m]."""
    if not height:
        return moment
    down = np.array([0, 0, height, 0, 0, 0, 0])
    return replace(moment, object_pose=moment.object_pose - down, tool_pose=moment.tool_pose - down)


def _raise_scene(scene: Scene, height: float) -> Scene:
    """The scene with its table and all objects moved up by `height` [m]."""
    if not height:
        return scene

    def moved(thing: SceneObject) -> SceneObject:
        return replace(thing, pose=(*thing.pose[:2], thing.pose[2] + height, *thing.pose[3:]))

    raised = scene.raised + height
    return replace(scene, objects=tuple(map(moved, scene.objects)), raised=0.0 if abs(raised) < 1e-9 else raised)


def _raise_plan(plan: Timeline, height: float) -> Timeline:
    """The plan with its waypoints moved up by `height` [m], on the same clock; hands start and wait where they do."""
    kept = (*HOME, *ASIDE)

    def moved(tool: Tool) -> Tool:
        return tool if any(tool is one for one in kept) else tool.moved(z=height)

    def moved_segments(segments: Sequence[Segment]) -> list[Segment]:
        return [replace(segment, waypoints=tuple(map(moved, segment.waypoints))) for segment in segments]

    left, right = plan.segments
    return replace(plan, at=[moved(tool) for tool in plan.at], segments=(moved_segments(left), moved_segments(right)))

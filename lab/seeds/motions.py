"""Distances between the tool paths of robots, in shared motion and in own motion.

Reads  the registries of tasks and robots
Writes two Markdown tables to the terminal, by task and by robot

It compares commands without physics. Paths are compared at equal phase of the plan: a robot that is slower on the same path
has a distance of 0. Scenes are omitted if a robot cannot follow the plan in one kind of motion.

Command: python -m lab.seeds.motions [--tasks … --robots … --seeds 4 --first-seed 0]
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import tyro
from tqdm import tqdm

from xew.config import user_errors
from xew.episode import EpisodeError
from xew.protocol import FRAME_RATE, MOTIONS, expand_robots
from xew.sim_warp.devices.workers import quiet_warp
from xew.sim_warp.kinematics.forward import tool_poses
from xew.sim_warp.plan import Timeline, ToolPath, frame_times
from xew.sim_warp.production.cells import Cell, Job, plan_cells
from xew.sim_warp.robots import ROBOTS, get_robot
from xew.sim_warp.tasks import TASKS, get_task

MILLIMETERS = 1000.0


@dataclass(frozen=True)
class Args:
    """What to compare."""

    tasks: tuple[str, ...] = tuple(TASKS)
    """Keys of the registry, or module:NAME."""
    robots: tuple[str, ...] = tuple(ROBOTS)
    """Keys of the registry, bodies (body:17, body:0-63), module:NAME, or paths (docs/add_a_robot.md)."""
    seeds: int = 4
    """Number of seeds of each task."""
    first_seed: int = 0


@dataclass(frozen=True)
class Compared:
    """The commanded motions of all robots in one scene and kind of motion."""

    task: str
    motion: str
    """One of `xew.protocol.MOTIONS`."""
    tools: Mapping[str, np.ndarray]
    """Commanded positions [t 2 3] m of both tools by robot, world, at t phases that all robots share."""
    seconds: Mapping[str, float]
    """Duration of the episode by robot [s]."""

    def distances(self, one: str, other: str) -> np.ndarray:
        """[t 2] mm, distance of the left and right tools of two robots at each phase."""
        return MILLIMETERS * np.linalg.norm(self.tools[one] - self.tools[other], axis=-1)


def compare_motions(args: Args) -> list[Compared]:
    """Plan every scene in both kinds of motion, for all robots.

    Raises:
        ConfigError: an unknown task or robot.
        EpisodeError: there is nothing to compare.
    """
    robots = {name: get_robot(name) for name in expand_robots(args.robots)}
    for task in args.tasks:
        get_task(task)
    if len(robots) < 2 or not args.tasks or args.seeds < 1 or args.first_seed < 0:
        raise EpisodeError(
            f"nothing to compare of {len(args.tasks)} tasks, {len(robots)} robots and {args.seeds} seeds from"
            f" {args.first_seed}; name a task, two robots, --seeds from 1 and --first-seed from 0."
        )
    found = []
    for task in tqdm(dict.fromkeys(args.tasks), desc="planning", unit="task"):
        seeds = range(args.first_seed, args.first_seed + args.seeds)
        kinds = [plan_cells([Job(task, seed, tuple(robots), motion=motion) for seed in seeds], robots) for motion in MOTIONS]
        for both in zip(*kinds, strict=True):
            if all(cell.commands.problem is None for cells in both for cell in cells):
                found += [_compare(task, cells) for cells in both]
    return found


def _compare(task: str, cells: Sequence[Cell]) -> Compared:
    """The motions of one scene's cells, which are of one kind."""
    plan = cells[0].task.plan(cells[0].scene)
    tools = {cell.robot_name: tools_at_phase(plan, cell.path, _commanded_tools(cell)) for cell in cells}
    seconds = {cell.robot_name: (cell.path.frame_count - 1) / FRAME_RATE for cell in cells}
    return Compared(task, cells[0].motion_kind, tools, seconds)


def _commanded_tools(cell: Cell) -> np.ndarray:
    """[t 2 3] m positions of both tools by the commands of a cell, world."""
    return tool_poses(cell.robot, cell.commands.action.astype(float))[..., :3]


def tools_at_phase(plan: Timeline, path: ToolPath, tools: np.ndarray) -> np.ndarray:
    """Positions of tools at the instants of the plan's clock that are stored frames of shared motion.

    Args:
        plan: whose clock tells the phase.
        path: a robot's path of this plan.
        tools: [n 2 3] m positions at the n frames of that path, world.

    Returns:
        [t 2 3] m, linear between frames.
    """
    planned, own = np.array(path.clock).T
    instants = np.interp(frame_times(plan.time), planned, own)
    at = frame_times(path.clock[-1][1])
    columns = [np.interp(instants, at, column) for column in tools.reshape(len(tools), -1).T]
    return np.stack(columns, -1).reshape(-1, *tools.shape[1:])


def task_table(scenes: Sequence[Compared]) -> str:
    """A line a task and one of all: mean and largest distance between robots and their durations, in each kind of motion."""
    head = ["task", "shared: mean, max [mm]", "own: mean, max [mm]", "shared [s]", "own: quickest, slowest robot [s]"]
    lines = []
    for task in [*dict.fromkeys(scene.task for scene in scenes), None]:
        shared, own = ([s for s in scenes if s.motion == motion and task in (None, s.task)] for motion in MOTIONS)
        durations = _mean_durations(own).values()
        seconds = [f"{np.mean(list(_mean_durations(shared).values())):.1f}", f"{min(durations):.1f}, {max(durations):.1f}"]
        lines.append([f"`{task}`" if task else "**all tasks**", _format_distances(shared), _format_distances(own), *seconds])
    return _markdown(head, lines)


def robot_table(scenes: Sequence[Compared]) -> str:
    """A line a robot: mean and largest distance from the others in own motion, and its durations in each kind."""
    shared, own = ([scene for scene in scenes if scene.motion == motion] for motion in MOTIONS)
    planned, durations = _mean_durations(shared), _mean_durations(own)
    head = ["robot", "own: mean, max [mm] from others", "shared [s]", "own [s]", "own / shared"]
    lines = []
    for robot, seconds in durations.items():
        times = f"{planned[robot]:.1f}", f"{seconds:.1f}", f"{seconds / planned[robot]:.2f}"
        lines.append([f"`{robot}`", _format_distances(own, robot), *times])
    return _markdown(head, lines)


def _mean_durations(scenes: Sequence[Compared]) -> dict[str, float]:
    """Mean duration of the episodes of each robot [s]."""
    return {robot: float(np.mean([scene.seconds[robot] for scene in scenes])) for robot in scenes[0].seconds}


def _format_distances(scenes: Sequence[Compared], robot: str | None = None) -> str:
    """Mean over scenes and pairs, and largest, of the distance between robots: of all pairs, or of those with one robot."""
    found = [
        scene.distances(*pair) for scene in scenes for pair in combinations(scene.tools, 2) if robot is None or robot in pair
    ]
    mean = np.mean([distances.mean() for distances in found])
    return f"{mean:.1f}, {max(distances.max() for distances in found):.1f}"


def _markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *lines))


@user_errors
def main() -> None:
    quiet_warp()
    args = tyro.cli(Args, description=__doc__)
    scenes = compare_motions(args)
    if not scenes:
        raise EpisodeError("no scene has a plan that all of these robots can follow; try other --tasks, --seeds or --robots.")
    asked = len(dict.fromkeys(args.tasks)) * args.seeds
    print(f"{len(scenes) // len(MOTIONS)} of {asked} scenes\n\n{task_table(scenes)}\n\n{robot_table(scenes)}")


if __name__ == "__main__":
    main()

"""Scenes made robot by robot, each by whichever worker is free: with physics on the CPU a robot's share is work for one core.

Reads  `Job`s, and functions that simulate and write one robot's share of a scene
Writes what those write; gives the headers of each job as soon as all of its robots are done

A scene counts only when all of its robots succeed, and only then it is rendered. So its shares are first simulated; when the
last of them is there they are written, ahead of all that has not begun.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from xew.episode import Record
from xew.sim_warp.devices.workers import Workers
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.production.cells import Cell, Job

Timed = tuple[Cell | Record, float]
"""Result of one robot's share of a scene, its simulated cell or at last its header, and the seconds spent on it."""


@dataclass
class _Scene:
    """A job, and how far it is."""

    job: Job
    cells: list[Cell] = field(default_factory=list)
    records: dict[str, Record] = field(default_factory=dict)
    seconds: float = 0.0


def make_by_robot(
    workers: Workers,
    jobs: Sequence[Job],
    robots: Mapping[str, RobotSpec],
    simulate: Callable[[Job, RobotSpec], Timed],
    write: Callable[[Cell, bool], Timed],
) -> Iterator[tuple[list[Record], float]]:
    """Make some scenes; the headers of each job in the order of its robots, and the seconds spent on it.

    Args:
        workers: processes to which the functions and their arguments travel by pickle.
        jobs: no two of them of the same task and seed.
        robots: the robots of the jobs by name.
        simulate: gives the cell of a job of one robot, and of that robot, with its motion.
        write: renders and writes a cell, or where its scene is rejected the header alone, and gives the header.
    """
    scenes = {(job.task, job.seed): _Scene(job) for job in jobs}
    shares = ((replace(job, robots=(robot,)), robots[robot]) for job in jobs for robot in job.robots)
    work: deque[Callable[[], Timed]] = deque(partial(simulate, *share) for share in shares)
    for made, seconds in workers.run(_call, work):
        scene = scenes[(made.task_name, made.scene.seed) if isinstance(made, Cell) else (made.task, made.seed)]
        scene.seconds += seconds
        if isinstance(made, Record):
            scene.records[made.robot] = made
            if len(scene.records) == len(scene.job.robots):
                yield [scene.records[robot] for robot in scene.job.robots], scene.seconds
        else:
            scene.cells.append(made)
            if len(scene.cells) == len(scene.job.robots):
                rejected = scene.job.rejected or any(cell.failure for cell in scene.cells)
                work.extendleft(partial(write, cell, rejected) for cell in scene.cells)
                scene.cells = []


def _call(share: Callable[[], Timed]) -> Timed:
    return share()

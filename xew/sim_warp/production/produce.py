"""Scenes made in worker processes: simulated in shares, then rendered and written a few robots at a time.

A scene is rendered only if all of its robots succeed: all of them are simulated first. A completed scene is written before
further simulations begin. On a CPU a share is one robot of a few scenes, on a GPU a batch of whole scenes. While some workers
wait for a GPU that steps their batches, the others render and write.
"""

import operator
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path

import warp as wp

from xew.concurrency import usable_cores
from xew.episode import Record
from xew.sim_warp.devices.workers import FRAMES_OF_A_RENDERING_WORKER, Workers
from xew.sim_warp.production.cells import Cell, Job, plan_cells, simulate_cells
from xew.sim_warp.production.episodes import render_cells, write_cell
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import ROBOTS, RobotSpec

PLANNED_TOGETHER = 16
"""Largest number of scenes in a CPU's share. Inverse kinematics of 16 paths together takes a fifth of the time."""
SHARES_PER_WORKER = 4
"""Least number of a CPU's shares for each worker, so all workers end at about the same time."""
ROBOTS_TOGETHER = 8
"""Largest number of a scene's robots whose pictures, 0.5 MB a frame each, one worker has in memory; other workers take more."""
BATCHES_PER_GPU = 3
"""Number of batches in flight on a GPU: one is stepped while the models of the next ones are built."""


@dataclass(frozen=True)
class Production:
    """Settings of the production, sent to every worker."""

    out: Path
    """Folder of the data set."""
    robots: Mapping[str, RobotSpec] = field(default_factory=lambda: ROBOTS)
    """All robots of the jobs by name."""
    gpu_physics: bool = False
    """Whether each worker's GPU runs planning and physics instead of the CPU."""
    batch: int = 256
    """Number of worlds that a GPU steps together."""
    videos: bool = True
    """Whether to store videos; otherwise `rerender.add_videos` makes them from the states."""
    gpus: int = 1
    """Number of GPUs that step physics."""

    @property
    def physics(self) -> str | None:
        """Warp's name of the device for planning and physics; None for a worker's own."""
        return None if self.gpu_physics else "cpu"

    def shares(self, jobs: Sequence[Job], workers: int = 1) -> list[list[Job]]:
        """The jobs in the shares that one of some workers simulates at a time."""
        if not self.gpu_physics:
            cells = sum(len(job.robots) for job in jobs)
            size = max(1, min(PLANNED_TOGETHER, cells // (SHARES_PER_WORKER * workers)))
            groups = [jobs[first : first + size] for first in range(0, len(jobs), size)]
            return [share for group in groups for share in _share_by_robot(group)]
        shares: list[list[Job]] = []
        worlds = self.batch
        for job in jobs:
            if worlds + len(job.robots) > self.batch:
                shares.append([])
                worlds = 0
            shares[-1].append(job)
            worlds += len(job.robots)
        return shares


def _share_by_robot(jobs: Sequence[Job]) -> list[list[Job]]:
    """The jobs of each robot."""
    robots = dict.fromkeys(robot for job in jobs for robot in job.robots)
    return [[replace(job, robots=(robot,)) for job in jobs if robot in job.robots] for robot in robots]


@dataclass
class _Scene:
    """A job, its simulated cells, and the headers of those that are written."""

    job: Job
    cells: list[Cell] = field(default_factory=list)
    records: list[Record] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def rejected(self) -> bool:
        """Whether a robot has failed, now or in an earlier run."""
        return self.job.rejected or any(cell.failure for cell in self.cells)

    @property
    def groups(self) -> list[list[Cell]]:
        """The cells in the order of the job's robots, as many as are written together."""
        by_robot = {cell.robot_name: cell for cell in self.cells}
        cells = [by_robot[robot] for robot in self.job.robots]
        return [cells[first : first + ROBOTS_TOGETHER] for first in range(0, len(cells), ROBOTS_TOGETHER)]

    @property
    def ordered_records(self) -> list[Record]:
        """The headers in the order of the job's robots."""
        return sorted(self.records, key=lambda record: self.job.robots.index(record.robot))


Outcome = tuple[list[list[Cell]] | list[Record], float]
"""Simulated cells of each job of a share, or the headers of some written cells of a scene; and the time for it [s]."""


def make_scenes(
    workers: Workers, jobs: Sequence[Job], production: Production, wait_for_renderer: Callable[[], object] = lambda: None
) -> Iterator[tuple[list[Record], float]]:
    """Make scenes of different tasks or seeds; yields the headers of a job in the order of its robots, and its time [s].

    `wait_for_renderer` is called before a scene is rendered. Workers simulate what has been handed out meanwhile.
    """
    scenes = {(job.task, job.seed): _Scene(job) for job in jobs}
    shares = [partial(_simulate, share, production) for share in production.shares(jobs, workers.count)]
    most = BATCHES_PER_GPU * production.gpus if production.gpu_physics else len(shares)
    work: deque[Callable[[], Outcome]] = deque(shares[:most])
    waiting = deque(shares[most:])
    for results, seconds in workers.run(operator.call, work):
        if results and isinstance(results[0], Record):
            scene = scenes[results[0].task, results[0].seed]
            scene.records += [record for record in results if isinstance(record, Record)]
            scene.seconds += seconds
            if len(scene.records) == len(scene.job.robots):
                yield scene.ordered_records, scene.seconds
            continue
        if waiting:
            work.append(waiting.popleft())
        cells = [cell for group in results if isinstance(group, list) for cell in group]
        for cell in cells:
            scene = scenes[cell.task_name, cell.seed]
            scene.cells.append(cell)
            scene.seconds += seconds / len(cells)
            if len(scene.cells) == len(scene.job.robots):
                wait_for_renderer()
                work.extendleft(partial(_write, group, scene.rejected, production) for group in reversed(scene.groups))


def _simulate(share: Sequence[Job], production: Production) -> Outcome:
    """Plan and simulate a share in a worker process."""
    begin = time.perf_counter()
    cells = simulate_jobs(share, production)
    return cells, time.perf_counter() - begin


def _write(cells: Sequence[Cell], rejected: bool, production: Production) -> Outcome:
    """Render and write some cells of a scene in a worker process, on its own device."""
    begin = time.perf_counter()
    records = write_cells(cells, production.out, _renderer(production.gpu_physics), rejected=rejected, videos=production.videos)
    return records, time.perf_counter() - begin


@cache
def _renderer(gpu_physics: bool) -> Renderer:
    """The renderer of a worker process on its own device; smaller if many workers share a GPU."""
    only_renders = wp.get_device().is_cuda and not gpu_physics
    return Renderer(frames_per_chunk=FRAMES_OF_A_RENDERING_WORKER if only_renders else None)


def simulate_jobs(jobs: Sequence[Job], production: Production) -> list[list[Cell]]:
    """The simulated cells of each job."""
    cells = plan_cells(jobs, production.robots, production.physics)
    return simulate_cells(cells, production.physics, production.batch)


def write_cells(
    cells: Sequence[Cell], out: Path, renderer: Renderer, *, rejected: bool = False, videos: bool = True
) -> list[Record]:
    """Render and write simulated cells of one scene; returns their headers in the same order.

    Nothing is rendered if a cell has failed, or if the scene is `rejected` by the failure of another robot.
    """
    accepted = not rejected and not any(cell.failure for cell in cells)
    pixels = render_cells(cells, renderer) if accepted else [None] * len(cells)
    with ThreadPoolExecutor(usable_cores()) as pool:  # codecs, zlib and hashes release the interpreter's lock
        writing = [pool.submit(write_cell, *pair, out, renderer.device, videos) for pair in zip(cells, pixels, strict=True)]
        return [future.result() for future in writing]

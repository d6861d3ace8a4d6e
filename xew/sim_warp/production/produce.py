"""The making of episodes for a batch of seeds: plan, simulate, render, write.

Reads  `Job`s: (task, seed) and the robots that still lack it
Writes episodes and, for what did not succeed, their headers with the reason

A seed counts only when all of its robots succeed, and only then it is rendered: so all of them are simulated first.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from xew.concurrency import usable_cores
from xew.episode import Record
from xew.sim_warp.production.cells import Cell, Job, plan_cells, simulate_cells
from xew.sim_warp.production.episodes import render_cells, write_cell
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import ROBOTS, RobotSpec

FRAMES_AT_ONCE = 4096
"""Number of frames in one group of seeds: about half a megabyte of pixels each."""


def produce(
    jobs: Sequence[Job],
    out: Path,
    renderer: Renderer,
    batch: int | None = None,
    videos: bool = True,
    robots: Mapping[str, RobotSpec] = ROBOTS,
) -> list[list[Record]]:
    """Make all episodes of some seeds and write them under `out`; the headers of each job in the order of its robots.

    All is done on the renderer's device. Seeds are rendered a group at a time while the group before is being written: that
    bounds the pixels in memory.

    Args:
        jobs: the seeds, and which robots do each.
        out: folder of the data set.
        renderer: draws the pictures.
        batch: worlds that a GPU steps together, None for all.
        videos: store them; without, an episode has all states and hashes, and `rerender.add_videos` makes its videos.
        robots: the robots of the jobs by name.
    """
    seeds = simulate_jobs(jobs, renderer.device.alias, batch, robots)
    return write_seeds(seeds, {(job.task, job.seed) for job in jobs if job.rejected}, out, renderer, videos)


def simulate_jobs(
    jobs: Sequence[Job], physics: str, batch: int | None = None, robots: Mapping[str, RobotSpec] = ROBOTS
) -> list[list[Cell]]:
    """The cells of each job with the motion that physics made of their plans.

    Args:
        jobs, batch, robots: as for `produce`.
        physics: Warp's name of the device that plans and steps physics.
    """
    return simulate_cells(plan_cells(jobs, robots, physics), physics, batch)


def write_seeds(
    seeds: Sequence[Sequence[Cell]],
    rejected: Collection[tuple[str, int]],
    out: Path,
    renderer: Renderer,
    videos: bool = True,
) -> list[list[Record]]:
    """Render and write simulated cells; their headers, in the same order.

    Args:
        seeds: the cells of each seed, or some of them.
        rejected: tasks and seeds on which a robot has failed that is not among the cells; then nothing is rendered.
        out, renderer, videos: as for `produce`.
    """
    records: list[list[Record]] = []
    writing: list[list[Future[Record]]] = []
    with ThreadPoolExecutor(usable_cores()) as pool:  # codecs, zlib and hashes let go of the interpreter's lock
        for group in _group_seeds(seeds):
            accepted = [cell for cells in group if _is_accepted(cells, rejected) for cell in cells]
            pixels = dict(zip(map(id, accepted), render_cells(accepted, renderer), strict=True))
            records += [[future.result() for future in cells] for cells in writing]
            writing = [
                [pool.submit(write_cell, cell, pixels.get(id(cell)), out, renderer.device, videos) for cell in cells]
                for cells in group
            ]
        return records + [[future.result() for future in cells] for cells in writing]


def _group_seeds(seeds: Sequence[Sequence[Cell]]) -> Iterator[list[Sequence[Cell]]]:
    """The seeds in order, about `FRAMES_AT_ONCE` frames at a time."""
    group: list[Sequence[Cell]] = []
    for cells in seeds:
        group.append(cells)
        if sum(cell.path.frame_count for others in group for cell in others) >= FRAMES_AT_ONCE:
            yield group
            group = []
    if group:
        yield group


def _is_accepted(cells: Sequence[Cell], rejected: Collection[tuple[str, int]]) -> bool:
    """Whether all robots of a seed have succeeded, those that were made before included."""
    return not any((cell.task_name, cell.scene.seed) in rejected or cell.failure for cell in cells)

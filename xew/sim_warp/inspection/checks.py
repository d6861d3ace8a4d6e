"""Checks of a data set: hashes, plausible motion and re-rendering; and rendering of missing videos."""

from functools import cache
from pathlib import Path

import numpy as np
from tqdm import tqdm

from xew.concurrency import usable_cores
from xew.episode import EpisodeError, verify_episode
from xew.sim_warp.devices.workers import Workers, find_devices, worker_count
from xew.sim_warp.production.rerender import add_videos, demand_plausible, render_again
from xew.sim_warp.production.warm_up import compile_kernels
from xew.sim_warp.rendering.render import Renderer

EPISODES_PER_WORKER = 32
"""Number of episodes that justify one more process, by its start-up time."""


def verify(folders: list[Path]) -> list[str]:
    """Compare all files with their hashes and check motions for plausibility; returns the error messages."""
    with Workers(min(usable_cores(), len(folders) // EPISODES_PER_WORKER)) as workers:
        several = len(folders) >= 2 * EPISODES_PER_WORKER
        results = workers.run(find_problem, folders) if several else map(find_problem, folders)
        bar = tqdm(results, desc="verifying", unit="episode", total=len(folders))
        damaged = sorted(problem for problem in bar if problem)
    print(f"{len(folders) - len(damaged)} of {len(folders)} episodes agree with their hashes and are plausible")
    return damaged


def find_problem(folder: Path) -> str:
    """The error message of an episode; empty if it is valid."""
    try:
        if not verify_episode(folder).source:
            demand_plausible(folder)
    except EpisodeError as error:
        return str(error)
    return ""


def rerender(folders: list[Path], count: int) -> None:
    """Render some episodes again, spread over the data set."""
    renderer = Renderer()
    sample = [folders[index] for index in np.unique(np.linspace(0, len(folders) - 1, max(1, count)).astype(int))]
    for folder in tqdm(sample, desc="rendering again", unit="episode"):
        render_again(folder, renderer)
    print(f"{len(sample)} episodes rendered again from their states agree with their hashes")


def render_videos(folders: list[Path]) -> None:
    """Make and store the videos of episodes that have none."""
    devices = find_devices(None)
    several = len(folders) >= 2 * EPISODES_PER_WORKER
    with Workers(worker_count(devices), devices) as workers:
        if several:
            compile_kernels(workers, devices[0], 1, ("rendering",))
        results = workers.run(_render_video, folders) if several else map(_render_video, folders)
        for _ in tqdm(results, desc="rendering", unit="episode", total=len(folders)):
            pass
    print(f"videos of {len(folders)} episodes made from their states")


@cache
def _renderer() -> Renderer:
    """The renderer of this process on its own device, made once."""
    return Renderer()


def _render_video(folder: Path) -> None:
    """Make and store the videos of one episode, in a worker process or here."""
    add_videos(folder, _renderer())

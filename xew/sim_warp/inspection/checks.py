"""Checks of a data set: hashes, plausible motion and re-rendering; and rendering of missing videos and views."""

from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from tqdm import tqdm

from xew.concurrency import usable_cores
from xew.dataset import Episode
from xew.episode import EpisodeError, Record, data_folder, verify_episode
from xew.protocol import RANDOM_CHANGE, CameraSpec
from xew.sim_warp.cameras import demand_sight
from xew.sim_warp.changes.scenes import check_change
from xew.sim_warp.devices.workers import Workers, find_devices, worker_count
from xew.sim_warp.production.rerender import add_tiled, add_videos, add_view, demand_plausible, render_again, render_changed
from xew.sim_warp.production.warm_up import compile_on_devices
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import recorded_robot
from xew.sim_warp.robots.user.own import KEPT, keep_robot, kept_robot

Result = TypeVar("Result")

EPISODES_PER_WORKER = 32
"""Number of episodes that justify one more process, by its start-up time."""


def verify(folders: list[Path]) -> list[str]:
    """Compare all files with their hashes and check motions for plausibility; returns the error messages."""
    damaged = sorted(filter(None, _on_cores(find_problem, folders, "verifying")))
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
    _render_all(_render_video, folders)
    print(f"videos of {len(folders)} episodes made from their states")


def render_views(cells: Sequence[Episode], specs: Sequence[CameraSpec]) -> None:
    """Make and store the views of cameras of episodes, where they are missing.

    Raises ConfigError, before anything is rendered, for a camera that sees nothing of a robot or is fixed to no link of it.
    """
    robots = {record.robot: recorded_robot(record.robot, data_folder(folder)) for folder, record in cells}
    demand_sight(specs, list(robots.values()))
    for spec in specs:
        made = _render_all(partial(_render_view, spec=spec), [folder for folder, _ in cells])
        print(f"view {spec.view}: {sum(made)} of {len(cells)} episodes new")


def tile_views(cells: Sequence[Episode], views: Sequence[str]) -> None:
    """Make and store the view that tiles others into one picture. Raises EpisodeError as `add_tiled`."""
    made = _on_cores(partial(add_tiled, views=views), [folder for folder, _ in cells], "tiling")
    print(f"view {'+'.join(views)}: {sum(made)} of {len(cells)} episodes new")


def _on_cores(function: Callable[[Path], Result], folders: list[Path], doing: str) -> list[Result]:
    """Results of episodes in any order, from a process for each core if there are many episodes, else from this one."""
    if not _are_many(folders):
        return _collect(map(function, folders), folders, doing)
    with Workers(min(usable_cores(), len(folders) // EPISODES_PER_WORKER), imported=(__name__,)) as workers:
        return _collect(workers.run(function, folders), folders, doing)


def _render_all(render: Callable[[Path], Result], folders: list[Path]) -> list[Result]:
    """The same, rendered on all devices."""
    devices = find_devices(None)
    if not _are_many(folders):
        return _collect(map(render, folders), folders, "rendering")
    with Workers(worker_count(devices), devices, (__name__,)) as workers:
        compile_on_devices(workers, {"rendering": devices[0].alias}, 1)
        return _collect(workers.run(render, folders), folders, "rendering")


def _are_many(folders: list[Path]) -> bool:
    """Whether so many episodes are worth starting processes."""
    return len(folders) >= 2 * EPISODES_PER_WORKER


def _collect(results: Iterable[Result], folders: list[Path], doing: str) -> list[Result]:
    return list(tqdm(results, desc=doing, unit="episode", total=len(folders)))


def render_changes(folders: list[Path], change: str, out: Path) -> None:
    """Write episodes of one data set with a change to another, from their states. Raises EpisodeError if it needs physics."""
    check_change(change)
    if change.partition(":")[0] in ("height", RANDOM_CHANGE):
        raise EpisodeError(f"the change {change} needs physics; run `python -m xew.sim_warp.generate --change {change}`.")
    data = data_folder(folders[0])
    for key in sorted({folder.name for folder in folders}):
        if (data / KEPT / key).is_dir() and (robot := kept_robot(key, data)) is not None:
            keep_robot(robot, out)
    failed = [record for record in _render_all(partial(_render_change, change=change, out=out), folders) if not record.is_kept]
    print(f"{len(folders) - len(failed)} of {len(folders)} episodes rendered with the change {change} into {out}")
    for record in failed:
        print(f"{record.task} {record.seed} {record.robot}: {record.failure_detail}")


@cache
def _renderer() -> Renderer:
    """The renderer of this process on its own device, made once."""
    return Renderer()


def _render_change(folder: Path, change: str, out: Path) -> Record:
    """Write one episode with a change to another data set; returns its header."""
    return render_changed(folder, change, out, _renderer())


def _render_video(folder: Path) -> bool:
    """Make and store the videos of one episode, in a worker process or here."""
    add_videos(folder, _renderer())
    return True


def _render_view(folder: Path, spec: CameraSpec) -> bool:
    """Make and store one view of an episode; returns whether it was missing."""
    return add_view(folder, spec, _renderer())

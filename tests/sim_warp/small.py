"""The smallest things that go the whole way: a task of twelve frames, a robot that cannot do every seed of it, no workers.

Both are reached from outside the registries, as a user's own would be: TASK and SLOW name them.
"""

import resource
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from xew.episode import Record
from xew.sim_warp import objects
from xew.sim_warp.plan import HOME, LEFT, RIGHT, Timeline
from xew.sim_warp.production.cells import Job
from xew.sim_warp.production.produce import Production, simulate_jobs, write_cells
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import ROBOTS, RobotSpec
from xew.sim_warp.scene import Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import Moment, Task

if TYPE_CHECKING:  # workers import this file
    import pytest

TASK = "tests.sim_warp.small:CLOSE"
SLOW = "tests.sim_warp.small:SLOW_PIPER"


def sample(rng: np.random.Generator, seed: int) -> Scene:
    x, y = rng.uniform([-0.1, 0.0], [0.1, 0.1])
    block = SceneObject("block", objects.block((0.04,) * 3, (200, 45, 40)), upright((x, y), TABLE_TOP), mass=0.05)
    return Scene(TASK, seed, (block,))


def plan(scene: Scene) -> Timeline:
    """Close both hands; on odd seeds raise the left one too, which is too fast for `SLOW_PIPER`."""
    timeline = Timeline()
    timeline.grip({LEFT: 0.0, RIGHT: 0.0})
    timeline.follow(LEFT, [HOME[LEFT].moved(z=0.01 * (scene.seed % 2))], seconds=0.18)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    return bool((now.gripper < 0.2).all())


CLOSE = Task("close", "close both hands", sample, plan, success)
SLOW_PIPER = replace(ROBOTS["piper"], joint_velocity=(0.02,) * 6)
WITH_SLOW = ROBOTS | {SLOW: SLOW_PIPER}
"""Robots of the registry and the slow one, by the names that jobs give."""
WITH_WORKERS = ("xew.sim_warp.devices.workers", "xew.sim_warp.generate", "xew.sim_warp.inspection.checks", "lab.seeds.yields")
"""Modules that name Workers: where commands find them, and those that have imported them already."""


def produce(
    jobs: Sequence[Job], out: Path, renderer: Renderer, *, videos: bool = True, robots: Mapping[str, RobotSpec] = ROBOTS
) -> list[list[Record]]:
    """Make some scenes in this process, with physics on the CPU; the headers of each job in the order of its robots."""
    production = Production(out, robots, videos=videos)
    scenes = zip(jobs, simulate_jobs(jobs, production), strict=True)
    return [write_cells(cells, out, renderer, rejected=job.rejected, videos=videos) for job, cells in scenes]


class InlineWorkers:
    """Workers that do their jobs in the test's own process: a process of their own imports for several seconds."""

    def __init__(self, count: int, devices: Sequence[Any] = (), imported: Sequence[str] = ()) -> None:
        self.count = count

    def __enter__(self) -> "InlineWorkers":
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def start(self, function: Callable[[Any], Any], job: Any) -> Callable[[], Any]:
        result = function(job)
        return lambda: result

    def run(self, function: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterator[Any]:
        waiting = jobs if isinstance(jobs, deque) else deque(jobs)  # to which whoever takes results may add
        while waiting:
            yield function(waiting.popleft())


def work_inline(patch: "pytest.MonkeyPatch") -> None:
    """Let commands that are called in this process start no workers."""
    for module in WITH_WORKERS:
        patch.setattr(f"{module}.Workers", InlineWorkers)


def fill_disk(_: object = None) -> None:
    """Let this process write no file as large as the video of twelve frames."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (20 * 1024, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


@contextmanager
def launched_modules(patch: "pytest.MonkeyPatch") -> Iterator[set[str]]:
    """Names of the modules of which kernels are launched within the block."""
    names: set[str] = set()
    launch = wp.launch

    def note(kernel: wp.Kernel, *arguments: object, **named: object) -> object:
        names.add(kernel.module.name)
        return launch(kernel, *arguments, **named)

    with patch.context() as own:
        own.setattr(wp, "launch", note)
        yield names

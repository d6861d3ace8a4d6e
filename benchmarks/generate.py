"""How many episodes a minute: the whole command over all tasks and robots, and where the time of one process goes.

    python benchmarks/generate.py [--device cpu|cuda:0] [--batch 256] [--seeds 1] [--workers N]

The first figure is that of `python -m xew.sim_warp.generate` with an empty folder, start of processes, rejected seeds and
all: episodes of 320x240 frames with scene, robot-only render, states, keypoints and hashes on disk. The second part does
every stage by itself, one after another, on the first accepted seeds. Before a figure is printed, the work is checked:
as many episodes as asked for, all of them successes, every video and array read back and compared with its hash.
"""

import os
import platform
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import tyro
import warp as wp

from xew.episode import Record, find_accepted, find_records, verify_episode
from xew.sim_warp import generate
from xew.sim_warp.observe import observe
from xew.sim_warp.produce import Cell, Job, plan_cells, simulate_cells, write_cell
from xew.sim_warp.render import Renderer
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.streams import command_renders
from xew.sim_warp.tasks import TASKS

PACKAGES = ("newton", "mujoco", "mujoco-warp", "warp-lang", "numpy", "opencv-python-headless")


@dataclass(frozen=True)
class Args:
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda:0")] = None
    """Default: a GPU if Warp finds one."""
    batch: int = 256
    """Worlds that a GPU steps together."""
    seeds: int = 0
    """Accepted seeds of each task; 0 for one on a CPU and for as many as fill three batches on a GPU."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Processes on a CPU."""


def whole_command(args: Args, seeds: int, out: Path) -> float:
    """Seconds that `generate` takes from nothing to the last header."""
    begin = time.perf_counter()
    generate.generate(
        generate.Args(train_seeds=seeds, test_seeds=0, out=out, batch=args.batch, workers=args.workers, device=args.device)
    )
    return time.perf_counter() - begin


def check(out: Path, seeds: int) -> list[Record]:
    """The headers of all episodes, after the work has been found to be what it is said to be."""
    accepted = find_accepted(out)
    assert len(accepted) == len(TASKS) * len(ROBOTS) * seeds, f"{len(accepted)} episodes"
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        records = list(pool.map(verify_episode, [folder for folder, _ in accepted]))
    assert all(record.success and set(record.hashes) == {"states", "rgb", "robot"} for record in records)
    return records


class Clock:
    """Seconds by stage."""

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        wp.synchronize_device(self.device)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin


def stages(jobs: list[Job], renderer: Renderer, out: Path, clock: Clock) -> int:
    """Do some jobs stage by stage; the number of frames."""
    device = renderer.device
    with clock.stage("scene, plan, inverse kinematics"):
        seeds = plan_cells(jobs)
    with clock.stage("physics"):
        seeds = simulate_cells(seeds, device.alias)
    cells: list[Cell] = [cell for cells in seeds if not any(other.failure for other in cells) for cell in cells]
    with clock.stage("scene render"):
        views = observe(renderer, [cell.recording for cell in cells])
    with clock.stage("robot-only render"):
        renders = command_renders([(cell.robot_name, cell.commands.action) for cell in cells], renderer=renderer)
    with clock.stage("writing"), ThreadPoolExecutor(1 if device.is_cpu else os.cpu_count()) as pool:
        pixels = zip(views, renders, strict=True)
        list(pool.map(lambda cell, seen: write_cell(cell, seen, out, device), cells, pixels))
    return sum(cell.path.frame_count for cell in cells)


def first_jobs(out: Path, count: int) -> list[Job]:
    """The first accepted seeds of each task."""
    seeds = sorted({(record.task, record.seed) for _, record in find_accepted(out)})
    return [Job(task, seed, tuple(ROBOTS)) for name in TASKS for task, seed in [s for s in seeds if s[0] == name][:count]]


def main(args: Args) -> None:
    """Print episodes a minute, and milliseconds a frame by stage."""
    device = wp.get_device(args.device)
    seeds = args.seeds or (1 if device.is_cpu else max(1, 3 * args.batch // (len(TASKS) * len(ROBOTS))))
    processes = f"{args.workers} processes" if device.is_cpu else f"batches of {args.batch}"
    print(f"{device.name} ({device.alias}), {processes}, {os.cpu_count()} cores, Python {platform.python_version()}")
    print(", ".join(f"{name} {version(name)}" for name in PACKAGES))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "data"
        seconds = whole_command(args, seeds, out)
        records = check(out, seeds)
        frames = sum(record.frame_count for record in records)
        tried = len({(record.task, record.seed) for _, record in find_records(out)})
        size = sum(path.stat().st_size for path in out.rglob("*.*")) / len(records)
        print(f"\n{len(records)} episodes of {frames / len(records):.0f} frames, {tried} seeds tried, {size / 1e6:.2f} MB each")
        print(
            f"generate: {seconds:.1f} s, {60 * len(records) / seconds:.1f} episodes a minute, {frames / seconds:.1f} frames/s"
        )
        print_stages(first_jobs(out, 1 if device.is_cpu else seeds), device, Path(folder) / "stages")


def print_stages(jobs: list[Job], device: wp.Device, out: Path) -> None:
    """Milliseconds a frame by stage, in one process, after a first round that loads kernels."""
    renderer = Renderer(device.alias)
    stages(jobs[:1], renderer, out, Clock(device))
    clock = Clock(device)
    batches = [[job] for job in jobs] if device.is_cpu else [jobs]
    frames = sum(stages(batch, renderer, out, clock) for batch in batches)
    total = sum(clock.seconds.values())
    print(f"\nstage by stage in one process, {frames} frames [ms/frame]")
    for name, spent in clock.seconds.items():
        print(f"  {name:34s}{1000 * spent / frames:8.2f}  {100 * spent / total:3.0f} %")
    print(f"  {'together':34s}{1000 * total / frames:8.2f}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

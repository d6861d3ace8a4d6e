"""How many episodes a minute: the whole command over all tasks and robots, and where the time of one process goes.

    python -m benchmarks.generate [--device cpu|cuda:0] [--batch 256] [--train-seeds 50 --test-seeds 20] [--states-only]

The first figure is that of `python -m xew.sim_warp.generate` with an empty folder, start of processes and failing seeds
included: episodes of 320x240 frames with scene, robot-only render, states, keypoints and hashes on disk. The second part
does every step of the work by itself, one after another, on some of the accepted seeds. Before a figure is printed, the work is
checked: as many episodes as asked for, all of them successes, and every video and array of a sample read back and
compared with its hash. Kernels should be compiled already: give the command twice on a new machine.
"""

import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
import warp as wp

from benchmarks.common import check_episodes, format_versions
from xew.dataset import find_accepted, find_records
from xew.sim_warp import generate
from xew.sim_warp.devices.kernels import has_kernels
from xew.sim_warp.devices.workers import worker_count
from xew.sim_warp.production.cells import Cell, Job, plan_cells, simulate_cells
from xew.sim_warp.production.episodes import write_cell
from xew.sim_warp.rendering.observe import observe
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.rendering.streams import command_renders
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.tasks import TASKS

PACKAGES = ("newton", "mujoco", "mujoco-warp", "warp-lang", "numpy", "av")


@dataclass(frozen=True)
class Args:
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda:0")] = None
    """Default: a GPU if Warp finds one."""
    batch: int = 256
    """Number of worlds that a GPU steps together."""
    tasks: tuple[str, ...] = tuple(TASKS)
    robots: tuple[str, ...] = tuple(ROBOTS)
    train_seeds: int = 1
    """Number of accepted seeds of each task."""
    test_seeds: int = 0
    workers: int | None = None
    """Number of processes; by default one a core, on a GPU one for two cores."""
    states_only: bool = False
    """Store no videos."""
    timed_seeds: int = 1
    """Number of seeds of each task that are done once more, step by step; 0 for none."""
    out: Path | None = None
    """An empty folder for the episodes, which stay there; by default a temporary one."""


def time_command(args: Args, out: Path) -> float:
    """Seconds that `generate` takes from nothing to the last header."""
    begin = time.perf_counter()
    generate.generate(
        generate.Args(
            tasks=args.tasks,
            robots=args.robots,
            train_seeds=args.train_seeds,
            test_seeds=args.test_seeds,
            out=out,
            batch=args.batch,
            workers=args.workers,
            device=args.device,
            states_only=args.states_only,
        )
    )
    return time.perf_counter() - begin


class Clock:
    """Seconds by step of the work."""

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.seconds: dict[str, float] = {}

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        wp.synchronize_device(self.device)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin


def run_steps(jobs: list[Job], renderer: Renderer, out: Path, clock: Clock) -> int:
    """Do some jobs step by step; the number of frames."""
    device = renderer.device
    with clock.measure("scene, plan, inverse kinematics"):
        seeds = plan_cells(jobs)
    with clock.measure("physics"):
        seeds = simulate_cells(seeds, device.alias)
    cells: list[Cell] = [cell for cells in seeds if not any(other.failure for other in cells) for cell in cells]
    with clock.measure("scene render"):
        views = observe(renderer, [cell.recording for cell in cells])
    with clock.measure("robot-only render"):
        renders = command_renders([(cell.robot, cell.commands.action) for cell in cells], renderer=renderer)
    with clock.measure("writing"), ThreadPoolExecutor(1 if device.is_cpu else os.cpu_count()) as pool:
        pixels = zip(views, renders, strict=True)
        list(pool.map(lambda cell, seen: write_cell(cell, seen, out, device), cells, pixels))
    return sum(cell.path.frame_count for cell in cells)


def first_jobs(args: Args, out: Path) -> list[Job]:
    """The first accepted seeds of each task."""
    seeds: dict[str, set[int]] = {}
    for _, record in find_accepted(out):
        seeds.setdefault(record.task, set()).add(record.seed)
    return [Job(task, seed, args.robots) for task, found in seeds.items() for seed in sorted(found)[: args.timed_seeds]]


def main(args: Args) -> None:
    """Print episodes a minute, and milliseconds a frame by step."""
    device = wp.get_device(args.device)
    batches = "" if device.is_cpu else f", batches of {args.batch}"
    print(f"{device.name} ({device.alias}), {args.workers or worker_count(device)} processes{batches}, {os.cpu_count()} cores")
    print(format_versions(PACKAGES))
    print("kernels were compiled before" if has_kernels(device) else "kernels are compiled on the way")
    with tempfile.TemporaryDirectory() as folder:
        out = args.out or Path(folder) / "data"
        seconds = time_command(args, out)
        expected = len(args.tasks) * len(args.robots) * (args.train_seeds + args.test_seeds)
        records = check_episodes(out, expected, videos=not args.states_only)
        frames = sum(record.frame_count for record in records)
        tried = len({(record.task, record.seed) for _, record in find_records(out)})
        size = sum(path.stat().st_size for path in out.rglob("*.*") if path.is_file()) / len(records)
        print(f"\n{len(records)} episodes of {frames / len(records):.0f} frames, {tried} seeds tried, {size / 1e6:.2f} MB each")
        print(
            f"generate: {seconds:.1f} s, {60 * len(records) / seconds:.1f} episodes a minute, {frames / seconds:.1f} frames/s"
        )
        if args.timed_seeds:
            print_steps(first_jobs(args, out), device, Path(folder) / "steps")


def print_steps(jobs: list[Job], device: wp.Device, out: Path) -> None:
    """Milliseconds a frame by step, in one process, after a first round that loads kernels."""
    renderer = Renderer(device.alias)
    run_steps(jobs[:1], renderer, out, Clock(device))
    clock = Clock(device)
    batches = [[job] for job in jobs] if device.is_cpu else [jobs]
    frames = sum(run_steps(batch, renderer, out, clock) for batch in batches)
    total = sum(clock.seconds.values())
    print(f"\nstep by step in one process, {frames} frames [ms/frame]")
    for name, spent in clock.seconds.items():
        print(f"  {name:34s}{1000 * spent / frames:8.2f}  {100 * spent / total:3.0f} %")
    print(f"  {'together':34s}{1000 * total / frames:8.2f}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

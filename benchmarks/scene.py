"""One scene of many bodies: each robot's share by whichever worker is free, beside one process that makes the scene whole.

    python -m benchmarks.scene [--robots body:0-7] [--task place_empty_cup] [--seed 0] [--workers 2] [--repeats 3]

Physics is on the CPU, where `python -m xew.sim_warp.generate` makes scenes robot by robot. Both ways are taken by turns, after
one scene each in which processes start and kernels load, and the median of the turns is printed with the ratio. Before a
figure is printed the work is checked: an episode of every robot, and the same hashes both ways.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import tyro

from xew.concurrency import usable_cores
from xew.episode import Record
from xew.protocol import expand_robots
from xew.sim_warp import generate
from xew.sim_warp.devices.workers import quiet_warp
from xew.sim_warp.production.cells import Job
from xew.sim_warp.production.produce import Production, simulate_jobs, write_cells
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import get_robot


@dataclass(frozen=True)
class Args:
    robots: tuple[str, ...] = ("body:0-7",)
    task: str = "place_empty_cup"
    seed: int = 0
    workers: int = usable_cores()
    repeats: int = 3


def main(args: Args) -> None:
    quiet_warp()
    robots = {name: get_robot(name) for name in expand_robots(args.robots)}
    job, renderer = Job(args.task, args.seed, tuple(robots)), Renderer("cpu")
    with TemporaryDirectory() as folder:
        asked = generate.Args((args.task,), tuple(robots), out=Path(folder), workers=args.workers, device="cpu")
        production = Production(Path(folder), robots)
        with generate.start_workers(asked, robots) as (_, make):
            ways: dict[str, Callable[[], list[Record]]] = {
                "one process": lambda: write_cells(simulate_jobs([job], production)[0], production.out, renderer),
                f"robot by robot, {args.workers} workers": lambda: next(iter(make([job])))[0],
            }
            seconds = time_by_turns(ways, args.repeats)
    whole, shared = (median(turns) for turns in seconds.values())
    for name, turns in seconds.items():
        print(f"{name:32} {median(turns):6.2f} s  (of {', '.join(f'{turn:.2f}' for turn in turns)})")
    print(f"{len(robots)} robots: {whole / shared:.2f} times as fast")


def time_by_turns(ways: dict[str, Callable[[], list[Record]]], repeats: int) -> dict[str, list[float]]:
    """Seconds of every turn but the first, by way. Every turn makes the same episodes."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    hashes = set()
    for _ in range(repeats + 1):
        for name, make in ways.items():
            begin = time.perf_counter()
            records = make()
            seconds[name].append(time.perf_counter() - begin)
            assert all(record.success and record.hashes for record in records), [record.failure for record in records]
            hashes.add(tuple((record.robot, *sorted(record.hashes.items())) for record in records))
    assert len(hashes) == 1, "the ways made different episodes"
    return {name: turns[1:] for name, turns in seconds.items()}


if __name__ == "__main__":
    main(tyro.cli(Args))

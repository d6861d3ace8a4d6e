"""Procedural bodies measured: how often they succeed, how far they lie apart, how fast they are generated and loaded.

    python -m lab.robots.measure_bodies yields [--bodies 32 --seeds 4]  # successes in physics, of bodies and the five robots
    python -m lab.robots.measure_bodies plans [--bodies 96 --seeds 2]  # the same without physics: which plans are followed
    python -m lab.robots.measure_bodies distances [--bodies 64 --wide 64 --plot docs/img/body_distances.png]
    python -m lab.robots.measure_bodies rate [--bodies 64 --seeds 2]  # frames a second of generate and of the five robots
    python -m lab.robots.measure_bodies loading [--bodies 16]  # CPU time to load a body whose files are in the cache
    python -m lab.robots.measure_bodies everything --out OUT  # all of these, and the digests of all bodies

`yields` and `rate` take minutes on a GPU with 16 cores, hours on a laptop. `yields` exits with 1 where fewer than 80 % of the
cells of bodies succeed, `rate` where bodies are generated at less than 0.8 of the five robots' rate.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

from xew.protocol import ROBOT_NAMES, body_key

TASKS = ("place_empty_cup", "lift_pot", "beat_block_hammer", "grab_roller", "move_can_pot", "stack_bowls_two")
LEAST_YIELD, LEAST_RATE = 0.8, 0.8


@dataclass(frozen=True)
class Yields:
    """Try seeds of tasks on bodies and on the five robots, in physics."""

    bodies: int = 32
    seeds: int = 4
    first_seed: int = 0
    tasks: tuple[str, ...] = TASKS
    batch: int = 256
    workers: int | None = None


@dataclass(frozen=True)
class Plans:
    """Let the experts of bodies follow plans of tasks, without physics."""

    bodies: int = 96
    seeds: int = 2
    tasks: tuple[str, ...] = TASKS


@dataclass(frozen=True)
class Distances:
    """Appearance and kinematic distances among the five robots, among bodies, and between."""

    bodies: int = 64
    """Number of bodies of the first family."""
    wide: int = 64
    """Number of bodies of the wide family."""
    draws: int = 5
    """Number of draws of configurations of the kinematic distance."""
    plot: Path | None = None
    """PNG file of the plot."""


@dataclass(frozen=True)
class Rate:
    """Generate episodes of bodies, and as many of the five robots."""

    bodies: int = 64
    seeds: int = 2
    task: str = "place_empty_cup"
    batch: int = 256
    out: Path | None = None
    """Folder for the data, which is kept; default: a temporary one."""


@dataclass(frozen=True)
class Loading:
    """Load bodies whose files are in the cache folder, in this process for the first time."""

    bodies: int = 16


@dataclass(frozen=True)
class Everything:
    """Run all measurements, each in a separate process, and write their output to files."""

    out: Path
    """Folder for a text file each, and the plot of distances."""


def count_yields(args: Yields) -> int:
    """Print a table of successes of each body and task; 1 if too few of the bodies' cells succeed."""
    from lab.seeds.yields import Args, attempt_seeds

    bodies = tuple(body_key(number) for number in range(args.bodies))
    robots = (*ROBOT_NAMES, *bodies)
    flags = Args(args.tasks, robots, args.seeds, args.first_seed, batch=args.batch, workers=args.workers)
    cells: dict[tuple[str, str], list[bool]] = defaultdict(list)
    failures: dict[str, int] = defaultdict(int)
    for seed in tqdm(attempt_seeds(flags), total=args.seeds * len(args.tasks), desc="seeds"):
        for record in seed:
            cells[record.robot, record.task].append(record.success)
            if not record.success and record.robot in bodies:
                failures[f"{record.failure}"] += 1
    print(yield_table(cells, args.tasks, bodies))
    print(f"\nreasons of the bodies' failures: {dict(failures) or 'none'}")
    return int(share(cells, bodies) < LEAST_YIELD)


def follow_plans(args: Plans) -> int:
    """Print the plans that each body follows; 1 if too few of them."""
    from xew.sim_warp.kinematics.expert import joint_commands
    from xew.sim_warp.robots import get_robot
    from xew.sim_warp.scene import scene_rng
    from xew.sim_warp.tasks import get_task

    seeds = [(task, seed) for task in args.tasks for seed in range(args.seeds)]
    paths = [get_task(t).plan(get_task(t).sample(scene_rng(t, seed), seed)).path() for t, seed in seeds]
    bodies = tuple(body_key(number) for number in range(args.bodies))
    cells: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for body in tqdm(bodies, desc="bodies"):
        for (task, _), commands in zip(seeds, joint_commands(get_robot(body), paths), strict=True):
            cells[body, task].append(commands.problem is None)
    print(yield_table(cells, args.tasks, bodies))
    return int(share(cells, bodies) < LEAST_YIELD)


def yield_table(cells: dict[tuple[str, str], list[bool]], tasks: Sequence[str], bodies: Sequence[str]) -> str:
    """Markdown: a line a task, for the bodies together, the worst of them, and each other robot."""
    others = [robot for robot in ROBOT_NAMES if (robot, tasks[0]) in cells]
    lines = ["| task | bodies | worst body | " + " | ".join(f"`{robot}`" for robot in others) + (" |" if others else "")]
    lines.append("|---|---|---|" + "---|" * len(others))
    for task in (*tasks, "all"):
        chosen = tasks if task == "all" else (task,)
        of = {robot: [ok for name in chosen for ok in cells[robot, name]] for robot in (*bodies, *others)}
        together = [ok for body in bodies for ok in of[body]]
        worst = min(bodies, key=lambda body: sum(of[body]))
        columns = [_format(together), f"`{worst}` {_format(of[worst])}", *(_format(of[robot]) for robot in others)]
        lines.append(f"| {f'`{task}`' if task != 'all' else '**all**'} | " + " | ".join(columns) + " |")
    return "\n".join(lines)


def share(cells: dict[tuple[str, str], list[bool]], robots: Sequence[str]) -> float:
    """Share of successes of some robots."""
    return float(np.mean([ok for (robot, _), found in cells.items() if robot in robots for ok in found]))


def _format(successes: Sequence[bool]) -> str:
    return f"{sum(successes)}/{len(successes)} ({100 * sum(successes) / len(successes):.0f} %)"


def compare_distances(args: Distances) -> int:
    """Print quantiles of both distances by kind of pair, and plot them."""
    from lab.robots.bodies import FIRST_FAMILY
    from xew.analysis.distance import appearance_matrix, measure
    from xew.sim_warp.rendering.streams import nine_views
    from xew.sim_warp.robots import get_robot

    numbers = (*range(args.bodies), *range(FIRST_FAMILY, FIRST_FAMILY + args.wide))
    names = (*ROBOT_NAMES, *(body_key(number) for number in numbers))
    robots = {name: get_robot(name) for name in names}
    kinematic = measure(robots, range(args.draws), workers=1).kinematic.mean(axis=0)
    appearance = appearance_matrix([nine_views(robot) for robot in tqdm(robots.values(), desc="views")])
    first, second = np.triu_indices(len(names), 1)
    group = np.repeat([0, 1, 2], [len(ROBOT_NAMES), args.bodies, args.wide])
    kinds = {
        "among the five": (group[second] == 0),
        "five to bodies": (group[first] == 0) & (group[second] == 1),
        "among bodies": (group[first] == 1) & (group[second] == 1),
        "five to wide bodies": (group[first] == 0) & (group[second] == 2),
        "among wide bodies": (group[first] == 2),
    }
    print("| pairs | kinematic [m]: least, median, largest | appearance: least, median, largest |\n|---|---|---|")
    for title, chosen in kinds.items():
        columns = [np.quantile(matrix[first, second][chosen], [0, 0.5, 1]) for matrix in (kinematic, appearance)]
        print(f"| {title} ({chosen.sum()}) | " + " | ".join(", ".join(f"{v:.3f}" for v in column) for column in columns) + " |")
    if args.plot:
        plot_distances(kinematic[first, second], appearance[first, second], kinds, args.plot)
        print(args.plot)
    return 0


def plot_distances(kinematic: np.ndarray, appearance: np.ndarray, kinds: dict[str, np.ndarray], path: Path) -> None:
    """A dot a pair of robots: kinematic distance [m] along x, appearance distance along y."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 5), layout="constrained")
    axes = figure.subplots()
    styles = {
        "among wide bodies": ("#cfe3d4", 6, 1),
        "among bodies": ("#b8bcc4", 6, 2),
        "five to wide bodies": ("#3f9a5f", 10, 3),
        "five to bodies": ("#2f7fc1", 10, 4),
        "among the five": ("#d1351b", 60, 5),
    }
    for title, (color, size, order) in styles.items():
        chosen = kinds[title]
        axes.scatter(
            kinematic[chosen], appearance[chosen], s=size, c=color, zorder=order, label=f"{title} ({chosen.sum()})", lw=0
        )
    axes.set_xlabel("kinematic distance [m]")
    axes.set_ylabel("appearance distance")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    figure.legend(frameon=False, loc="outside upper center", ncols=3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def measure_rate(args: Rate) -> int:
    """Print frames a second of both; 1 if bodies are too slow."""
    from xew.sim_warp.generate import Args, generate

    folder = args.out or Path(tempfile.mkdtemp())
    bodies = tuple(body_key(number) for number in range(args.bodies))
    rates: dict[str, float] = {}
    few = -(-args.seeds * args.bodies // len(ROBOT_NAMES))
    for title, robots, seeds in (
        ("warm up", ROBOT_NAMES, 1),
        ("five robots", ROBOT_NAMES, few),
        ("bodies", bodies, args.seeds),
    ):
        out = folder / title.replace(" ", "_")
        begin = time.perf_counter()
        families = generate(Args((args.task,), robots, train_seeds=seeds, test_seeds=0, out=out, batch=args.batch))
        records = [record for family in families for seed in family.done.values() for record in seed.values()]
        frames = sum(record.frame_count for record in records if record.hashes)
        rates[title] = frames / (time.perf_counter() - begin)
        print(f"{title}: {frames} frames of {len(robots)} robots at {rates[title]:.1f} a second")
    ratio = rates["bodies"] / rates["five robots"]
    print(f"bodies are generated at {ratio:.2f} of the five robots' rate; expected at least {LEAST_RATE}")
    if args.out is None:
        shutil.rmtree(folder)
    return int(ratio < LEAST_RATE)


def time_loading(args: Loading) -> int:
    """Print the CPU time of `get_robot` and `load_urdf` for each body."""
    from xew.sim_warp.robots import get_robot, load_urdf

    get_robot(body_key(args.bodies))  # imports, the catalog and the digest of the code are paid for once a process
    load_urdf(get_robot(body_key(args.bodies)).urdf)
    keys = [body_key(number) for number in range(args.bodies)]
    for key in keys:
        get_robot(key)  # writes its files if need be
    from xew.sim_warp.robots.procedural.bodies import load_body

    load_body.cache_clear()
    times = []
    for key in keys:
        begin = time.process_time()
        load_urdf(get_robot(key).urdf)
        times.append(1000 * (time.process_time() - begin))
    print(f"{len(keys)} bodies: {np.median(times):.0f} ms each in the median, {max(times):.0f} ms at most")
    return int(max(times) > 50)


def run_everything(args: Everything) -> int:
    """Print what each command prints and keep it; the number of commands that failed."""
    args.out.mkdir(parents=True, exist_ok=True)
    this = [sys.executable, "-m", "lab.robots.measure_bodies"]
    failed = 0
    for name, command in {
        "digest": [sys.executable, "-m", "lab.robots.bodies", "--digest"],
        "loading": [*this, "loading"],
        "yields": [*this, "yields"],
        "rate": [*this, "rate"],
        "distances": [*this, "distances", "--plot", str(args.out / "body_distances.png")],
    }.items():
        begin = time.perf_counter()
        done = subprocess.run(command, stdout=subprocess.PIPE, encoding="utf-8")
        (args.out / f"{name}.txt").write_text(done.stdout, encoding="utf-8")
        print(f"{done.stdout}{name}: {time.perf_counter() - begin:.0f} s, exit code {done.returncode}\n", flush=True)
        failed += done.returncode != 0
    return failed


COMMANDS = {
    Yields: count_yields,
    Plans: follow_plans,
    Distances: compare_distances,
    Rate: measure_rate,
    Loading: time_loading,
    Everything: run_everything,
}


def main() -> int:
    chosen: Any = tyro.cli(Yields | Plans | Distances | Rate | Loading | Everything)
    command: Callable[[Any], int] = COMMANDS[type(chosen)]  # type: ignore[assignment]
    return command(chosen)


if __name__ == "__main__":
    sys.exit(main())

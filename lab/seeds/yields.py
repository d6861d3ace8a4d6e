"""The command that counts how often the experts succeed, on some seeds of every task and robot, in physics, without pictures.

Reads  the registries of tasks and robots
Writes a Markdown table to the terminal and, with --page, docs/reference/tasks.md: the tasks in words and the table

Unlike generate this tries every seed on every robot and stores no episode.

Command: python -m lab.seeds.yields [--tasks … --robots … --seeds 20 --first-seed 0 --page docs/reference/tasks.md]
"""

import contextlib
import importlib
import inspect
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

import tyro
import warp as wp
from tqdm import tqdm

from xew.config import user_errors
from xew.episode import EpisodeError, Record
from xew.files import hold_lock, write_text
from xew.protocol import SHARED_MOTION, expand_robots
from xew.sim_warp.devices.workers import Workers, find_devices, quiet_warp, worker_count
from xew.sim_warp.production.cells import Job, plan_cells, simulate_cells
from xew.sim_warp.production.episodes import header
from xew.sim_warp.production.warm_up import compile_on_devices
from xew.sim_warp.robots import ROBOTS, RobotSpec, get_robot
from xew.sim_warp.tasks import TASKS, Task, get_task

PARAGRAPHS = ("Task", "Randomization", "Success", "After")
"""Words with which the paragraphs of a task's module docstring begin."""
COMMAND = "python -m lab.seeds.yields"
YIELDS = "## How often the experts succeed"
"""Heading of the last section that this command writes. It keeps the sections that follow."""


@dataclass(frozen=True)
class Args:
    """What to try."""

    tasks: tuple[str, ...] = tuple(TASKS)
    """Keys of the registry, or module:NAME."""
    robots: tuple[str, ...] = tuple(ROBOTS)
    """Keys of the registry, bodies (body:17, body:0-63), module:NAME, or paths (docs/add_a_robot.md)."""
    seeds: int = 20
    """Number of seeds of each task, all of which count."""
    first_seed: int = 0
    motion: Literal["shared", "own"] = "shared"
    """shared: one tool path for all robots. own: each robot's own path, time and rest posture."""
    batch: int = 256
    """Number of worlds that a GPU steps together."""
    workers: int | None = None
    """Number of processes; by default one a core, on GPUs one for two cores."""
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda:0")] = None
    """Default: all GPUs of the kind of the first, which workers share, else the CPU."""
    page: Path | None = None
    """Markdown file to write; none is written without it."""


def attempt_seeds(args: Args) -> Iterator[list[Record]]:
    """Try all seeds in worker processes; the headers of all robots of a seed, as they come.

    Raises:
        ConfigError: an unknown task, robot or device.
        EpisodeError: nothing to try.
    """
    tasks, robots = dict.fromkeys(args.tasks), {name: get_robot(name) for name in expand_robots(args.robots)}
    for name in tasks:
        get_task(name)
    jobs = [
        Job(task, args.first_seed + index, tuple(robots), motion=args.motion) for task in tasks for index in range(args.seeds)
    ]
    if args.workers is not None and args.workers < 1:
        raise EpisodeError(f"--workers is {args.workers}; expected at least 1, or none for as many as there are cores.")
    if not jobs or not robots or args.first_seed < 0:
        raise EpisodeError(
            f"nothing to try of {len(tasks)} tasks, {len(robots)} robots and {args.seeds} seeds from {args.first_seed}; name "
            "tasks and robots, --seeds from 1 and --first-seed from 0."
        )
    devices = find_devices(args.device)
    size = max(1, args.batch // len(robots)) if devices[0].is_cuda else 1
    batches = [jobs[start : start + size] for start in range(0, len(jobs), size)]
    attempt = partial(attempt_batch, batch=args.batch, robots=robots)
    with Workers(args.workers or worker_count(devices), devices) as workers:
        compile_on_devices(workers, dict.fromkeys(("physics", "kinematics"), devices[0].alias), args.batch)
        for seeds in workers.run(attempt, batches):
            yield from seeds


def attempt_batch(jobs: Sequence[Job], batch: int, robots: Mapping[str, RobotSpec] = ROBOTS) -> list[list[Record]]:
    """Plan and simulate some seeds on the worker's device; the headers that their episodes would have, without hashes."""
    device = wp.get_device()
    seeds = simulate_cells(plan_cells(jobs, robots), device.alias, batch)
    return [[header(cell, device) for cell in cells] for cells in seeds]


def markdown(records: Sequence[Record]) -> str:
    """A table of yields, a line a task and a column a robot, then every failure with its reason."""
    cells: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for record in sorted(records, key=lambda record: (record.task, record.seed, record.robot)):
        cells[record.task, record.robot].append(record.success)
    tasks = list(dict.fromkeys(task for task, _ in cells))
    robots = [name for name in ROBOTS if any(name == r for _, r in cells)]
    robots += sorted({robot for _, robot in cells} - set(robots))
    seeds = {task: _seed_successes(records, task) for task in tasks}
    shares = {f"`{task}`": [*(cells[task, robot] for robot in robots), seeds[task]] for task in tasks}
    shares["**all tasks**"] = [list(chain.from_iterable(column)) for column in zip(*shares.values(), strict=True)]
    head = ["task", *(f"`{robot}`" for robot in robots), "all robots on the same seed"]
    table = [head, ["---"] * len(head), *([name, *map(_format_share, counted)] for name, counted in shares.items())]
    return "\n".join([*("| " + " | ".join(line) + " |" for line in table), "", *_failure_lines(records)])


def _seed_successes(records: Sequence[Record], task: str) -> list[bool]:
    """For every seed of a task, whether all robots have succeeded."""
    seeds: dict[int, bool] = {}
    for record in records:
        if record.task == task:
            seeds[record.seed] = seeds.get(record.seed, True) and record.success
    return list(seeds.values())


def _format_share(successes: Sequence[bool]) -> str:
    return f"{sum(successes)}/{len(successes)} ({100 * sum(successes) / len(successes):.0f} %)" if successes else "–"


def _failure_lines(records: Sequence[Record]) -> list[str]:
    failed = sorted((r for r in records if not r.success), key=lambda record: (record.task, record.robot, record.seed))
    if not failed:
        return ["Nothing failed."]
    return [
        "| task | robot | seed | failure | detail |",
        "|---|---|---|---|---|",
        *(f"| `{r.task}` | `{r.robot}` | {r.seed} | {r.failure} | {r.failure_detail} |" for r in failed),
    ]


def describe_task(task: Task) -> dict[str, str]:
    """The paragraphs of a task's module docstring by how they begin: what to do, what varies, when it is done."""
    module = importlib.import_module(task.sample.__module__)
    found: dict[str, str] = {}
    for line in inspect.cleandoc(module.__doc__ or "").replace("Randomisation:", "Randomization:").splitlines():
        begun = next((part for part in PARAGRAPHS if line.startswith((part + ":", part + " "))), None)
        if begun:
            found[begun] = line.removeprefix(begun + ":").strip()
        elif line.strip() and found:
            last = list(found)[-1]
            found[last] += " " + line.strip()
    return found


def task_section(task: Task) -> str:
    """A task as a section of the page."""
    parts = describe_task(task)
    rows = {"Instruction": task.instruction} | {part: text for part, text in parts.items() if part != "After"}
    rows |= {"Source": parts["After"]} if "After" in parts else {}
    lines = [f"| {name} | {text.replace('|', chr(92) + '|')} |" for name, text in rows.items()]
    return "\n".join([f"### `{task.name}`", "", lines[0], "|---|---|", *lines[1:]])


def page(records: Sequence[Record], args: Args) -> str:
    """The text of docs/reference/tasks.md."""
    tasks = "\n\n".join(task_section(get_task(name)) for name in sorted(args.tasks))
    seeds = f"{args.seeds} seeds from {args.first_seed}"
    first = f" --first-seed {args.first_seed}" if args.first_seed else ""
    first += f" --motion {args.motion}" if args.motion != SHARED_MOTION else ""
    device = next(record.device for record in records)
    return f"""# Reference: tasks

This page is written by `{COMMAND} --seeds {args.seeds}{first} --page docs/reference/tasks.md`;
the descriptions are the docstrings of `xew/sim_warp/tasks/`. Lengths are in meters,
x to the right, y away from the robot, the origin under the table's center; the table's top is at z = 0.74.
Words in braces stand for the scene's objects, their kinds and their colors.

{tasks}

{YIELDS}
{seeds} of each task, in physics, on {device}:

{markdown(records)}

A seed belongs to the data set only when all robots succeed on it.
"""


@user_errors
def main() -> None:
    quiet_warp()
    args = tyro.cli(Args, description=__doc__)
    with hold_lock(args.page) if args.page else contextlib.nullcontext():
        try_and_print(args)


def try_and_print(args: Args) -> None:
    """Try all seeds, print the table, and write the page if there is to be one."""
    records: list[Record] = []
    with tqdm(total=args.seeds * len(set(args.tasks)), desc="trying seeds", unit="seed") as bar:
        for seed in attempt_seeds(args):
            records += seed
            bar.update()
    print(markdown(records))
    if args.page:
        write_page(args.page, page(records, args) + find_kept(args.page))


def find_kept(path: Path) -> str:
    """The end of a page that this command does not write: from the first heading after YIELDS on; '' where there is none."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    start = text.find("\n## ", text.find(f"\n{YIELDS}\n") + 1)
    return text[start:] if YIELDS in text and start >= 0 else ""


def write_page(path: Path, text: str) -> None:
    try:
        write_text(path, text, within=path.parent)
    except OSError as error:
        raise EpisodeError(f"cannot write {path}: {error.strerror}. Choose another file with --page.") from error


if __name__ == "__main__":
    main()

"""What a batch costs, and how far physics repeats itself: worlds of all tasks and robots stepped together.

    python -m benchmarks.physics [--device cuda:0] [--batches 64 256 1024 4096] [--tasks lift_pot …] [--repeat 200]

The worlds are those of `generate`: the first seeds of every task on every robot, each along the commands of its expert,
from the first frame to the last of the longest, with contacts and states recorded at every stored frame. Building (the
Newton model, its conversion to MuJoCo Warp) is timed apart from stepping, which begins with the first forward pass and ends
with the motions on the host. Before a figure is printed, the work is checked: nothing overflowed, and as many worlds as
physics has in other batches, 90 % and more, end in success.

With --repeat that many worlds are stepped again: in the same batch, in one of another size, and by MuJoCo's C engine. Told are
the share of worlds whose states are the same to the bit, how far commanded joints and things are apart (at any frame, and
at the last), and in how many worlds both end alike in success or failure. Contacts make small differences large: a thing
that is let go a hair earlier rolls elsewhere.
"""

import gc
import itertools
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import tyro
import warp as wp

from benchmarks.common import format_versions
from xew.sim_warp.physics import simulate
from xew.sim_warp.physics.gpu import Batch
from xew.sim_warp.physics.worlds import STEPS_PER_FRAME, Motion, World
from xew.sim_warp.production.cells import Cell, Job, plan_cells, with_motion
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.tasks import TASKS, get_task

PACKAGES = ("newton", "mujoco-warp", "warp-lang", "numpy")
LEAST_SUCCESS = 0.9


@dataclass(frozen=True)
class Args:
    device: str | None = None
    """Name of the device in Warp."""
    batches: tuple[int, ...] = (64, 256, 1024, 4096)
    """Numbers of worlds."""
    frames: int | None = None
    """Number of stored frames that are stepped; by default all."""
    tasks: tuple[str, ...] = ()
    """Tasks that are stepped by themselves, as by `generate`, whose batches hold one to three tasks."""
    repeat: int = 0
    """Number of worlds that are stepped again and again."""


def cells_for(count: int, tasks: Sequence[str] = tuple(TASKS)) -> list[Cell]:
    """`count` cells that their robots can follow, of the tasks and all robots in turn, seed by seed."""
    cells: list[Cell] = []
    seeds = ((seed, task) for seed in itertools.count() for task in tasks)
    while len(cells) < count:
        jobs = [Job(task, seed, tuple(ROBOTS)) for seed, task in itertools.islice(seeds, -(-count // len(ROBOTS)))]
        cells += [cell for planned in plan_cells(jobs) for cell in planned if cell.commands.problem is None]
    return cells[:count]


def find_successes(cells: Sequence[Cell], motions: Sequence[Motion]) -> np.ndarray:
    """[n] bool, whether each cell with this motion ends in success."""
    return np.array([with_motion(cell, motion).failure is None for cell, motion in zip(cells, motions, strict=True)])


def check(cells: list[Cell], motions: list[Motion], whole: bool) -> float:
    """The share of worlds that end in success, if they were stepped to their end."""
    assert not any(motion.overflow for motion in motions), "a buffer overflowed: the worlds are not what they should be"
    assert all(np.isfinite(motion.joint_pos).all() for motion in motions)
    if not whole:
        return float("nan")
    share = float(find_successes(cells, motions).mean())
    assert share > LEAST_SUCCESS, f"only {share:.2f} of the worlds end in success"
    return share


def print_table(device: wp.Device, args: Args) -> None:
    """Print a row a number of worlds, and a row a task where tasks are named."""
    print("worlds  frames  build [s]  stepping [s]  world-steps/s  ms a step  with building  memory [GB]  success")
    begin = time.perf_counter()
    cells = cells_for(max(args.batches))
    planning = (time.perf_counter() - begin) / len(cells)
    for count in args.batches:
        print_batch(cells[:count], device, args.frames)
    for task in args.tasks:
        print(f"{task} alone:")
        print_batch(cells_for(args.batches[0], [get_task(task).name]), device, args.frames)
    print(f"planning and inverse kinematics: {1000 * planning:.1f} ms a world")


def print_batch(cells: list[Cell], device: wp.Device, frames: int | None) -> None:
    """Step one batch and print what it cost."""
    worlds = [World(cell.robot, cell.scene, cell.commands.action[:frames]) for cell in cells]
    Batch([World(w.robot, w.scene, w.action[:2]) for w in worlds], device).run()  # loads or compiles kernels
    gc.collect()  # the last batch and its graph
    before = used_memory(device)
    begin = time.perf_counter()
    batch = Batch(worlds, device)
    wp.synchronize_device(device)
    built = time.perf_counter()
    motions = batch.run()
    end = time.perf_counter()
    used = used_memory(device) - before
    success = check(cells, motions, frames is None)
    steps = STEPS_PER_FRAME * (batch.frame_count - 1)
    print(
        f"{len(cells):6d}  {batch.frame_count:6d}  {built - begin:9.1f}  {end - built:12.1f}  "
        f"{len(cells) * steps / (end - built):13,.0f}  {1000 * (end - built) / steps:9.2f}  "
        f"{len(cells) * steps / (end - begin):13,.0f}  {used:11.1f}  {success:7.1%}",
        flush=True,
    )


def used_memory(device: wp.Device) -> float:
    """Memory of the device that is in use [GB]."""
    return wp.get_mempool_used_mem_current(device) / 1e9 if device.is_cuda else float("nan")


def compare(label: str, cells: Sequence[Cell], ours: Sequence[Motion], others: Sequence[Motion]) -> None:
    """Print a row of the table."""
    pairs = list(zip(ours, others, strict=True))
    same = np.mean([(a.joint_pos == b.joint_pos).all() and (a.object_pose == b.object_pose).all() for a, b in pairs])
    joints = [1000 * np.abs(a.joint_pos - b.joint_pos)[:, [*range(7), *range(8, 15)]].max() for a, b in pairs]
    things = [1000 * np.linalg.norm(a.object_pose[..., :3] - b.object_pose[..., :3], axis=-1) for a, b in pairs]
    anywhere, at_last = [thing.max() for thing in things], [thing[-1].max() for thing in things]
    alike = int((find_successes(cells, ours) == find_successes(cells, others)).sum())
    print(
        f"{label:34s}  {same:6.1%}  {np.median(joints):7.3f} {np.max(joints):8.3f}  {np.median(anywhere):7.3f} "
        f"{np.max(anywhere):8.1f}  {np.median(at_last):7.3f} {np.max(at_last):8.1f}  {alike:4d} of {len(cells)}",
        flush=True,
    )


def print_repeatability(device: wp.Device, count: int, batch: int, other_batch: int) -> None:
    """Print a row a pair of runs."""
    cells = cells_for(count)
    worlds = [World(cell.robot, cell.scene, cell.commands.action) for cell in cells]
    first = simulate(worlds, device.alias, batch)
    print(f"\n{count} worlds of all tasks and robots in a batch of {batch}; median and largest over worlds")
    print(f"{'and':34s}  bitwise  joints [mrad]     things [mm]      at the end [mm]   both succeed or both fail")
    compare("the same batch again", cells, first, simulate(worlds, device.alias, batch))
    compare(f"a batch of {other_batch}", cells, first, simulate(worlds, device.alias, other_batch))
    compare("MuJoCo's C engine on the CPU", cells, first, simulate(worlds, "cpu"))


def main(args: Args) -> None:
    """Print both tables."""
    device = wp.get_device(args.device)
    print(f"{device.name} ({device.alias}), {os.cpu_count()} cores")
    print(format_versions(PACKAGES))
    if args.batches:
        print_table(device, args)
    if args.repeat:
        print_repeatability(device, args.repeat, 256, 1024)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

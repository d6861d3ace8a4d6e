"""Physics: commands to states, by MuJoCo Warp on a GPU and MuJoCo's C engine on a CPU, behind one function.

Reads  `World`s: robot, scene and commanded joints at every stored frame
Writes `Motion`s: what the joints, objects and contacts did

Both engines step the model that Newton compiles from the common template (template.py, worlds.py). `cpu` steps one world
after another and repeats bit for bit; `gpu` steps all worlds of a batch together and does not, for the order in which a
GPU adds up contacts is free. `plausibility` refuses motions that could not have happened.
"""

from collections.abc import Sequence

import warp as wp

from xew.sim_warp.physics.cpu import simulate_one
from xew.sim_warp.physics.worlds import Motion, World

__all__ = ["Motion", "World", "simulate"]


def simulate(worlds: Sequence[World], device: str | None = None, batch: int | None = None) -> list[Motion]:
    """Step every world through its commands.

    Args:
        worlds: of any robots, tasks and lengths.
        device: "cpu" for MuJoCo's C engine, "cuda:0" for MuJoCo Warp; by default what Warp prefers.
        batch: worlds that a GPU steps together, None for all.
    """
    if wp.get_device(device).is_cuda:
        from xew.sim_warp.physics.gpu import simulate_batch  # MuJoCo Warp is heavy, and of no use without a GPU

        return simulate_batch(worlds, device, batch)
    return [simulate_one(world) for world in worlds]

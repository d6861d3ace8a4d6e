"""Physics: commands to states, by MuJoCo Warp on a GPU and MuJoCo's C engine on a CPU.

Both engines step the model that Newton compiles from the common template (template.py, worlds.py). `cpu` steps one world after
another and is bit-repeatable; `compiled` makes its worlds. `gpu` steps all worlds of a batch together and is not, because a GPU
adds contacts in any order. `plausibility` rejects implausible motions.
"""

from collections.abc import Sequence

import warp as wp

from xew.sim_warp.physics.cpu import simulate_one
from xew.sim_warp.physics.worlds import Motion, World

__all__ = ["Motion", "World", "simulate"]


def simulate(worlds: Sequence[World], device: str | None = None, batch: int | None = None) -> list[Motion]:
    """Step every world through its commands on a device, or Warp's default one; on a GPU `batch` at a time (None: all)."""
    if wp.get_device(device).is_cuda:
        from xew.sim_warp.physics.gpu import simulate_batch  # slow to import, needed on a GPU only

        return simulate_batch(worlds, device, batch)
    return [simulate_one(world) for world in worlds]

"""Compile Warp's kernels for a GPU that need not be in this machine, into Warp's kernel cache.

    python -m lab.compile_kernels --arch 90

Set WARP_CACHE_PATH to choose the folder, and copy what is in it to the other machine's.
"""

from dataclasses import dataclass
from functools import partial

import tyro
import warp as wp
from tqdm import tqdm

from xew.config import ConfigError, user_errors
from xew.sim_warp.devices.kernels import Variant, compile_for, watched_launches
from xew.sim_warp.devices.workers import Workers, quiet_warp
from xew.sim_warp.production.warm_up import PARTS, ROBOT, do_smallest_piece, standing_world
from xew.sim_warp.robots import ROBOTS


@dataclass(frozen=True)
class Args:
    """Compile Warp's kernels for a GPU that need not be in this machine, into Warp's kernel cache."""

    arch: int
    """Compute capability of the GPU: 90 for an H100 or H200, 80 for an A100, 89 for an L40S or an RTX 4090."""
    batch: int = 256
    """Number of worlds that it will step together, as of generate."""
    workers: int = len(PARTS)
    """Number of processes; each part of the work is compiled by one of them, in as many threads as there are cores."""


@user_errors
def main(args: Args) -> None:
    """Compile for another machine's GPU. Raises ConfigError for an architecture that Warp's compiler does not know."""
    quiet_warp()
    wp.init()
    known = wp.get_cuda_supported_archs()
    if args.arch not in known:
        raise ConfigError(f"--arch is {args.arch}; Warp's compiler knows {', '.join(map(str, known)) or 'none here'}.")
    with Workers(args.workers) as workers:
        compiled = workers.run(partial(compile_piece, arch=args.arch, batch=args.batch), PARTS)
        modules = sum(tqdm(compiled, desc="compiling kernels", unit="part", total=len(PARTS)))
    print(f"{wp.config.kernel_cache_dir}: {modules} modules for sm_{args.arch}; copy the folder to the GPU's machine")


def compile_piece(part: str, arch: int, batch: int) -> int:
    """Compile what a part of the work, one of PARTS, launches, for GPUs of an architecture; returns the number of modules.

    The smallest piece of the work is done on the CPU, to see what it launches.
    """
    kernels: list[Variant] = []
    with watched_launches() as found:
        if part == "physics":
            kernels = _batch_kernels(batch)
        else:
            do_smallest_piece(part, "cpu", batch)
    return compile_for([*found, *kernels], arch)


def _batch_kernels(batch: int) -> list[Variant]:
    """What a GPU launches to step a batch of worlds."""
    from xew.sim_warp.physics.gpu import Batch  # MuJoCo Warp is heavy

    return Batch([standing_world(ROBOTS[ROBOT])] * batch, wp.get_device("cpu")).list_kernels()


if __name__ == "__main__":
    main(tyro.cli(Args))

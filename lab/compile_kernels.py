"""Compile Warp's kernels for a GPU that need not be in this machine, into Warp's kernel cache.

    python -m lab.compile_kernels --arch 90

Set WARP_CACHE_PATH to choose the folder, and copy what is in it to the other machine's.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest import mock

import tyro
import warp as wp
from tqdm import tqdm

from xew.config import ConfigError, user_errors
from xew.sim_warp.devices.kernels import DEFAULT_BLOCK, Variant, run_in_threads
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
        compiled = workers.run(partial(compile_piece, arch=args.arch, batch=args.batch), list(PARTS))
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


@contextmanager
def watched_launches() -> Iterator[dict[Variant, None]]:
    """Note what a block launches by `wp.launch` and `wp.launch_tiled`, in its order, and launch it."""
    found: dict[Variant, None] = {}

    def watch(launch: Callable[..., Any]) -> Callable[..., Any]:
        def note(kernel: wp.Kernel, *arguments: Any, block_dim: int = DEFAULT_BLOCK, **named: Any) -> Any:
            found[kernel.module, block_dim] = None
            return launch(kernel, *arguments, block_dim=block_dim, **named)

        return note

    with mock.patch.multiple(wp, launch=watch(wp.launch), launch_tiled=watch(wp.launch_tiled)):
        yield found


def compile_for(variants: Iterable[Variant], arch: int) -> int:
    """Compile modules into Warp's cache for GPUs of an architecture, on as many threads as there are cores.

    No such GPU needs to be here: the compiler comes with Warp. A module's file is found there by its name, which says what is
    in it. Copy the cache to the machine with the GPU.

    Args:
        variants: what to compile.
        arch: compute capability, such as 90; one of `wp.get_cuda_supported_archs()`.

    Returns:
        Number of modules.
    """
    blocks: dict[wp.Module, list[int]] = defaultdict(list)
    for module, block_dim in dict.fromkeys(variants):
        blocks[module].append(block_dim)
    run_in_threads(lambda item: _compile_module(item[0], item[1], arch), blocks.items())
    return sum(map(len, blocks.values()))


def _compile_module(module: wp.Module, blocks: Sequence[int], arch: int) -> None:
    """Compile a module for each number of threads in a block, which Warp takes from the module's options."""
    before = module.options["block_dim"]
    try:
        for block_dim in blocks:
            module.options["block_dim"] = block_dim
            wp.compile_aot_module(module, arch=arch)
    finally:
        module.options["block_dim"] = before


def _batch_kernels(batch: int) -> list[Variant]:
    """What a GPU launches to step a batch of worlds."""
    from xew.sim_warp.physics.gpu import Batch  # MuJoCo Warp is heavy

    return Batch([standing_world(ROBOTS[ROBOT])] * batch, wp.get_device("cpu")).list_kernels()


if __name__ == "__main__":
    main(tyro.cli(Args))

"""Warp's kernels: whether a device has compiled ones, and parallel compilation.

Warp compiles a module of kernels at its first launch, one after another. `noted_launches` lists the modules that a block would
launch, and `compile_together` compiles them on all cores.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import warp as wp

from xew.concurrency import usable_cores

Variant = tuple[wp.Module, int]
"""A module and the number of threads per block for which it is compiled."""
DEFAULT_BLOCK = 256
"""Default number of threads per block of a launch."""


def has_kernels(device: wp.Device, module: str = "") -> bool:
    """Whether Warp has compiled a module, named by its beginning, or any for this kind of device on this machine."""
    ending = "cubin" if device.is_cuda else "o"
    return any(Path(wp.config.kernel_cache_dir).glob(f"wp_{module}*/*.{ending}"))


@contextmanager
def noted_launches() -> Iterator[dict[Variant, None]]:
    """Collect the modules that the block would launch by `wp.launch` and `wp.launch_tiled`, in order, without launching them.

    Bodies of captured loops and branches are entered once.
    """
    variants: dict[Variant, None] = {}

    def note(kernel: wp.Kernel, *_: Any, block_dim: int = DEFAULT_BLOCK, **__: Any) -> None:
        if not kernel.is_generic:  # a generic kernel has a module per type of array, known only at launch
            variants[kernel.module, block_dim] = None

    def enter(_: wp.array, *bodies: Any, stream: Any = None, **named: Any) -> None:
        named_bodies = [named.pop(name, None) for name in ("while_body", "on_true", "on_false")]
        for body in (*bodies, *named_bodies):
            if callable(body):
                body(**named)

    with mock.patch.multiple(wp, launch=note, launch_tiled=note, capture_while=enter, capture_if=enter):
        yield variants


def compile_together(variants: Iterable[Variant], device: wp.Device) -> None:
    """Compile and load modules on all cores; modules that are not listed are compiled at launch.

    Args:
        variants: modules, as `noted_launches` gives them.
        device: device of the launches.
    """
    run_in_threads(lambda variant: wp.force_load(device, [variant[0]], variant[1], 0), variants)


def run_in_threads(function: Callable[[Any], object], items: Iterable[Any]) -> None:
    """Call a function with each item on one thread per core, and raise the first error."""
    with ThreadPoolExecutor(usable_cores()) as pool:
        for _ in pool.map(function, items):
            pass

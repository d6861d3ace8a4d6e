"""Kernels of Warp: whether a device has any compiled yet, and compiling many at once.

Warp compiles a module of kernels when one of them is first launched, one module after another. What many launches need can be
known before: `noted_launches` lets them pass by without launching anything, and `compile_together` compiles on all cores.
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
"""A module, and the number of threads in a block that it is compiled for."""
DEFAULT_BLOCK = 256
"""Number of threads in a block where a launch names none."""


def has_kernels(device: wp.Device) -> bool:
    """Has Warp compiled any kernel for this kind of device on this machine?"""
    ending = "cubin" if device.is_cuda else "o"
    return any(Path(wp.config.kernel_cache_dir).glob(f"wp_*/*.{ending}"))


@contextmanager
def noted_launches() -> Iterator[dict[Variant, None]]:
    """Note what a block would launch, in its order, and launch nothing. Bodies of loops and branches are entered once.

    It holds for code that launches by `wp.launch` and `wp.launch_tiled`, as Newton and MuJoCo Warp do.
    """
    found: dict[Variant, None] = {}

    def note(kernel: wp.Kernel, *_: Any, block_dim: int = DEFAULT_BLOCK, **__: Any) -> None:
        if not kernel.is_generic:  # of which there is one for each type of array, which only a launch finds out
            found[kernel.module, block_dim] = None

    def enter(_: wp.array, *bodies: Any, stream: Any = None, **named: Any) -> None:
        named_bodies = [named.pop(name, None) for name in ("while_body", "on_true", "on_false")]
        for body in (*bodies, *named_bodies):
            if callable(body):
                body(**named)

    with mock.patch.multiple(wp, launch=note, launch_tiled=note, capture_while=enter, capture_if=enter):
        yield found


def compile_together(variants: Iterable[Variant], device: wp.Device) -> None:
    """Compile and load kernels, on as many threads as there are cores.

    Nothing depends on it: what is not among them is compiled when it is launched.

    Args:
        variants: what to compile, as `noted_launches` gives it.
        device: that they will be launched on.
    """
    run_in_threads(lambda variant: wp.force_load(device, [variant[0]], variant[1], 0), variants)


def run_in_threads(function: Callable[[Any], object], items: Iterable[Any]) -> None:
    """Call a function with each item, on as many threads as there are cores, and raise what one of the calls raises."""
    with ThreadPoolExecutor(usable_cores()) as pool:
        for _ in pool.map(function, items):
            pass

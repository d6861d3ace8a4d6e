"""Newton, imported at first use, with kernels compiled without adjoints.

Import Newton from here: it takes seconds, which commands that only distribute work avoid. xew needs no gradients of physics. A
Warp module reads that option when it is created, at Newton's import; custom kernels of users keep their gradients.
"""

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, Any

import warp

__all__ = ["convert_quickly", "load_newton", "newton", "without_adjoints"]

HULLS = 4096
"""Number of convex hulls whose edges are cached."""


@contextmanager
def without_adjoints() -> Iterator[None]:
    """Create Warp's modules in the block without adjoint kernels, which takes half the time to compile."""
    before = warp.config.enable_backward
    warp.config.enable_backward = False
    try:
        yield
    finally:
        warp.config.enable_backward = before


@functools.cache
def load_newton() -> ModuleType:
    """Import Newton and return the module."""
    with without_adjoints():
        import newton
        import newton.ik
        from newton.solvers import SolverFeatherstone, SolverMuJoCo  # noqa: F401  Newton imports them at first use
    return newton


class _Newton:
    """Stand-in for the module that imports it at the first attribute access."""

    def __getattr__(self, name: str) -> Any:
        return getattr(load_newton(), name)


if TYPE_CHECKING:
    import newton
else:
    newton = _Newton()


@functools.cache
def convert_quickly() -> None:
    """Convert models for MuJoCo's C engine faster in this process.

    The kernels of the conversion are compiled without optimization, in 6 s instead of 20 s: each runs once per world on a few
    hundred numbers. Edges of convex hulls are cached: links of robots return in every world.
    """
    load_newton()
    from newton._src.sim import builder

    warp.set_module_options({"optimization_level": 0}, "newton._src.solvers.mujoco.kernels")
    builder._convex_hull_adjacency = functools.lru_cache(HULLS)(builder._convex_hull_adjacency)

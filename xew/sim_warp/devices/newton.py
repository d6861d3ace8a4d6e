"""Newton, imported at first use, with kernels compiled without adjoints.

Import Newton from here: it takes seconds, which commands that only distribute work avoid. xew needs no gradients of physics. A
Warp module reads that option when it is created, at Newton's import; custom kernels of users keep their gradients.
"""

import functools
from types import ModuleType
from typing import TYPE_CHECKING, Any

import warp

__all__ = ["compile_conversion_quickly", "load_newton", "newton"]


@functools.cache
def load_newton() -> ModuleType:
    """Import Newton and return the module."""
    before = warp.config.enable_backward
    warp.config.enable_backward = False
    try:
        import newton
        import newton.ik
        import newton.solvers
    finally:
        warp.config.enable_backward = before
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
def compile_conversion_quickly() -> None:
    """Compile the kernels that convert a model for MuJoCo without optimization, in this process.

    With MuJoCo's C engine each of them runs once per world on a few hundred numbers. Compilation takes 6 s instead of 20 s.
    """
    load_newton()
    warp.set_module_options({"optimization_level": 0}, "newton._src.solvers.mujoco.kernels")

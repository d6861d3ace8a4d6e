"""Newton, imported when it is first used, and with kernels that are compiled without their adjoints.

Import it from here. It takes seconds, which commands that hand out work to others need not wait for. Nothing here asks for
gradients of physics: a module of Warp's takes that option over when it is made, that is, when Newton is imported; the option
itself is then as it was, so that kernels of a user's own keep their gradients.
"""

import functools
from types import ModuleType
from typing import TYPE_CHECKING, Any

import warp

__all__ = ["compile_conversion_quickly", "load_newton", "newton"]


@functools.cache
def load_newton() -> ModuleType:
    """Import Newton now, such as in a process that others are forked from; gives the module."""
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
    """Stands for the module, which is imported when something of it is asked for."""

    def __getattr__(self, name: str) -> Any:
        return getattr(load_newton(), name)


if TYPE_CHECKING:
    import newton
else:
    newton = _Newton()


@functools.cache
def compile_conversion_quickly() -> None:
    """Have the kernels that hand a model to MuJoCo compiled without optimizing them, for this process.

    For MuJoCo's C engine, where each of them runs once a world, on a few hundred numbers, and nothing else of theirs runs:
    compiling all of Newton's module takes 6 s instead of 20.
    """
    load_newton()
    warp.set_module_options({"optimization_level": 0}, "newton._src.solvers.mujoco.kernels")

"""Newton, whose kernels are compiled without their adjoints: nothing here asks for gradients of physics.

Import it from here. A module of Warp's takes this option over when it is made, that is, when Newton is first imported; the
option itself is then as it was, so that kernels of a user's own keep their gradients.
"""

import functools

import warp

_before = warp.config.enable_backward
warp.config.enable_backward = False
try:
    import newton
    import newton.ik
    import newton.solvers
finally:
    warp.config.enable_backward = _before

__all__ = ["compile_conversion_quickly", "newton"]


@functools.cache
def compile_conversion_quickly() -> None:
    """Have the kernels that hand a model to MuJoCo compiled without optimizing them, for this process.

    For MuJoCo's C engine, where each of them runs once a world, on a few hundred numbers, and nothing else of theirs runs:
    compiling all of Newton's module takes 6 s instead of 20.
    """
    warp.set_module_options({"optimization_level": 0}, "newton._src.solvers.mujoco.kernels")

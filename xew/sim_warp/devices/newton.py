"""Newton, whose kernels are compiled without their adjoints: nothing here asks for gradients of physics.

Import it from here. A module of Warp's takes this option over when it is made, that is, when Newton is first imported; the
option itself is then as it was, so that kernels of a user's own keep their gradients.
"""

import warp

_before = warp.config.enable_backward
warp.config.enable_backward = False
try:
    import newton
    import newton.ik
    import newton.solvers
finally:
    warp.config.enable_backward = _before

__all__ = ["newton"]

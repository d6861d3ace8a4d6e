"""What worker processes are forked with, so that none of them imports for seconds: physics, the renderer, and Newton itself.

Reads  nothing
Writes nothing; importing it is all
"""

from xew.sim_warp.devices.newton import load_newton
from xew.sim_warp.production import produce

__all__ = ["produce"]

load_newton()

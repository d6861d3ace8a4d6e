"""Slow imports that worker processes are forked with: physics, the renderer and Newton."""

from xew.sim_warp.devices.newton import load_newton
from xew.sim_warp.production import produce

__all__ = ["produce"]

load_newton()

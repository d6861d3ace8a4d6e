"""Slow imports that worker processes are forked with: physics, the renderer, Newton, MuJoCo Warp and the robots."""

from xew.sim_warp.devices.newton import load_newton
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.production import produce
from xew.sim_warp.robots import ROBOTS

__all__ = ["produce"]

load_newton().solvers.SolverMuJoCo.import_mujoco()  # Newton imports MuJoCo Warp at first use
for robot in ROBOTS.values():
    load_urdf(robot.urdf)

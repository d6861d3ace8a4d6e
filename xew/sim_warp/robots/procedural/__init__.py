"""Procedural bimanual robots: a body is a function of its number, the same bytes on every machine.

`design_body` draws a candidate, `body_files` makes its URDF and meshes, both without a place. `load_body` gives the robot
`body:17`: the candidate of the catalog's entry, with its base poses and homes.
"""

from xew.sim_warp.robots.procedural.bodies import load_body
from xew.sim_warp.robots.procedural.design import BodyDesign, design_body
from xew.sim_warp.robots.procedural.urdf_files import body_files

__all__ = ["BodyDesign", "body_files", "design_body", "load_body"]

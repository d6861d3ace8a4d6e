"""Procedural bimanual robots: a body is a function of its number, the same bytes on every machine.

`design_body` draws what a body is, `body_files` makes its URDF and meshes. Neither knows where it stands: that is found like
the place of any user's robot.
"""

from xew.sim_warp.robots.procedural.design import BodyDesign, design_body
from xew.sim_warp.robots.procedural.urdf_files import body_files

__all__ = ["BodyDesign", "body_files", "design_body"]

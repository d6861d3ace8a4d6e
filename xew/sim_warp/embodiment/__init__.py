"""Descriptions of robots: URDFs with links, joints and colored meshes, and `RobotSpec`.

They are read once, checked, and never changed. `xew.sim_warp.robots` lists the robots.
"""

__all__ = ["mesh_claims", "mesh_files", "named_files", "prepared", "spec", "urdf", "xml_files"]

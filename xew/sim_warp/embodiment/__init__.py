"""What a robot is: its URDF with links, joints and colored meshes, and the `RobotSpec` beside it.

Read from files once, checked, and never changed; which robots exist is the business of `xew.sim_warp.robots`.
"""

__all__ = ["mesh_files", "prepared", "spec", "urdf"]

"""What the five robots look like and collide with: one file a robot, written into its URDF by `author`.

`solids` has the pieces that they are built of.
"""

__all__ = ["aloha_agilex", "arx_x5", "franka_panda", "piper", "solids", "ur5_wsg"]

"""Forward kinematics on the host and on a device, inverse kinematics in batches, and the experts' joint commands.

Functions of joint positions are pure; poses are in the world unless a docstring says otherwise.
"""

from xew.sim_warp.kinematics.forward import forward_kinematics

__all__ = ["forward_kinematics"]

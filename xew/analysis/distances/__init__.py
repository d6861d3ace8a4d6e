"""Distances between robots, by reach and by appearance. Kinematic and appearance distance are the paper's; spreads,
workspaces in the frame of the arm's base and perceptual distance are ours.
"""

__all__ = ["appearance", "frames", "matrices", "workspaces"]

"""Distances between robots, by what they can reach and by what they look like.

Kinematic distance and appearance distance are the paper's (its appendix on embodiment distances). The spread over sampling
seeds, the workspaces in the frame of the arm's base and the perceptual distance of the reference renders are ours.
"""

__all__ = ["appearance", "frames", "matrices", "workspaces"]

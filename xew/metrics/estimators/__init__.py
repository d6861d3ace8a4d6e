"""Who finds the robot, its points and its motion in a video that has no ground truth.

Two estimators need no weights, and `presence` confirms what any of them found; the others open local checkpoints of other
projects.
"""

__all__ = ["adapters", "cotracker", "flow", "images", "masks", "presence", "sam2", "similarity", "tapir", "tracks"]

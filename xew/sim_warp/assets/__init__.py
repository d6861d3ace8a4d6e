"""Models of everyday objects that several tasks share: appearance, collision shapes and grasps.

Each is drawn from a random stream and returned as plain geometry; scenes place them.
"""

__all__ = ["containers", "household"]

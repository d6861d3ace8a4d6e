"""Models of everyday things that several tasks share: looks, collision shapes, and how a hand takes them.

Each is drawn from a random stream and returned as plain geometry; scenes place them.
"""

__all__ = ["containers", "household"]

"""Models of everyday things that several tasks share: what they look like, what they collide with, how a hand takes them.

Each is drawn from a random stream and returned as plain geometry; scenes place them.
"""

__all__ = ["containers", "household"]

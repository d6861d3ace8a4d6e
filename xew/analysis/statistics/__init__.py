"""Means, intervals and verdicts of score tables."""

__all__ = ["grades", "summary"]

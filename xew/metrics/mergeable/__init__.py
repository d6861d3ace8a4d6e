"""What the mergeable states of metrics are made of: sums of floats that are exact in any order."""

__all__ = ["sums"]

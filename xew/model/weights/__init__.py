"""Reading and writing checkpoints in the formats of other projects.

A module's `Layout` gives for each of its leaves the names of its tensors and the order of their axes.
"""

__all__ = ["filling", "layout", "reading", "writing"]

"""Checkpoints of other projects: their tensors into our modules, and our modules out under their names.

A module's `Layout` says for each of its leaves which tensors it comes from and how their axes are ordered.
"""

__all__ = ["filling", "layout", "reading", "writing"]

"""Tensors of other projects' checkpoints into our modules, and back out under their names.

A tensor that is missing, left over or of another shape is an error that names it.
"""

__all__ = ["tensors"]

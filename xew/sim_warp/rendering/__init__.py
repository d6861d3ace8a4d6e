"""Posed bodies to images: what the head camera sees of recorded states, and what follows from commands alone.

Every image is a pure, bit-repeatable function of its inputs; `observe` and `streams` are the doors, the rest draws.
"""

__all__ = ["bodies", "observe", "packing", "raster_kernels", "render", "shading_kernels", "streams"]

"""Rendering of recorded states and of commands: pure, bit-repeatable functions of their inputs.

Call `observe` and `surfaces` for recorded states and `streams` for commands. `render` draws posed bodies for all three, with
the kernels that `passes` launches on the data of `bodies`, `packing` and `lighting`.
"""

__all__ = [
    "bodies",
    "lighting",
    "observe",
    "packing",
    "passes",
    "raster_kernels",
    "render",
    "shading_kernels",
    "streams",
    "surfaces",
]

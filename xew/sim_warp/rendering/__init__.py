"""Posed bodies to images: what the head camera sees of recorded states, and what follows from commands alone.

Every image is a pure, bit-repeatable function of its inputs. Call `observe` and `surfaces` for recorded states and `streams`
for commands; `render` draws any posed bodies for all three, by the kernels that `passes` launches, of what `bodies`, `packing`
and `lighting` give it.
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

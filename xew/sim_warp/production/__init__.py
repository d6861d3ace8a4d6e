"""Seeds to episodes.

`seeds` schedules seeds. `produce` makes scenes in workers: `cells` plans and simulates, `outcome` finds failures, `episodes`
renders and writes. For episodes on disk, `rerender` renders them again, `surfaces` tracks surface points, which `kept_tracks`
stores, and `summary` makes a table. `warm_up` compiles kernels. Workers are forked with the imports of `preloaded`.
"""

__all__ = [
    "cells",
    "episodes",
    "kept_tracks",
    "outcome",
    "preloaded",
    "produce",
    "rerender",
    "seeds",
    "summary",
    "surfaces",
    "warm_up",
]

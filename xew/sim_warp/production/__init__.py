"""Seeds to episodes in batches, in the order in which a seed goes through the files.

`produce` takes jobs; `cells` plans (by `kinematics.expert`) and simulates them, `outcome` says why one does not count,
`episodes` renders and writes them. With physics on a CPU `by_robot` has each robot of a scene made by whichever worker is free.
`rerender` makes what is on disk again, and `surfaces` follows points on it, which `kept_tracks` keeps; `warm_up` compiles the
kernels of all that where there are none. Workers are forked with what `preloaded` imports. What is written is complete or
absent.
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

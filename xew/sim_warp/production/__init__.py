"""Seeds to episodes, in the order in which a seed goes through the files.

`seeds` says which are tried. `produce` makes scenes in workers: `cells` plans (by `kinematics.expert`) and simulates them,
`outcome` says why one does not count, `episodes` renders and writes them. `rerender` makes what is on disk again, `surfaces`
follows points on it, which `kept_tracks` keeps, and `summary` lists it. `warm_up` compiles the kernels of all that where there
are none. Workers are forked with what `preloaded` imports. What is written is complete or absent.
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

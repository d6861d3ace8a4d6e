"""Seeds to episodes in batches, in the order in which a seed goes through the files.

`produce` takes jobs; `cells` plans (by `kinematics.expert`) and simulates them, `outcome` says why one does not count,
`episodes` renders and writes them, and `rerender` makes what is on disk again. What is written is complete or absent.
"""

__all__ = ["cells", "episodes", "outcome", "produce", "rerender"]

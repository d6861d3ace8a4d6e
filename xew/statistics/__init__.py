"""The statistics of scores: bootstrap draws, intervals, noise floors and verdicts.

`evaluate`, `report`, `study` and `distance` all ask here, so that the same scores have the same intervals and verdicts in each.
The package stands on the ground: it imports NumPy, SciPy and pandas, and nothing of ours but `xew.protocol`.

    bootstrap.py   what is drawn, how often, and the mean in every draw
    verdicts.py    noise floors, and better, worse or unresolved
"""

from xew.statistics.bootstrap import (
    DRAWS,
    LEVEL,
    MIN_SCENES,
    UNITS,
    Mean,
    Units,
    bootstrap_means,
    draw_units,
    every_draw,
    interval,
)
from xew.statistics.verdicts import BETTER, UNRESOLVED, WORSE, noise_floor, verdict

__all__ = [
    "BETTER",
    "DRAWS",
    "LEVEL",
    "MIN_SCENES",
    "UNITS",
    "UNRESOLVED",
    "WORSE",
    "Mean",
    "Units",
    "bootstrap_means",
    "draw_units",
    "every_draw",
    "interval",
    "noise_floor",
    "verdict",
]

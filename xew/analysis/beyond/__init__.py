"""Tables beyond the paper, on questions that five robots in one motion cannot answer.

`scaling.py`: scores by the number of bodies in training. `difficulty.py`: error of one model on many bodies against their
distance. `halves.py`: scores and gap of models that saw a body and that did not. `motion.py`: shared against own motion.
`shifts.py`: unseen robots against changed scenes.
"""

from xew.analysis.beyond.difficulty import OverBodies, body_errors, correlate_bodies, difficulty_table, find_difficulty
from xew.analysis.beyond.halves import body_gaps, errors_table, find_gaps, find_unseen_errors, gaps_table, halves_table
from xew.analysis.beyond.motion import Motions, motion_frame, motion_table
from xew.analysis.beyond.scaling import scaling_frame, scaling_table
from xew.analysis.beyond.shifts import Shifts, shifts_frame, shifts_table

__all__ = [
    "Motions",
    "OverBodies",
    "Shifts",
    "body_errors",
    "body_gaps",
    "correlate_bodies",
    "difficulty_table",
    "errors_table",
    "find_difficulty",
    "find_gaps",
    "find_unseen_errors",
    "gaps_table",
    "halves_table",
    "motion_frame",
    "motion_table",
    "scaling_frame",
    "scaling_table",
    "shifts_frame",
    "shifts_table",
]

"""What five robots in one motion cannot answer: tables beyond the paper.

`scaling.py` compares models by the number of bodies that they were trained on, `difficulty.py` correlates the error of one
model on many bodies with how far these are from the robots that it was trained on, `halves.py` does so with the gap of bodies
that one model trained on and another did not, and `motion.py` sets a study in shared motion beside the same study in motion of
each robot's own. `reports/study_beyond.py` draws them.
"""

from xew.analysis.beyond.difficulty import OverBodies, body_errors, correlate_bodies, difficulty_table, find_difficulty
from xew.analysis.beyond.halves import body_gaps, find_gaps, gaps_table
from xew.analysis.beyond.motion import Motions, motion_frame, motion_table
from xew.analysis.beyond.scaling import scaling_frame, scaling_table

__all__ = [
    "Motions",
    "OverBodies",
    "body_errors",
    "body_gaps",
    "correlate_bodies",
    "difficulty_table",
    "find_difficulty",
    "find_gaps",
    "gaps_table",
    "motion_frame",
    "motion_table",
    "scaling_frame",
    "scaling_table",
]

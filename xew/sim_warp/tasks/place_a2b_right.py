"""Task: put one everyday thing to the right of another.

Randomization: that of place_a2b_left, mirrored: B at x in [-.23, -.18] if A is on the left, else in [-.10, .10].
Success: A right of B, between .08 and .20 away, within 50 mm of it in y, both grippers open.
After RoboTwin 2.0's place_a2b_right, with the departures of place_a2b_left.
"""

from xew.sim_warp.tasks.place_a2b_left import RIGHT_OF, task_beside

TASK = task_beside("place_a2b_right", "place the {a} to the right of the {b}", RIGHT_OF)

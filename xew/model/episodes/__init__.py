"""Episodes of an experiment: for training, replay, failures, sample videos and rollouts, and their commands.

`choice.py` selects them from the index of a data set; other packages take the episodes themselves.
"""

__all__ = ["choice", "commands"]

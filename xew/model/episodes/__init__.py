"""Which episodes of a data set an experiment reads: to learn from, to replay, to draw samples of, to predict.

Each choice is made here once, from one index of the data set, and everything behind takes the episodes themselves.
"""

__all__ = ["choice", "commands"]

"""Autoregressive prediction: a trained network continues episodes from their first frame and their commands.

A rollout and the sample videos of a training run use the same predictor. `rolling.py` shares the episodes of a rollout among
processes, which read, predict and write side by side.
"""

__all__ = ["predict", "reading", "rolling", "writing"]

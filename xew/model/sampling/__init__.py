"""Autoregressive prediction: a trained network continues episodes from their first frame and their commands.

A rollout and the sample videos of a training run use the same predictor.
"""

__all__ = ["predict"]

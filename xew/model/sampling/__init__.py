"""Prediction: a trained network continues episodes from their first frame and their commands."""

__all__ = ["predict"]

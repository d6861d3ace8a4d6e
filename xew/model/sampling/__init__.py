"""Autoregressive prediction of episodes from their first frame and their commands."""

__all__ = ["predict"]

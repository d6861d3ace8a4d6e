"""Pixels of episodes: their sources, conversion between the camera's and the model's frames, and comparison of videos."""

__all__ = ["comparison", "frames", "pixels"]

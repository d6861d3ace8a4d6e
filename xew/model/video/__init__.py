"""Pixels of episodes: where they come from, how the camera's frames become the model's and back, and videos compared."""

__all__ = ["comparison", "frames", "pixels"]

"""Pixels of episodes: where they come from, and how the camera's frames become the model's and back."""

__all__ = ["frames", "pixels"]

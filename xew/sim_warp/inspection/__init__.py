"""The explorer: an offline page on which the robots' videos of a scene run side by side on one clock.

`explorer` chooses scenes and writes the page, `films` puts all videos of a scene into one file, and `overlays` brings masks,
keypoints, contacts and errors into the form in which the page draws them. Nothing that is written refers to a network.
"""

__all__ = ["explorer", "films", "overlays"]

"""What `inspect` shows of a data set beside its pictures: the explorer, and how much of everything the camera sees.

The explorer is an offline page on which the robots' videos of a scene run side by side on one clock: `explorer` chooses scenes
and writes it, `films` puts all videos of a scene into one file, and `overlays` brings masks, keypoints, contacts and errors
into the form in which the page draws them. Nothing that is written refers to a network. `visibility` counts visible points.
"""

__all__ = ["explorer", "films", "overlays", "visibility"]

"""Parts of `inspect`: checks, pictures, visibility, and the explorer.

The explorer is an offline page that plays the robots' videos of a scene side by side on one clock. `explorer` chooses scenes
and writes the page, `films` combines all videos of a scene in one file, and `overlays` makes the data of masks, keypoints,
contacts and errors.
"""

__all__ = ["explorer", "films", "overlays", "visibility"]

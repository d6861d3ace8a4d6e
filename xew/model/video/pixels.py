"""Where the pixels of episodes come from: their stored videos, or on one GPU straight from states through the renderer.

Reads  episodes
Writes {"rgb": …, "robot": …} uint8 [t 240 320 3], the head camera and the robot alone

Stored videos are lossless, so both ways give the same pixels; `rendered_pixels` holds each episode to its hashes.
"""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import numpy as np

from xew.episode import EpisodeError, Record, read_video

Pixels = Mapping[str, np.ndarray]
PixelSource = Callable[[Path, Record, Collection[str]], Pixels]
"""(folder, header, names among rgb and robot) -> the videos of these names, perhaps more."""


def stored_pixels(folder: Path, record: Record, names: Collection[str]) -> Pixels:
    """The stored videos of an episode. Raises EpisodeError if one is missing or not as long as its header says."""
    if names and not record.videos:
        raise EpisodeError(
            f"{folder} was made with --states-only and has no videos; encode it with `python -m xew.model.latents CONFIG "
            "--from-states`, or make its videos by `python -m xew.sim_warp.inspect DATA --render`."
        )
    videos = {name: read_video(folder / f"{name}.mkv") for name in names}
    for name, video in videos.items():
        if len(video) != record.frame_count:
            raise EpisodeError(
                f"{folder}/{name}.mkv has {len(video)} frames, episode.json says {record.frame_count}; delete the episode and "
                "run generate again."
            )
    return videos


def rendered_pixels() -> PixelSource:
    """A source that renders episodes from their recorded states; their videos need not be there (--states-only).

    It is for episodes that were made on this kind of device with these versions: what differs from the recorded hashes is
    an EpisodeError.
    """
    from xew.sim_warp.production.rerender import render_again
    from xew.sim_warp.rendering.streams import default_renderer

    def render(folder: Path, record: Record, names: Collection[str]) -> Pixels:
        return dict(zip(("rgb", "robot"), render_again(folder, default_renderer()), strict=True))

    return render

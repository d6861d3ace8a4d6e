"""Sources of episodes' pixels {"rgb": …, "robot": …} uint8 [t 240 320 3]: stored lossless videos, or the renderer."""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import numpy as np

from xew.episode import EpisodeError, Record, read_pixels

Pixels = Mapping[str, np.ndarray]
PixelSource = Callable[[Path, Record, Collection[str]], Pixels]
"""Function (folder, header, names among rgb and robot) -> the videos of these names, perhaps more."""


def stored_pixels(folder: Path, record: Record, names: Collection[str]) -> Pixels:
    """The stored videos of an episode. Raises EpisodeError as `read_pixels`."""
    if names and not record.videos:
        raise EpisodeError(
            f"{folder} was made with --states-only and has no videos; encode it with `python -m xew.model.latents CONFIG "
            "--from-states`, or make its videos by `python -m xew.sim_warp.inspect DATA --render`."
        )
    return {name: read_pixels(folder, name, record=record) for name in names}


def rendered_pixels() -> PixelSource:
    """A source that renders episodes from their recorded states, for episodes without videos (--states-only).

    It raises EpisodeError if the pixels differ from the recorded hashes, as on another kind of device or version.
    """
    from xew.sim_warp.production.rerender import render_again
    from xew.sim_warp.rendering.streams import default_renderer

    def render(folder: Path, record: Record, names: Collection[str]) -> Pixels:
        return dict(zip(("rgb", "robot"), render_again(folder, default_renderer()), strict=True))

    return render

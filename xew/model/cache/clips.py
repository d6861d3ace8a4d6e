"""Clips of episodes: where they start, which pixels they need, and what each stream of a clip is made from."""

import itertools
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from xew.episode import Record
from xew.model.conditions import Condition, clip_numbers, pasted_render, robot_render
from xew.model.episodes.commands import episode_command
from xew.model.settings.settings import Clip
from xew.model.video.frames import to_model_size
from xew.model.video.pixels import Pixels, stored_pixels


def sample_starts(frame_count: int, frames: int, chunks: int = 1) -> tuple[tuple[int, ...], ...]:
    """First frames of the chunks of every training sample of an episode.

    One chunk: the chunks of a rollout that fit, and the last clip that fits. Two: every chunk of a rollout with its
    successor, which shares one frame with it and may go past the episode's end; an episode of one chunk is one sample of it.
    """
    if chunks == 1:
        last = max(frame_count - frames, 0)
        return tuple((start,) for start in sorted({*range(0, last + 1, frames - 1), last}))
    starts = tuple(range(0, max(frame_count - 1, 1), frames - 1))
    return tuple(itertools.pairwise(starts)) or (starts,)


def clip_starts(frame_count: int, frames: int, chunks: int = 1) -> tuple[int, ...]:
    """First frames of all clips of an episode that any training sample has."""
    samples = sample_starts(frame_count, frames, chunks)
    return tuple(sorted({start for sample in samples for start in sample}))


def read_streams(
    conditions: Mapping[str, Condition],
    clip: Clip,
    folder: Path,
    record: Record,
    streams: Collection[str],
    pixels: Pixels | None = None,
) -> dict[str, np.ndarray]:
    """Read the named streams of a whole episode: [t h w 3] uint8 at the model's size, or [t n] float32.

    Streams are rgb and keys of `conditions`. Where the episode's pixels are not at hand (`needed_pixels`), its videos are read.
    """
    if pixels is None:
        pixels = stored_pixels(folder, record, needed_pixels(conditions, streams))
    wanted = {name: condition for name, condition in conditions.items() if name in streams}
    videos = {name: pixels["rgb"] for name in streams if name == "rgb" or wanted[name].make is None}
    if len(videos) < len(streams):
        command = episode_command(folder, record, pixels.get("robot"), pixels.get("rgb"))
        videos |= {name: condition.make(command) for name, condition in wanted.items() if condition.make is not None}
    return {name: to_model_size(v, clip.height, clip.width) if v.ndim == 4 else v for name, v in videos.items()}


def needed_pixels(conditions: Mapping[str, Condition], streams: Collection[str]) -> list[str]:
    """Names of the videos of an episode that the named streams are made from whole, among rgb and robot."""
    scene = any(name == "rgb" or conditions[name].make is None for name in streams)
    robot = any(name in conditions and conditions[name].make in (robot_render, pasted_render) for name in streams)
    return [name for name, needed in (("rgb", scene), ("robot", robot)) if needed]


def cut_clip(
    condition: Condition | None, video: np.ndarray, start: int, frames: int, history: Sequence[int] = ()
) -> list[np.ndarray]:
    """Cut what one clip of one stream is made from: clips [t h w 3] uint8 to be encoded and joined, or numbers [t' n] float32.

    Past the end the last frame is repeated. A condition that is not aligned is encoded whole. Earlier frames are encoded one
    by one (`history`, counted from the clip's first frame); before the start the first is repeated.

    Args:
        condition: None for rgb.
        video: of the whole episode, [t h w 3] uint8 or [t n] float32.
    """
    if condition is not None and condition.make is None:
        return [video[frame : frame + 1] for frame in np.maximum(start + np.asarray(history), 0)]
    if video.ndim == 2:
        assert condition is not None
        return [clip_numbers(condition, video, start, frames, history)]
    return [take_frames(video, start, frames)] if condition is None or condition.aligned else [video]


def take_frames(video: np.ndarray, start: int, frames: int) -> np.ndarray:
    """Some frames [t h w 3] of a video [t' h w 3] from `start` on; past its end the last frame is repeated."""
    return video[np.minimum(np.arange(start, start + frames), len(video) - 1)]

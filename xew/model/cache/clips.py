"""Clips of episodes: their first frames, the pixels that they need, and the input of each stream of a clip."""

import itertools
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from xew.episode import Record
from xew.model.codecs.contract import Codec
from xew.model.conditions import SHOW_RENDER, Command, Condition, clip_numbers, shows_carried
from xew.model.episodes.commands import episode_command
from xew.model.settings.settings import Clip
from xew.model.video.frames import to_model_size
from xew.model.video.pixels import Pixels, stored_pixels


def sample_starts(frame_count: int, frames: int, chunks: int = 1) -> tuple[tuple[int, ...], ...]:
    """First frames of the chunks of every training sample of an episode.

    With one chunk: the chunks of a rollout that fit, and the last clip that fits. With two: every chunk of a rollout and its
    successor, which share one frame; the successor may pass the episode's end. An episode of one chunk gives one sample.
    """
    if chunks == 1:
        last = max(frame_count - frames, 0)
        return tuple((start,) for start in sorted({*range(0, last + 1, frames - 1), last}))
    starts = tuple(range(0, max(frame_count - 1, 1), frames - 1))
    return tuple(itertools.pairwise(starts)) or (starts,)


def clip_starts(frame_count: int, frames: int, chunks: int = 1) -> tuple[int, ...]:
    """First frames of all clips in an episode's training samples."""
    samples = sample_starts(frame_count, frames, chunks)
    return tuple(sorted({start for sample in samples for start in sample}))


def read_streams(
    conditions: Mapping[str, Condition],
    clip: Clip,
    folder: Path,
    record: Record,
    streams: Collection[str],
    pixels: Pixels | None = None,
    command: Command | None = None,
) -> dict[str, np.ndarray]:
    """Read streams (rgb and keys of `conditions`) of an episode: [t h w 3] uint8 at the model's size or [t n] float32.

    Without `pixels` the episode's videos are read, without `command` its commands.
    """
    if pixels is None:
        pixels = stored_pixels(folder, record, needed_pixels(conditions, streams))
    wanted = {name: condition for name, condition in conditions.items() if name in streams}
    videos = {name: pixels["rgb"] for name in streams if name == "rgb" or wanted[name].make is None}
    if len(videos) < len(streams):
        command = command or episode_command(folder, record, pixels.get("robot"), pixels.get("rgb"))
        videos |= {name: condition.make(command) for name, condition in wanted.items() if condition.make is not None}
    return {name: to_model_size(v, clip.height, clip.width) if v.ndim == 4 else v for name, v in videos.items()}


def needed_pixels(conditions: Mapping[str, Condition], streams: Collection[str]) -> list[str]:
    """Names of the episode's videos, among rgb and robot, that the named streams need in full."""
    scene = any(name == "rgb" or conditions[name].make is None for name in streams)
    robot = any(name in conditions and conditions[name].make in SHOW_RENDER for name in streams)
    return [name for name, needed in (("rgb", scene), ("robot", robot)) if needed]


def gives_render(codec: Codec, conditions: Mapping[str, Condition]) -> bool:
    """Whether a model's decoder is given the commanded robot's render: it uses it, and a condition holds it."""
    return codec.sees_render and any(condition.make in SHOW_RENDER for condition in conditions.values())


def codec_digest(codec: Codec, clip: Clip, conditions: Mapping[str, Condition]) -> str:
    """Identifier of what the codec of a model with these clips and conditions leaves of a true video."""
    carried = " carried" if gives_render(codec, conditions) and shows_carried(conditions.values()) else ""
    return f"{codec.decoder_hash} {clip.height}x{clip.width}{carried}"


def cut_clip(
    condition: Condition | None, video: np.ndarray, start: int, frames: int, history: Sequence[int] = ()
) -> list[np.ndarray]:
    """Cut the input of one clip of one stream: clips [t h w 3] uint8 to encode and join, or numbers [t' n] float32.

    An unaligned condition is returned whole.

    Args:
        condition: None for rgb.
        video: of the whole episode, [t h w 3] uint8 or [t n] float32; its first and last frame are repeated beyond its ends.
        start: first frame of the clip.
        frames: number of frames.
        history: earlier frames, relative to `start`, each encoded alone.
    """
    if condition is not None and condition.make is None:
        return [video[frame : frame + 1] for frame in np.maximum(start + np.asarray(history), 0)]
    if video.ndim == 2:
        assert condition is not None
        return [clip_numbers(condition, video, start, frames, history)]
    return [take_frames(video, start, frames)] if condition is None or condition.aligned else [video]


def take_frames(video: np.ndarray, start: int, frames: int) -> np.ndarray:
    """Frames [t h w 3] of a video [t' h w 3] from `start` on; past its end the last frame is repeated."""
    return video[np.minimum(np.arange(start, start + frames), len(video) - 1)]

"""Training pictures of an autoencoder: clips of every stream, decoded or drawn once and held in memory.

Reads  episodes
Writes `Pictures`: uint8 [n t h w 3] of all clips, the robot's pixels in them, and their streams

Streams with a frame for each frame of an episode are cut into consecutive clips, of which every `every`-th is taken. Those that
describe a robot are drawn once for each robot and taken whole, in the codec's groups.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Integer, UInt8
from tqdm import tqdm

from xew.concurrency import map_in_order
from xew.config import ConfigError
from xew.dataset import Episode
from xew.episode import Record, read_pixels, read_states
from xew.model import conditions
from xew.model.cache.clips import take_frames
from xew.model.conditions import make_command
from xew.model.video.frames import TEMPORAL_FACTOR, to_model_size

STORED = {"rgb": "rgb", "robot_render": "robot"}
"""Streams that are videos of an episode, with their names there."""
DRAWN = {"optical_flow": conditions.optical_flow, "mask": conditions.robot_mask, "ray_map": conditions.ray_map}
"""Streams that are drawn from an episode's commands."""
ALIGNED = (*STORED, *DRAWN)
"""Streams with a frame for each frame of an episode."""
UNALIGNED = {
    "reference_image": conditions.reference_image,
    "nine_views": conditions.nine_views,
    "articulation_clip": conditions.articulation_clip,
}
"""Streams of 4 k + 1 pictures that describe a robot, the same in all of its episodes."""

Video = UInt8[np.ndarray, "t h w 3"]
Masks = Bool[np.ndarray, "t h w"]


@dataclass(frozen=True)
class Cut:
    """Cutting of videos into clips."""

    frames: int
    """Number of frames of a clip."""
    every: int
    height: int
    """Height of the resized frames."""
    width: int
    drawn_every: int = 1
    """Interval of the episodes whose DRAWN streams are taken."""

    def starts(self, record: Record) -> list[int]:
        """First frames of an episode's clips, with an offset that differs between episodes."""
        stride = self.every * self.frames
        phase = zlib.crc32(f"{record.task}/{record.seed}/{record.robot}".encode()) % stride
        last = record.frame_count - self.frames
        return list(range(phase, last + 1, stride)) or [max(last, 0)]

    @property
    def clip_bytes(self) -> int:
        """Number of bytes of a clip."""
        return self.frames * self.height * self.width * 3


@dataclass(frozen=True)
class Pictures:
    """All training clips."""

    clips: Any
    """[n t h w 3] uint8, in the host's memory or on a device."""
    regions: Any
    """Mask of the robot [n k h w] uint8, one bit per frame from the highest on, or None."""
    streams: dict[str, range]
    """Stream -> indices of its clips."""

    def describe(self) -> str:
        """Numbers of clips by stream, and their size."""
        counts = ", ".join(f"{len(numbers)} of {name}" for name, numbers in self.streams.items())
        return f"{len(self.clips)} clips ({counts}), {self.clips.nbytes / 1e9:.2f} GB"


def gather_pictures(
    episodes: Sequence[Episode], streams: Sequence[str], cut: Cut, host_gb: float, *, regions: bool = False
) -> Pictures:
    """Decode and draw the clips of some streams of some episodes, in threads.

    Args:
        episodes: training episodes.
        streams: names among ALIGNED and UNALIGNED.
        cut: cutting of the videos.
        host_gb: largest size of all clips [GB].
        regions: whether masks of the robot are included.

    Raises:
        ConfigError: there would be more than `host_gb`.
        EpisodeError: a video is missing or damaged.
    """
    aligned = [name for name in streams if name in ALIGNED]
    short = _cut_descriptions(episodes, [name for name in streams if name in UNALIGNED], cut)
    firsts = {name: _first_clips(episodes, cut, cut.drawn_every if name in DRAWN else 1) for name in aligned}
    counts = {name: int(of_name[-1]) for name, of_name in firsts.items()} | {name: len(clips) for name, clips in short.items()}
    total = sum(counts.values())
    if total * cut.clip_bytes > host_gb * 1e9:
        raise ConfigError(
            f"{total} clips of {cut.width}x{cut.height} are {total * cut.clip_bytes / 1e9:.1f} GB, more than pictures.host_gb"
            f" {host_gb:g}; raise pictures.every (now {cut.every}), or name fewer streams or robots."
        )
    ends = np.cumsum(list(counts.values()))
    ranges = {name: range(int(end) - counts[name], int(end)) for name, end in zip(counts, ends, strict=True)}
    clips = np.empty((total, cut.frames, cut.height, cut.width, 3), np.uint8)
    bits = np.zeros((total, -(-cut.frames // 8), cut.height, cut.width), np.uint8) if regions else None

    def put(name: str, offset: int, added: np.ndarray, masks: np.ndarray | None) -> None:
        target = slice(ranges[name].start + offset, ranges[name].start + offset + len(added))
        clips[target] = added
        if bits is not None and masks is not None:
            bits[target] = np.packbits(masks, axis=1)

    def load(number: int) -> None:
        folder, record = episodes[number]
        starts = cut.starts(record)
        times = np.minimum(np.add.outer(starts, np.arange(cut.frames)), record.frame_count - 1)
        wanted = [name for name in aligned if firsts[name][number + 1] > firsts[name][number]]
        read = read_aligned(folder, record, wanted, times.ravel().tolist(), regions=regions)
        for name, (video, mask) in read.items():
            shape = len(starts), cut.frames, cut.height, cut.width
            resized = to_model_size(video, cut.height, cut.width).reshape(*shape, 3)
            masks = None if mask is None else mask_to_model_size(mask, cut).reshape(shape)
            put(name, int(firsts[name][number]), resized, masks)

    for name, cuts in short.items():
        masks = differs_from_corner(cuts.reshape(-1, *cuts.shape[2:])).reshape(cuts.shape[:-1]) if regions else None
        put(name, 0, cuts, masks)
    if aligned:
        loaded = map_in_order(load, range(len(episodes)))
        for _ in tqdm(loaded, desc="pictures", total=len(episodes), unit="episode"):
            pass
    return Pictures(clips, bits, ranges)


def _first_clips(episodes: Sequence[Episode], cut: Cut, every: int) -> Integer[np.ndarray, " n"]:
    """Index [n + 1] of a stream's first clip of each episode, and the total, if every `every`-th episode is taken."""
    counts = (len(cut.starts(record)) if number % every == 0 else 0 for number, (_, record) in enumerate(episodes))
    return np.cumsum([0, *counts])


def read_aligned(
    folder: Path, record: Record, streams: Sequence[str], times: Sequence[int], *, regions: bool = True
) -> dict[str, tuple[Video, Masks | None]]:
    """Frames [t 240 320 3] of an episode's streams at some times, each with the mask of the robot [t 240 320] or None.

    Args:
        folder, record: the episode.
        streams: names among ALIGNED.
        times: indices of frames.
        regions: whether masks are included.

    Raises:
        EpisodeError: a video is missing or damaged.
    """
    drawn = any(name in DRAWN for name in streams)
    states = read_states(folder, record) if drawn or regions else None
    command = make_command(folder, record, states) if states is not None and drawn else None
    chosen, pairs = np.asarray(times), {}
    for name in streams:
        if name in STORED:
            video = read_pixels(folder, STORED[name], int(chosen.max()) + 1, record)[chosen]
        else:
            assert command is not None
            video = DRAWN[name](command)[chosen]
        mask = None
        if regions and states is not None:
            mask = states.robot_mask[chosen] if name == "rgb" else differs_from_corner(video)
        pairs[name] = video, mask
    return pairs


def draw_descriptions(streams: Sequence[str], episode: Episode) -> dict[str, Video]:
    """The pictures [t h w 3] uint8 of the streams that describe the robot of an episode, by name."""
    folder, record = episode
    command = make_command(folder, record, read_states(folder)) if streams else None
    return {name: UNALIGNED[name](command) for name in streams if command is not None}


def _cut_descriptions(episodes: Sequence[Episode], streams: Sequence[str], cut: Cut) -> dict[str, np.ndarray]:
    """Clips [n t h w 3] of the streams that describe robots, each robot once."""
    if not streams:
        return {}
    robots = {record.robot: (folder, record) for folder, record in reversed(episodes)}
    drawn = map_in_order(lambda robot: draw_descriptions(streams, robots[robot]), sorted(robots))
    cuts: dict[str, list[np.ndarray]] = {name: [] for name in streams}
    for videos in tqdm(drawn, desc="robots", total=len(robots), unit="robot"):
        for name, video in videos.items():
            cuts[name].append(cut_description(to_model_size(video, cut.height, cut.width), cut.frames))
    return {name: np.concatenate(clips) for name, clips in cuts.items()}


def cut_description(video: Video, frames: int) -> UInt8[np.ndarray, "n f h w 3"]:
    """Clips [n frames h w 3] of a short video [t h w 3] of 4 k + 1 frames.

    For four frames, the codec's groups (the first frame four times); otherwise its beginning, padded by its last frame.
    """
    if frames != TEMPORAL_FACTOR:
        return take_frames(video, 0, frames)[None]
    groups = np.concatenate([np.repeat(video[:1], TEMPORAL_FACTOR - 1, axis=0), video])
    return groups.reshape(-1, TEMPORAL_FACTOR, *video.shape[1:])


def differs_from_corner(video: Video) -> Masks:
    """Mask [t h w] bool of a drawn video [t h w 3] where it differs from the background, the color of its first pixel."""
    # By channel, because `any` over an axis of three takes ten times as long.
    red, green, blue = (video[..., channel] != video[0, 0, 0, channel] for channel in range(3))
    return red | green | blue


def mask_to_model_size(mask: Masks, cut: Cut) -> Bool[np.ndarray, "t y x"]:
    """Resize masks [t 240 320] bool to the model's size [t height width]."""
    pictures = to_model_size(mask[..., None].astype(np.uint8) * 255, cut.height, cut.width)
    return pictures.reshape(len(mask), cut.height, cut.width) > 127

"""Batches of short crops of video for training an autoencoder.

Reads  episodes; pictures that none of their files hold (optical flow and such) are drawn once and kept under the cache
Writes uint8 [b t h w 3]

A sample is several clips of one video, since a lossless video is decoded from its beginning: on one core about 0.05 s for
113 frames, which is 80 clips a second at 4 a video.
"""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import grain
import numpy as np
from tqdm import tqdm

from xew.config import ConfigError, pick
from xew.dataset import Episode
from xew.episode import EpisodeError, Record, episode_folder, write_video
from xew.files import replacing
from xew.model.conditions import optical_flow, ray_map, robot_mask
from xew.model.episodes.commands import episode_command
from xew.model.training.data import PASSES
from xew.model.video.frames import to_model_size
from xew.threads import map_in_order

STORED = {"rgb": "rgb.mkv", "robot_render": "robot.mkv"}
"""Streams that every episode has as a file."""
DRAWN = {"optical_flow": optical_flow, "mask": robot_mask, "ray_map": ray_map}
"""Streams of pictures that are drawn from an episode's commands."""


@dataclass(frozen=True)
class Cut:
    """What is cut out of a video at random places."""

    clips: int
    frames: int
    size: tuple[int, int]
    """Height and width to which frames are brought before cropping."""
    crop: tuple[int, int]
    """Height and width of the crops."""


def check_streams(streams: Sequence[str]) -> None:
    """Raise ConfigError unless every name is a stream of pictures, and there is one."""
    for name in streams:
        pick(dict.fromkeys((*STORED, *DRAWN), ""), name, "stream of pictures")
    if not streams:
        raise ConfigError(f"streams is empty; name some of {', '.join((*STORED, *DRAWN))}.")


def video_files(streams: Sequence[str], episodes: Sequence[Episode], cache: Path) -> list[tuple[Path, int]]:
    """The file of each stream of each episode, with its number of frames; a stream named twice comes twice as often."""

    def draw(episode: Episode) -> list[tuple[Path, int]]:
        folder, record = episode
        return [(_find_or_draw(name, folder, record, cache), record.frame_count) for name in streams]

    drawn = tqdm(map_in_order(draw, episodes), desc="streams", total=len(episodes), unit="episode")
    return [file for files in drawn for file in files]


def _find_or_draw(name: str, folder: Path, record: Record, cache: Path) -> Path:
    """The file of a stream's pictures, which are drawn if there are none yet."""
    if name in STORED:
        path = folder / STORED[name]
        if not path.exists():
            raise EpisodeError(
                f"{path} is missing; data made with --states-only get their videos by"
                " `python -m xew.sim_warp.inspect DATA --render`."
            )
        return path
    key = hashlib.sha256(f"{name} {record.hashes['states']}".encode()).hexdigest()[:12]
    path = episode_folder(cache, record.task, record.seed, record.robot) / f"{name}-{key}.mkv"
    if not path.exists():
        with replacing(path) as temporary:
            write_video(temporary, DRAWN[name](episode_command(folder, record)))
    return path


def make_dataset(files: Sequence[tuple[Path, int]], cut: Cut, batch: int, seed: int) -> grain.IterDataset:
    """Make endless batches uint8 [b t h w 3], b = batch; the iterator's get_state and set_state carry its position.

    Raises:
        ConfigError: the clips of a video do not fill the batch evenly, or there is no video.
    """
    if not files or batch % cut.clips:
        raise ConfigError(f"a batch of {batch} from {len(files)} videos with {cut.clips} clips each; they must divide it.")

    def load(file: tuple[Path, int], rng: np.random.Generator) -> np.ndarray:
        return random_clips(*file, cut, rng)

    order = grain.MapDataset.source(files).seed(seed).shuffle().repeat(PASSES)
    dataset = order.random_map(load).batch(batch // cut.clips, batch_fn=np.concatenate)
    threads = min(16, os.cpu_count() or 1)
    return dataset.to_iter_dataset(grain.ReadOptions(num_threads=threads, prefetch_buffer_size=2 * threads))


def random_clips(path: Path, frame_count: int, cut: Cut, rng: np.random.Generator) -> np.ndarray:
    """Cut clips at random times and places out of one video: uint8 [clips frames h w 3]."""
    last = max(frame_count - cut.frames, 0)
    starts = rng.integers(0, last + 1, cut.clips)
    times = np.minimum(starts[:, None] + np.arange(cut.frames), frame_count - 1)
    frames = read_frames(path, set(times.ravel().tolist()))
    return np.stack([_crop(to_model_size(np.stack([frames[t] for t in clip]), *cut.size), cut.crop, rng) for clip in times])


def _crop(video: np.ndarray, crop: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    top, left = (rng.integers(0, side - part + 1) for side, part in zip(video.shape[1:3], crop, strict=True))
    return video[:, top : top + crop[0], left : left + crop[1]]


def read_frames(path: Path, wanted: set[int]) -> dict[int, np.ndarray]:
    """Read frames of a video by number, each uint8 [h w 3]. Raises EpisodeError if it does not hold them."""
    frames = {}
    try:
        with av.open(str(path)) as container:
            container.streams.video[0].codec_context.thread_count = 1
            for number, frame in enumerate(container.decode(video=0)):
                if number in wanted:
                    frames[number] = frame.to_ndarray(format="rgb24")
                if len(frames) == len(wanted):
                    break
    except (av.FFmpegError, IndexError):
        frames = {}
    if len(frames) < len(wanted):
        raise EpisodeError(f"{path} is damaged or shorter than its episode; delete it and make it again.")
    return frames

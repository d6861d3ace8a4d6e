"""The latent cache: every stream of every training episode goes through the codec once, and no video is read in training.

Reads  episodes
Writes <cache>/<task>/<seed>/<robot>/<stream>-KEY.safetensors float16 [clips ...], <cache>/header.json,
       <cache>/codec-KEY/ if the codec is one that is fitted, <cache>/text/ if a text encoder is used

KEY names the codec, the source data and the cut into clips, so that what is stale is not found and never mistaken.
Command: python -m xew.model.latents CONFIG [--data … and other overrides]
"""

import argparse
import hashlib
import itertools
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from tqdm import tqdm

from xew.config import ConfigError, digest, suggestion, user_errors
from xew.dataset import find_accepted
from xew.episode import Record, complete_folder, episode_folder, read_states
from xew.files import replacing
from xew.model.cache.scales import Scale, fit_scales, load_run_scales, read_scales, save_scales
from xew.model.codecs.ceiling import choose_evenly, measure_ceiling
from xew.model.codecs.codec import Codec, check_clip_shape, codec_class, encode_pictures
from xew.model.conditions import Command, Condition, clip_numbers, make_command, robot_render
from xew.model.experiment import Experiment, load_experiment
from xew.model.runs.checkpoint import load_run
from xew.model.video.frames import to_model_size
from xew.model.video.pixels import Pixels, PixelSource, rendered_pixels, stored_pixels
from xew.protocol import seed_split
from xew.threads import in_order

Episode = tuple[Path, Record]
CEILING_CLIPS = 8
CACHE_VERSION = 2
CLIPS = "clips"
"""Name of the one array of a cached stream. Safetensors and not .npy, whose headers no two threads may read at once."""


@dataclass(frozen=True)
class LatentCache:
    """Where the encoded streams of an experiment are, and whether they are still those of its data."""

    experiment: Experiment
    codec: Codec

    @property
    def streams(self) -> dict[str, Condition | None]:
        """The experiment's streams: rgb (no condition) and its conditions."""
        return {"rgb": None} | dict(self.experiment.conditions)

    def path(self, record: Record, stream: str) -> Path:
        """The file of one stream of one episode."""
        condition = self.streams[stream]
        name = condition.name if condition else stream
        of_scene = condition is None or condition.make is None
        sources = (record.hashes["rgb"],) if of_scene else (record.hashes["states"], record.hashes["robot"])
        if condition is not None and (of_scene or condition.with_history):
            sources = (*sources, str(self.experiment.model.history))
        cut = digest(self.experiment.clip) if self.experiment.train.chunks == 1 else (digest(self.experiment.clip), "chunks")
        content = (CACHE_VERSION, self.codec.hash, cut, name, *sources)
        key = hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]
        return (
            episode_folder(self.experiment.cache_folder, record.task, record.seed, record.robot) / f"{name}-{key}.safetensors"
        )

    def starts(self, record: Record) -> tuple[int, ...]:
        """First frames of the clips of an episode."""
        return clip_starts(record.frame_count, self.experiment.clip.frames, self.experiment.train.chunks)

    def read(self, record: Record, stream: str, clip: int) -> np.ndarray:
        """One stream of one clip of an episode, float16, numbers float32; what is not aligned has one clip for all.

        Raises:
            ConfigError: it was never encoded, or from other data, codec or clips.
        """
        path = self.path(record, stream)
        try:
            with safe_open(path, framework="np") as stored:
                clips = stored.get_slice(CLIPS)
                return clips[min(clip, clips.get_shape()[0] - 1)]
        except FileNotFoundError:
            stale = list(path.parent.glob(f"{path.stem.rpartition('-')[0]}-*.safetensors"))
            found = "was encoded from other data, with another codec or other clips" if stale else "is not in the cache"
            raise ConfigError(f"{path.parent}: the stream {stream} {found}; {remedy(self.experiment)}.") from None
        except SafetensorError as error:
            raise ConfigError(f"{path} is damaged ({error}); delete it and {remedy(self.experiment)}.") from error

    def missing(self, record: Record) -> list[str]:
        """Streams of an episode that are not encoded yet."""
        return [name for name in self.streams if not self.path(record, name).exists()]

    def encode(self, episodes: Sequence[Episode], source: PixelSource = stored_pixels, batch: int = 4) -> int:
        """Encode what is missing of some episodes; returns the number of bytes written.

        Args:
            source: where their pixels come from; they are read or rendered, and conditions drawn, ahead in threads.
            batch: clips that the codec encodes at once.
        """
        pending = [episode for episode in episodes if self.missing(episode[1])]
        done = len(episodes) - len(pending)
        progress = tqdm(total=len(episodes), initial=done, desc="encode", unit="episode", file=sys.stderr)
        written = 0

        def load(episode: Episode) -> dict[str, np.ndarray]:
            missing = self.missing(episode[1])
            pixels = source(*episode, needed_pixels(self.experiment, missing))
            return stream_videos(self.experiment, *episode, missing, pixels)

        for (_, record), videos in zip(pending, in_order(load, pending), strict=True):
            written += self._encode_videos(record, videos, batch)
            progress.update()
        progress.close()
        return written

    def _encode_videos(self, record: Record, videos: dict[str, np.ndarray], batch: int) -> int:
        """Encode some streams of one episode and write each as a whole."""
        parts = {name: self._cut(name, video, self.starts(record)) for name, video in videos.items()}
        pictures = [clip for clips in parts.values() for part in clips for clip in part if clip.dtype == np.uint8]
        encoded = iter(encode_many(self.codec, pictures, batch))
        sizes = []
        for name, clips in parts.items():
            arrays = [np.concatenate([next(encoded) if c.dtype == np.uint8 else c for c in part]) for part in clips]
            sizes.append(_write(self.path(record, name), np.stack(arrays)))
        return sum(sizes)

    def _cut(self, name: str, video: np.ndarray, starts: Sequence[int]) -> list[list[np.ndarray]]:
        condition = self.streams[name]
        starts = starts if condition is None or condition.aligned else (0,)
        frames, history = self.experiment.clip.frames, self.experiment.model.history
        return [cut_clip(condition, video, start, frames, history) for start in starts]


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


def remedy(experiment: Experiment) -> str:
    """What to do where the cache lacks something."""
    return f"run `python -m xew.model.latents CONFIG --data {experiment.data}`, with the other choices of this command too"


def clip_starts(frame_count: int, frames: int, chunks: int = 1) -> tuple[int, ...]:
    """First frames of all clips of an episode that any training sample has."""
    samples = sample_starts(frame_count, frames, chunks)
    return tuple(sorted({start for sample in samples for start in sample}))


def needed_pixels(experiment: Experiment, streams: Sequence[str]) -> list[str]:
    """Which videos of an episode the named streams are made from, among rgb and robot."""
    conditions = experiment.conditions
    scene = any(name == "rgb" or conditions[name].make is None for name in streams)
    robot = any(name in conditions and conditions[name].make is robot_render for name in streams)
    return [name for name, needed in (("rgb", scene), ("robot", robot)) if needed]


def stream_videos(
    experiment: Experiment, folder: Path, record: Record, streams: Sequence[str], pixels: Pixels | None = None
) -> dict[str, np.ndarray]:
    """Whole-episode input of the named streams: uint8 [t h w 3] at the model's size, or float32 [t n].

    Args:
        pixels: the episode's own, where they are at hand (`needed_pixels`); else its videos are read.
    """
    if pixels is None:
        pixels = stored_pixels(folder, record, needed_pixels(experiment, streams))
    conditions = {name: condition for name, condition in experiment.conditions.items() if name in streams}
    videos = {name: pixels["rgb"] for name in streams if name == "rgb" or conditions[name].make is None}
    if len(videos) < len(streams):
        command = episode_command(folder, record, pixels.get("robot"))
        videos |= {name: condition.make(command) for name, condition in conditions.items() if condition.make is not None}
    clip = experiment.clip
    return {name: to_model_size(v, clip.height, clip.width) if v.ndim == 4 else v for name, v in videos.items()}


def episode_command(folder: Path, record: Record, rendered: np.ndarray | None = None) -> Command:
    """What conditions may be made from, of an episode of a data set."""
    return make_command(folder, record, read_states(folder), rendered)


def cut_clip(
    condition: Condition | None, video: np.ndarray, start: int, frames: int, history: Sequence[int] = ()
) -> list[np.ndarray]:
    """What one clip of one stream is made from: uint8 clips [t h w 3] to be encoded and joined, or numbers [t' n].

    Past the end the last frame is repeated. A condition that is not aligned is encoded whole. Earlier frames are encoded one
    by one (`history`, counted from the clip's first frame); before the start the first is repeated.
    """
    if condition is not None and condition.make is None:
        return [video[frame : frame + 1] for frame in np.maximum(start + np.asarray(history), 0)]
    if video.ndim == 2:
        assert condition is not None
        return [clip_numbers(condition, video, start, frames, history)]
    if condition is None or condition.aligned:
        video = video[np.minimum(np.arange(start, start + frames), len(video) - 1)]
    return [video]


def encode_many(codec: Codec, clips: Sequence[np.ndarray], batch: int) -> list[np.ndarray]:
    """uint8 clips [t h w 3] to float32 latents [t' h' w' c], `batch` of equal shape at once (the last batch is filled up)."""
    encoded: dict[int, np.ndarray] = {}
    shapes = sorted({clip.shape for clip in clips})
    for shape in shapes:
        check_clip_shape(shape, codec.spatial_factor)
        same = [index for index, clip in enumerate(clips) if clip.shape == shape]
        for group in (same[first : first + batch] for first in range(0, len(same), batch)):
            filled = group + group[-1:] * (batch - len(group))
            latents = np.asarray(encode_pictures(codec, np.stack([clips[index] for index in filled])))
            encoded |= dict(zip(group, latents, strict=False))
    return [encoded[index] for index in range(len(clips))]


def training_episodes(experiment: Experiment) -> list[Episode]:
    """The episodes to learn from, of training seeds: all of the split's training robots, or a few of the robots to adapt to.

    Raises:
        ConfigError, EpisodeError: there are none, or too few to adapt to.
    """
    adapt = experiment.adapt
    if adapt.start_from is None:
        return _training_episodes_of(experiment, experiment.robots.train_robots)
    return first_of_each(_training_episodes_of(experiment, adapt.robots), adapt.episodes)


def replay_episodes(experiment: Experiment) -> list[Episode]:
    """In an adaptation with replay, what the run that it starts from was trained on; else none."""
    start, replay = experiment.adapt.start_from, experiment.adapt.replay
    if start is None or not replay:
        return []
    source = load_experiment(start / "config.yaml").robots.train_robots
    return _training_episodes_of(experiment, [robot for robot in source if robot not in experiment.adapt.robots])


def _training_episodes_of(experiment: Experiment, robots: Sequence[str]) -> list[Episode]:
    accepted = find_accepted(experiment.data)
    chosen = [(f, r) for f, r in accepted if r.robot in robots and seed_split(r.seed) == "train"]
    missing = [robot for robot in robots if robot not in {record.robot for _, record in chosen}]
    if missing and (experiment.adapt.start_from is not None or not chosen):
        meant = suggestion(missing[0], {record.robot for _, record in accepted})
        command = f"python -m xew.sim_warp.generate --robots {' '.join(robots)} --out {experiment.data}"
        raise ConfigError(f"{experiment.data} has no training episode of {', '.join(missing)};{meant} make some: {command}")
    return chosen


def first_of_each(episodes: Sequence[Episode], count: int) -> list[Episode]:
    """The first `count` seeds of every task and robot. Raises ConfigError where there are fewer."""
    groups: dict[tuple[str, str], list[Episode]] = {}
    for episode in sorted(episodes, key=lambda episode: episode[1].seed):
        groups.setdefault((episode[1].task, episode[1].robot), []).append(episode)
    for (task, robot), group in groups.items():
        if len(group) < count:
            raise ConfigError(
                f"adapt.episodes is {count}, there are only {len(group)} training episodes of {robot} in {task}; lower it, or "
                "make more with `python -m xew.sim_warp.generate`."
            )
    return [episode for _, group in sorted(groups.items()) for episode in group[:count]]


def test_episodes(data: Path, robots: Sequence[str]) -> list[Episode]:
    """Accepted episodes of test seeds of the given robots, possibly none."""
    return [(f, r) for f, r in find_accepted(data) if r.robot in robots and seed_split(r.seed) == "test"]


def codec_path(experiment: Experiment, episodes: Sequence[Episode]) -> Path:
    """The folder where the codec fitted on these episodes is kept."""
    hashes = [(record.hashes["rgb"], record.hashes["robot"]) for _, record in episodes]
    content = (CACHE_VERSION, digest(experiment.codec), digest(experiment.clip), hashes)
    return experiment.cache_folder / f"codec-{hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]}"


def load_codec(experiment: Experiment, episodes: Sequence[Episode]) -> Codec:
    """The codec of these episodes: fitted on them, or read from the weights that the config names.

    Raises:
        ConfigError: `latents` has not been run for them, or the weights are missing or do not fit.
    """
    if experiment.adapt.start_from is not None:
        return load_run(experiment.adapt.start_from)[1]
    kind = codec_class(experiment.codec)
    if not kind.fitted:
        return kind.prepare(experiment.codec, list)
    path = codec_path(experiment, episodes)
    if not path.exists():
        raise ConfigError(f"no codec fitted on {experiment.data} as it is now under {path.parent}; {remedy(experiment)}.")
    return kind.load(path)


def scales_path(experiment: Experiment, episodes: Sequence[Episode]) -> Path:
    """Where the scales of numbers of these episodes are kept."""
    content = (CACHE_VERSION, sorted(record.hashes["states"] for _, record in episodes))
    names = sorted({condition.name for condition in experiment.conditions.values() if condition.scale != "none"})
    key = hashlib.sha256(json.dumps((*content, names)).encode()).hexdigest()[:12]
    return experiment.cache_folder / f"scales-{key}.json"


def load_scales(experiment: Experiment, episodes: Sequence[Episode]) -> dict[str, Scale]:
    """The scales of these episodes' numbers, or in an adaptation those of the run that it starts from.

    Raises:
        ConfigError: `latents` has not been run for them.
    """
    start = experiment.adapt.start_from
    if start is not None:
        return load_run_scales(experiment, start)
    return read_scales(scales_path(experiment, episodes), tuple(experiment.conditions.values()), remedy(experiment))


def keep_scales(experiment: Experiment, episodes: Sequence[Episode]) -> None:
    """Find and keep the scales of numbers of these episodes, where any is needed and they are not there yet."""
    path = scales_path(experiment, episodes)
    needed = any(condition.scale != "none" for condition in experiment.conditions.values())
    if needed and experiment.adapt.start_from is None and not path.exists():
        commands = (episode_command(folder, record) for folder, record in episodes)
        save_scales(path, fit_scales(experiment.conditions.values(), commands))


def fit_codec(experiment: Experiment, episodes: Sequence[Episode], source: PixelSource = stored_pixels) -> Codec:
    """Fit the codec on clips of training episodes, and keep it."""
    codec = codec_class(experiment.codec).prepare(experiment.codec, lambda: _clips_to_fit(experiment, episodes, source))
    path = codec_path(experiment, episodes)
    with complete_folder(path) as unfinished:
        codec.save(unfinished)
    return codec


def _clips_to_fit(experiment: Experiment, episodes: Sequence[Episode], source: PixelSource) -> list[np.ndarray]:
    """Evenly chosen clips, scene and robot-only, uint8 [t h w 3] at the model's size."""
    settings, clip = experiment.codec, experiment.clip
    chosen = [episodes[i] for i in np.linspace(0, len(episodes) - 1, min(len(episodes), settings.fit_clips // 2)).astype(int)]
    clips = []
    for number, (folder, record) in enumerate(tqdm(chosen, desc="fit codec", disable=not sys.stderr.isatty())):
        starts = clip_starts(record.frame_count, clip.frames)
        start = starts[number % len(starts)]
        pixels = source(folder, record, ("rgb", "robot"))
        for name in ("rgb", "robot"):
            video = pixels[name][start : start + clip.frames]
            video = video[np.minimum(np.arange(clip.frames), len(video) - 1)]
            clips.append(to_model_size(video, clip.height, clip.width))
    return clips


def ceiling(experiment: Experiment, codec: Codec, episodes: Sequence[Episode], source: PixelSource) -> dict[str, Any]:
    """The codec's reconstruction of clips of held-out robots and test seeds, or of training data where there are none."""
    held_out = test_episodes(experiment.data, experiment.robots.held_out_robots)
    chosen = choose_evenly(held_out or episodes, CEILING_CLIPS)
    videos = (source(folder, record, ("rgb",))["rgb"] for folder, record in chosen)
    measured = measure_ceiling(codec, videos, **asdict(experiment.clip))
    on = "held-out robots" if held_out else "training episodes, for there are none of held-out robots"
    print(f"codec ceiling: {measured}, of {on}")
    return {**asdict(measured), "of": on, "robots": sorted({record.robot for _, record in chosen})}


def _write(path: Path, array: np.ndarray) -> int:
    """Save atomically, latents as float16 and numbers as float32; returns the size in bytes."""
    array = array.astype(np.float32 if array.ndim == 3 else np.float16)
    with replacing(path) as temporary:
        save_file({CLIPS: array}, temporary)
    return array.nbytes


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m xew.model.latents", description=__doc__.splitlines()[0])
    parser.add_argument("config", type=Path, help="a YAML file such as configs/debug.yaml")
    parser.add_argument("--from-states", action="store_true", help="render the episodes anew; no video needs to be there")
    parser.add_argument("--batch", type=int, default=4, help="clips that the codec encodes at once (default: 4)")
    args, overrides = parser.parse_known_args(arguments)
    if args.batch < 1:
        raise ConfigError(f"--batch is {args.batch}; expected at least one clip.")
    experiment = load_experiment(args.config, overrides)
    episodes = training_episodes(experiment)
    source = rendered_pixels() if args.from_states else stored_pixels
    adapts = experiment.adapt.start_from is not None
    to_fit = codec_class(experiment.codec).fitted and not adapts and not codec_path(experiment, episodes).exists()
    codec = fit_codec(experiment, episodes, source) if to_fit else load_codec(experiment, episodes)
    keep_scales(experiment, episodes)
    experiment.encode_instructions((record.instruction for _, record in find_accepted(experiment.data)))
    cache = LatentCache(experiment, codec)
    written = cache.encode([*episodes, *replay_episodes(experiment)], source, args.batch)
    header = {"version": CACHE_VERSION, "codec": codec.hash, "clip": asdict(experiment.clip), "streams": list(cache.streams)}
    header |= {"episodes": len(episodes), "ceiling": ceiling(experiment, codec, episodes, source)}
    (experiment.cache_folder / "header.json").write_text(json.dumps(header, indent=1) + "\n")
    robots, streams = sorted({record.robot for _, record in episodes}), ", ".join(cache.streams)
    print(f"{experiment.cache_folder}: {len(episodes)} episodes of {', '.join(robots)}")
    print(f"streams {streams}, {written / 1e6:.1f} MB new")


if __name__ == "__main__":
    main()

"""The latent cache: encode every stream of every training episode once, so training reads no video.

Reads  episodes
Writes <cache>/<task>/<seed>/<robot>/<stream>-KEY.safetensors float16 [clips ...], <cache>/header.json,
       <cache>/text/ if a text encoder is used

KEY is a hash of codec, source data and clips, so stale files are never read.
Command: python -m xew.model.latents CONFIG [--data … and other overrides]
"""

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from xew.compilation import keep_compiled_programs, take_memory_as_needed
from xew.config import ConfigError, user_errors
from xew.dataset import Dataset, Episode, read_dataset
from xew.files import hold_lock, read_json, write_text
from xew.model.cache.clips import gives_render
from xew.model.cache.encode import encode_episodes, prepare_for_gpus
from xew.model.cache.keys import CACHE_VERSION
from xew.model.cache.scales import keep_scales
from xew.model.cache.store import LatentCache, load_codec
from xew.model.codecs.ceiling import check_lpips, choose_evenly, measure_ceiling
from xew.model.codecs.contract import Codec
from xew.model.conditions import shown_scene
from xew.model.episodes.choice import replayed_episodes, training_episodes
from xew.model.episodes.commands import episode_command
from xew.model.experiment import Experiment, parse_experiment
from xew.model.settings.settings import Clip
from xew.model.video.pixels import PixelSource, rendered_pixels, stored_pixels
from xew.protocol import validation_split

CEILING_CLIPS = 8
"""Number of clips on which the codec ceiling is measured."""
MOST_NAMED = 8
"""Largest number of robots that are listed by name."""


@dataclass(frozen=True)
class Flags:
    """Options of the command itself."""

    from_states: bool = False
    """Render the episodes from their states instead of reading their videos, in one process."""
    batch: int = 4
    """Number of clips that the codec encodes at once."""
    processes: int = 0
    """Number of processes that read for each GPU, or for the CPU; 1 selects threads, and 0 what suits the machine."""
    trust: tuple[str, ...] = ()
    """Modules of custom tasks and robots, such as my_lab.tasks, that the data may name."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Encode the training data of an experiment."""
    flags, experiment = parse_experiment(Flags, arguments, "python -m xew.model.latents", __doc__.splitlines()[0])
    if flags.batch < 1 or flags.processes < 0:
        raise ConfigError(f"--batch is {flags.batch}, --processes {flags.processes}; expected 1 or more, and 0 or more.")
    keep_compiled_programs()
    take_memory_as_needed()
    if flags.processes != 1 and not flags.from_states:
        prepare_for_gpus()
    if flags.from_states:
        encode_experiment(experiment, rendered_pixels(), flags.batch)
    else:
        encode_experiment(experiment, stored_pixels, flags.batch, flags.processes)


def encode_experiment(experiment: Experiment, source: PixelSource = stored_pixels, batch: int = 4, processes: int = 1) -> None:
    """Encode the training data of an experiment as `encode_episodes`, and print a summary.

    Several processes need a picklable source.
    """
    check_lpips()
    encoding, choice, dataset = experiment.encoding, experiment.choice, read_dataset(experiment.episodes)
    if experiment.cache is None and encoding.folder.is_symlink():
        raise ConfigError(f"{encoding.folder} is a link; name the folder that it leads to: --cache {encoding.folder.resolve()}")
    episodes, replayed = training_episodes(dataset, choice), replayed_episodes(dataset, choice)
    codec = load_codec(encoding)
    with hold_lock(encoding.folder, wait=True):
        keep_scales(encoding, episodes)
        experiment.instructions.encode(record.instruction for _, record in dataset.accepted)
    cache = LatentCache(encoding, codec)
    # Experiments of a study share a cache: those with the same conditions wait for each other, the others run in parallel.
    encoded = ("rgb", *sorted(condition.name for condition in encoding.inputs.conditions.values()))
    with hold_lock(encoding.folder.with_name("-".join((encoding.folder.name, *encoded))), wait=True):
        measure = partial(report_ceiling, experiment, cache, dataset, episodes, source)
        with ThreadPoolExecutor(1) as thread:
            # Where processes read, and others encode on several GPUs, this one measures the ceiling meanwhile.
            measured = thread.submit(measure) if jax.default_backend() != "cpu" and processes != 1 else None
            written = encode_episodes(cache, [*episodes, *replayed], source, batch, processes)
            ceiling = measured.result() if measured else measure()
        header = {"version": CACHE_VERSION, "codec": codec.decoder_hash, "clip": asdict(experiment.clip)}
        header |= {"streams": list(cache.streams), "episodes": len(episodes), "ceiling": ceiling}
        write_text(encoding.folder / "header.json", json.dumps(header, indent=1) + "\n", within=encoding.folder)
    robots, streams = sorted({record.robot for _, record in episodes}), ", ".join(cache.streams)
    named = ", ".join(robots) if len(robots) <= MOST_NAMED else f"{len(robots)} robots"
    others = f", and {len(replayed)} that are replayed" if replayed else ""
    print(f"{encoding.folder}: {len(episodes)} episodes of {named}{others}")
    print(f"streams {streams}, {written / 1e6:.1f} MB new")


def report_ceiling(
    experiment: Experiment, cache: LatentCache, dataset: Dataset, episodes: Sequence[Episode], source: PixelSource
) -> dict[str, Any]:
    """The codec ceiling on validation seeds, or on training episodes if there are none.

    It is measured once for a cache; its header lists the videos.
    """
    robots = validation_split(experiment.robots)
    validation = dataset.select(robots=(*robots.train_robots, *robots.held_out_robots), split="validation", faults=False)
    chosen = choose_evenly(validation or episodes, CEILING_CLIPS)
    on = "validation seeds" if validation else "training episodes, for there are no validation seeds"
    hashes = [record.hashes["rgb"] for _, record in chosen]
    stored = _read_ceiling(cache, experiment.clip, hashes)
    if stored is not None:
        return stored
    videos = (_ceiling_videos(experiment, cache.codec, episode, source) for episode in chosen)
    measured = measure_ceiling(cache.codec, videos, **asdict(experiment.clip))
    tqdm.write(f"codec ceiling: {measured}, of {on}")
    return {**asdict(measured), "of": on, "robots": sorted({record.robot for _, record in chosen}), "videos": hashes}


def _ceiling_videos(
    experiment: Experiment, codec: Codec, episode: Episode, source: PixelSource
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """The truth of an episode, and the render and the scene if the model's decoder is given them, uint8 [t 240 320 3]."""
    if not gives_render(codec, experiment.conditions):
        return source(*episode, ("rgb",))["rgb"], None, None
    pixels = source(*episode, ("rgb", "robot"))
    command = episode_command(*episode, pixels["robot"], pixels["rgb"])
    return pixels["rgb"], pixels["robot"], shown_scene(experiment.conditions.values(), command)


def _read_ceiling(cache: LatentCache, clip: Clip, videos: Sequence[str]) -> dict[str, Any] | None:
    """The ceiling in a cache's header for the same codec, clips and videos (their hashes), or None."""
    try:
        header = read_json(cache.encoding.folder / "header.json")
        same = (header["codec"], header["clip"]) == (cache.codec.decoder_hash, asdict(clip))
        return header["ceiling"] if same and header["ceiling"]["videos"] == list(videos) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


if __name__ == "__main__":
    main()

"""Rollouts: a trained model predicts episodes from their first frame and their commands.

Reads  a run, episodes
Writes <out>/<task>/<seed>/<robot>/rgb.mkv (lossless, 320x240) and rollout.json

Long episodes are predicted in chunks; the last predicted frame of one is the reference of the next.
Command: python -m xew.model.rollout RUN --data DATA --split test [--robots … --out …]
"""

import argparse
import json
import sys
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from tqdm import tqdm

from xew.config import CONVERTER, ConfigError, suggestion, user_errors
from xew.episode import EpisodeError, episode_folder, find_accepted
from xew.model.checkpoint import load_run, restore_params
from xew.model.codec import Codec
from xew.model.data import Batch
from xew.model.experiment import Experiment, compile_cache, create_model
from xew.model.frames import to_camera_size
from xew.model.latents import Episode, encode_clip, stream_videos
from xew.model.samplers import GRIDS, SAMPLERS, Grid
from xew.model.scales import Scale, apply_scales, load_run_scales
from xew.model.text import encode_instructions
from xew.protocol import ROBOT_NAMES, seed_split
from xew.rollout import write_rollout


@dataclass(frozen=True)
class Predictor:
    """A trained model that continues videos."""

    experiment: Experiment
    codec: Codec
    graph: nnx.GraphDef
    params: Any
    scales: Mapping[str, Scale] = field(default_factory=dict)
    """Of the numbers that the network is told, as in training."""

    def predict(self, episodes: Sequence[Episode], frame_count: int) -> np.ndarray:
        """The first `frame_count` frames of each episode, predicted from its first: uint8 [b t h w 3] at the model's size.

        Frame 0 is the codec's view of the given one. The noise depends on the episode and the chunk, not on the batch.
        """
        names = ("rgb", *self.experiment.conditions)
        streams = [stream_videos(self.experiment, folder, record, names) for folder, record in episodes]
        reference = np.stack([stream["rgb"][:1] for stream in streams])
        horizon = self.experiment.clip.frames - 1
        frames: list[np.ndarray] = []
        for chunk, start in enumerate(range(0, max(frame_count - 1, 1), horizon)):
            keys = [self._key(episode, chunk) for episode in episodes]
            if self.experiment.model.history:  # what the model has made itself; the recorded frames would show the future
                past = np.concatenate([*frames], axis=1) if frames else reference
                streams = [stream | {"history": video} for stream, video in zip(streams, past, strict=True)]
            predicted = self._predict_chunk(episodes, streams, reference, start, keys)
            frames.append(predicted[:, 1:] if frames else predicted)
            reference = predicted[:, -1:]
        return np.concatenate(frames, axis=1)[:, :frame_count]

    def _key(self, episode: Episode, chunk: int) -> jax.Array:
        _, record = episode
        name = zlib.crc32(f"{record.task}/{record.seed}/{record.robot}".encode())
        return jax.random.fold_in(jax.random.fold_in(jax.random.key(self.experiment.rollout.seed), name), chunk)

    def _predict_chunk(
        self,
        episodes: Sequence[Episode],
        streams: Sequence[dict[str, np.ndarray]],
        reference: np.ndarray,
        start: int,
        keys: Sequence[jax.Array],
    ) -> np.ndarray:
        """One clip of each episode [b t h w 3] from reference frames [b 1 h w 3]."""
        frames, history = self.experiment.clip.frames, self.experiment.model.history
        conditions = {
            name: np.stack([encode_clip(self.codec, condition, stream[name], start, frames, history) for stream in streams])
            for name, condition in self.experiment.conditions.items()
        }
        conditions = apply_scales(self.scales, self.experiment.conditions, conditions)
        words = encode_instructions(self.experiment, [record.instruction for _, record in episodes])
        text = np.stack([words[record.instruction] for _, record in episodes])
        noise = jnp.stack([jax.random.normal(key, self.experiment.latent_shape, jnp.float32) for key in keys])
        latents = np.stack([self.codec.encode(frame) for frame in reference])
        settings = self.experiment.rollout
        grid = GRIDS[settings.grid](settings.steps, settings.shift or self.experiment.train.shift)
        sampled = sample(self.graph, self.params, Batch(latents, conditions, text), noise, grid, settings.sampler)
        return np.stack([self.codec.decode(clip) for clip in np.asarray(sampled)])


@jax.jit(static_argnums=(0, 4, 5))
def sample(graph: nnx.GraphDef, params: Any, batch: Batch, noise: jax.Array, grid: Grid, sampler: str) -> jax.Array:
    """Latents [b t h w c] sampled from noise; `batch.latents` [b 1 h w c] is the reference."""
    model = nnx.merge(graph, params)

    def velocity(latents: jax.Array, sigma: jax.Array) -> jax.Array:
        return model(latents, batch.conditions, sigma, batch.text)

    return SAMPLERS[sampler](velocity, batch.latents, noise, grid)


def select_episodes(data: Path, split: str, robots: Sequence[str]) -> list[Episode]:
    """Accepted episodes of a seed family and of the given robots. Raises ConfigError if there is none."""
    for robot in robots:
        if robot not in ROBOT_NAMES:
            raise ConfigError(f"unknown robot {robot!r};{suggestion(robot, ROBOT_NAMES)} known: {', '.join(ROBOT_NAMES)}.")
    chosen = [(f, r) for f, r in find_accepted(data) if seed_split(r.seed) == split and r.robot in robots]
    if not chosen:
        raise EpisodeError(
            f"{data} has no {split} episode of {', '.join(robots)}; run python -m xew.sim_warp.generate --out {data}"
        )
    return chosen


def rollout_header(experiment: Experiment, step: int, episode: Episode) -> dict[str, Any]:
    """rollout.json: what was predicted, from what, with what."""
    _, record = episode
    limit = experiment.rollout.max_frames
    frames = min(record.frame_count, limit) if limit else record.frame_count
    action, embodiment = experiment.model.action, experiment.model.embodiment
    return {
        "model": experiment.out.name,
        "condition": "+".join(name for name in (action, embodiment) if name != "none") or "none",
        "source_hash": record.hashes["rgb"],
        "frame_count": frames,
        "checkpoint_step": step,
        "config": CONVERTER.unstructure(experiment),
    }


def is_done(out: Path, episode: Episode, header: dict[str, Any]) -> bool:
    """Whether this very rollout is there already."""
    _, record = episode
    folder = episode_folder(out, record.task, record.seed, record.robot)
    try:
        return json.loads((folder / "rollout.json").read_text()) == header and (folder / "rgb.mkv").exists()
    except (OSError, ValueError):
        return False


def batches(pending: list[tuple[Episode, dict[str, Any]]], size: int) -> Iterator[list[tuple[Episode, dict[str, Any]]]]:
    """Groups of episodes of similar length, so that few chunks are computed for nothing."""
    ordered = sorted(pending, key=lambda item: item[1]["frame_count"])
    for start in range(0, len(ordered), size):
        yield ordered[start : start + size]


def predict_and_write(predictor: Predictor, group: list[tuple[Episode, dict[str, Any]]], out: Path) -> None:
    """Roll out a group of episodes and write each as long as its header says."""
    size = predictor.experiment.rollout.batch
    episodes = [episode for episode, _ in group]
    padded = episodes + [episodes[-1]] * (size - len(episodes))
    videos = predictor.predict(padded, max(header["frame_count"] for _, header in group))
    for ((_, record), header), video in zip(group, videos, strict=False):
        write_rollout(out, record.task, record.seed, record.robot, to_camera_size(video[: header["frame_count"]]), header)


def load_predictor(run: Path) -> tuple[Predictor, int]:
    """The model of a run at its latest checkpoint, and that checkpoint's step."""
    experiment, codec = load_run(run)
    graph, params = nnx.split(create_model(experiment), nnx.Param)
    params, step = restore_params(run, params)
    return Predictor(experiment, codec, graph, params, load_run_scales(experiment, run)), step


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m xew.model.rollout", description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a trained run")
    parser.add_argument("--data", type=Path, help="episodes (default: those of the run's config)")
    parser.add_argument("--split", choices=("test", "train"), default="test", help="seed family (default: test)")
    parser.add_argument("--robots", nargs="+", default=ROBOT_NAMES, metavar="ROBOT", help="default: all five")
    parser.add_argument("--out", type=Path, help="default: rollouts/<name of the run>")
    args = parser.parse_args(arguments)
    compile_cache()
    predictor, step = load_predictor(args.run)
    out = args.out or Path("rollouts") / args.run.name
    episodes = select_episodes(args.data or predictor.experiment.data, args.split, args.robots)
    headers = [(episode, rollout_header(predictor.experiment, step, episode)) for episode in episodes]
    pending = [item for item in headers if not is_done(out, *item)]
    with tqdm(total=len(pending), desc="rollout", unit="episode", file=sys.stderr) as progress:
        for group in batches(pending, predictor.experiment.rollout.batch):
            predict_and_write(predictor, group, out)
            progress.update(len(group))
    print(f"{out}: {len(pending)} rollouts new, {len(headers) - len(pending)} there before, checkpoint {step}")


if __name__ == "__main__":
    main()

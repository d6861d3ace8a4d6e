"""Train the codec, an autoencoder, on frames of episodes.

Reads  episodes of training seeds; test seeds only for the report, with `report.test_seeds`
Writes <out>/autoencoder.safetensors and autoencoder.json, which `codec.weights: <out>` reads;
       report.md and pictures of reconstructions, config, checkpoints, metrics

The loss is L1 + MSE + LPIPS + a small penalty on latents, without an adversary, because rendered frames have few sharp edges.
Command: python -m lab.codec CONFIG [--resume | --overwrite] [--train.seconds … and other overrides]
"""

import functools
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lab.codec.pictures import Pictures, gather_pictures
from lab.codec.report import measure_codec, report_rows, report_scalars, write_report
from lab.codec.sampling import Batches, place_pictures
from lab.codec.settings import (
    CodecExperiment,
    check_codec_experiment,
    load_codec_experiment,
)
from lab.codec.step import init_codec_state, make_codec_step, summarize
from lab.codec.unpaired import unpaired_training_episodes
from xew.command_line import parse_command
from xew.compilation import keep_compiled_programs
from xew.config import load, user_errors
from xew.dataset import Dataset, Episode, read_dataset
from xew.episode import read_pixels
from xew.files import file_digest, hold_lock, write_text
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.codecs.ceiling import check_lpips
from xew.model.codecs.contract import to_pictures, to_signed
from xew.model.codecs.conv_autoencoder import ConvAutoencoder, save_weights
from xew.model.runs.checkpoint import TrainState, restore_state
from xew.model.runs.folder import check_episodes, check_one_of, claim_run, write_episodes
from xew.model.runs.log import RunLog
from xew.model.runs.session import open_session
from xew.model.training.loop import STOPPED, Meter, Timetable, run_steps
from xew.model.video.comparison import strip
from xew.model.video.frames import to_model_size

SMALLEST_DEVIATION = 1e-3
"""Smallest standard deviation of a latent channel, so an unused channel is not amplified."""
ENDLESS = 2**40
"""Number of steps of a run with a time budget."""


@dataclass(frozen=True)
class Flags:
    """Options of the command itself."""

    resume: bool = False
    """Continue the run in --out if there is one."""
    overwrite: bool = False
    """Replace the run in --out."""


@user_errors
def main(arguments: Sequence[str] | None = None, prog: str = "python -m lab.codec") -> None:
    """Train an autoencoder."""
    read = functools.partial(load, CodecExperiment)
    command = parse_command(Flags, CodecExperiment, read, arguments, prog=prog, description=__doc__.splitlines()[0])
    experiment, flags = check_codec_experiment(command.config, command.path), command.flags
    check_one_of(flags.resume, flags.overwrite)
    keep_compiled_programs()
    with hold_lock(experiment.out):
        completed = train_codec(experiment, resume=flags.resume, overwrite=flags.overwrite)
    if not completed:
        sys.exit(STOPPED)


def train_codec(experiment: CodecExperiment, *, resume: bool = False, overwrite: bool = False) -> bool:
    """Train from the start or the latest checkpoint, then write and measure the weights; returns whether it is done."""
    check_lpips()
    settings = experiment.train
    dataset = read_dataset(experiment.data)
    episodes = unpaired_training_episodes(dataset, experiment.train_robots, experiment.motion)
    if resume:
        check_episodes(experiment.out, episodes)
    claim_run(experiment.out, experiment, load_codec_experiment, resume=resume, overwrite=overwrite)
    write_episodes(experiment.out, episodes)
    pictures = load_pictures(experiment, episodes)
    batches = Batches(pictures, experiment.streams, settings)
    print(f"{'device' if batches.on_device else 'host'} memory: {pictures.describe()}")

    graph, statistics, state = init_codec_state(experiment)
    with open_session(experiment.out, settings.keep_checkpoints) as session:
        log = session.log
        assert log is not None, "autoencoders are trained by one process"
        if session.step:
            state, position = restore_state(session.checkpoints, state)
            batches.set_state(position)

        def draw_samples(state: TrainState, step: int) -> None:
            module = nnx.merge(graph, state.ema, statistics)
            log.image(step, "sample", sample_picture(module, episodes[0], experiment))

        if not batches.is_over(int(state.step)):
            steps = settings.steps or ENDLESS
            timetable = Timetable(
                steps,
                settings.log_every,
                settings.save_every,
                range(settings.sample_every, steps + 1, settings.sample_every) if settings.sample_every else (),
                batches.rate,
                batches.is_over if settings.seconds else None,
            )
            take_step = make_codec_step(graph, statistics, experiment)
            state = run_steps(timetable, session, Meter(summarize, settings.batch), take_step, state, batches, draw_samples)
        completed = batches.is_over(int(state.step))
        if completed:
            print(f"{int(state.step)} steps in {batches.clock.elapsed:.0f} s")
            finish(experiment, nnx.merge(graph, state.ema, statistics), batches, dataset, int(state.step), log)
    return completed


def load_pictures(experiment: CodecExperiment, episodes: Sequence[Episode]) -> Pictures:
    """Decode and draw the training pictures, and put them on the device if they fit."""
    begin = time.perf_counter()
    streams = [name for name, share in experiment.streams.items() if share]
    host_gb, regions = experiment.pictures.host_gb, experiment.train.region > 0
    pictures = gather_pictures(episodes, streams, experiment.cut, host_gb, regions=regions)
    placed = place_pictures(pictures, experiment.pictures.device_share)
    print(f"{len(episodes)} episodes read in {time.perf_counter() - begin:.0f} s")
    return placed


def sample_picture(module: ConvAutoencoder, episode: Episode, experiment: CodecExperiment) -> np.ndarray:
    """A strip [2h w 3] uint8 of one clip of an episode's scene, ground truth above reconstruction."""
    folder, record = episode
    cut = experiment.cut
    times = np.minimum(np.arange(cut.frames), record.frame_count - 1)
    frames = read_pixels(folder, "rgb", cut.frames, record)
    clip = to_model_size(frames[times], cut.height, cut.width)
    return strip(clip, np.asarray(reconstruct_clip(module, clip)))


@jax.jit
def reconstruct_clip(module: ConvAutoencoder, clip: jax.Array) -> jax.Array:
    """Reconstruction of one clip [t h w 3] uint8 by the autoencoder, without noise."""
    return to_pictures(module.decode_groups(module.encode_groups(to_signed(clip[None])))[0])


def finish(
    experiment: CodecExperiment, module: ConvAutoencoder, batches: Batches, dataset: Dataset, step: int, log: RunLog
) -> None:
    """Compute the statistics of the latents, write the weights, measure reconstructions, and write the report."""
    out = experiment.out
    mean, std = latent_statistics(module, batches, experiment.train.statistics_clips)
    module.latents_mean.set_value(mean)
    module.latents_std.set_value(std)
    weights = out / "autoencoder.safetensors"
    save_weights(module, weights)
    codec = ConvAutoencoderCodec.from_weights(weights, experiment.dtype)
    description = {
        "size": asdict(experiment.autoencoder),
        "dtype": experiment.dtype,
        "hash": codec.hash,
        "file": file_digest(weights),
        "bytes": weights.stat().st_size,
        "steps": step,
        "seconds": round(batches.clock.elapsed, 1),
        "latents_mean": mean.tolist(),
        "latents_std": std.tolist(),
    }
    write_description(experiment, description)  # in case the report fails
    qualities = measure_codec(experiment, codec, dataset, out / "pictures" if experiment.report.pictures else None)
    write_description(experiment, description | {"reconstruction": report_rows(qualities)})
    if qualities:
        log.scalars(step, report_scalars(qualities))
        print(write_report(qualities, experiment))
    print(f"{weights} ({weights.stat().st_size / 1e6:.2f} MB): use it with --codec.weights {out}")


def write_description(experiment: CodecExperiment, description: dict[str, Any]) -> None:
    """Write autoencoder.json next to the weights."""
    path = experiment.out / "autoencoder.json"
    write_text(path, json.dumps(description, indent=1) + "\n", within=path.parent)


def latent_statistics(module: ConvAutoencoder, batches: Batches, count: int) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation [c] of the latents of about `count` clips, drawn as in training, without augmentation."""

    @jax.jit
    def moments(module: ConvAutoencoder, clips: jax.Array) -> tuple[jax.Array, jax.Array]:
        latents = module.encode_groups(to_signed(clips))
        return latents.mean(axis=(0, 1, 2)), jnp.square(latents).mean(axis=(0, 1, 2))

    of_batches = []
    for number in range(max(1, count // batches.settings.batch)):
        clips, _ = batches.pick(ENDLESS + number)
        of_batches.append([np.asarray(part, np.float64) for part in moments(module, clips)])
    mean, squares = np.mean(of_batches, axis=0)
    std = np.sqrt(np.maximum(squares - np.square(mean), 0))
    return jnp.asarray(mean, jnp.float32), jnp.asarray(np.maximum(std, SMALLEST_DEVIATION), jnp.float32)


if __name__ == "__main__":
    main()

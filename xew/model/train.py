"""Train a world model from the latent cache, on any number of devices and hosts.

Reads  the latent cache
Writes <out>: config, checkpoints, metrics.jsonl, TensorBoard curves and sample videos
Command: python -m xew.model.train CONFIG [--resume | --overwrite] [--train.steps … and other overrides]
         python -m xew.model.train CONFIG --estimate --devices 8 --memory-gb 80
"""

import contextlib
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jax.sharding import AbstractMesh

from xew.compilation import keep_compiled_programs
from xew.config import CONVERTER, ConfigError, user_errors
from xew.dataset import read_dataset
from xew.files import hold_lock
from xew.model.devices.sharding import (
    AXES,
    check_batch,
    make_mesh,
    mesh_shape,
    process_samples,
    start_processes,
)
from xew.model.episodes.choice import choose_episodes
from xew.model.experiment import Experiment, parse_experiment
from xew.model.runs.checkpoint import TrainState
from xew.model.runs.folder import begin_run, check_one_of, check_start
from xew.model.runs.session import open_session
from xew.model.settings.optimizer import learning_rate
from xew.model.training.data import ClipSource
from xew.model.training.flops import flops_of_step
from xew.model.training.loop import STOPPED, Meter, Timetable, run_steps
from xew.model.training.memory import check_memory, estimate_memory
from xew.model.training.order import make_dataset
from xew.model.training.samples import SampleRollouts, sample_steps
from xew.model.training.start import begin_state
from xew.model.training.step import StepResult, make_trainer

NOISE_LEVEL_EDGES = (0.0, 0.5, 0.8, 0.95, 1.0)
"""Edges of the noise-level bins of which the mean loss is logged."""


@dataclass(frozen=True)
class Flags:
    """Options of the command itself."""

    resume: bool = False
    """Continue the run in --out if there is one."""
    overwrite: bool = False
    """Replace the run in --out."""
    distributed: bool = False
    """Join the other processes of a launcher."""
    ignore_memory: bool = False
    """Start even if the estimated memory exceeds the available memory."""
    estimate: bool = False
    """Print the estimated memory and exit."""
    devices: int = 1
    """Number of devices for --estimate."""
    memory_gb: float | None = None
    """Memory of each device for --estimate [GB]."""
    trust: tuple[str, ...] = ()
    """Modules of custom tasks and robots, such as my_lab.tasks, that the data may name."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Train an experiment, or estimate its memory."""
    flags, experiment = parse_experiment(Flags, arguments, "python -m xew.model.train", __doc__.splitlines()[0])
    if flags.estimate:
        print_estimate(experiment, flags.devices, flags.memory_gb)
        return
    check_one_of(flags.resume, flags.overwrite)
    start_processes(flags.distributed)
    keep_compiled_programs()
    with hold_lock(experiment.out) if jax.process_index() == 0 else contextlib.nullcontext():
        completed = train(experiment, resume=flags.resume, overwrite=flags.overwrite, ignore_memory=flags.ignore_memory)
    if not completed:
        sys.exit(STOPPED)


def print_estimate(experiment: Experiment, devices: int, memory_gb: float | None) -> None:
    """Print the estimated memory of a run on a number of devices, which need not exist."""
    if devices < 1:
        raise ConfigError(f"--devices is {devices}; expected at least one.")
    mesh = AbstractMesh(mesh_shape(experiment.mesh, devices), AXES)
    check_batch(experiment.train.batch, experiment.train.accumulate, devices)
    memory = estimate_memory(make_trainer(experiment.spec, mesh), experiment.encoding)
    print(memory.table())
    if memory_gb:
        print(f"{'fits' if memory.total < memory_gb * 1e9 else 'does not fit'} in {memory_gb:g} GB a device")


def train(experiment: Experiment, *, resume: bool = False, overwrite: bool = False, ignore_memory: bool = False) -> bool:
    """Train an experiment, from the start or its latest checkpoint; returns whether it reached the last step."""
    # Missing data and too little memory are errors before the run folder is created.
    mesh = make_mesh(experiment.mesh)
    check_batch(experiment.train.batch, experiment.train.accumulate, mesh.size)
    own = process_samples(mesh, experiment.train.batch)
    check_start(experiment)
    episodes = choose_episodes(read_dataset(experiment.episodes), experiment.choice)
    source = ClipSource.open(experiment.encoding, experiment.instructions, episodes.fresh, episodes.replayed)
    source.check()
    spec = experiment.spec.with_steps(source.fresh)
    settings = spec.settings
    codec = source.cache.codec
    trainer = make_trainer(spec, mesh, codec)
    batches = iter(make_dataset(source, settings.batch, settings.seed, spec.replay, own, trainer.place))
    check_memory(estimate_memory(trainer, experiment.encoding), ignore=ignore_memory)

    trained = (*episodes.fresh, *episodes.replayed)
    source.scales = begin_run(experiment, codec, source.scales, trained, resume=resume, overwrite=overwrite)
    timetable = Timetable(
        settings.steps, settings.log_every, settings.save_every, sample_steps(settings), learning_rate(settings)
    )
    recommended = CONVERTER.unstructure(Experiment(experiment.data, experiment.out))
    with open_session(experiment.out, settings.keep_checkpoints, recommended) as session:
        state = begin_state(trainer, experiment.adapt.start_from, experiment.model.weights, session, batches)

        samples = SampleRollouts(experiment, codec, source.scales, episodes.samples)

        def draw_samples(state: TrainState, step: int) -> None:
            samples.log(session.log, trainer.average_params(state), step)

        meter = Meter(summarize, settings.batch, flops_of_step(spec))
        state = run_steps(timetable, session, meter, trainer.step, state, batches, draw_samples)
    return int(state.step) >= settings.steps


def summarize(results: Sequence[StepResult]) -> dict[str, float]:
    """Mean loss, loss by noise level and gradient norm over some steps."""
    losses, sigma, weights = (np.concatenate([getattr(r, name) for r in results]) for name in ("losses", "sigma", "weights"))
    norms = [float(result.gradient_norm) for result in results]
    values = {"loss/train": (weights * losses).sum(axis=1).mean(), "train/gradient_norm": np.mean(norms)}
    for low, high in itertools.pairwise(NOISE_LEVEL_EDGES):
        inside = (sigma > low) & (sigma <= high) & (weights > 0)
        if inside.any():
            values[f"train/loss_at_noise_{low:g}_{high:g}"] = losses[inside].mean()
    return {name: float(value) for name, value in values.items()}


if __name__ == "__main__":
    main()

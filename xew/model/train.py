"""Training: the latent cache to checkpoints, on any number of devices and hosts.

Reads  the latent cache
Writes <out>: config, checkpoints, metrics.jsonl, TensorBoard curves and sample videos
Command: python -m xew.model.train CONFIG [--resume | --overwrite] [--train.steps … and other overrides]
         python -m xew.model.train CONFIG --estimate --devices 8 --memory-gb 80
"""

import contextlib
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jax.sharding import AbstractMesh

from xew.compilation import keep_compiled_programs
from xew.config import ConfigError, user_errors
from xew.dataset import read_dataset
from xew.files import hold_lock
from xew.model.cache.scales import load_run_scales
from xew.model.devices.sharding import (
    AXES,
    check_batch,
    make_mesh,
    mesh_shape,
    place_batch,
    place_shapes,
    process_samples,
    start_processes,
)
from xew.model.episodes.choice import choose_episodes
from xew.model.experiment import Experiment, parse_experiment
from xew.model.runs.begin import begin_run, check_one_of, check_start
from xew.model.runs.checkpoint import TrainState
from xew.model.runs.session import open_session
from xew.model.sampling.predict import Predictor
from xew.model.settings.network import check_network
from xew.model.settings.optimizer import learning_rate, make_optimizer, set_steps, tell_stale_average
from xew.model.training.data import ClipSource
from xew.model.training.flops import flops_of_step
from xew.model.training.loop import STOPPED, Meter, Timetable, run_steps
from xew.model.training.memory import check_memory, estimate_memory
from xew.model.training.order import make_dataset
from xew.model.training.samples import log_samples
from xew.model.training.start import begin_state
from xew.model.training.step import StepResult, abstract_state, make_learner

NOISE_LEVEL_EDGES = (0.0, 0.5, 0.8, 0.95, 1.0)
"""Bins of the noise level in which the loss is shown apart."""


@dataclass(frozen=True)
class Flags:
    """Options of the command itself."""

    resume: bool = False
    """Continue the run in --out if there is one."""
    overwrite: bool = False
    """Replace the run in --out."""
    distributed: bool = False
    """Join the other processes that a launcher has started."""
    ignore_memory: bool = False
    """Start even if the estimate says that memory is too small."""
    estimate: bool = False
    """Print the memory that training needs, and do nothing else."""
    devices: int = 1
    """With --estimate: number of devices."""
    memory_gb: float | None = None
    """With --estimate: memory of each device [GB]."""
    trust: tuple[str, ...] = ()
    """Modules of your own tasks and robots, such as my_lab.tasks, that the data may name."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Train an experiment, or estimate the memory that this needs."""
    flags, experiment = parse_experiment(Flags, arguments, "python -m xew.model.train", __doc__.splitlines()[0])
    if flags.estimate:
        print_estimate(experiment, flags.devices, flags.memory_gb)
        return
    check_one_of(flags.resume, flags.overwrite)
    start_processes(flags.distributed)
    keep_compiled_programs()
    with hold_lock(experiment.out) if jax.process_index() == 0 else contextlib.nullcontext():
        ended = train(experiment, resume=flags.resume, overwrite=flags.overwrite, ignore_memory=flags.ignore_memory)
    if not ended:
        sys.exit(STOPPED)


def print_estimate(experiment: Experiment, devices: int, memory_gb: float | None) -> None:
    """Print the memory of a run on devices that need not be there, with the arithmetic."""
    if devices < 1:
        raise ConfigError(f"--devices is {devices}; expected at least one.")
    mesh = AbstractMesh(mesh_shape(experiment.mesh, devices), AXES)
    check_batch(experiment.train.batch, experiment.train.accumulate, devices)
    shapes = place_shapes(abstract_state(experiment.learning)[1], mesh)
    memory = estimate_memory(experiment.learning, shapes, experiment.encoding, mesh)
    print(memory.table())
    if memory_gb:
        print(f"{'fits' if memory.total < memory_gb * 1e9 else 'does not fit'} in {memory_gb:g} GB a device")


def train(experiment: Experiment, *, resume: bool = False, overwrite: bool = False, ignore_memory: bool = False) -> bool:
    """Train an experiment to its last step, from the start or from its latest checkpoint; returns whether it came there."""
    # Everything that can be missing or too small is found before a run folder is made.
    settings = experiment.train
    adapt = experiment.adapt
    encoding = experiment.encoding
    out = experiment.out
    mesh = make_mesh(experiment.mesh)
    check_batch(settings.batch, settings.accumulate, mesh.size)
    own = process_samples(mesh, settings.batch)
    check_network(experiment.network)
    check_start(experiment)
    episodes = choose_episodes(read_dataset(experiment.data), experiment.choice)
    source = ClipSource.open(encoding, experiment.instructions, episodes.fresh, episodes.replay)
    source.check()
    dataset = make_dataset(source, settings.batch, settings.seed, adapt.replay, own)
    settings = set_steps(settings, source.fresh, adapt.replay)
    if (told := tell_stale_average(settings)) and jax.process_index() == 0:
        print(told, file=sys.stderr)
    rates = learning_rate(settings)
    learning = replace(experiment.learning, settings=settings, optimizer=make_optimizer(settings))
    learner = make_learner(learning, mesh)
    flops = flops_of_step(learning, encoding.inputs)
    check_memory(estimate_memory(learning, learner.shapes, encoding, mesh), ignore=ignore_memory)

    begin_run(experiment, source.cache.codec, source.scales, resume=resume, overwrite=overwrite)
    source.scales = load_run_scales(encoding.inputs.conditions, out)
    graph, codec = experiment.sampling_network.structure, source.cache.codec
    predictor = Predictor(encoding.inputs, experiment.instructions, experiment.sampling, codec, graph, None, source.scales)
    timetable = Timetable(settings.steps, settings.log_every, settings.save_every, settings.sample_every, rates)
    batches = iter(dataset)
    with open_session(out, settings.keep_checkpoints) as session:
        state = begin_state(learner, adapt.start_from, session, batches)
        take_step = learner.compile_step(source.cache.codec)

        def draw_samples(state: TrainState, step: int) -> None:
            params = learner.average_params(state)
            log_samples(session.log, replace(predictor, params=params), episodes.samples, step)

        meter = Meter(summarize, settings.batch, flops)
        state = run_steps(
            timetable, session, meter, take_step, state, batches, draw_samples, lambda batch: place_batch(batch, mesh)
        )
    return int(state.step) >= settings.steps


def summarize(results: Sequence[StepResult]) -> dict[str, float]:
    """Means of the loss, of the loss by noise level and of the gradient norm over some steps."""
    losses, sigma, weights = (np.concatenate([getattr(r, name) for r in results]) for name in ("losses", "sigma", "weights"))
    norms = [float(result.gradient_norm) for result in results]
    values = {"train/loss": (weights * losses).sum(axis=1).mean(), "train/gradient_norm": np.mean(norms)}
    for low, high in itertools.pairwise(NOISE_LEVEL_EDGES):
        inside = (sigma > low) & (sigma <= high) & (weights > 0)
        if inside.any():
            values[f"train/loss_at_noise_{low:g}_{high:g}"] = losses[inside].mean()
    return {name: float(value) for name, value in values.items()}


if __name__ == "__main__":
    main()

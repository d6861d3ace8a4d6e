"""Training: the latent cache to checkpoints, on any number of devices and hosts.

Reads  the latent cache
Writes <out>: config, checkpoints, metrics.jsonl, TensorBoard curves and sample videos
Command: python -m xew.model.train CONFIG [--resume | --overwrite] [--train.steps … and other overrides]
         python -m xew.model.train CONFIG --estimate --devices 8 --memory-gb 80
"""

import argparse
import itertools
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.experimental import multihost_utils

from xew.compilation import keep_compiled_programs
from xew.config import ConfigError, user_errors
from xew.model.cache.scales import SCALES, Scale, load_run_scales, save_scales
from xew.model.codecs.codec import Codec
from xew.model.conditions import Condition
from xew.model.devices.sharding import check_batch, make_mesh, mesh_shape, place_batch, process_samples, start_processes
from xew.model.episodes.choice import choose_episodes
from xew.model.experiment import Experiment, Network, load_experiment
from xew.model.network.blocks import choose_attention
from xew.model.network.dit_layouts import check_dit, load_dit_params
from xew.model.network.lora import apply_lora
from xew.model.runs.checkpoint import TrainState, restore_state
from xew.model.runs.folder import prepare_run
from xew.model.runs.start import START, check_start, note_start, restore_start
from xew.model.sampling.predict import Predictor
from xew.model.training.data import ClipSource, make_dataset
from xew.model.training.loop import STOPPED, Meter, Session, Timetable, open_session, run_steps
from xew.model.training.memory import check_memory, estimate_memory, flops_of_step
from xew.model.training.optimizer import learning_rate, set_steps
from xew.model.training.samples import check_samples, log_samples
from xew.model.training.step import Learner, StepResult, abstract_state, make_learner, random_params

NOISE_LEVEL_EDGES = (0.0, 0.5, 0.8, 0.95, 1.0)
"""Bins of the noise level in which the loss is shown apart."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m xew.model.train", description=__doc__.splitlines()[0])
    parser.add_argument("config", type=Path, help="a YAML file; every field may be overridden, as in --train.steps 100")
    existing = parser.add_mutually_exclusive_group()
    existing.add_argument("--resume", action="store_true", help="continue the run in --out if there is one")
    existing.add_argument("--overwrite", action="store_true", help="replace the run in --out")
    parser.add_argument("--distributed", action="store_true", help="join the other processes that a launcher has started")
    parser.add_argument("--ignore-memory", action="store_true", help="start even if the estimate says that memory is too small")
    parser.add_argument("--estimate", action="store_true", help="print the memory that training needs, and do nothing else")
    parser.add_argument("--devices", type=int, default=1, help="with --estimate: how many")
    parser.add_argument("--memory-gb", type=float, help="with --estimate: of each device")
    args, overrides = parser.parse_known_args(arguments)
    experiment = load_experiment(args.config, overrides)
    if args.estimate:
        print_estimate(experiment, args.devices, args.memory_gb)
        return
    start_processes(args.distributed)
    keep_compiled_programs()
    if not train(experiment, resume=args.resume, overwrite=args.overwrite, ignore_memory=args.ignore_memory):
        sys.exit(STOPPED)


def print_estimate(experiment: Experiment, devices: int, memory_gb: float | None) -> None:
    """Print the memory of a run on devices that need not be there, with the arithmetic."""
    if devices < 1:
        raise ConfigError(f"--devices is {devices}; expected at least one.")
    _, fsdp = mesh_shape(experiment.mesh, devices)
    check_batch(experiment.train.batch, experiment.train.accumulate, devices)
    learning = experiment.learning
    memory = estimate_memory(learning, abstract_state(learning)[1], experiment.inputs, experiment.codec, devices, fsdp)
    print(memory.table())
    if memory_gb:
        print(f"{'fits' if memory.total < memory_gb * 1e9 else 'does not fit'} in {memory_gb:g} GB a device")


def train(experiment: Experiment, *, resume: bool = False, overwrite: bool = False, ignore_memory: bool = False) -> bool:
    """Train an experiment to its last step, from the start or from its latest checkpoint; returns whether it came there."""
    # Everything that can be missing or too small is found before a run folder is made.
    settings, adapt, out = experiment.train, experiment.adapt, experiment.out
    mesh = make_mesh(experiment.mesh)
    check_batch(settings.batch, settings.accumulate, mesh.size)
    own = process_samples(mesh, settings.batch)
    check_network(experiment.network)
    if adapt.start_from is not None:
        check_start(experiment)
    episodes = choose_episodes(experiment.choice)
    source = ClipSource.open(experiment.encoding, experiment.instructions, episodes.fresh, episodes.replay)
    source.check()
    if settings.sample_every:
        check_samples(episodes.samples, experiment.data)
    settings = set_steps(settings, source.fresh, adapt.replay)
    learner = make_learner(replace(experiment.learning, settings=settings), mesh)
    needed = estimate_memory(
        learner.learning, learner.shapes, experiment.inputs, experiment.codec, mesh.size, mesh.shape["fsdp"]
    )
    check_memory(needed, ignore=ignore_memory)
    begin_run(experiment, source.cache.codec, resume=resume, overwrite=overwrite)
    source.scales = share_scales(out, experiment.conditions, source.scales)

    batches = iter(make_dataset(source, settings.batch, settings.seed, adapt.replay, own))
    timetable = Timetable(
        settings.steps, settings.log_every, settings.save_every, settings.sample_every, learning_rate(settings)
    )
    meter = Meter(summarize, settings.batch, flops_of_step(learner.learning, experiment.inputs))
    with open_session(out, settings.keep_checkpoints) as session:
        state = begin_state(experiment, learner, session, batches)
        base = Predictor(
            experiment.inputs,
            experiment.instructions,
            experiment.sampling,
            source.cache.codec,
            learner.graph,
            None,
            source.scales,
        )

        def draw_samples(state: TrainState, step: int) -> None:
            log_samples(session.log, replace(base, params=average_params(learner, state)), episodes.samples, step)

        take_step = learner.compile_step(source.cache.codec)
        state = run_steps(
            timetable, session, meter, take_step, state, batches, draw_samples, lambda batch: place_batch(batch, mesh)
        )
    return int(state.step) >= settings.steps


def check_network(network: Network) -> None:
    """Raise ConfigError if the network cannot be computed here as asked, or its published weights do not fit."""
    settings = network.settings
    choose_attention(settings.attention, network.size.head_dim, jnp.dtype(settings.dtype))
    if settings.weights is not None:
        check_dit(nnx.eval_shape(network.create), settings.weights)


def begin_run(experiment: Experiment, codec: Codec, *, resume: bool, overwrite: bool) -> None:
    """Make the run folder ready, by the first process; the others wait for it."""
    out, start = experiment.out, experiment.adapt.start_from
    if jax.process_index() == 0:
        prepare_run(experiment, codec, resume=resume, overwrite=overwrite)
        if start is not None and not (resume and (out / START).exists()):
            note_start(out, start)
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("run folder")


def share_scales(out: Path, conditions: Mapping[str, Condition], found: Mapping[str, Scale]) -> dict[str, Scale]:
    """The scales of numbers that the run was begun with; those found in the data if it is new."""
    path = out / SCALES
    if found and not path.exists() and jax.process_index() == 0:
        save_scales(path, found)
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("scales")
    return load_run_scales(conditions, out)


def begin_state(experiment: Experiment, learner: Learner, session: Session, batches: Any) -> TrainState:
    """Make the state of step 0, or restore that of the latest checkpoint with the position of the data."""
    if session.step == 0:
        return learner.init_state(start_params(experiment, learner))
    base = start_params(experiment, learner) if experiment.adapt.lora_rank else None
    state, position = restore_state(session.checkpoints, learner.shapes)
    batches.set_state(position)
    return replace(state, base=base)


def start_params(experiment: Experiment, learner: Learner) -> Any:
    """Parameters of step 0, placed on the mesh: those of the run to adapt, published weights, or None for random ones."""
    start, weights = experiment.adapt.start_from, experiment.model.weights
    if start is not None:
        return restore_start(experiment.out, start, learner.network_shapes)
    if weights is not None:
        return load_dit_params(*random_params(learner.learning.network, learner.mesh), weights)
    return None


def average_params(learner: Learner, state: TrainState) -> Any:
    """The network's parameters for inference: the moving average where one is kept."""
    with jax.set_mesh(learner.mesh):
        return jax.jit(apply_lora)(state.base, state.params if state.ema is None else state.ema)


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

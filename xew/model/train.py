"""Training: the latent cache to checkpoints, on any number of devices and hosts.

Reads  the latent cache
Writes <out>: config, checkpoints, metrics.jsonl, TensorBoard curves and sample videos
Command: python -m xew.model.train CONFIG [--resume | --overwrite] [--train.steps … and other overrides]
         python -m xew.model.train CONFIG --estimate --devices 8 --memory-gb 80
"""

import argparse
import contextlib
import itertools
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.experimental import multihost_utils
from jax.sharding import Mesh
from tqdm import tqdm

from xew.config import ConfigError, user_errors
from xew.model.cache.scales import SCALES, Scale, load_run_scales, save_scales
from xew.model.codecs.codec import Codec
from xew.model.devices.sharding import (
    check_batch,
    make_mesh,
    mesh_shape,
    place_batch,
    process_samples,
    start_processes,
    state_shardings,
)
from xew.model.experiment import Experiment, compile_cache, create_model, load_experiment
from xew.model.latents import LatentCache, load_codec, replay_episodes, training_episodes
from xew.model.network.blocks import choose_attention
from xew.model.network.dit_layouts import check_dit, load_dit_params
from xew.model.network.lora import apply_lora
from xew.model.runs.checkpoint import (
    START,
    TrainState,
    check_start,
    note_start,
    open_checkpoints,
    prepare_run,
    restore_start,
    restore_state,
    save_state,
)
from xew.model.sampling.predict import Predictor
from xew.model.training.data import ClipSource, make_dataset
from xew.model.training.memory import check_memory, estimate_memory, flops_of_step, peak_flops
from xew.model.training.optimizer import learning_rate, with_steps
from xew.model.training.samples import check_samples, log_samples
from xew.model.training.step import StepResult, abstract_state, init_train_state, make_train_step, random_params
from xew.model.training.tensorboard import RunLog

NOISE_LEVEL_EDGES = (0.0, 0.5, 0.8, 0.95, 1.0)
"""Bins of the noise level in which the loss is shown apart."""
STOPPED = 128 + signal.SIGTERM
"""Exit status of a run that was asked to stop before its last step: it is saved, but nobody may take it for done."""


@dataclass
class Meter:
    """What has happened since the last log line."""

    flops: float
    """Of one step, forward and backward, counted on the model."""
    samples: int
    """Of one step."""
    results: list[StepResult] = field(default_factory=list)
    wait_s: float = 0.0
    """Time in which the devices had to wait for data."""
    since: float = field(default_factory=time.perf_counter)

    def add(self, result: StepResult, wait_s: float) -> None:
        self.results.append(result)
        self.wait_s += wait_s

    def demand_finite(self) -> None:
        """End the program if any step since the last log line was not finite: the state is spoilt and must not be saved."""
        steps = len(self.results)
        for number, result in enumerate(self.results):
            if not bool(result.finite):
                sys.exit(
                    f"error: loss, gradients or update are not finite {steps - number - 1} steps ago; nothing of it was saved. "
                    "--resume returns to the last checkpoint, or lower the rate (train.learning_rate)."
                )

    def take(self) -> dict[str, float]:
        """The values of a log line; begins anew."""
        results, seconds = jax.device_get(self.results), time.perf_counter() - self.since
        values = summarize(results) | {
            "time/step_s": seconds / len(results),
            "time/data_wait_s": self.wait_s / len(results),
            "time/samples_per_s": len(results) * self.samples / seconds,
        }
        if peak := peak_flops(jax.devices()[0].device_kind):
            values["time/mfu"] = len(results) * self.flops / seconds / (peak * jax.device_count())
        if used := (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use"):
            values["memory/peak_gb"] = used / 1e9
        self.results, self.wait_s, self.since = [], 0.0, time.perf_counter()
        return values

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Leave out what is not training."""
        begin = time.perf_counter()
        yield
        self.since += time.perf_counter() - begin


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


class StopSignal:
    """Notes SIGTERM and SIGINT, so that the run saves before it ends."""

    def __init__(self) -> None:
        self.received = False
        self.before = {number: signal.signal(number, self._note) for number in (signal.SIGTERM, signal.SIGINT)}

    def _note(self, number: int, frame: Any) -> None:
        self.received = True

    def agreed(self) -> bool:
        """Whether any process was asked to stop; all processes must ask at the same step."""
        if jax.process_count() == 1:
            return self.received
        return bool(np.any(multihost_utils.process_allgather(np.asarray(self.received))))

    def release(self) -> None:
        """Give the signals back to who had them."""
        for number, handler in self.before.items():
            signal.signal(number, handler)


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
    compile_cache()
    if not train(experiment, resume=args.resume, overwrite=args.overwrite, ignore_memory=args.ignore_memory):
        sys.exit(STOPPED)


def print_estimate(experiment: Experiment, devices: int, memory_gb: float | None) -> None:
    """The memory of a run on devices that need not be there, with the arithmetic."""
    if devices < 1:
        raise ConfigError(f"--devices is {devices}; expected at least one.")
    _, fsdp = mesh_shape(experiment.mesh, devices)
    check_batch(experiment.train.batch, experiment.train.accumulate, devices)
    memory = estimate_memory(experiment, devices, fsdp)
    print(memory.table())
    if memory_gb:
        print(f"{'fits' if memory.total < memory_gb * 1e9 else 'does not fit'} in {memory_gb:g} GB a device")


def train(experiment: Experiment, *, resume: bool = False, overwrite: bool = False, ignore_memory: bool = False) -> bool:
    """Train an experiment to its last step, from the start or from its latest checkpoint; returns whether it came there."""
    # Everything that can be missing or too small is found before a run folder is made.
    mesh = make_mesh(experiment.mesh)
    check_batch(experiment.train.batch, experiment.train.accumulate, mesh.size)
    check_network(experiment)
    source, codec = open_data(experiment)
    check_samples(experiment)
    experiment, asked = with_steps(experiment, source.fresh), experiment
    check_memory(estimate_memory(experiment, mesh.size, mesh.shape["fsdp"]), ignore=ignore_memory)
    begin_run(asked, codec, resume=resume, overwrite=overwrite)
    source.scales = dict(run_scales(experiment, source.scales))

    # State: step 0, or where the run was left.
    settings = experiment.train
    rows = process_samples(mesh, settings.batch)
    batches = iter(make_dataset(source, settings.batch, settings.seed, experiment.adapt.replay, rows))
    with open_checkpoints(experiment.out, settings.keep_checkpoints) as checkpoints:  # what is being written is finished
        if checkpoints.latest_step() is None:
            graph, state = init_train_state(experiment, mesh, start_params(experiment, mesh))
        else:
            graph, state, position = left_state(experiment, mesh, checkpoints)
            batches.set_state(position)
        return run_steps(experiment, Run(mesh, codec, graph, checkpoints), state, batches)


class Run(NamedTuple):
    """What stays the same over the steps of a run."""

    mesh: Mesh
    codec: Codec
    graph: nnx.GraphDef
    checkpoints: Any


def run_steps(experiment: Experiment, run: Run, state: TrainState, batches: Any) -> bool:
    """From the given state to the last step; logs, saves and draws samples as the settings say.

    Args:
        batches: an iterator of this process's batches, with its position.

    Returns:
        Whether the last step was reached; where a signal asked to stop before, what was reached is saved.
    """
    settings, train_step = experiment.train, make_train_step(experiment, run.graph, run.mesh, run.codec)
    begin = int(state.step)
    log = RunLog(experiment.out, begin) if jax.process_index() == 0 else None
    stop, schedule = StopSignal(), learning_rate(settings)
    meter = Meter(flops_of_step(experiment), settings.batch)
    progress = tqdm(range(begin, settings.steps), desc="train", initial=begin, total=settings.steps, file=sys.stderr)
    for step in (number + 1 for number in progress):
        asking = time.perf_counter()
        batch = place_batch(next(batches), run.mesh)
        wait_s = time.perf_counter() - asking
        state, result = train_step(state, batch)
        meter.add(result, wait_s)
        last = step == settings.steps
        logs = step % settings.log_every == 0 or last
        stops = (logs or jax.process_count() == 1) and stop.agreed()
        saves = step % settings.save_every == 0 or last or stops
        if logs or saves:
            meter.demand_finite()
        if logs:
            values = meter.take() | {"train/learning_rate": float(schedule(step - 1))}
            progress.set_postfix(loss=f"{values['train/loss']:.4f}")
            if log:
                log.scalars(step, values)
            stops = stops or stop.agreed()
        if saves or stops:
            save_state(run.checkpoints, state, batches.get_state())
        if stops and not last:  # whoever asked will not wait for samples
            progress.write(f"stopped at step {step} of {settings.steps} and saved; continue with --resume", file=sys.stderr)
            break
        if settings.sample_every and (step % settings.sample_every == 0 or last):
            with meter.paused():
                draw_samples(log, experiment, run, state, step)
    stop.release()
    if log:
        log.close()
    return int(state.step) >= settings.steps


def check_network(experiment: Experiment) -> None:
    """Raises ConfigError if the network cannot be computed here as asked, or its published weights do not fit."""
    settings = experiment.model
    choose_attention(settings.attention, experiment.size.head_dim, jnp.dtype(settings.dtype))
    if settings.weights is not None:
        check_dit(nnx.eval_shape(lambda: create_model(experiment)), settings.weights)


def open_data(experiment: Experiment) -> tuple[ClipSource, Codec]:
    """The training samples and the codec that made them. Raises ConfigError if any of it is missing or stale."""
    if experiment.adapt.start_from is not None:
        check_start(experiment)
    episodes = training_episodes(experiment)
    codec = load_codec(experiment, episodes)
    source = ClipSource(LatentCache(experiment, codec), episodes, replay_episodes(experiment))
    source.check()
    return source, codec


def begin_run(experiment: Experiment, codec: Codec, *, resume: bool, overwrite: bool) -> None:
    """Make the run folder ready, by the first process; the others wait for it."""
    if jax.process_index() == 0:
        prepare_run(experiment, codec, resume=resume, overwrite=overwrite)
        if experiment.adapt.start_from is not None and not (resume and (experiment.out / START).exists()):
            note_start(experiment)
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("run folder")


def run_scales(experiment: Experiment, found: Mapping[str, Scale]) -> Mapping[str, Scale]:
    """The scales of numbers that the run was begun with; those found in the data if it is new."""
    path = experiment.out / SCALES
    if found and not path.exists() and jax.process_index() == 0:
        save_scales(path, found)
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("scales")
    return load_run_scales(experiment, experiment.out)


def start_params(experiment: Experiment, mesh: Mesh) -> Any:
    """What step 0 begins with, placed on the mesh: those of the run to adapt, published weights, or None for random ones."""
    if experiment.adapt.start_from is not None:
        return restore_start(experiment, network_shapes(experiment, mesh))
    if experiment.model.weights is not None:
        return load_dit_params(*random_params(experiment, mesh), experiment.model.weights)
    return None


def network_shapes(experiment: Experiment, mesh: Mesh) -> Any:
    """Shapes and places of the network's parameters."""
    state = abstract_state(experiment)[1]
    return placed(state.params if state.base is None else state.base, mesh)


def placed(shapes: Any, mesh: Mesh) -> Any:
    """Shapes with their places on the mesh."""
    return jax.tree.map(
        lambda leaf, place: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place), shapes, state_shardings(shapes, mesh)
    )


def left_state(experiment: Experiment, mesh: Mesh, checkpoints: Any) -> tuple[nnx.GraphDef, TrainState, dict[str, Any]]:
    """Structure, state and data position at the latest checkpoint, whatever mesh it was saved from."""
    graph, shapes = abstract_state(experiment)
    base = start_params(experiment, mesh) if experiment.adapt.lora_rank else None
    state, position = restore_state(checkpoints, placed(shapes, mesh))
    return graph, replace(state, base=base), position


def draw_samples(log: RunLog | None, experiment: Experiment, run: Run, state: TrainState, step: int) -> None:
    """Predict clips of seen and unseen robots beside the truth."""
    with jax.set_mesh(run.mesh):
        params = jax.jit(apply_lora)(state.base, state.params if state.ema is None else state.ema)
    scales = load_run_scales(experiment, experiment.out)
    log_samples(log, Predictor(experiment, run.codec, run.graph, params, scales), step)


if __name__ == "__main__":
    main()

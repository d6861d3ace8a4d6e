"""Training: the latent cache to checkpoints.

Reads  the latent cache
Writes <out>: config, checkpoints, metrics.jsonl, TensorBoard curves and sample videos
Command: python -m xew.model.train CONFIG [--resume | --overwrite] [--train.steps … and other overrides]
"""

import argparse
import functools
import itertools
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from tqdm import tqdm

from xew.config import user_errors
from xew.model.checkpoint import TrainState, open_checkpoints, prepare_run, restore_state, save_state
from xew.model.data import Batch, ClipSource, make_dataset
from xew.model.experiment import Experiment, TrainSettings, compile_cache, create_model, load_experiment
from xew.model.flow_matching import sample_losses, training_pair
from xew.model.latents import LatentCache, load_codec, training_episodes
from xew.model.rollout import Predictor
from xew.model.samples import log_samples
from xew.model.tensorboard import RunLog

NOISE_LEVEL_EDGES = (0.0, 0.5, 0.8, 0.95, 1.0)
"""Bins of the noise level in which the loss is shown apart."""


class StepResult(NamedTuple):
    """What one training step reports."""

    losses: jax.Array
    """[b], one for each sample."""
    sigma: jax.Array
    """[b], their noise levels."""
    gradient_norm: jax.Array
    """Global norm before clipping."""


def make_optimizer(settings: TrainSettings) -> optax.GradientTransformation:
    """AdamW with clipping, optional warm-up and cosine decay."""
    decay = optax.cosine_decay_schedule(settings.learning_rate, max(settings.steps, 1), alpha=settings.decay_to)
    constant = optax.constant_schedule(settings.learning_rate)
    schedule = constant if settings.decay_to == 1 else decay
    if settings.warmup_steps:
        warmup = optax.linear_schedule(0.0, settings.learning_rate, settings.warmup_steps)
        schedule = optax.join_schedules([warmup, schedule], [settings.warmup_steps])
    return optax.chain(optax.clip_by_global_norm(settings.clip_norm), optax.adamw(schedule, weight_decay=settings.weight_decay))


def init_train_state(experiment: Experiment, optimizer: optax.GradientTransformation) -> tuple[nnx.GraphDef, TrainState]:
    """The network's structure and the state of step 0."""
    graph = nnx.split(nnx.eval_shape(lambda: create_model(experiment)), nnx.Param)[0]

    @jax.jit
    def init() -> TrainState:
        params = nnx.state(create_model(experiment), nnx.Param)
        ema = jax.tree.map(jnp.copy, params) if experiment.train.ema_decay else None
        return TrainState(jnp.int32(0), params, optimizer.init(params), ema)

    return graph, init()


def make_train_step(
    graph: nnx.GraphDef, optimizer: optax.GradientTransformation, settings: TrainSettings
) -> Callable[[TrainState, Batch], tuple[TrainState, StepResult]]:
    """The compiled step; its noise depends on the seed and the step only, so that a resumed run repeats it."""

    @functools.partial(jax.jit, donate_argnums=0)
    def train_step(state: TrainState, batch: Batch) -> tuple[TrainState, StepResult]:
        key = jax.random.fold_in(jax.random.key(settings.seed), state.step)
        pair = training_pair(key, batch.latents, settings.shift)

        def loss(params: Any) -> tuple[jax.Array, jax.Array]:
            predicted = nnx.merge(graph, params)(pair.noisy, batch.conditions, pair.sigma, batch.text)
            losses = sample_losses(predicted, pair)
            return losses.mean(), losses

        (_, losses), gradients = jax.value_and_grad(loss, has_aux=True)(state.params)
        updates, optimizer_state = optimizer.update(gradients, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        ema = None if state.ema is None else optax.incremental_update(params, state.ema, 1 - settings.ema_decay)
        result = StepResult(losses, pair.sigma, optax.tree.norm(gradients))
        return TrainState(state.step + 1, params, optimizer_state, ema), result

    return train_step


def summarise(results: Sequence[StepResult], seconds: float) -> dict[str, float]:
    """Means since the last log line: loss, loss by noise level, gradient norm, step time."""
    losses, sigma, norms = (np.concatenate([np.atleast_1d(part) for part in parts]) for parts in zip(*results, strict=True))
    values = {"train/loss": losses.mean(), "train/gradient_norm": norms.mean(), "train/step_s": seconds / len(results)}
    for low, high in itertools.pairwise(NOISE_LEVEL_EDGES):
        inside = (sigma > low) & (sigma <= high)
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
    args, overrides = parser.parse_known_args(arguments)
    experiment = load_experiment(args.config, overrides)
    compile_cache()
    train(experiment, resume=args.resume, overwrite=args.overwrite)


def train(experiment: Experiment, *, resume: bool = False, overwrite: bool = False) -> None:
    """Train an experiment to its last step, from the start or from its latest checkpoint."""
    settings = experiment.train

    # Data: everything that can be missing is found before a run folder is made.
    episodes = training_episodes(experiment)
    codec = load_codec(experiment, episodes)
    source = ClipSource(LatentCache(experiment, codec), episodes)
    source.check()
    prepare_run(experiment, codec, resume=resume, overwrite=overwrite)
    position = iter(make_dataset(source, settings.batch, settings.seed))

    # State: step 0, or where the run was left.
    optimizer = make_optimizer(settings)
    graph, state = init_train_state(experiment, optimizer)
    checkpoints = open_checkpoints(experiment.out, settings.keep_checkpoints)
    if checkpoints.latest_step() is not None:
        state, data_position = restore_state(checkpoints, state)
        position.set_state(data_position)
    train_step = make_train_step(graph, optimizer, settings)

    # Steps.
    log, stop, results, since = RunLog(experiment.out), StopSignal(), [], time.perf_counter()
    begin = int(state.step)
    progress = tqdm(range(begin, settings.steps), desc="train", initial=begin, total=settings.steps, file=sys.stderr)
    for step in (number + 1 for number in progress):
        state, result = train_step(state, next(position))
        results.append(result)
        if step % settings.log_every == 0 or step == settings.steps:
            values = summarise(jax.device_get(results), time.perf_counter() - since)
            log.scalars(step, values)
            progress.set_postfix(loss=f"{values['train/loss']:.4f}")
            if not np.isfinite(values["train/loss"]):
                sys.exit(
                    f"error: the loss is not finite at step {step}; --resume returns to the last checkpoint, or lower the rate."
                )
            results, since = [], time.perf_counter()
        if step % settings.save_every == 0 or step == settings.steps or stop.received:
            save_state(checkpoints, state, position.get_state())
        if step % settings.sample_every == 0 or step == settings.steps:
            predictor = Predictor(experiment, codec, graph, state.params if state.ema is None else state.ema)
            log_samples(log, predictor, step)
            since = time.perf_counter()
        if stop.received:
            print(f"stopped at step {step} and saved; continue with --resume", file=sys.stderr)
            break
    stop.release()
    log.close()
    checkpoints.close()


if __name__ == "__main__":
    main()

"""The optimizer: AdamW with clipping, as in the paper (its section on optimization), and how many steps a run takes."""

import math
from dataclasses import replace

import jax.numpy as jnp
import optax

from xew.model.experiment import Experiment, TrainSettings, replayed


def learning_rate(settings: TrainSettings) -> optax.Schedule:
    """Step -> learning rate: optional warm-up, then constant or decaying by a cosine."""
    decaying = max(settings.steps - settings.warmup_steps, 1)
    decay = optax.cosine_decay_schedule(settings.learning_rate, decaying, alpha=settings.decay_to)
    schedule = optax.constant_schedule(settings.learning_rate) if settings.decay_to == 1 else decay
    if settings.warmup_steps:
        warmup = optax.linear_schedule(0.0, settings.learning_rate, settings.warmup_steps)
        schedule = optax.join_schedules([warmup, schedule], [settings.warmup_steps])
    return schedule


def make_optimizer(settings: TrainSettings) -> optax.GradientTransformation:
    """AdamW after clipping by the global norm; moments in float32, the first in `mu_dtype`."""
    adamw = optax.adamw(learning_rate(settings), weight_decay=settings.weight_decay, mu_dtype=jnp.dtype(settings.mu_dtype))
    return optax.chain(optax.clip_by_global_norm(settings.clip_norm), adamw)


def with_steps(experiment: Experiment, samples: int) -> Experiment:
    """The same experiment with `train.steps` set to its `train.epochs` passes over `samples` new (not replayed) samples."""
    settings = experiment.train
    if not settings.epochs:
        return experiment
    fresh = settings.batch - replayed(settings.batch, experiment.adapt.replay)
    steps = max(1, math.ceil(settings.epochs * samples / fresh))
    return replace(experiment, train=replace(settings, steps=steps))

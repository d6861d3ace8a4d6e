"""The optimizer: AdamW with clipping, as in the paper (its section on optimization), and how many steps a run takes."""

import math
from dataclasses import replace

import jax.numpy as jnp
import optax

from xew.model.settings.settings import TrainSettings, count_replayed


def learning_rate(settings: TrainSettings) -> optax.Schedule:
    """Make the schedule, step -> learning rate: optional warm-up, then constant or decaying by a cosine."""
    decaying = max(settings.steps - settings.warmup_steps, 1)
    decay = optax.cosine_decay_schedule(settings.learning_rate, decaying, alpha=settings.decay_to)
    schedule = optax.constant_schedule(settings.learning_rate) if settings.decay_to == 1 else decay
    if settings.warmup_steps:
        warmup = optax.linear_schedule(0.0, settings.learning_rate, settings.warmup_steps)
        schedule = optax.join_schedules([warmup, schedule], [settings.warmup_steps])
    return schedule


def make_optimizer(settings: TrainSettings) -> optax.GradientTransformation:
    """Make AdamW after clipping by the global norm; moments in float32, the first in `mu_dtype`."""
    adamw = optax.adamw(learning_rate(settings), weight_decay=settings.weight_decay, mu_dtype=jnp.dtype(settings.mu_dtype))
    return optax.chain(optax.clip_by_global_norm(settings.clip_norm), adamw)


def set_steps(settings: TrainSettings, samples: int, replay: float = 0.0) -> TrainSettings:
    """The same settings with `steps` set to their `epochs` passes over `samples` new (not replayed) samples."""
    if not settings.epochs:
        return settings
    fresh = settings.batch - count_replayed(settings.batch, replay)
    return replace(settings, steps=max(1, math.ceil(settings.epochs * samples / fresh)))

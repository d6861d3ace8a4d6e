"""The optimizer (AdamW with clipping as in the paper's section on optimization, or Muon) and the number of steps."""

import math
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.typing import DTypeLike
from optax.contrib import MuonDimensionNumbers, muon

from xew.model.devices.sharding import path_names
from xew.model.settings.settings import TrainSettings, count_replayed

WEIGHT_DECAY = 0.01
"""Weight decay, as in the paper."""
CLIP_NORM = 1.0
"""Largest global norm of the gradients; larger ones are scaled down to it."""


def learning_rate(settings: TrainSettings) -> optax.Schedule:
    """Learning-rate schedule: optional warm-up, then constant or cosine decay."""
    decaying = max(settings.steps - settings.warmup_steps, 1)
    decay = optax.cosine_decay_schedule(settings.learning_rate, decaying, alpha=settings.decay_to)
    schedule = optax.constant_schedule(settings.learning_rate) if settings.decay_to == 1 else decay
    if settings.warmup_steps:
        warmup = optax.linear_schedule(0.0, settings.learning_rate, settings.warmup_steps)
        schedule = optax.join_schedules([warmup, schedule], [settings.warmup_steps])
    return schedule


RMS_OF_ADAM = 0.2
"""Root mean square of Muon's updates relative to the learning rate, as of AdamW's (Moonlight, Liu et al. 2025,
arXiv:2502.16982, equation 4)."""
ADAM_SHARE = 0.25
"""Learning rate of AdamW's parameters beside Muon, relative to Muon's. At equal rates, with second moments of 1,000 steps, the
loss on 25 tasks jumped back to where it began in two of two runs (docs/results/all_tasks)."""
ADAM_B2 = 0.95
"""Decay of AdamW's second moments beside Muon: they reach over 20 steps, so a burst of gradients makes no large steps."""


def make_optimizer(settings: TrainSettings) -> optax.GradientTransformation:
    """Make the optimizer of `train.optimizer` after clipping by the global norm; the first moments are in `mu_dtype`.

    Muon orthogonalizes its updates in that type too; its author uses bfloat16 (Jordan 2024).
    """
    rate, mu_dtype = learning_rate(settings), jnp.dtype(settings.mu_dtype)
    if settings.optimizer == "muon":
        update = muon(
            rate,
            weight_decay=WEIGHT_DECAY,
            adam_learning_rate=lambda step: ADAM_SHARE * rate(step),
            adam_b2=ADAM_B2,
            adam_weight_decay=WEIGHT_DECAY,
            mu_dtype=mu_dtype,
            consistent_rms=RMS_OF_ADAM,
            muon_weight_dimension_numbers=find_matrices,
        )
        if mu_dtype != jnp.float32:
            update = optax.chain(round_matrices(mu_dtype), update)
    else:
        update = optax.adamw(rate, weight_decay=WEIGHT_DECAY, mu_dtype=mu_dtype)
    return optax.chain(optax.clip_by_global_norm(CLIP_NORM), update)


def round_matrices(dtype: DTypeLike) -> optax.GradientTransformation:
    """Cast the gradients of `find_matrices`, because optax's Muon computes in the type of its gradients and moments."""

    def rounded(updates: Any, params: Any) -> Any:
        axes = find_matrices(updates)
        return jax.tree.map(lambda update, axis: update if axis is None else update.astype(dtype), updates, axes)

    return optax.stateless(rounded)


def find_matrices(params: Any) -> Any:
    """Axes for Muon of the blocks' stacked matrices [layers in out] in the tree of parameters, None for AdamW's parameters.

    AdamW optimizes embeddings, the head, norms and modulations, as Muon's author advises (Jordan 2024).
    """

    def axes(path: tuple[Any, ...], leaf: Any) -> MuonDimensionNumbers | None:
        names = path_names(path)
        is_matrix = leaf.ndim == 3 and names[0] == "blocks" and names[-1] == "kernel"
        return MuonDimensionNumbers(1, 2) if is_matrix else None

    return jax.tree_util.tree_map_with_path(axes, params)


def average_decay(settings: TrainSettings) -> float:
    """Decay of the moving average over the fraction `train.ema` of the run's steps."""
    return 1 - 1 / max(settings.ema * settings.steps, 1)


def set_steps(settings: TrainSettings, samples: int, replay: float = 0.0) -> TrainSettings:
    """The settings with `steps` set to `epochs` passes over `samples` fresh samples."""
    if not settings.epochs:
        return settings
    fresh = settings.batch - count_replayed(settings.batch, replay)
    return replace(settings, steps=max(1, math.ceil(settings.epochs * samples / fresh)))

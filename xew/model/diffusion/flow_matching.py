"""Flow matching: noise levels, the training pair and the RGB loss. (samplers.py goes the way back.)

x_sigma = (1 - sigma) x_0 + sigma n; the network predicts the velocity n - x_0. Latent frame 0 is the given reference:
clean in training (up to a small perturbation), put back after every sampling step, and never in the loss.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

TRAIN_LEVELS = 1000
REFERENCE_NOISE = 0.1
"""Upper end of the uniform strength of the perturbation that the reference latent gets in training (FlowWAM)."""


class TrainingPair(NamedTuple):
    """What one training example asks of the network."""

    noisy: Array
    """[b t h w c], latent frame 0 the perturbed reference."""
    velocity: Array
    """[b t h w c], the target."""
    sigma: Array
    """[b], noise level of latent frames 1 and on."""


def shift_sigma(sigma: np.ndarray, shift: float) -> np.ndarray:
    """Move noise levels towards 1: s u / (1 + (s - 1) u)."""
    return shift * sigma / (1 + (shift - 1) * sigma)


def sampling_sigmas(steps: int, shift: float) -> np.ndarray:
    """`steps` + 1 levels from 1 to 0 on the grid of DiffSynth and FlowWAM (float64)."""
    return np.append(shift_sigma(np.linspace(1, 0, steps + 1)[:-1], shift), 0.0)


def training_pair(key: Array, latents: Array, shift: float) -> TrainingPair:
    """Noise latents [b t h w c]: level uniform over the shifted grid of 1000, perturbed reference in frame 0."""
    key_level, key_noise, key_strength, key_reference = jax.random.split(key, 4)
    batch = latents.shape[0]
    levels = jnp.asarray(sampling_sigmas(TRAIN_LEVELS, shift)[:-1], jnp.float32)
    sigma = levels[jax.random.randint(key_level, (batch,), 0, TRAIN_LEVELS)]
    noise = jax.random.normal(key_noise, latents.shape, jnp.float32)
    strength = jax.random.uniform(key_strength, (batch, 1, 1, 1, 1), maxval=REFERENCE_NOISE)
    reference = latents[:, :1] + strength * jax.random.normal(key_reference, latents[:, :1].shape, jnp.float32)
    level = sigma[:, None, None, None, None]
    noisy = (1 - level) * latents + level * noise
    return TrainingPair(jnp.concatenate([reference, noisy[:, 1:]], axis=1), noise - latents, sigma)


def sample_losses(predicted: Array, pair: TrainingPair, shown: Array | None = None) -> Array:
    """Mean squared velocity error [b] over latent frames 1 and on, of those that show the episode [b t] (else all)."""
    errors = jnp.square(predicted[:, 1:] - pair.velocity[:, 1:]).mean(axis=(2, 3, 4))
    if shown is None:
        return errors.mean(axis=1)
    return (errors * shown[:, 1:]).sum(axis=1) / jnp.maximum(shown[:, 1:].sum(axis=1), 1)

"""Flow matching: noise levels, the training pair and the RGB loss; samplers.py integrates the velocity.

x_sigma = (1 - sigma) x_0 + sigma n; the network predicts the velocity n - x_0. Latent frame 0 is the given reference: slightly
perturbed in training, restored after every sampling step, and never in the loss.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Key, Num

TRAIN_LEVELS = 1000
"""Number of noise levels that training draws from."""
REFERENCE_NOISE = 0.1
"""Largest standard deviation of the noise on the reference latent in training; it is drawn uniformly (FlowWAM)."""
GUESS_SPREAD = 0.7
"""Standard deviation of clean latents around the guess of a residual; measured 0.67 around the pasted render."""


class TrainingPair(NamedTuple):
    """Input and target of the network for a batch."""

    noisy: Float[Array, "b t h w c"]
    """Noisy latents [b t h w c] float32, whose latent frame 0 is the perturbed reference."""
    velocity: Float[Array, "b t h w c"]
    """Target [b t h w c] float32."""
    sigma: Float[Array, " b"]
    """Noise level [b] float32 of latent frames from 1 on."""


def put_first(latents: Float[Array, "b t h w c"], reference: Float[Array, "b 1 h w c"]) -> Float[Array, "b t h w c"]:
    """Replace the first frame of latents [b t h w c] by the given one [b 1 h w c]."""
    return jnp.concatenate([reference, latents[:, 1:]], axis=1)


def training_pair(key: Key[Array, ""], latents: Float[Array, "b t h w c"], shift: float) -> TrainingPair:
    """Noisy latents with a perturbed reference, and their velocity, at a random level for each sample.

    Args:
        key: of the random numbers.
        latents: [b t h w c] float32, clean.
        shift: of the `TRAIN_LEVELS` levels, which are drawn uniformly, toward noise.
    """
    key_level, key_noise, key_strength, key_reference = jax.random.split(key, 4)
    batch = latents.shape[0]
    levels = jnp.asarray(sampling_sigmas(TRAIN_LEVELS, shift)[:-1], jnp.float32)
    sigma = levels[jax.random.randint(key_level, (batch,), 0, TRAIN_LEVELS)]
    noise = jax.random.normal(key_noise, latents.shape, jnp.float32)
    strength = jax.random.uniform(key_strength, (batch, 1, 1, 1, 1), maxval=REFERENCE_NOISE)
    reference = latents[:, :1] + strength * jax.random.normal(key_reference, latents[:, :1].shape, jnp.float32)
    level, latents = sigma[:, None, None, None, None], put_first(latents, reference)
    noisy = (1 - level) * latents + level * noise
    return TrainingPair(put_first(noisy, reference), noise - latents, sigma)


def motion_weights(latents: Float[Array, "b t h w c"], strength: float) -> Float[Array, "b t h w"]:
    """Weights [b t h w] of positions in the loss, of mean 1: up to 1 + `strength` where clean latents [b t h w c] differ from
    the first frame, relative to positions that do not.
    """
    change = jnp.square(latents - latents[:, :1]).mean(axis=-1)
    weights = 1 + strength * change / (change + GUESS_SPREAD**2)
    return weights / weights[:, 1:].mean(axis=(1, 2, 3), keepdims=True)


def sample_losses(
    predicted: Float[Array, "b t h w c"],
    pair: TrainingPair,
    valid: Num[Array, "b t"] | None = None,
    weights: Float[Array, "b t h w"] | None = None,
) -> Float[Array, " b"]:
    """Mean squared error [b] float32 of the velocity of each sample, over latent frames from 1 on; 0 if no frame is valid.

    Args:
        predicted: [b t h w c] float32, velocity.
        pair: input and target.
        valid: [b t] float32, 1 for latent frames of the episode and 0 past its end; by default all 1.
        weights: [b t h w] of positions, as from `motion_weights`; by default all 1.
    """
    squares = jnp.square(predicted[:, 1:] - pair.velocity[:, 1:]).mean(axis=4)
    errors = (squares if weights is None else weights[:, 1:] * squares).mean(axis=(2, 3))
    if valid is None:
        return errors.mean(axis=1)
    return (errors * valid[:, 1:]).sum(axis=1) / jnp.maximum(valid[:, 1:].sum(axis=1), 1)


def sampling_sigmas(steps: int, shift: float) -> Float[np.ndarray, " levels"]:
    """Noise levels [steps + 1] float64 from 1 to 0, in the schedule of DiffSynth and FlowWAM."""
    return np.append(shift_sigma(np.linspace(1, 0, steps + 1)[:-1], shift), 0.0)


def shift_sigma(sigma: Float[np.ndarray, "*n"], shift: float) -> Float[np.ndarray, "*n"]:
    """Shift noise levels [...] float64 toward 1: s u / (1 + (s - 1) u)."""
    return shift * sigma / (1 + (shift - 1) * sigma)


def velocity_of_residual(
    residual: Float[Array, "b t h w c"],
    noisy: Float[Array, "b t h w c"],
    sigma: Float[Array, " b"],
    guess: Float[Array, "b k h w c"],
) -> Float[Array, "b t h w c"]:
    """Velocity [b t h w c] from the residual of the best linear estimate of the clean latents.

    The estimate assumes latents normally distributed around a guess with the standard deviation `GUESS_SPREAD`; the residual
    then has variance 1 at every level. This is the preconditioning of Karras et al. 2022 (arXiv 2206.00364, section 5) for
    flow matching with a mean.

    Args:
        residual: [b t h w c] output of the network.
        noisy: [b t h w c] noisy latents.
        sigma: [b] their noise levels.
        guess: [b k h w c] with k = t, or k = 1 for a still guess.
    """
    level, variance = sigma[:, None, None, None, None], GUESS_SPREAD**2
    seen = (1 - level) ** 2 * variance + level**2
    offset = noisy - (1 - level) * guess
    return offset * (level - (1 - level) * variance) / seen - guess - GUESS_SPREAD / jnp.sqrt(seen) * residual

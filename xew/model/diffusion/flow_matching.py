"""Flow matching: noise levels, the training pair and the RGB loss; samplers.py integrates what the network learns.

x_sigma = (1 - sigma) x_0 + sigma n; the network predicts the velocity n - x_0. Latent frame 0 is the given reference:
clean in training but for a small perturbation, put back after every sampling step, and never in the loss.
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
"""Largest standard deviation of the noise that perturbs the reference latent in training; it is drawn uniformly (FlowWAM)."""
GUESS_SPREAD = 0.7
"""Standard deviation of latents round the guess that a prediction of residuals begins with. Of standardized latents of 18
episodes it is .67 round the pasted render and 1.0 round the first frame."""


class TrainingPair(NamedTuple):
    """What one training example asks of the network."""

    noisy: Float[Array, "b t h w c"]
    """Noisy latents [b t h w c] float32, whose latent frame 0 is the perturbed reference."""
    velocity: Float[Array, "b t h w c"]
    """Target [b t h w c] float32."""
    sigma: Float[Array, " b"]
    """Noise level [b] float32 of latent frames 1 and on."""


def put_first(latents: Float[Array, "b t h w c"], reference: Float[Array, "b 1 h w c"]) -> Float[Array, "b t h w c"]:
    """Latents [b t h w c] whose first frame is replaced by the given one [b 1 h w c]."""
    return jnp.concatenate([reference, latents[:, 1:]], axis=1)


def training_pair(key: Key[Array, ""], latents: Float[Array, "b t h w c"], shift: float) -> TrainingPair:
    """Noisy latents and their velocity, at a level drawn for each sample.

    The reference, latent frame 0, is perturbed.

    Args:
        key: of the random numbers.
        latents: [b t h w c] float32, clean.
        shift: moves the `TRAIN_LEVELS` levels, which are drawn uniformly, toward noise.
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
    """Weights [b t h w] of places in the loss: a moving place weighs up to 1 + `strength` times a still one; mean 1.

    Args:
        latents: [b t h w c], clean and of variance 1; a place moves as far as it differs from the first frame.
        strength: 0 weighs all places alike.
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
    """Mean squared error of the velocity of each sample, over latent frames 1 and on.

    Args:
        predicted: [b t h w c] float32, velocity.
        pair: what it was predicted for.
        valid: [b t] float32, 1 for latent frames that show the episode and 0 past its end; all count if left out.
        weights: [b t h w] of places, as from `motion_weights`; all weigh alike if left out.

    Returns:
        [b] float32; 0 where no frame counts.
    """
    places = jnp.square(predicted[:, 1:] - pair.velocity[:, 1:]).mean(axis=4)
    errors = (places if weights is None else weights[:, 1:] * places).mean(axis=(2, 3))
    if valid is None:
        return errors.mean(axis=1)
    return (errors * valid[:, 1:]).sum(axis=1) / jnp.maximum(valid[:, 1:].sum(axis=1), 1)


def sampling_sigmas(steps: int, shift: float) -> Float[np.ndarray, " levels"]:
    """Noise levels [steps + 1] float64 from 1 to 0, in the schedule of DiffSynth and FlowWAM."""
    return np.append(shift_sigma(np.linspace(1, 0, steps + 1)[:-1], shift), 0.0)


def shift_sigma(sigma: Float[np.ndarray, "*n"], shift: float) -> Float[np.ndarray, "*n"]:
    """Noise levels [...] float64 moved toward 1: s u / (1 + (s - 1) u)."""
    return shift * sigma / (1 + (shift - 1) * sigma)


def velocity_of_residual(
    residual: Float[Array, "b t h w c"],
    noisy: Float[Array, "b t h w c"],
    sigma: Float[Array, " b"],
    guess: Float[Array, "b k h w c"],
) -> Float[Array, "b t h w c"]:
    """Velocity [b t h w c] of what is left of clean latents behind their best linear estimate.

    The estimate is the best linear one of latents that are normally distributed round a guess, with the standard deviation
    `GUESS_SPREAD`, from noisy ones. A residual of 0 is that estimate (at level 1 the guess itself), and of such latents it
    has the variance 1 at every level: the preconditioning of Karras et al. 2022 (arXiv 2206.00364, section 5), for flow
    matching and with a mean.

    Args:
        residual: [b t h w c] what the network computes.
        noisy: [b t h w c] noisy latents.
        sigma: [b] their noise levels.
        guess: [b k h w c] with k = t, or k = 1 where it stands still.
    """
    level, variance = sigma[:, None, None, None, None], GUESS_SPREAD**2
    seen = (1 - level) ** 2 * variance + level**2
    offset = noisy - (1 - level) * guess
    return offset * (level - (1 - level) * variance) / seen - guess - GUESS_SPREAD / jnp.sqrt(seen) * residual

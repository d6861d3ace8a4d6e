"""Noise levels and training pairs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.networks import normal
from xew.model.diffusion import flow_matching as fm

SHAPE = (64, 3, 2, 2, 4)


@pytest.fixture(scope="module")
def latents() -> jax.Array:
    return jax.random.normal(jax.random.key(0), SHAPE, jnp.float32)


def test_grid_is_that_of_diffsynth_and_flowwam() -> None:
    """50 steps, shift 5: the third of the four grids in circulation."""
    sigmas = fm.sampling_sigmas(50, 5.0)
    assert len(sigmas) == 51 and sigmas[-1] == 0
    np.testing.assert_allclose(sigmas[:3], [1.0, 0.99593, 0.99174], atol=6e-6)
    np.testing.assert_allclose(sigmas[-3:-1], [0.17241, 0.09259], atol=6e-6)


@pytest.mark.parametrize(("shift", "mean", "above"), [(1, 0.50, 0.10), (3, 0.677, 0.25), (5, 0.748, 0.358), (8, 0.804, 0.471)])
def test_training_levels_are_distributed_as_published(shift: float, mean: float, above: float) -> None:
    levels = fm.sampling_sigmas(fm.TRAIN_LEVELS, shift)[:-1]
    assert levels.mean() == pytest.approx(mean, abs=2e-3)
    assert (levels > 0.9).mean() == pytest.approx(above, abs=2e-3)


def test_training_pair_obeys_its_definition(latents: jax.Array) -> None:
    pair = fm.training_pair(jax.random.key(1), latents, 5.0)
    sigma = pair.sigma[:, None, None, None, None]
    noise = pair.velocity + latents
    np.testing.assert_allclose(pair.noisy[:, 1:], ((1 - sigma) * latents + sigma * noise)[:, 1:], atol=1e-5)
    np.testing.assert_allclose((pair.noisy - sigma * pair.velocity)[:, 1:], latents[:, 1:], atol=1e-5)
    assert noise.std() == pytest.approx(1, abs=0.05)


def test_reference_is_perturbed_by_at_most_a_tenth(latents: jax.Array) -> None:
    pair = fm.training_pair(jax.random.key(1), jnp.tile(latents, (1, 1, 8, 8, 1)), 5.0)
    change = np.asarray(pair.noisy[:, 0] - jnp.tile(latents, (1, 1, 8, 8, 1))[:, 0])
    strength = change.std(axis=(1, 2, 3))
    assert 0 < strength.min() < 0.02 and 0.08 < strength.max() < 0.11


def test_loss_ignores_the_reference_frame(latents: jax.Array) -> None:
    pair = fm.training_pair(jax.random.key(1), latents, 5.0)
    wrong_reference = pair.velocity.at[:, 0].add(100.0)
    np.testing.assert_array_equal(fm.sample_losses(wrong_reference, pair), np.zeros(len(latents)))
    np.testing.assert_allclose(fm.sample_losses(pair.velocity + 2, pair), np.full(len(latents), 4.0), rtol=1e-5)


def test_what_moves_weighs_more() -> None:
    """A place that changes by far more than latents spread weighs 1 + 4 times one that stands still, and the mean is 1."""
    latents = np.zeros((1, 3, 2, 2, 5), np.float32)
    latents[:, 1:, 0, 0] = 1e3
    weights = fm.motion_weights(jnp.asarray(latents), 4.0)
    np.testing.assert_allclose(weights[:, 1:, 0, 0] / weights[:, 1:, 1, 1], 5, rtol=1e-5)
    np.testing.assert_allclose(weights[:, 1:].mean(), 1, rtol=1e-6)
    pair = fm.training_pair(jax.random.key(0), jnp.asarray(latents), 5.0)
    wrong = np.zeros(latents.shape, np.float32)
    wrong[:, :, 0, 0] = 1
    alike, weighed = (fm.sample_losses(pair.velocity + wrong, pair, weights=given) for given in (None, weights))
    np.testing.assert_allclose(weighed / alike, 5 / 2, rtol=1e-4)
    assert np.ptp(fm.motion_weights(jnp.asarray(latents), 0.0)) == 0


@pytest.mark.parametrize("guessed", [1, 4], ids=["that stands still", "that moves"])
def test_residuals_have_the_variance_one_at_every_level_and_give_the_velocity(guessed: int) -> None:
    """Of latents that are as far from the guess as is assumed; the residual is what their estimate leaves, and no more."""
    reference, spread, noise = (
        np.asarray(normal(seed, 6, frames, 64, 64, 1)) for seed, frames in ((1, guessed), (2, 4), (3, 4))
    )
    later, guess = reference + fm.GUESS_SPREAD * spread, jnp.asarray(reference)
    sigma = jnp.asarray([0.01, 0.2, 0.5, 0.8, 0.95, 1.0], jnp.float32)
    level = np.asarray(sigma)[:, None, None, None, None]
    noisy = jnp.asarray((1 - level) * later + level * noise)
    expected, moved = (fm.velocity_of_residual(jnp.full(noisy.shape, fill), noisy, sigma, guess) for fill in (0.0, 1.0))
    residual = (noise - later - expected) / (moved - expected)
    np.testing.assert_allclose(residual.std(axis=(1, 2, 3, 4)), np.ones(6), rtol=0.02)
    seen = np.asarray(noisy - (1 - level) * reference)
    assert np.abs((residual * seen).mean(axis=(1, 2, 3, 4))).max() < 0.03, "nothing linear is left to be guessed"
    still = fm.velocity_of_residual(jnp.zeros(noisy.shape), noisy, sigma, guess)[-1]
    np.testing.assert_allclose(noisy[-1] - still, np.broadcast_to(reference[-1], still.shape), atol=1e-5)

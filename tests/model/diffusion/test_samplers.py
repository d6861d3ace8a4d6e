"""Noise schedules against published numbers and live schedulers; samplers against the schedulers and exact answers."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import golden
from xew.model.diffusion.samplers import SAMPLERS, SCHEDULES, NoiseSchedule

SHAPE = (2, 3, 2, 2, 4)
PUBLISHED = {
    "flowwam": ([1.0, 0.99593, 0.99174], [0.17241, 0.09259, 0]),
    "wan_official": ([0.9998, 0.99573, 0.99153], [0.17227, 0.09251, 0]),
    "diffusers_unipc": ([1.0, 0.99594, 0.99174], [0.17597, 0.09678, 0]),
    "diffusers_euler": ([1.0], [0.1148, 0.0244, 0]),
}
TIMESTEPS = {"wan_official": ([999, 995, 991, 987], [92]), "diffusers_unipc": ([999, 995, 991, 987], [244, 175, 96])}


@pytest.mark.parametrize("name", SCHEDULES)
def test_schedule_has_the_published_levels(name: str) -> None:
    """50 steps, shift 5."""
    schedule = SCHEDULES[name](50, 5.0)
    first, last = PUBLISHED[name]
    assert schedule.steps == 50 and len(schedule.sigmas) == 51
    np.testing.assert_allclose(schedule.sigmas[: len(first)], first, atol=6e-6)
    np.testing.assert_allclose(schedule.sigmas[-len(last) :], last, atol=6e-5)
    assert (np.diff(schedule.sigmas) < 0).all()


@pytest.mark.parametrize("name", TIMESTEPS)
def test_whole_timesteps_are_the_published_ones(name: str) -> None:
    levels = np.array(SCHEDULES[name](50, 5.0).input_levels) * 1000
    first, last = TIMESTEPS[name]
    np.testing.assert_allclose(levels[: len(first)], first, atol=1e-9)
    np.testing.assert_allclose(levels[-len(last) :], last, atol=1e-9)


def toy_velocity(latents: jax.Array, input_level: jax.Array) -> jax.Array:
    """Smooth, curved, and different for every element, so that no step is exact."""
    level = input_level[:, None, None, None, None]
    return jnp.sin(1.3 * latents + 2 * level) + 0.5 * latents - 0.2


def sample(
    name: str, schedule: NoiseSchedule, velocity: Callable[[jax.Array, jax.Array], jax.Array] = toy_velocity
) -> np.ndarray:
    noise = jax.random.normal(jax.random.key(0), SHAPE, jnp.float32)
    return np.asarray(jax.jit(lambda: SAMPLERS[name](velocity, noise[:, :1] * 0.5, noise, schedule))())


def run_scheduler(scheduler: object, steps: int) -> dict[str, np.ndarray]:
    """Sigmas, timesteps and the sample of a diffusers scheduler on the same toy, with the same frame put back."""
    import torch

    scheduler.set_timesteps(steps)
    noise = np.asarray(jax.random.normal(jax.random.key(0), SHAPE, jnp.float32))
    reference = noise[:, :1] * 0.5
    latents = np.concatenate([reference, noise[:, 1:]], axis=1)
    for timestep in scheduler.timesteps:
        levels = jnp.full(SHAPE[0], float(timestep) / 1000, jnp.float32)
        velocity = np.array(toy_velocity(jnp.asarray(latents), levels))
        latents = scheduler.step(torch.from_numpy(velocity), timestep, torch.from_numpy(latents)).prev_sample.numpy()
        latents = np.concatenate([reference, latents[:, 1:]], axis=1)
    return {"sigmas": scheduler.sigmas.numpy(), "levels": scheduler.timesteps.numpy() / 1000, "latents": latents}


@pytest.mark.parity
@pytest.mark.parametrize(("steps", "shift"), [(50, 5.0), (7, 3.0), (2, 5.0), (1, 5.0)])
def test_unipc_is_that_of_diffusers(steps: int, shift: float) -> None:
    def run_unipc() -> dict[str, np.ndarray]:
        from diffusers import UniPCMultistepScheduler

        kind = {"prediction_type": "flow_prediction", "use_flow_sigmas": True, "num_train_timesteps": 1000}
        return run_scheduler(UniPCMultistepScheduler(flow_shift=shift, **kind), steps)

    expected = golden(f"unipc_{steps}", run_unipc)
    schedule = SCHEDULES["diffusers_unipc"](steps, shift)
    np.testing.assert_allclose(schedule.sigmas, expected["sigmas"], atol=1e-7)
    np.testing.assert_allclose(schedule.input_levels, expected["levels"], atol=1e-7)
    np.testing.assert_allclose(sample("unipc", schedule), expected["latents"], atol=5e-5)


@pytest.mark.parity
@pytest.mark.parametrize(("steps", "shift"), [(50, 5.0), (7, 3.0), (1, 5.0)])
def test_euler_is_that_of_diffusers(steps: int, shift: float) -> None:
    def run_euler() -> dict[str, np.ndarray]:
        from diffusers import FlowMatchEulerDiscreteScheduler

        return run_scheduler(FlowMatchEulerDiscreteScheduler(shift=shift), steps)

    expected = golden(f"euler_{steps}", run_euler)
    schedule = SCHEDULES["diffusers_euler"](steps, shift)
    np.testing.assert_allclose(schedule.sigmas, expected["sigmas"], atol=1e-6)
    np.testing.assert_allclose(schedule.input_levels, expected["levels"], atol=1e-6)
    np.testing.assert_allclose(sample("euler", schedule), expected["latents"], atol=2e-5)


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("steps", [1, 2, 5])
def test_a_point_target_is_reached_whatever_the_schedule(sampler: str, schedule: str, steps: int) -> None:
    """With the true velocity toward one point, data predictions never change and every sampler is exact."""
    target = jax.random.normal(jax.random.key(5), SHAPE, jnp.float32)
    levels = SCHEDULES[schedule](steps, 5.0)
    true_levels = jnp.asarray(levels.sigmas[:-1], jnp.float32)

    def velocity(latents: jax.Array, input_level: jax.Array) -> jax.Array:
        sigma = true_levels[jnp.abs(jnp.asarray(levels.input_levels, jnp.float32) - input_level[0]).argmin()]
        return (latents - target) / sigma

    np.testing.assert_allclose(sample(sampler, levels, velocity)[:, 1:], target[:, 1:], atol=1e-3)


def test_unipc_is_of_second_order_and_euler_of_first() -> None:
    """Against a fine Euler solution, four times the steps bring a fourth of Euler's error and less of UniPC's."""
    fine = sample("euler", SCHEDULES["flowwam"](4000, 3.0))
    error = {
        (name, steps): np.abs(sample(name, SCHEDULES["flowwam"](steps, 3.0)) - fine)[:, 1:].mean()
        for name in SAMPLERS
        for steps in (10, 40)
    }
    assert 3 < error["euler", 10] / error["euler", 40] < 6
    assert error["unipc", 10] / error["unipc", 40] > 8
    assert error["unipc", 40] < error["euler", 40] / 10


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_the_reference_is_given_to_every_step_and_returned(sampler: str) -> None:
    def velocity(latents: jax.Array, input_level: jax.Array) -> jax.Array:
        return jnp.broadcast_to(latents[:, :1], latents.shape)

    noise = jax.random.normal(jax.random.key(0), SHAPE, jnp.float32)
    sampled = sample(sampler, SCHEDULES["wan_official"](4, 5.0), velocity)
    np.testing.assert_array_equal(sampled[:, :1], noise[:, :1] * 0.5)
    travelled = SCHEDULES["wan_official"](4, 5.0).sigmas[0]
    expected = noise[:, 1:] - travelled * jnp.broadcast_to(noise[:, :1] * 0.5, noise[:, 1:].shape)
    np.testing.assert_allclose(sampled[:, 1:], expected, atol=1e-3 if sampler == "unipc" else 1e-5)

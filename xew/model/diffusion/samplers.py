"""Samplers and noise schedules: from noise to latents through decreasing noise levels.

Reads  a velocity (latents, level) -> velocity, the reference (clean latent frame 0), noise, a `NoiseSchedule`
Writes latents whose frame 0 is the reference
To add a schedule: a function (steps, shift) -> NoiseSchedule and one line in SCHEDULES. To add a sampler: a function as
`euler` and one line in SAMPLERS.

Published code has four schedules for "Wan2.2, shift 5", which differ in the third digit. Compare results only under the same
schedule.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from xew.model.diffusion.flow_matching import TRAIN_LEVELS, put_first, sampling_sigmas, shift_sigma

Velocity = Callable[[Array, Array], Array]
"""Function (latents [b t h w c], the network's input level [b]) -> velocity [b t h w c], all float32."""
Schedule = Callable[[int, float], "NoiseSchedule"]
"""Function (steps, shift) -> noise schedule."""
_Carry = tuple[Array, Array, Array, Array]
NEARLY_ONE = 1 - 1e-6
"""Highest noise level in UniPC, as in diffusers: the log signal-to-noise ratio of pure noise is infinite."""


@dataclass(frozen=True)
class NoiseSchedule:
    """Noise levels of a sampler; hashable, for use as a static argument."""

    sigmas: tuple[float, ...]
    """Decreasing levels, `steps` + 1 of them, the last 0."""
    input_levels: tuple[float, ...]
    """The network's input levels, `steps` of them; some projects truncate timesteps (level times 1000) to integers."""

    @property
    def steps(self) -> int:
        """Number of evaluations of the network."""
        return len(self.input_levels)


def flowwam(steps: int, shift: float) -> NoiseSchedule:
    """The schedule of FlowWAM and DiffSynth, and of training: from 1, evenly spaced before the shift."""
    sigmas = sampling_sigmas(steps, shift)
    return _make_schedule(sigmas, sigmas[:-1])


def wan_official(steps: int, shift: float) -> NoiseSchedule:
    """The schedule of Wan's repository (`fm_solvers_unipc.py`): from 0.999, even before the shift, integer timesteps."""
    sigmas = shift_sigma(np.linspace(1 - 1 / TRAIN_LEVELS, 0, steps + 1), shift)
    return _make_schedule(sigmas, np.floor(sigmas[:-1] * TRAIN_LEVELS) / TRAIN_LEVELS)


def diffusers_unipc(steps: int, shift: float) -> NoiseSchedule:
    """The schedule of diffusers' `UniPCMultistepScheduler` with flow sigmas: from 1 to before 0.001, integer timesteps."""
    sigmas = shift_sigma(np.linspace(1, 1 / TRAIN_LEVELS, steps + 1)[:-1], shift)
    sigmas[0] = min(sigmas[0], NEARLY_ONE)
    return _make_schedule(np.append(sigmas, 0), np.floor(sigmas * TRAIN_LEVELS) / TRAIN_LEVELS)


def diffusers_euler(steps: int, shift: float) -> NoiseSchedule:
    """The schedule of diffusers' `FlowMatchEulerDiscreteScheduler`: from 1 to the shifted 0.001, then shifted again."""
    lowest = shift_sigma(np.array([1 / TRAIN_LEVELS]), shift)[0]
    sigmas = shift_sigma(np.linspace(1, lowest, steps), shift)
    return _make_schedule(np.append(sigmas, 0), sigmas)


SCHEDULES: dict[str, Schedule] = {
    "flowwam": flowwam,
    "wan_official": wan_official,
    "diffusers_unipc": diffusers_unipc,
    "diffusers_euler": diffusers_euler,
}


def euler(
    velocity: Velocity,
    reference: Float[Array, "b 1 h w c"],
    noise: Float[Array, "b t h w c"],
    schedule: NoiseSchedule,
) -> Float[Array, "b t h w c"]:
    """Integrate the velocity by Euler steps: latents [b t h w c] float32 whose frame 0 is the reference.

    Args:
        velocity: see `Velocity`.
        reference: [b 1 h w c] float32, clean latent frame 0, restored after every step.
        noise: [b t h w c] float32, unit normal; its frame 0 is not used.
        schedule: see `SCHEDULES`.
    """

    def step(latents: Array, levels: tuple[Array, Array]) -> tuple[Array, None]:
        input_level, difference = levels
        change = difference * velocity(latents, _repeat_for_batch(input_level, latents))
        return put_first(latents + change, reference), None

    levels = (_to_float32(schedule.input_levels), _to_float32(np.diff(schedule.sigmas)))
    return jax.lax.scan(step, put_first(noise, reference), levels)[0]


def unipc(
    velocity: Velocity,
    reference: Float[Array, "b 1 h w c"],
    noise: Float[Array, "b t h w c"],
    schedule: NoiseSchedule,
) -> Float[Array, "b t h w c"]:
    """Integrate the velocity by UniPC (Zhao et al., arXiv 2302.04867): arguments and result [b t h w c] as of `euler`.

    Order 2, data prediction, variant B2; the first and last step have order 1. Each evaluation corrects the current latents,
    then predicts the next. All coefficients depend on the schedule alone, so a step is two weighted sums.
    """

    def step(carry: _Carry, weights: tuple[Array, ...]) -> tuple[_Carry, None]:
        latents, before, data_1, data_2 = carry
        input_level, sigma, correct, predict = weights
        data = latents - sigma * velocity(latents, _repeat_for_batch(input_level, latents))
        corrected = _sum_weighted(correct, (latents, before, data, data_1, data_2))
        latents = _sum_weighted(predict, (corrected, data, data_1))
        return (put_first(latents, reference), corrected, data, data_1), None

    start = put_first(noise, reference)
    nothing = jnp.zeros_like(start)
    sigmas = schedule.sigmas
    weights = (schedule.input_levels, sigmas[:-1], corrector_weights(sigmas), predictor_weights(sigmas))
    latents, *_ = jax.lax.scan(step, (start, nothing, nothing, nothing), tuple(_to_float32(weight) for weight in weights))[0]
    return latents


SAMPLERS = {"euler": euler, "unipc": unipc}


def predictor_weights(sigmas: tuple[float, ...]) -> Float[np.ndarray, "steps 3"]:
    """UniP's weights [steps 3] float64 of the corrected latents, and of the data predicted here and one step before."""
    return np.array([_predictor(sigmas, step) for step in range(len(sigmas) - 1)])


def corrector_weights(sigmas: tuple[float, ...]) -> Float[np.ndarray, "steps 5"]:
    """UniC's weights [steps 5] float64 of the latents, the previous corrected latents, and the data of the last three steps."""
    keep = (1.0, 0.0, 0.0, 0.0, 0.0)
    return np.array([keep, *(_corrector(sigmas, step) for step in range(1, len(sigmas) - 1))])


def _predictor(sigmas: tuple[float, ...], step: int) -> tuple[float, float, float]:
    interval = _interval(sigmas, step)
    latents, data = interval.decay, interval.gain
    if _order(sigmas, step) == 1:
        return latents, data, 0.0
    slope = 0.5 * interval.gain / _ratio(sigmas, step, interval)
    return latents, data - slope, slope


def _corrector(sigmas: tuple[float, ...], step: int) -> tuple[float, float, float, float, float]:
    """Weights that repeat the previous interval with the data predicted at its end."""
    interval = _interval(sigmas, step - 1)
    if _order(sigmas, step - 1) == 1:
        return 0.0, interval.decay, 0.5 * interval.gain, 0.5 * interval.gain, 0.0
    ratio = _ratio(sigmas, step - 1, interval)
    phi_2 = interval.phi / -interval.length - 1
    phi_3 = phi_2 / -interval.length - 0.5
    matched = np.array([phi_2, 2 * phi_3]) / interval.phi
    past, here = np.linalg.solve(np.array([[1, 1], [ratio, 1]]), matched)
    slope = past / ratio
    return 0.0, interval.decay, here * interval.gain, (1 - slope - here) * interval.gain, slope * interval.gain


@dataclass(frozen=True)
class _Interval:
    """An exact exponential step between two levels for constant data."""

    length: float
    """Difference in log signal-to-noise; infinite for the last step."""
    decay: float
    """Weight of the latents."""
    phi: float
    """exp(-length) - 1."""
    gain: float
    """Weight of the data."""


def _interval(sigmas: tuple[float, ...], step: int) -> _Interval:
    length = _log_snr(sigmas[step + 1]) - _log_snr(sigmas[step])
    phi = float(np.expm1(-length))
    signal = 1 - min(sigmas[step + 1], NEARLY_ONE)
    return _Interval(length, sigmas[step + 1] / sigmas[step], phi, -signal * phi)


def _log_snr(sigma: float) -> float:
    sigma = min(sigma, NEARLY_ONE)
    return float(np.log((1 - sigma) / sigma)) if sigma > 0 else np.inf


def _ratio(sigmas: tuple[float, ...], step: int, interval: _Interval) -> float:
    """Position of the previous level relative to this interval's length (negative)."""
    return (_log_snr(sigmas[step - 1]) - _log_snr(sigmas[step])) / interval.length


def _order(sigmas: tuple[float, ...], step: int) -> int:
    """Order of a step: 1 for the first and last, otherwise 2."""
    return 1 if step in (0, len(sigmas) - 2) else 2


def _repeat_for_batch(level: Array, latents: Array) -> Array:
    return jnp.broadcast_to(level, latents.shape[:1])


def _sum_weighted(weights: Array, terms: tuple[Array, ...]) -> Array:
    return sum((weights[i] * term for i, term in enumerate(terms[1:], start=1)), start=weights[0] * terms[0])


def _to_float32(values: np.ndarray | tuple[float, ...]) -> Array:
    return jnp.asarray(np.asarray(values), jnp.float32)


def _make_schedule(sigmas: np.ndarray, input_levels: np.ndarray) -> NoiseSchedule:
    return NoiseSchedule(tuple(map(float, sigmas)), tuple(map(float, input_levels)))

"""Samplers: from noise to latents along a grid of noise levels.

Reads  a velocity (latents, level) -> velocity, the reference (clean latent frame 0), noise, a `Grid`
Writes latents whose frame 0 is the reference
To add a grid: a function (steps, shift) -> Grid and one line in GRIDS; a sampler: a function as `euler`, one line in SAMPLERS.

Four grids are in circulation for "Wan2.2, shift 5"; they differ in the third digit, and results only compare on the same
one, so a grid is chosen by name.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from xew.model.diffusion.flow_matching import TRAIN_LEVELS, sampling_sigmas, shift_sigma

Velocity = Callable[[Array, Array], Array]
"""(latents [b t h w c], noise level that the network is told [b]) -> velocity [b t h w c]."""
_Carry = tuple[Array, Array, Array, Array]
NEARLY_ONE = 1 - 1e-6
"""UniPC works in the log of the signal-to-noise ratio, which pure noise does not have; diffusers starts here too."""


@dataclass(frozen=True)
class Grid:
    """Noise levels of a sampler; hashable, so that a compiled function can take it as static."""

    sigmas: tuple[float, ...]
    """`steps` + 1 decreasing levels, the last 0."""
    told: tuple[float, ...]
    """`steps` levels as the network is told them: some projects cut their timesteps (level times 1000) to whole numbers."""

    @property
    def steps(self) -> int:
        return len(self.told)


def flowwam(steps: int, shift: float) -> Grid:
    """From 1, evenly spaced before the shift. FlowWAM and DiffSynth; also the grid that training draws levels from."""
    sigmas = sampling_sigmas(steps, shift)
    return _grid(sigmas, sigmas[:-1])


def wan_official(steps: int, shift: float) -> Grid:
    """From 0.999, evenly spaced before the shift, timesteps whole. Wan's repository (`fm_solvers_unipc.py`)."""
    sigmas = shift_sigma(np.linspace(1 - 1 / TRAIN_LEVELS, 0, steps + 1), shift)
    return _grid(sigmas, np.floor(sigmas[:-1] * TRAIN_LEVELS) / TRAIN_LEVELS)


def diffusers_unipc(steps: int, shift: float) -> Grid:
    """From 1 to 0.001 before the shift, the last left out, timesteps whole. `UniPCMultistepScheduler` with flow sigmas."""
    sigmas = shift_sigma(np.linspace(1, 1 / TRAIN_LEVELS, steps + 1)[:-1], shift)
    sigmas[0] = min(sigmas[0], NEARLY_ONE)
    return _grid(np.append(sigmas, 0), np.floor(sigmas * TRAIN_LEVELS) / TRAIN_LEVELS)


def diffusers_euler(steps: int, shift: float) -> Grid:
    """From 1 to the shifted 0.001, then shifted again. `FlowMatchEulerDiscreteScheduler`."""
    lowest = shift_sigma(np.array(1 / TRAIN_LEVELS), shift)
    sigmas = shift_sigma(np.linspace(1, lowest, steps), shift)
    return _grid(np.append(sigmas, 0), sigmas)


GRIDS: dict[str, Callable[[int, float], Grid]] = {
    "flowwam": flowwam,
    "wan_official": wan_official,
    "diffusers_unipc": diffusers_unipc,
    "diffusers_euler": diffusers_euler,
}


def euler(velocity: Velocity, reference: Array, noise: Array, grid: Grid) -> Array:
    """Straight steps along the velocity.

    Args:
        velocity: see `Velocity`.
        reference: [b 1 h w c], clean latent frame 0; put back after every step.
        noise: [b t h w c], unit normal; its frame 0 is not used.
        grid: see `GRIDS`.

    Returns:
        [b t h w c] whose frame 0 is the reference.
    """

    def step(latents: Array, levels: tuple[Array, Array]) -> tuple[Array, None]:
        told, difference = levels
        change = difference * velocity(latents, _for_batch(told, latents))
        return _put_back(reference, latents + change), None

    levels = (_floats(grid.told), _floats(np.diff(grid.sigmas)))
    return jax.lax.scan(step, _put_back(reference, noise), levels)[0]


def unipc(velocity: Velocity, reference: Array, noise: Array, grid: Grid) -> Array:
    """UniPC (Zhao et al., arXiv 2302.04867) of order 2, predicting data, variant B2, first and last step of order 1.

    Each evaluation first corrects the latents that it was made at, then predicts the next. All coefficients follow from
    the grid alone, so a step is two weighted sums. Arguments and result are those of `euler`.
    """

    def step(carry: _Carry, weights: tuple[Array, ...]) -> tuple[_Carry, None]:
        latents, before, data_1, data_2 = carry
        told, sigma, correct, predict = weights
        data = latents - sigma * velocity(latents, _for_batch(told, latents))
        corrected = _weighted(correct, (latents, before, data, data_1, data_2))
        latents = _weighted(predict, (corrected, data, data_1))
        return (_put_back(reference, latents), corrected, data, data_1), None

    start = _put_back(reference, noise)
    nothing = jnp.zeros_like(start)
    weights = (grid.told, grid.sigmas[:-1], correctors(grid.sigmas), predictors(grid.sigmas))
    latents, *_ = jax.lax.scan(step, (start, nothing, nothing, nothing), tuple(_floats(weight) for weight in weights))[0]
    return latents


SAMPLERS = {"euler": euler, "unipc": unipc}


def predictors(sigmas: tuple[float, ...]) -> np.ndarray:
    """UniP's weights [steps 3] of the corrected latents, of the data predicted here and of that predicted a step before."""
    return np.array([_predictor(sigmas, step) for step in range(len(sigmas) - 1)])


def correctors(sigmas: tuple[float, ...]) -> np.ndarray:
    """UniC's weights [steps 5] of the latents, the corrected latents a step before, and the data predicted here, one and two
    steps before. Nothing precedes the first step, which keeps its latents."""
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
    """The interval that led here, taken again with the data predicted at its end."""
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
    """What an exact exponential step from one level to the next does when the predicted data stay what they are."""

    length: float
    """In log signal-to-noise; infinite for the last."""
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
    """Where the level before lies, in lengths of this interval (negative)."""
    return (_log_snr(sigmas[step - 1]) - _log_snr(sigmas[step])) / interval.length


def _order(sigmas: tuple[float, ...], step: int) -> int:
    """2 but for the first step, which has no past, and the last."""
    return 1 if step in (0, len(sigmas) - 2) else 2


def _put_back(reference: Array, latents: Array) -> Array:
    return jnp.concatenate([reference, latents[:, 1:]], axis=1)


def _for_batch(level: Array, latents: Array) -> Array:
    return jnp.broadcast_to(level, latents.shape[:1])


def _weighted(weights: Array, terms: tuple[Array, ...]) -> Array:
    return sum((weights[i] * term for i, term in enumerate(terms[1:], start=1)), start=weights[0] * terms[0])


def _floats(values: np.ndarray | tuple[float, ...]) -> Array:
    return jnp.asarray(np.asarray(values), jnp.float32)


def _grid(sigmas: np.ndarray, told: np.ndarray) -> Grid:
    return Grid(tuple(map(float, sigmas)), tuple(map(float, told)))

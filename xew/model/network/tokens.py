"""Latents to tokens and back, and encodings of positions and noise levels."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

Patch = tuple[int, int, int]
"""Latent frames, rows and columns of a token."""
TokenGrid = tuple[int, int, int]
"""Number of tokens in time, height and width."""
WAN_PATCH: Patch = (1, 2, 2)
WAVELENGTH_BASE = 10_000.0
TIME_FREQUENCIES = 256


def sinusoid(timestep: Float[Array, "*n"]) -> Float[Array, "*n 256"]:
    """Cosines, then sines [... 256] of float32 timesteps [...], exact to 2e-7 compared with Wan's float64.

    The angle is the exact product of the factors' upper bits plus a small rest, combined by the addition theorem.
    """
    half = TIME_FREQUENCIES // 2
    frequencies = (WAVELENGTH_BASE ** (-np.arange(half) / half)).reshape((1,) * timestep.ndim + (half,))
    upper_frequencies = (frequencies.astype(np.float32).view(np.uint32) & UPPER_HALF).view(np.float32)
    lower_frequencies = (frequencies - upper_frequencies).astype(np.float32)
    timestep = timestep[..., None]
    bits = jax.lax.bitcast_convert_type(timestep, jnp.uint32)
    upper = jax.lax.bitcast_convert_type(bits & UPPER_HALF, jnp.float32)
    angle = upper * upper_frequencies
    rest = (timestep - upper) * upper_frequencies + timestep * lower_frequencies
    cos, sin, cos_rest, sin_rest = jnp.cos(angle), jnp.sin(angle), jnp.cos(rest), jnp.sin(rest)
    return jnp.concatenate([cos * cos_rest - sin * sin_rest, sin * cos_rest + cos * sin_rest], axis=-1)


UPPER_HALF = np.uint32(0xFFFFF000)
"""Mask of a float32 number's upper 12 of 24 significant bits."""


def rounded_sinusoid(timestep: Float[Array, "*n"]) -> Float[Array, "*n 256"]:
    """`sinusoid` of timesteps [...] as in FlowWAM, with timestep and result rounded to bfloat16: [... 256] float32."""
    return sinusoid(timestep.astype(jnp.bfloat16).astype(jnp.float32)).astype(jnp.bfloat16).astype(jnp.float32)


def token_grid(shape: Sequence[int], patch: Patch) -> tuple[int, int, int]:
    """Frames, rows and columns of the tokens of latents [b t h w c] or of joint positions [b t 16]."""
    if len(shape) == 3:
        return shape[1], 1, 1
    return shape[1] // patch[0], shape[2] // patch[1], shape[3] // patch[2]


def rotary_angles(
    grid: tuple[int, int, int], head_dim: int, base: float = WAVELENGTH_BASE, times: Sequence[float] | None = None
) -> Float[np.ndarray, "s angles"]:
    """Rotation angles [s head_dim/2, rad] float64 of the tokens of a grid that starts at (0, 0, 0).

    The head is split among time, height and width as in Wan (44, 42, 42 of 128), each with a geometric series of frequencies
    over a factor of `base`. `times` of the frames are in latent frames, by default 0, 1, …
    """
    part = 2 * (head_dim // 6)
    parts = (head_dim - 2 * part, part, part)
    axes = (np.arange(grid[0]) if times is None else np.asarray(times), np.arange(grid[1]), np.arange(grid[2]))
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    series = [base ** (-np.arange(0, width, 2) / width) for width in parts]
    return np.concatenate([np.outer(positions[:, axis], frequencies) for axis, frequencies in enumerate(series)], axis=-1)


def patchify(latents: Float[Array, "b t h w c"], patch: Patch) -> Float[Array, "b s features"]:
    """Latents [b t h w c] -> tokens [b s c*ph*pw] in the feature order of Wan's convolution weights."""
    b, _, _, _, c = latents.shape
    t, h, w = token_grid(latents.shape, patch)
    cut = latents.reshape(b, t, patch[0], h, patch[1], w, patch[2], c)
    return cut.transpose(0, 1, 3, 5, 7, 2, 4, 6).reshape(b, t * h * w, -1)


def unpatchify(features: Float[Array, "b s features"], shape: Sequence[int], patch: Patch) -> Float[Array, "b t h w c"]:
    """Features of the head [b s pt*ph*pw*c] -> latents of `shape` [b t h w c]; here c runs fastest."""
    b, _, _, _, c = shape
    t, h, w = token_grid(shape, patch)
    cut = features.reshape(b, t, h, w, *patch, c)
    return cut.transpose(0, 1, 4, 2, 5, 3, 6, 7).reshape(shape)

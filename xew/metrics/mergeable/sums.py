"""Sums of floats that are exact, and the states of metrics that are made of them.

Evaluations over many hosts merge states: because a sum is exact, no split of the work and no order of merging changes a bit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

BITS, LIMBS = 16, 20
"""Bits of a limb and limbs of an exact sum: 320 bits, of which one float32 needs 277; the rest is room for more values than can
be counted."""
LOWEST = -149
"""Exponent of the smallest float32 above zero, a power of two."""
BLOCK = 4096
"""Number of values that are added up before carrying: each is under 2^17 in any one limb, which int32 holds so often."""


@dataclass(frozen=True)
class Mergeable:
    """The four functions of one metric's states."""

    init: Callable[..., Any]
    """() -> the state of nothing; of metrics by object (number of objects) -> that state."""
    update: Callable[..., Any]
    """(state, *what the metric function takes, **its options) -> state."""
    merge: Callable[[Any, Any], Any]
    compute: Callable[[Any], jax.Array]
    """state -> scalar float32; NaN where nothing was counted, or where anything that counts is not a finite number."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mean:
    """The mean of float32 values, as the exact sum and the number of the finite ones, and the number of the others."""

    total: jax.Array
    """[... 20] int32, the sum in units of 2^-149: 16 bits each from the lowest, the last with the sign."""
    count: jax.Array
    """[...] int32, number of finite values."""
    undefined: jax.Array
    """[...] int32, number of values that are NaN or infinite."""

    @property
    def value(self) -> jax.Array:
        """[...] float32, within 5e-7 of the true mean relative to it; NaN where nothing was counted, or what is not finite."""
        return jnp.where(self.undefined > 0, jnp.nan, to_float(self.total) / self.count.astype(jnp.float32))


def mean_over(values: Callable[..., tuple[jax.Array, jax.Array | None]]) -> Mergeable:
    """The states of a metric that is the mean of parts.

    Args:
        values: of what the metric takes, to the values of its parts [...] and which of them count [...] bool, or None for all.
    """

    def update(state: Mean, *inputs: jax.Array | np.ndarray, **options: Any) -> Mean:
        found, counts = values(*inputs, **options)
        return merge_means(state, mean_of(found.reshape(-1), True if counts is None else counts.reshape(-1)))

    return Mergeable(empty_mean, update, merge_means, lambda state: state.value)


def empty_mean(shape: tuple[int, ...] = ()) -> Mean:
    """The mean of no values, or an array of such means of this shape: total [shape 20], count and undefined [shape] int32."""
    return Mean(jnp.zeros((*shape, LIMBS), jnp.int32), jnp.zeros(shape, jnp.int32), jnp.zeros(shape, jnp.int32))


@jax.jit
def mean_of(values: jax.Array, keep: jax.Array | bool = True) -> Mean:
    """The mean along the first axis of values [n ...] float32 where `keep` [n ...] bool; NaN if a kept one is not finite."""
    finite = jnp.isfinite(values)
    undefined = jnp.sum(~finite & keep, axis=0, dtype=jnp.int32)
    keep = finite & keep
    limbs = jnp.where(keep[..., None], _limbs(values.astype(jnp.float32)), 0)
    block = max(1, min(BLOCK, len(limbs)))
    filled = jnp.pad(limbs, ((0, -len(limbs) % block), *[(0, 0)] * (limbs.ndim - 1)))
    sums = _carry(jnp.sum(filled.reshape(-1, block, *limbs.shape[1:]), axis=1, dtype=jnp.int32))
    return Mean(_carry(jnp.sum(sums, axis=0, dtype=jnp.int32)), jnp.sum(keep, axis=0, dtype=jnp.int32), undefined)


@jax.jit
def merge_means(a: Mean, b: Mean) -> Mean:
    """The mean of the values of both, total [... 20] int32, count and undefined [...] int32 each."""
    return Mean(_carry(a.total + b.total), a.count + b.count, a.undefined + b.undefined)


def _limbs(values: jax.Array) -> jax.Array:
    """float32 [...] as an integer multiple of 2^-149 in LIMBS parts of BITS bits [... 20], each of the value's sign."""
    bits = lax.bitcast_convert_type(values, jnp.int32)
    exponent = (bits >> 23) & 0xFF
    mantissa = (bits & 0x7FFFFF) | jnp.where(exponent > 0, 1 << 23, 0)
    place = jnp.maximum(exponent, 1) - 1
    first, shift = place // BITS, place % BITS
    low, high = (mantissa & 0xFFFF) << shift, (mantissa >> BITS) << shift
    parts = low & 0xFFFF, (low >> BITS) + (high & 0xFFFF), high >> BITS
    places = np.arange(LIMBS, dtype=np.int32).reshape((1,) * first.ndim + (LIMBS,))
    limbs = sum(jnp.where(places == (first + i)[..., None], part[..., None], 0) for i, part in enumerate(parts))
    return jnp.where(bits < 0, -1, 1)[..., None] * limbs


def _carry(limbs: jax.Array) -> jax.Array:
    """The same integer with all limbs but the last in [0, 2^16): one form for each number."""

    def step(carry: jax.Array, limb: jax.Array) -> tuple[jax.Array, jax.Array]:
        return (limb + carry) >> BITS, (limb + carry) & 0xFFFF

    carry, low = lax.scan(step, jnp.zeros_like(limbs[..., 0]), jnp.moveaxis(limbs[..., :-1], -1, 0))
    return jnp.concatenate([jnp.moveaxis(low, 0, -1), (limbs[..., -1] + carry)[..., None]], axis=-1)


@jax.jit
def to_float(limbs: jax.Array) -> jax.Array:
    """float32 [...] of exact sums [... 20]."""
    negative = limbs[..., -1] < 0
    magnitude = _carry(jnp.where(negative[..., None], -limbs, limbs))
    with np.errstate(over="ignore"):
        units = np.ldexp(np.float32(1), LOWEST + BITS * np.arange(LIMBS)).astype(np.float32)
    terms = magnitude.astype(jnp.float32) * jnp.expand_dims(units, range(magnitude.ndim - 1))
    total = jnp.sum(jnp.where(magnitude > 0, terms, 0), axis=-1)
    return jnp.where(negative, -total, total)

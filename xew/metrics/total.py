"""Sum and number of values, from which a mean over parts of a video, over videos or over hosts is merged."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float32, Int32


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Total:
    """Sum and number of values. The sum of two totals is the total of the values of both."""

    total: Float32[jax.Array, ""]
    """Sum of the values that count; not finite where one of them is not."""
    count: Int32[jax.Array, ""]

    @property
    def mean(self) -> Float32[jax.Array, ""]:
        """Mean [()] of the values that count; NaN where there is none."""
        return self.total / self.count.astype(jnp.float32)

    def __add__(self, other: "Total") -> "Total":
        return Total(self.total + other.total, self.count + other.count)


def total_of(values: Float32[jax.Array, "..."], counts: Bool[jax.Array, "..."] | None = None) -> Total:
    """Total of values [...] float32: of those where `counts` [...] bool, or of all."""
    counts = jnp.ones(values.shape, bool) if counts is None else counts
    return Total(jnp.sum(jnp.where(counts, values, 0), dtype=jnp.float32), jnp.sum(counts, dtype=jnp.int32))

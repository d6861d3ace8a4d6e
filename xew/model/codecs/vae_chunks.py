"""Applying a causal network to a long video in chunks, with the same result as in one pass."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

WINDOW = 3
"""Number of frames in the window of a causal convolution."""


class History:
    """The last input frames of causal layers, passed from chunk to chunk, in the order in which the layers run.

    None marks the beginning of a video: layers see zeros before the first frame.
    """

    def __init__(self, before: Sequence[Array] | None = None) -> None:
        self.before = before
        self.after: list[Array] = []

    @property
    def begins(self) -> bool:
        """Whether this is the beginning of a video."""
        return self.before is None

    def extend(self, x: Float[Array, "b t h w c"], frames: int = WINDOW - 1) -> Float[Array, "b t2 h w c"]:
        """Prepend the previous frames (zeros at the beginning) to x [b t h w c]: [b t+frames h w c]."""
        if self.before is None:
            extended = jnp.pad(x, ((0, 0), (frames, 0), (0, 0), (0, 0), (0, 0)))
        else:
            extended = jnp.concatenate([self.before[len(self.after)], x], axis=1)
        self.after.append(extended[:, extended.shape[1] - frames :])
        return extended

    def follow(self, x: Float[Array, "b t h w c"]) -> Float[Array, "b t2 h w c"]:
        """Prepend the previous frame, if there is one, to x [b t h w c]: [b t' h w c]."""
        if self.before is not None:
            return self.extend(x, 1)
        self.after.append(x[:, -1:])
        return x


def apply_in_chunks(
    step: Callable[[Array, History], Array], video: Float[Array, "b t ..."], size: int
) -> Float[Array, "b m ..."]:
    """Apply a causal function to a video, and concatenate the results [b m ...].

    Args:
        step: function from frames [b n ...] and their history to frames [b m ...].
        video: [b t ...]; its first frame is the first chunk.
        size: frames of the other chunks; 0 makes one chunk of the whole video.
    """
    if size == 0:
        return step(video, History())
    begin = History()
    parts = [step(video[:, :1], begin)]
    before, rest = begin.after, video[:, 1:]
    b, count = rest.shape[0], rest.shape[1] // size
    if count:

        def apply_next(before: list[Array], chunk: Array) -> tuple[list[Array], Array]:
            history = History(before)
            result = step(chunk, history)
            return history.after, result

        chunks = jnp.moveaxis(rest[:, : count * size].reshape(b, count, size, *rest.shape[2:]), 1, 0)
        before, results = lax.scan(apply_next, before, chunks)
        parts.append(jnp.moveaxis(results, 0, 1).reshape(b, count * results.shape[2], *results.shape[3:]))
    if rest.shape[1] % size:
        parts.append(step(rest[:, count * size :], History(before)))
    return jnp.concatenate(parts, axis=1)


def even_chunk(count: int, most: int) -> int:
    """The largest divisor of `count` up to `most`, so only one chunk size is compiled; `most` if it is under half of that."""
    even = next((size for size in range(min(most, count), 0, -1) if count % size == 0), most)
    return even if 2 * even >= most else most

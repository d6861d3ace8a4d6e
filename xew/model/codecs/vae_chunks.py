"""A causal network over a long video chunk by chunk, with the frames that its layers keep in between.

Reads  video [b t h w c], in chunks of any size
Writes what the network gives for the whole of it, the same function as in one pass
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

WINDOW = 3
"""Number of frames that a causal convolution sees, itself included."""


class History:
    """Frames that causal layers keep between the chunks of a video, in the order in which the layers run.

    Without kept frames it is the beginning of a video: layers see zeros before the first frame.
    """

    def __init__(self, kept: Sequence[Array] | None = None) -> None:
        self.before = kept
        self.after: list[Array] = []

    @property
    def begins(self) -> bool:
        """Whether this is the beginning of a video."""
        return self.before is None

    def extend(self, x: Float[Array, "b t h w c"], frames: int = WINDOW - 1) -> Float[Array, "b t2 h w c"]:
        """Frames x [b t h w c] behind those before them, which are zeros at the beginning: [b t+frames h w c]."""
        if self.before is None:
            extended = jnp.pad(x, ((0, 0), (frames, 0), (0, 0), (0, 0), (0, 0)))
        else:
            extended = jnp.concatenate([self.before[len(self.after)], x], axis=1)
        self.after.append(extended[:, extended.shape[1] - frames :])
        return extended

    def follow(self, x: Float[Array, "b t h w c"]) -> Float[Array, "b t2 h w c"]:
        """Frames x [b t h w c] behind the one before them, if there is one: for a layer that passes the first frame by."""
        if self.before is not None:
            return self.extend(x, 1)
        self.after.append(x[:, -1:])
        return x


def apply_in_chunks(
    step: Callable[[Array, History], Array], video: Float[Array, "b t ..."], size: int
) -> Float[Array, "b m ..."]:
    """Apply a causal function to a video, all at once or chunk by chunk.

    Args:
        step: function from frames [b n ...] and their history to frames [b m ...].
        video: [b t ...]; its first frame is a chunk of its own.
        size: frames of the other chunks; 0 makes one chunk of everything.

    Returns:
        [b m ...], the results one after another.
    """
    if size == 0:
        return step(video, History())
    begin = History()
    parts = [step(video[:, :1], begin)]
    kept, rest = begin.after, video[:, 1:]
    b, count = rest.shape[0], rest.shape[1] // size
    if count:

        def apply_next(kept: list[Array], chunk: Array) -> tuple[list[Array], Array]:
            history = History(kept)
            made = step(chunk, history)
            return history.after, made

        chunks = jnp.moveaxis(rest[:, : count * size].reshape(b, count, size, *rest.shape[2:]), 1, 0)
        kept, made = lax.scan(apply_next, kept, chunks)
        parts.append(jnp.moveaxis(made, 0, 1).reshape(b, count * made.shape[2], *made.shape[3:]))
    if rest.shape[1] % size:
        parts.append(step(rest[:, count * size :], History(kept)))
    return jnp.concatenate(parts, axis=1)


def even_chunk(count: int, most: int) -> int:
    """The largest chunk up to `most` that divides `count`, so that no shorter one is compiled beside it.

    Where that is less than half of `most`, `most` itself; 0 stays 0.
    """
    even = next((size for size in range(min(most, count), 0, -1) if count % size == 0), most)
    return even if 2 * even >= most else most

"""Conditioning mechanisms of other systems, besides token streams.

To add a mechanism: a module and one line in MECHANISMS; `conditions.ACTIONS` assigns its input.

Each mechanism enters the network at one of four points, and a system is a combination of mechanisms:
    time     a vector for each latent frame, added to the time embedding of that frame's RGB tokens (IRASim, BWM)
    frame    tokens that only the tokens of their own latent frame attend to (Ctrl-World)
    context  tokens that all tokens attend to, next to the text or instead of it (EnerVerse-AC, BWM)
    channels pictures, or the clip's first frame, added to RGB's channels before the patch embedding (EnerVerse-AC)

Shape letters: b batch, t h w c latent video, f latent frames (earlier ones first), n numbers, d width, k context tokens.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from xew.episode import HEIGHT, WIDTH
from xew.model.video.frames import TEMPORAL_FACTOR, padding_to

TOOLS = 14
"""Number of values of two tools: position, roll, pitch, yaw and gripper of each."""
CAMERA = 16
"""Number of values of a camera: fx fy cx cy [pixels of the camera], rotation from world to camera [9], position [3, m]."""
RAY_CHANNELS = 6
"""Number of channels of a ray map: direction and origin."""
HIDDEN = 4
"""Width of the hidden layer of per-frame vectors relative to the network's width (IRASim, BWM)."""
POOLED_TOKENS, POOLING_LAYERS = 16, 2
"""Number of queries and of layers of the resampler; EnerVerse-AC's has four narrower layers."""

Activation = Callable[[Array], Array]


class FrameVector(nnx.Module):
    """Two layers from the four actions of a latent frame to a vector of the time embedding's width.

    The second layer starts at zero, to leave a pretrained network unchanged. With `null`, latent frame 0 gets a learned vector.
    """

    def __init__(self, dim: int, numbers: int, activation: Activation, null: bool, rngs: nnx.Rngs) -> None:
        self.activation = activation
        self.first = linear(numbers, HIDDEN * dim, jnp.float32, rngs)
        self.second = nnx.Linear(HIDDEN * dim, dim, kernel_init=nnx.initializers.zeros_init(), rngs=rngs)
        self.null = nnx.Param(0.02 * jax.random.normal(rngs.params(), (dim,), jnp.float32)) if null else None

    def __call__(self, numbers: Float[Array, "b t n"]) -> Float[Array, "b t d"]:
        """Numbers [b t 4*n] -> vectors [b t d] float32."""
        vectors = self.second(self.activation(self.first(numbers)))
        if self.null is None:
            return vectors
        null = jnp.broadcast_to(self.null[...], (len(vectors), 1, vectors.shape[-1]))
        return jnp.concatenate([null, vectors[:, 1:]], axis=1)


class FrameTokens(nnx.Module):
    """Three layers from the tool poses of a latent frame to one context token of that frame (Ctrl-World)."""

    def __init__(self, dim: int, numbers: int, dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        self.layers = nnx.List([linear(width, dim, dtype, rngs) for width in (numbers, dim, dim)])

    def __call__(self, numbers: Float[Array, "b f n"]) -> Float[Array, "b f 1 d"]:
        """Numbers [b f n] -> tokens [b f 1 d]."""
        first, second, third = self.layers
        return third(nnx.silu(second(nnx.silu(first(numbers)))))[:, :, None]


class ClipTokens(nnx.Module):
    """Two layers from the tool pose of each frame of video to a context token of all (BWM)."""

    def __init__(self, dim: int, numbers: int, dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        self.first, self.second = linear(numbers // TEMPORAL_FACTOR, dim, dtype, rngs), linear(dim, dim, dtype, rngs)

    def __call__(self, numbers: Float[Array, "b t n"]) -> Float[Array, "b k d"]:
        """Numbers [b t 4*n] -> tokens [b k d], k the frames of video."""
        return self.second(nnx.gelu(self.first(frames_of_groups(numbers)), approximate=False))


class PooledTokens(nnx.Module):
    """A fixed number of learned queries that attend to the actions of all frames of video (EnerVerse-AC's resampler)."""

    def __init__(self, dim: int, heads: int, numbers: int, dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        self.first = linear(numbers // TEMPORAL_FACTOR, dim, dtype, rngs)
        self.queries = nnx.Param(0.02 * jax.random.normal(rngs.params(), (POOLED_TOKENS, dim), jnp.float32))
        self.layers = nnx.List([PoolingLayer(dim, heads, dtype, rngs) for _ in range(POOLING_LAYERS)])

    def __call__(self, numbers: Float[Array, "b t n"]) -> Float[Array, "b 16 d"]:
        """Numbers [b t 4*n] -> tokens [b 16 d] float32."""
        actions = self.first(frames_of_groups(numbers)).astype(jnp.float32)
        actions = actions + jnp.asarray(positions(*actions.shape[1:]))[None]
        tokens = jnp.broadcast_to(self.queries[...], (len(actions), *self.queries.shape))
        for layer in self.layers:
            tokens = layer(tokens, actions)
        return tokens


class PoolingLayer(nnx.Module):
    """Residual attention of queries to the actions and themselves, then a residual feed-forward layer."""

    def __init__(self, dim: int, heads: int, dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        self.norm_tokens, self.norm_actions, self.norm = (nnx.LayerNorm(dim, dtype=jnp.float32, rngs=rngs) for _ in range(3))
        self.attention = nnx.MultiHeadAttention(heads, dim, dtype=dtype, decode=False, rngs=rngs)
        self.first, self.second = linear(dim, HIDDEN * dim, dtype, rngs), linear(HIDDEN * dim, dim, dtype, rngs)

    def __call__(self, tokens: Float[Array, "b 16 d"], actions: Float[Array, "b k d"]) -> Float[Array, "b 16 d"]:
        """Tokens [b 16 d] and actions [b k d] -> tokens [b 16 d], all float32."""
        queries = self.norm_tokens(tokens)
        keys = jnp.concatenate([self.norm_actions(actions), queries], axis=1)
        tokens = tokens + self.attention(queries, keys).astype(jnp.float32)
        return tokens + self.second(nnx.gelu(self.first(self.norm(tokens)))).astype(jnp.float32)


class Channels(nnx.Module):
    """Additional columns of RGB's patch embedding for additional channels, initially zero."""

    def __init__(self, dim: int, features: int, dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        self.columns = nnx.Linear(
            features, dim, use_bias=False, dtype=dtype, kernel_init=nnx.initializers.zeros_init(), rngs=rngs
        )

    def __call__(self, patches: Float[Array, "b s features"]) -> Float[Array, "b s d"]:
        """Patches [b s features] -> [b s d] to add to RGB's tokens."""
        return self.columns(patches)


@dataclass(frozen=True)
class Mechanism:
    """A conditioning mechanism."""

    enters: Literal["time", "frame", "context", "channels"]
    """Entry point."""
    source: Literal["numbers", "camera", "latents", "reference"]
    """Input: `width` numbers for each latent frame, the camera as a ray map, encoded pictures, or the clip's first latent
    frame, which needs no condition."""
    build: Callable[[Any, int, DTypeLike, nnx.Rngs], nnx.Module]
    """Function (`dit.ModelSize`, features of a patch of the source, dtype of products, rngs) -> module."""
    width: int = 0
    """Number of input values of a latent frame; 0 for pictures."""
    replaces_text: bool = False
    """Whether its context replaces the text."""


def _frame_vector(activation: Activation, null: bool) -> Callable[[Any, int, DTypeLike, nnx.Rngs], nnx.Module]:
    return lambda size, _, dtype, rngs: FrameVector(size.dim, TEMPORAL_FACTOR * TOOLS, activation, null, rngs)


def _channels(size: Any, features: int, dtype: DTypeLike, rngs: nnx.Rngs) -> nnx.Module:
    return Channels(size.dim, features, dtype, rngs)


MECHANISMS = {
    "relative_time": Mechanism("time", "numbers", _frame_vector(nnx.gelu, null=True), width=TEMPORAL_FACTOR * TOOLS),
    "pose_time": Mechanism("time", "numbers", _frame_vector(nnx.silu, null=False), width=TEMPORAL_FACTOR * TOOLS),
    "pose_frame": Mechanism(
        "frame", "numbers", lambda size, _, dtype, rngs: FrameTokens(size.dim, TOOLS, dtype, rngs), width=TOOLS
    ),
    "pose_context": Mechanism(
        "context",
        "numbers",
        lambda size, _, dtype, rngs: ClipTokens(size.dim, TEMPORAL_FACTOR * TOOLS, dtype, rngs),
        width=TEMPORAL_FACTOR * TOOLS,
        replaces_text=True,
    ),
    "pooled_context": Mechanism(
        "context",
        "numbers",
        lambda size, _, dtype, rngs: PooledTokens(size.dim, size.heads, TEMPORAL_FACTOR * TOOLS, dtype, rngs),
        width=TEMPORAL_FACTOR * TOOLS,
    ),
    "map_channels": Mechanism("channels", "latents", _channels),
    "mask_channels": Mechanism("channels", "latents", _channels),
    "flow_channels": Mechanism("channels", "latents", _channels),
    "shadow_channels": Mechanism("channels", "latents", _channels),
    "reference_channels": Mechanism("channels", "reference", _channels),
    "ray_channels": Mechanism("channels", "camera", _channels, width=CAMERA),
}


class FramedContext(NamedTuple):
    """Context of cross-attention if mechanisms have tokens of single frames."""

    shared: Float[Array, "b k d"]
    """Context [b k d] of every token."""
    framed: Float[Array, "b f m d"]
    """Additional context [b f k d] of each frame, for the first f * `tokens` tokens."""
    tokens: int
    """Number of tokens of a frame."""


def create_mechanism(name: str, size: Any, channels: int, dtype: DTypeLike, rngs: nnx.Rngs) -> nnx.Module:
    """The module of a mechanism for a network of this size on latents with this many channels."""
    mechanism = MECHANISMS[name]
    of_pixel = RAY_CHANNELS if mechanism.source == "camera" else channels
    return mechanism.build(size, of_pixel * math.prod(size.patch), dtype, rngs)


def frames_of_groups(numbers: Float[Array, "b t n"]) -> Float[Array, "b k m"]:
    """Numbers of latent frames [b t 4*n] -> of frames of video [b 4*(t-1)+1 n]; the first group repeats one frame."""
    frames = numbers.reshape(len(numbers), TEMPORAL_FACTOR * numbers.shape[1], -1)
    return frames[:, TEMPORAL_FACTOR - 1 :]


def ray_maps(camera: Float[Array, "b t 16"], shape: Sequence[int]) -> Float[Array, "b t h w 6"]:
    """Unit direction and origin [m] in the world of each latent pixel's ray, [b t h w 6] float32 (EnerVerse-AC).

    Args:
        camera: [b t 16], see `CAMERA`.
        shape: of the latents [b t h w c], of frames after `frames.to_model_size`.
    """
    height, width = shape[2:4]
    top, bottom, left, right = padding_to(height, width)
    rows = (np.arange(height) + 0.5) / height * (HEIGHT + top + bottom) - 0.5 - top
    columns = (np.arange(width) + 0.5) / width * (WIDTH + left + right) - 0.5 - left
    x, y = (jnp.asarray(grid, jnp.float32)[None, None] for grid in np.meshgrid(columns, rows))
    fx, fy, cx, cy = (camera[:, :, index, None, None] for index in range(4))
    rotation = camera[:, :, 4:13].reshape(*camera.shape[:2], 3, 3)
    seen = jnp.stack([(x - cx) / fx, (y - cy) / fy, jnp.ones_like((x - cx) / fx)], axis=-1)
    world = jnp.einsum("bthwi,btij->bthwj", seen, rotation)
    direction = world / jnp.linalg.norm(world, axis=-1, keepdims=True)
    return jnp.concatenate([direction, jnp.broadcast_to(camera[:, :, None, None, 13:], direction.shape)], axis=-1)


def positions(count: int, dim: int) -> Float[np.ndarray, "count dim"]:
    """Sines and cosines [count dim] float32 that encode the order of frames."""
    angles = np.arange(count)[:, None] * 10_000.0 ** (-np.arange(0, dim, 2) / dim)
    return np.concatenate([np.sin(angles), np.cos(angles)], axis=-1)[:, :dim].astype(np.float32)


def linear(features: int, out: int, dtype: DTypeLike, rngs: nnx.Rngs) -> nnx.Linear:
    """A linear layer whose product is computed in `dtype`."""
    return nnx.Linear(features, out, dtype=dtype, kernel_init=nnx.initializers.xavier_uniform(), rngs=rngs)

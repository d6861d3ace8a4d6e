"""The diffusion transformer: Wan2.2-TI2V-5B's block stack over a list of token streams (Flax NNX).

Reads  latents [b t h w c] of each stream, noise level, text embeddings [b l e]
Writes velocity [b t h w c] of the RGB stream
To add a size: one line in MODELS. To add a stream: one line in STREAMS.

Shape letters: b batch, t h w c latent video, s tokens (t' h' w' flattened), d width, n heads, r distinct noise levels.
Numbers that look arbitrary (eps 1e-6, 256 frequencies, six modulations) are those of the published weights.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array

from xew.model.sharding import cut_over_batch

PATCH = (1, 2, 2)
EPSILON = 1e-6
WAVELENGTH_BASE = 10_000.0
TIME_FREQUENCIES = 256
TIMESTEPS = 1000.0
"""The network is told the noise level as sigma times this."""

Activation = Callable[[Array], Array]
Rotary = tuple[Array, Array]
"""Cosine and sine [s head_dim/2] of every token's rotation angles."""


@dataclass(frozen=True)
class ModelSize:
    """Everything that distinguishes one size of the network from another."""

    dim: int
    depth: int
    heads: int
    ffn_dim: int
    text_dim: int
    text_tokens: int
    rotary_base: float = WAVELENGTH_BASE
    """Ratio of the slowest to the fastest rotation of positions; Wan's serves clips of hundreds of positions a side, and
    a model of few positions tells them apart sooner with less."""

    @property
    def head_dim(self) -> int:
        return self.dim // self.heads


MODELS = {
    "tiny": ModelSize(dim=32, depth=2, heads=2, ffn_dim=64, text_dim=16, text_tokens=8),
    "debug": ModelSize(dim=256, depth=4, heads=2, ffn_dim=768, text_dim=32, text_tokens=16, rotary_base=10.0),
    "small": ModelSize(dim=768, depth=12, heads=12, ffn_dim=3072, text_dim=256, text_tokens=32),
    "wan5b": ModelSize(dim=3072, depth=30, heads=24, ffn_dim=14336, text_dim=4096, text_tokens=512),
}


@dataclass(frozen=True)
class Stream:
    """One sequence of tokens beside the others. Only RGB is noised and has a head and a loss."""

    source: Literal["latents", "joints"]
    """Encoded video [b t h w c], or the 16-number action of each latent frame [b t 16]."""
    timestep: Literal["shared", "clean"]
    """Noise level that its tokens are told: RGB's own (0 in latent frame 0), as FlowWAM does, or 0."""


STREAMS = {
    "rgb": Stream("latents", "shared"),
    "action": Stream("latents", "shared"),
    "embodiment": Stream("latents", "clean"),
    "joints": Stream("joints", "shared"),
}


class WorldModel(nnx.Module):
    """Predicts the flow-matching velocity of the RGB stream given clean condition streams.

    Args:
        size: one of `MODELS`.
        channels: of the latents.
        streams: names in `STREAMS` beside rgb.
        dtype: of the matrix products; parameters, norms, modulation and the residual stream stay float32.
        remat: recompute blocks in the backward pass instead of keeping their activations.
        unroll: blocks compiled as one loop body; more is faster on a CPU and slower to compile.
        attention: an implementation of `jax.nn.dot_product_attention` ("xla", or "cudnn" on a GPU in bfloat16).
    """

    def __init__(
        self,
        size: ModelSize,
        channels: int,
        streams: Sequence[str] = (),
        *,
        dtype: jnp.dtype = jnp.float32,
        remat: bool = False,
        unroll: int = 1,
        attention: Literal["xla", "cudnn"] = "xla",
        rngs: nnx.Rngs,
    ) -> None:
        self.size, self.channels, self.dtype = size, channels, dtype
        self.remat, self.unroll = remat, unroll
        self.condition_streams = tuple(streams)
        features = channels * int(np.prod(PATCH))
        self.patch_embedding = _linear(features, size.dim, dtype, rngs)
        self.text_embedding = TwoLayer(size.text_dim, size.dim, size.dim, _gelu, dtype, EMBEDDING_INIT, rngs)
        self.time_embedding = TwoLayer(TIME_FREQUENCIES, size.dim, size.dim, nnx.silu, jnp.float32, EMBEDDING_INIT, rngs)
        self.time_projection = _linear(size.dim, 6 * size.dim, jnp.float32, rngs)
        self.blocks = _stacked_blocks(size, dtype, attention, rngs)
        self.head = Head(size.dim, features, rngs)
        self.stream_embeddings = nnx.data({})
        self.stream_inputs = nnx.data({})
        for name in self.condition_streams:
            self.stream_embeddings[name] = nnx.Param(_scaled_normal(rngs.params(), (size.dim,)))
            self.stream_inputs[name] = self._stream_input(STREAMS[name], rngs)

    def _stream_input(self, stream: Stream, rngs: nnx.Rngs) -> nnx.Module:
        """Pixel streams start from a copy of RGB's patch embedding, as FlowWAM and the paper do."""
        if stream.source == "joints":
            return TwoLayer(16, self.size.dim, self.size.dim, nnx.silu, self.dtype, nnx.initializers.xavier_uniform(), rngs)
        return jax.tree.map(jnp.copy, self.patch_embedding)

    def __call__(self, latents: Array, conditions: Mapping[str, Array], sigma: Array, text: Array) -> Array:
        """Velocity of the RGB latents.

        Args:
            latents: [b t h w c] float32; latent frame 0 is the clean reference.
            conditions: name of each condition stream -> [b t' h' w' c] latents, or [b t' 16] joint positions.
            sigma: [b] float32, noise level in [0, 1] of latent frames 1 and on.
            text: [b l e] float32, zero-padded (there is no mask, as in Wan).

        Returns:
            [b t h w c] float32; frame 0 carries no meaning.
        """
        tokens, rows, rotary = self.embed_streams(latents, conditions)
        time = self.time_embedding(sinusoid(jnp.stack([jnp.zeros_like(sigma), TIMESTEPS * sigma], axis=1)))
        modulation = self.modulation(time)
        tokens = self.apply_blocks(tokens, modulation, rows, rotary, self.text_embedding(text))
        rgb = np.prod(token_grid(latents.shape)).item()
        return unpatchify(self.head(tokens[:, :rgb], time, rows[:rgb]), latents.shape)

    def embed_streams(self, latents: Array, conditions: Mapping[str, Array]) -> tuple[Array, np.ndarray, Rotary]:
        """All streams' tokens [b s d], the row of the noise level that each token is told [s], and their rotations."""
        inputs = {"rgb": latents} | {name: conditions[name] for name in self.condition_streams}
        grids = {name: token_grid(array.shape) for name, array in inputs.items()}
        tokens = jnp.concatenate([self._embed(name, array) for name, array in inputs.items()], axis=1)
        rows = np.concatenate([token_rows(STREAMS[name], grid) for name, grid in grids.items()])
        angles = np.concatenate([rotary_angles(grid, self.size.head_dim, self.size.rotary_base) for grid in grids.values()])
        return tokens, rows, (jnp.asarray(np.cos(angles), jnp.float32), jnp.asarray(np.sin(angles), jnp.float32))

    def _embed(self, name: str, array: Array) -> Array:
        if name == "rgb":
            return self.patch_embedding(patchify(array)).astype(jnp.float32)
        values = array if STREAMS[name].source == "joints" else patchify(array)
        return self.stream_inputs[name](values).astype(jnp.float32) + self.stream_embeddings[name][None, None]

    def modulation(self, time: Array) -> Array:
        """Adaptive-norm shifts, scales and gates [b r 6 d] of time embeddings [b r d]."""
        return self.time_projection(nnx.silu(time)).reshape(*time.shape[:-1], 6, self.size.dim)

    def apply_blocks(self, tokens: Array, modulation: Array, rows: np.ndarray, rotary: Rotary, text: Array) -> Array:
        """The block stack as a scan over the leading axis of the stacked parameters."""
        graph, layers = nnx.split(self.blocks)

        def block(carry: Array, layer: nnx.State) -> tuple[Array, None]:
            return nnx.merge(graph, layer)(cut_over_batch(carry), modulation, rows, rotary, text), None

        return jax.lax.scan(jax.checkpoint(block) if self.remat else block, tokens, layers, unroll=self.unroll)[0]


class Block(nnx.Module):
    """Self-attention over all streams, cross-attention to the text, feed-forward; modulated by the noise level."""

    def __init__(self, size: ModelSize, dtype: jnp.dtype, attention: Literal["xla", "cudnn"], rngs: nnx.Rngs) -> None:
        self.modulation = nnx.Param(_scaled_normal(rngs.params(), (1, 6, size.dim)))
        self.self_attn = Attention(size, dtype, attention, rngs)
        self.cross_attn = Attention(size, dtype, attention, rngs)
        self.norm3 = nnx.LayerNorm(size.dim, epsilon=EPSILON, dtype=jnp.float32, rngs=rngs)
        self.ffn = TwoLayer(size.dim, size.ffn_dim, size.dim, _gelu, dtype, nnx.initializers.xavier_uniform(), rngs)

    def __call__(self, tokens: Array, modulation: Array, rows: np.ndarray, rotary: Rotary, text: Array) -> Array:
        """tokens [b s d]; modulation [b r 6 d], of which token i takes row rows[i]; text [b l d]."""
        chunks = self.modulation[...][None] + modulation
        shift_sa, scale_sa, gate_sa, shift_ffn, scale_ffn, gate_ffn = (take_rows(chunks[:, :, i], rows) for i in range(6))
        attended = self.self_attn(modulate(tokens, shift_sa, scale_sa), rotary=rotary)
        tokens = tokens + attended.astype(jnp.float32) * gate_sa
        tokens = tokens + self.cross_attn(self.norm3(tokens), text).astype(jnp.float32)
        return tokens + self.ffn(modulate(tokens, shift_ffn, scale_ffn)).astype(jnp.float32) * gate_ffn


class Attention(nnx.Module):
    """Multi-head attention; queries and keys are normalised over the full width, before they are split into heads."""

    def __init__(self, size: ModelSize, dtype: jnp.dtype, implementation: Literal["xla", "cudnn"], rngs: nnx.Rngs) -> None:
        self.heads, self.dtype, self.implementation = size.heads, dtype, implementation
        self.q, self.k, self.v, self.o = (_linear(size.dim, size.dim, dtype, rngs) for _ in range(4))
        self.norm_q, self.norm_k = (nnx.RMSNorm(size.dim, epsilon=EPSILON, dtype=jnp.float32, rngs=rngs) for _ in range(2))

    def __call__(self, tokens: Array, context: Array | None = None, rotary: Rotary | None = None) -> Array:
        """tokens [b s d] attend to context [b l d], or to each other under rotary positions."""
        context = tokens if context is None else context
        q, k, v = (
            self._split(self.norm_q(self.q(tokens))),
            self._split(self.norm_k(self.k(context))),
            self._split(self.v(context)),
        )
        if rotary is not None:
            q, k = rotate(q, rotary), rotate(k, rotary)
        q, k, v = (cut_over_batch(x.astype(self.dtype)) for x in (q, k, v))
        return self.o(jax.nn.dot_product_attention(q, k, v, implementation=self.implementation).reshape(tokens.shape))

    def _split(self, values: Array) -> Array:
        return values.reshape(*values.shape[:2], self.heads, -1)


class Head(nnx.Module):
    """Norm modulated by the time embedding itself (not by its projection), then one linear layer, zero at the start."""

    def __init__(self, dim: int, features: int, rngs: nnx.Rngs) -> None:
        self.modulation = nnx.Param(_scaled_normal(rngs.params(), (1, 2, dim)))
        self.head = nnx.Linear(dim, features, dtype=jnp.float32, kernel_init=nnx.initializers.zeros_init(), rngs=rngs)

    def __call__(self, tokens: Array, time: Array, rows: np.ndarray) -> Array:
        """Features [b s pt*ph*pw*c] of tokens [b s d]; time [b r d]."""
        chunks = self.modulation[...][None] + time[:, :, None]
        return self.head(modulate(tokens, take_rows(chunks[:, :, 0], rows), take_rows(chunks[:, :, 1], rows)))


class TwoLayer(nnx.Module):
    """Linear, activation, linear."""

    def __init__(
        self,
        features: int,
        hidden: int,
        out: int,
        activation: Activation,
        dtype: jnp.dtype,
        init: nnx.Initializer,
        rngs: nnx.Rngs,
    ) -> None:
        self.activation = activation
        self.first = nnx.Linear(features, hidden, dtype=dtype, kernel_init=init, rngs=rngs)
        self.second = nnx.Linear(hidden, out, dtype=dtype, kernel_init=init, rngs=rngs)

    def __call__(self, values: Array) -> Array:
        return self.second(self.activation(self.first(values)))


EMBEDDING_INIT = nnx.initializers.normal(0.02)


def modulate(tokens: Array, shift: Array, scale: Array) -> Array:
    """LayerNorm without parameters in float32, then scale and shift [b s d]."""
    mean = tokens.mean(-1, keepdims=True)
    variance = tokens.var(-1, keepdims=True)
    return (tokens - mean) * jax.lax.rsqrt(variance + EPSILON) * (1 + scale) + shift


def take_rows(values: Array, rows: np.ndarray) -> Array:
    """values[:, rows] of [b r d] as a sum over masks [b s d]: a gather's gradient is a scatter, slow on every device."""
    masks = (rows[:, None] == np.arange(values.shape[1])).astype(np.float32)
    return sum(values[:, row, None] * masks[None, :, row, None] for row in range(values.shape[1]))


def sinusoid(timestep: Array) -> Array:
    """Cosines, then sines [... 256] of timesteps [...]."""
    half = TIME_FREQUENCIES // 2
    frequencies = jnp.asarray(WAVELENGTH_BASE ** (-np.arange(half) / half), jnp.float32)
    angles = timestep[..., None] * frequencies.reshape(*(1,) * timestep.ndim, half)
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], axis=-1)


def token_grid(shape: Sequence[int]) -> tuple[int, int, int]:
    """Frames, rows and columns of the tokens of latents [b t h w c] or of joint positions [b t 16]."""
    if len(shape) == 3:
        return shape[1], 1, 1
    return shape[1] // PATCH[0], shape[2] // PATCH[1], shape[3] // PATCH[2]


def token_rows(stream: Stream, grid: tuple[int, int, int]) -> np.ndarray:
    """Which noise level each token is told [s]: row 0 is clean, row 1 the sample's own."""
    frames = np.zeros(grid[0], int) if stream.timestep == "clean" else np.minimum(np.arange(grid[0]), 1)
    return np.repeat(frames, grid[1] * grid[2])


def rotary_angles(grid: tuple[int, int, int], head_dim: int, base: float = WAVELENGTH_BASE) -> np.ndarray:
    """Rotation angles [s head_dim/2] float64 of the tokens of a grid; every stream counts from (0, 0, 0).

    The head is split among time, height and width as in Wan (44, 42, 42 of 128; 24, 20, 20 of 64), and each part has
    its own geometric series of frequencies.
    """
    part = 2 * (head_dim // 6)
    parts = (head_dim - 2 * part, part, part)
    positions = np.stack(np.meshgrid(*(np.arange(n) for n in grid), indexing="ij"), -1).reshape(-1, 3)
    series = [base ** (-np.arange(0, width, 2) / width) for width in parts]
    return np.concatenate([np.outer(positions[:, axis], frequencies) for axis, frequencies in enumerate(series)], axis=-1)


def rotate(values: Array, rotary: Rotary) -> Array:
    """Turn neighbouring pairs of features of [b s n k] by each token's angles, in float32."""
    cos, sin = (table[None, :, None, :, None] for table in rotary)
    pairs = values.reshape(*values.shape[:-1], -1, 2)
    return (pairs * cos + pairs[..., ::-1] * jnp.concatenate([-sin, sin], axis=-1)).reshape(values.shape)


def patchify(latents: Array) -> Array:
    """[b t h w c] -> tokens [b s c*ph*pw] in the feature order of Wan's convolution weights."""
    b, _, _, _, c = latents.shape
    t, h, w = token_grid(latents.shape)
    cut = latents.reshape(b, t, PATCH[0], h, PATCH[1], w, PATCH[2], c)
    return cut.transpose(0, 1, 3, 5, 7, 2, 4, 6).reshape(b, t * h * w, -1)


def unpatchify(features: Array, shape: Sequence[int]) -> Array:
    """Head features [b s pt*ph*pw*c] -> latents of `shape` [b t h w c]; here c runs fastest."""
    b, _, _, _, c = shape
    t, h, w = token_grid(shape)
    cut = features.reshape(b, t, h, w, *PATCH, c)
    return cut.transpose(0, 1, 4, 2, 5, 3, 6, 7).reshape(shape)


def parameter_count(model: nnx.Module) -> int:
    """How many numbers the model learns."""
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))


def _gelu(values: Array) -> Array:
    return nnx.gelu(values, approximate=True)


def _linear(features: int, out: int, dtype: jnp.dtype, rngs: nnx.Rngs) -> nnx.Linear:
    return nnx.Linear(features, out, dtype=dtype, kernel_init=nnx.initializers.xavier_uniform(), rngs=rngs)


def _scaled_normal(key: Array, shape: tuple[int, ...]) -> Array:
    """Wan's start for modulations: normal over the root of the width."""
    return jax.random.normal(key, shape, jnp.float32) / np.sqrt(shape[-1]).astype(np.float32)


def _stacked_blocks(size: ModelSize, dtype: jnp.dtype, attention: Literal["xla", "cudnn"], rngs: nnx.Rngs) -> Block:
    """`depth` blocks as one whose parameters have a leading layer axis."""

    @nnx.split_rngs(splits=size.depth)
    @nnx.vmap(in_axes=0, out_axes=0)
    def create(layer_rngs: nnx.Rngs) -> Block:
        return Block(size, dtype, attention, layer_rngs)

    return create(rngs)

"""The diffusion transformer: Wan2.2-TI2V-5B's block stack over a list of token streams (Flax NNX).

Reads  latents [b t h w c] of each stream, noise level, text embeddings [b l e]
Writes velocity [b t h w c] of the RGB stream
To add a size: one line in MODELS. To add a stream: one line in STREAMS. Published weights: dit_layouts.py.

Shape letters: b batch, t h w c latent video, s tokens (t' h' w' flattened), d width, n heads, r distinct noise levels,
l text tokens (in a cache: layers).
Numbers that look arbitrary (eps 1e-6, 256 frequencies, six modulations) are those of the published weights.

Precision: matrix products and attention in `dtype`; norms, modulation, residual sums, time embedding and head in float32
and written so that they fuse: no [b s 6 d] is formed, and what enters several products is rounded once.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array
from jax.ad_checkpoint import checkpoint_name

from xew.config import ConfigError
from xew.model.mechanisms import MECHANISMS, FramedContext, create_mechanism, ray_maps
from xew.model.sharding import cut_over_batch, gathered

PATCH = (1, 2, 2)
EPSILON = 1e-6
WAVELENGTH_BASE = 10_000.0
TIME_FREQUENCIES = 256
TIMESTEPS = 1000.0
"""The network is told the noise level as sigma times this."""

Activation = Callable[[Array], Array]
Rotary = tuple[Array, Array]
"""Cosine and sine [s head_dim/2] of every token's rotation angles."""
AttentionName = Literal["auto", "xla", "cudnn"]
RematName = Literal["none", "attention", "dots", "full"]
Visibility = Literal["joint", "one_way"]
TimeEmbedding = Literal["exact", "flowwam"]


class ConditionCache(NamedTuple):
    """What every layer's RGB tokens read of the condition tokens, when these do not look back (`one_way`)."""

    keys: Array
    """[layers b s n head_dim], rotated."""
    values: Array
    """[layers b s n head_dim]."""


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

    source: Literal["latents", "joints", "history"]
    """Encoded video [b t h w c], the 16-number action of each latent frame [b t 16], or earlier RGB frames, each encoded
    alone [b n h w c], which RGB's own patch embedding takes."""
    timestep: Literal["shared", "clean"]
    """Noise level that its tokens are told: RGB's own (0 in latent frame 0), as FlowWAM does, or 0."""


STREAMS = {
    "rgb": Stream("latents", "shared"),
    "action": Stream("latents", "shared"),
    "embodiment": Stream("latents", "clean"),
    "joints": Stream("joints", "shared"),
    "history": Stream("history", "clean"),
}


class WorldModel(nnx.Module):
    """Predicts the flow-matching velocity of the RGB stream given clean condition streams.

    Args:
        size: one of `MODELS`.
        channels: of the latents.
        streams: names in `STREAMS` beside rgb, and in `mechanisms.MECHANISMS`.
        dtype: of the matrix products; parameters, norms and modulation stay float32.
        residual: of the tokens between blocks; sums are float32 either way. bfloat16 (as diffusers') halves what is kept
            of each block and most of what is moved, and rounds the tokens 90 times.
        remat: what the backward pass computes again instead of keeping; see `REMAT`.
        unroll: blocks compiled as one loop body; more is faster on a CPU and slower to compile.
        attention: see `choose_attention`.
        visibility: "joint": all tokens see all, as in FlowWAM. "one_way": condition tokens see condition tokens only and
            are told the noise level 0, so that a sampler computes them once a clip (`condition_cache`); a departure.
        time: "exact", or "flowwam": the rounding with which FlowWAM's published weights were trained.
        history: when the frames of the stream history were, in latent frames from the clip's first (negative).
        words: rows of a learned table of words; text is then ids [b l] instead of embeddings. 0 has none.
    """

    def __init__(
        self,
        size: ModelSize,
        channels: int,
        streams: Sequence[str] = (),
        *,
        dtype: jnp.dtype = jnp.float32,
        residual: jnp.dtype = jnp.float32,
        remat: RematName = "none",
        unroll: int = 1,
        attention: AttentionName = "auto",
        visibility: Visibility = "joint",
        time: TimeEmbedding = "exact",
        history: Sequence[float] = (),
        words: int = 0,
        rngs: nnx.Rngs,
    ) -> None:
        self.size, self.channels, self.dtype, self.residual = size, channels, dtype, residual
        self.remat, self.unroll, self.visibility, self.time = remat, unroll, visibility, time
        self.history = tuple(history)
        # Earlier frames come right after RGB's tokens, so that all frames that have a context of their own are one piece.
        self.condition_streams = tuple(sorted((name for name in streams if name in STREAMS), key="history".__ne__))
        features = channels * int(np.prod(PATCH))
        self.patch_embedding = _linear(features, size.dim, dtype, rngs)
        self.text_embedding = TwoLayer(size.text_dim, size.dim, size.dim, _gelu, dtype, EMBEDDING_INIT, rngs)
        self.time_embedding = TwoLayer(TIME_FREQUENCIES, size.dim, size.dim, nnx.silu, jnp.float32, EMBEDDING_INIT, rngs)
        self.time_projection = _linear(size.dim, 6 * size.dim, jnp.float32, rngs)
        self.blocks = _stacked_blocks(size, dtype, attention, rngs)
        self.head = Head(size.dim, features, rngs)
        self.words = nnx.Embed(words, size.text_dim, embedding_init=nnx.initializers.normal(1.0), rngs=rngs) if words else None
        self.stream_embeddings = nnx.data({})
        self.stream_inputs = nnx.data({})
        for name in self.condition_streams:
            self.stream_embeddings[name] = nnx.Param(_scaled_normal(rngs.params(), (size.dim,)))
            if STREAMS[name].source != "history":
                self.stream_inputs[name] = self._stream_input(STREAMS[name], rngs)
        self.mechanisms = nnx.data({})
        for name in (name for name in streams if name not in STREAMS):
            self.mechanisms[name] = create_mechanism(name, size, features, dtype, rngs)

    def _stream_input(self, stream: Stream, rngs: nnx.Rngs) -> nnx.Module:
        """Pixel streams start from a copy of RGB's patch embedding, as FlowWAM and the paper do."""
        if stream.source == "joints":
            return TwoLayer(16, self.size.dim, self.size.dim, nnx.silu, self.dtype, nnx.initializers.xavier_uniform(), rngs)
        return jax.tree.map(jnp.copy, self.patch_embedding)

    def __call__(
        self,
        latents: Array,
        conditions: Mapping[str, Array],
        sigma: Array,
        text: Array,
        cache: ConditionCache | None = None,
    ) -> Array:
        """Velocity of the RGB latents.

        Args:
            latents: [b t h w c] float32; latent frame 0 is the clean reference.
            conditions: name of each condition stream or mechanism -> [b t' h' w' c] latents, or [b t' n] numbers. Those of
                streams are not read where a cache is given.
            sigma: [b] float32, noise level in [0, 1] of latent frames 1 and on.
            text: [b l e] float32, zero-padded (there is no mask, as in Wan); or ids [b l] int32 of `words`, 0 for none.
            cache: of these conditions and this text, from `condition_cache`.

        Returns:
            [b t h w c] float32; frame 0 carries no meaning.
        """
        rgb = np.prod(token_grid(latents.shape)).item()
        tokens, rows, rotary = self.embed_streams(latents, conditions, cached=cache is not None)
        time, rows = self.tell_frames(self.embed_time(sigma), rows, latents.shape, conditions)
        context = self.framed_context(text, latents.shape, conditions)
        tokens = self.apply_blocks(tokens, self.modulation(time), rows, rotary, context, rgb, cache)
        return unpatchify(self.head(tokens[:, :rgb].astype(jnp.float32), time, rows[:rgb]), latents.shape)

    def condition_cache(self, conditions: Mapping[str, Array], text: Array) -> ConditionCache:
        """Keys and values of the condition tokens in every layer; they hold for all steps of sampling a clip.

        Raises:
            ValueError: the model is not `one_way`, so that condition tokens depend on the RGB tokens of each step.
        """
        if self.visibility != "one_way":
            raise ValueError("condition tokens can only be computed ahead in a model of visibility one_way.")
        tokens, rows, rotary = self._join({name: conditions[name] for name in self.condition_streams})
        modulation = self.modulation(self.embed_time(jnp.zeros(tokens.shape[0], jnp.float32)))
        context = self.context(text, conditions)
        graph, layers = nnx.split(self.blocks)

        def block(carry: Array, layer: nnx.State) -> tuple[Array, ConditionCache]:
            module = nnx.merge(graph, layer)
            read = ConditionCache(*module.keys_values(carry, modulation, rows, rotary))
            return module(carry, modulation, rows, rotary, context), read

        return jax.lax.scan(block, tokens, layers, unroll=self.unroll)[1]

    def embed_streams(
        self, latents: Array, conditions: Mapping[str, Array], cached: bool = False
    ) -> tuple[Array, np.ndarray, Rotary]:
        """All streams' tokens [b s d], the row of the noise level that each token is told [s], and their rotations."""
        streams = {name: conditions[name] for name in self.condition_streams if not cached}
        tokens, rows, rotary = self._join({"rgb": latents} | streams)
        for name in self._entering("channels"):
            pictures = conditions[name]
            if MECHANISMS[name].source == "camera":
                pictures = ray_maps(pictures, latents.shape)
            columns = self.mechanisms[name](patchify(pictures)).astype(jnp.float32)
            tokens = tokens.at[:, : columns.shape[1]].add(columns.astype(self.residual))
        return tokens, rows, rotary

    def _join(self, inputs: Mapping[str, Array]) -> tuple[Array, np.ndarray, Rotary]:
        grids = {name: token_grid(array.shape) for name, array in inputs.items()}
        tokens = jnp.concatenate([self._embed(name, array) for name, array in inputs.items()], axis=1)
        rows = np.concatenate([token_rows(self._stream(name), grid) for name, grid in grids.items()])
        head_dim, base, times = self.size.head_dim, self.size.rotary_base, {"history": self.history}
        angles = np.concatenate([rotary_angles(grid, head_dim, base, times.get(name)) for name, grid in grids.items()])
        rotary = jnp.asarray(np.cos(angles), jnp.float32), jnp.asarray(np.sin(angles), jnp.float32)
        return tokens.astype(self.residual), rows, rotary

    def _stream(self, name: str) -> Stream:
        """A stream as this model tells it the time: nothing that RGB does not feed can know its noise level."""
        stream = STREAMS[name]
        return dataclasses.replace(stream, timestep="clean") if self.visibility == "one_way" and name != "rgb" else stream

    def _embed(self, name: str, array: Array) -> Array:
        if name == "rgb":
            return self.patch_embedding(patchify(array)).astype(jnp.float32)
        values = array if STREAMS[name].source == "joints" else patchify(array)
        embed = self.patch_embedding if STREAMS[name].source == "history" else self.stream_inputs[name]
        return embed(values).astype(jnp.float32) + self.stream_embeddings[name][None, None]

    def embed_time(self, sigma: Array) -> Array:
        """Time embeddings [b 2 d] of the two noise levels of each sample: none, and its own [b]."""
        timesteps = jnp.stack([jnp.zeros_like(sigma), TIMESTEPS * sigma], axis=1)
        return self.time_embedding(rounded_sinusoid(timesteps) if self.time == "flowwam" else sinusoid(timesteps))

    def _entering(self, place: str) -> list[str]:
        """The model's mechanisms that enter the network at one place."""
        return [name for name in self.mechanisms if MECHANISMS[name].enters == place]

    def tell_frames(
        self, time: Array, rows: np.ndarray, shape: Sequence[int], conditions: Mapping[str, Array]
    ) -> tuple[Array, np.ndarray]:
        """Time embeddings [b r d] and rows [s] in which each frame of RGB latents of `shape` has a row of its own.

        It is the embedding of the frame's noise level plus the vectors of the mechanisms that enter there; without one,
        all stays as it is. Other streams keep their two rows.
        """
        names = self._entering("time")
        if not names:
            return time, rows
        frames, height, width = token_grid(shape)
        levels = token_rows(STREAMS["rgb"], (frames, 1, 1))
        told = sum((self.mechanisms[name](conditions[name]) for name in names), take_rows(time, levels))
        own = np.repeat(time.shape[1] + np.arange(frames), height * width)
        return jnp.concatenate([time, told], axis=1), np.concatenate([own, rows[len(own) :]])

    def context(self, text: Array, conditions: Mapping[str, Array] | None = None) -> Array:
        """What all tokens' cross-attention reads [b l d].

        Args:
            text: embeddings [b l e], or ids of words [b l].
            conditions: of mechanisms whose tokens stand beside the text, or instead of it.
        """
        names = self._entering("context")
        told = [self.mechanisms[name]((conditions or {})[name]).astype(self.dtype) for name in names]
        if any(MECHANISMS[name].replaces_text for name in names):
            return jnp.concatenate(told, axis=1)
        if self.words is not None:
            text = self.words(text) * (text > 0)[..., None].astype(jnp.float32)
        return jnp.concatenate([self.text_embedding(text), *told], axis=1)

    def framed_context(self, text: Array, shape: Sequence[int], conditions: Mapping[str, Array]) -> Array | FramedContext:
        """`context`, and beside it what only the tokens of one frame read, where a mechanism has such tokens.

        The frames are those of RGB latents of `shape` and, after them as in the tokens, those of the history.
        """
        shared, names = self.context(text, conditions), self._entering("frame")
        if not names:
            return shared
        frames, height, width = token_grid(shape)
        told = jnp.concatenate([self.mechanisms[name](conditions[name]).astype(self.dtype) for name in names], axis=2)
        earlier = told.shape[1] - frames
        return FramedContext(shared, jnp.concatenate([told[:, earlier:], told[:, :earlier]], axis=1), height * width)

    def modulation(self, time: Array) -> Array:
        """Adaptive-norm shifts, scales and gates [b r 6 d] of time embeddings [b r d]."""
        return self.time_projection(nnx.silu(time)).reshape(*time.shape[:-1], 6, self.size.dim)

    def apply_blocks(
        self,
        tokens: Array,
        modulation: Array,
        rows: np.ndarray,
        rotary: Rotary,
        text: Array | FramedContext,
        rgb: int | None = None,
        cache: ConditionCache | None = None,
    ) -> Array:
        """The block stack as a scan over the leading axis of the stacked parameters; the first `rgb` tokens are RGB's."""
        graph, layers = nnx.split(self.blocks)
        alone = rgb if self.visibility == "one_way" and rgb != tokens.shape[1] else None

        def block(carry: Array, xs: tuple[nnx.State, ConditionCache | None]) -> tuple[Array, None]:
            layer, read = xs
            module = nnx.merge(graph, gathered(layer, layer=True))
            return module(cut_over_batch(carry), modulation, rows, rotary, text, alone=alone, cache=read), None

        if self.remat != "none":
            # The loop already keeps recomputation apart from the forward pass; only without a loop must it be forced.
            block = jax.checkpoint(block, policy=REMAT[self.remat], prevent_cse=self.unroll >= self.size.depth)
        return jax.lax.scan(block, tokens, (layers, cache), unroll=self.unroll)[0]


class Block(nnx.Module):
    """Self-attention over all streams, cross-attention to the text, feed-forward; modulated by the noise level."""

    def __init__(self, size: ModelSize, dtype: jnp.dtype, attention: AttentionName, rngs: nnx.Rngs) -> None:
        self.dtype = dtype
        self.modulation = nnx.Param(_scaled_normal(rngs.params(), (1, 6, size.dim)))
        self.self_attn = Attention(size, dtype, attention, rngs)
        self.cross_attn = Attention(size, dtype, attention, rngs)
        self.norm3 = nnx.LayerNorm(size.dim, epsilon=EPSILON, use_fast_variance=False, dtype=jnp.float32, rngs=rngs)
        self.ffn = TwoLayer(size.dim, size.ffn_dim, size.dim, _gelu, dtype, nnx.initializers.xavier_uniform(), rngs)

    def __call__(
        self,
        tokens: Array,
        modulation: Array,
        rows: np.ndarray,
        rotary: Rotary,
        text: Array | FramedContext,
        alone: int | None = None,
        cache: ConditionCache | None = None,
    ) -> Array:
        """tokens [b s d]; modulation [b r 6 d], of which token i takes row rows[i]; text [b l d].

        Tokens from `alone` on see none before them; those before see all, and the keys and values of `cache` too.
        """
        shift_sa, scale_sa, gate_sa, shift_ffn, scale_ffn, gate_ffn = self._chunks(modulation, rows)
        attended = self.self_attn(modulate(tokens, shift_sa, scale_sa, self.dtype), rotary=rotary, alone=alone, cache=cache)
        tokens = add(tokens, attended, gate_sa)
        across = self.cross_attn.by_frame if isinstance(text, FramedContext) else self.cross_attn
        tokens = add(tokens, across(self.norm3(tokens).astype(self.dtype), text))
        return add(tokens, self.ffn(modulate(tokens, shift_ffn, scale_ffn, self.dtype)), gate_ffn)

    def keys_values(self, tokens: Array, modulation: Array, rows: np.ndarray, rotary: Rotary) -> tuple[Array, Array]:
        """What others' self-attention reads of these tokens: keys and values [b s n head_dim]."""
        shift, scale = self._chunks(modulation, rows)[:2]
        return self.self_attn.keys_values(modulate(tokens, shift, scale, self.dtype), rotary)

    def _chunks(self, modulation: Array, rows: np.ndarray) -> list[Array]:
        """Six [b s d]: shift, scale and gate of self-attention, then of the feed-forward; never formed at once."""
        chunks = self.modulation[...][None] + modulation
        return [take_rows(chunks[:, :, i], rows) for i in range(6)]


class Attention(nnx.Module):
    """Multi-head attention; queries and keys are normalised over the full width, before they are split into heads."""

    def __init__(self, size: ModelSize, dtype: jnp.dtype, implementation: AttentionName, rngs: nnx.Rngs) -> None:
        self.heads, self.dtype, self.implementation = size.heads, dtype, implementation
        self.q, self.k, self.v, self.o = (_linear(size.dim, size.dim, dtype, rngs) for _ in range(4))
        self.norm_q, self.norm_k = (nnx.RMSNorm(size.dim, epsilon=EPSILON, dtype=jnp.float32, rngs=rngs) for _ in range(2))

    def __call__(
        self,
        tokens: Array,
        context: Array | None = None,
        rotary: Rotary | None = None,
        alone: int | None = None,
        cache: ConditionCache | None = None,
    ) -> Array:
        """tokens [b s d] attend to context [b l d], or to each other under rotary positions.

        Tokens from `alone` on see none before them: two calls of attention instead of a mask [s s]. The keys and values
        of `cache` (one layer's) are seen beside the tokens' own.
        """
        q = self._heads(self.norm_q(self.q(tokens)), rotary)
        k, v = self.keys_values(tokens if context is None else context, rotary)
        if cache is not None:
            k, v = jnp.concatenate([k, cache.keys], axis=1), jnp.concatenate([v, cache.values], axis=1)
        if alone is None:
            attended = self._attend(q, k, v)
        else:
            parts = self._attend(q[:, :alone], k, v), self._attend(q[:, alone:], k[:, alone:], v[:, alone:])
            attended = jnp.concatenate(parts, axis=1)
        return self.o(attended.reshape(tokens.shape))

    def by_frame(self, tokens: Array, context: FramedContext) -> Array:
        """tokens [b s d] attend to the shared context; those of the first frames to their own frame's beside it."""
        batch, frames, own, width = context.framed.shape
        shared = self.keys_values(context.shared, None)
        k, v = (
            jnp.concatenate([jnp.repeat(all_see[:, None], frames, axis=1), one.reshape(batch, frames, own, *one.shape[2:])], 2)
            for all_see, one in zip(
                shared, self.keys_values(context.framed.reshape(batch, frames * own, width), None), strict=True
            )
        )
        q, cut = self._heads(self.norm_q(self.q(tokens)), None), frames * context.tokens
        by_frame = q[:, :cut].reshape(batch * frames, context.tokens, *q.shape[2:])
        attended = self._attend(by_frame, *(x.reshape(batch * frames, *x.shape[2:]) for x in (k, v)))
        attended = attended.reshape(batch, cut, *q.shape[2:])
        if cut < tokens.shape[1]:
            attended = jnp.concatenate([attended, self._attend(q[:, cut:], *shared)], axis=1)
        return self.o(attended.reshape(tokens.shape))

    def keys_values(self, context: Array, rotary: Rotary | None) -> tuple[Array, Array]:
        """Keys (rotated where there are positions) and values [b l n head_dim] of context [b l d]."""
        return self._heads(self.norm_k(self.k(context)), rotary), self._heads(self.v(context), None)

    def _heads(self, values: Array, rotary: Rotary | None) -> Array:
        values = values.reshape(*values.shape[:2], self.heads, -1)
        return cut_over_batch((values if rotary is None else rotate(values, rotary)).astype(self.dtype))

    def _attend(self, q: Array, k: Array, v: Array) -> Array:
        chosen = choose_attention(self.implementation, q.shape[-1], self.dtype)
        attended = jax.nn.dot_product_attention(q, k, v, implementation=chosen)
        return attended if chosen == "cudnn" else checkpoint_name(attended, "attention")


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


def modulate(tokens: Array, shift: Array, scale: Array, dtype: jnp.dtype = jnp.float32) -> Array:
    """LayerNorm without parameters in float32, then scale and shift [b s d], rounded once for all who read it."""
    tokens = tokens.astype(jnp.float32)
    centred = tokens - tokens.mean(-1, keepdims=True)
    normed = centred * jax.lax.rsqrt(jnp.square(centred).mean(-1, keepdims=True) + EPSILON)
    return (normed * (1 + scale) + shift).astype(dtype)


def add(tokens: Array, change: Array, gate: Array | None = None) -> Array:
    """tokens + change * gate [b s d] in float32, in the type of the tokens."""
    change = change.astype(jnp.float32)
    return (tokens.astype(jnp.float32) + (change if gate is None else change * gate)).astype(tokens.dtype)


def take_rows(values: Array, rows: np.ndarray) -> Array:
    """values[:, rows] [b s d] of [b r d] float32, in forms whose gradient is no scatter (slow on every device).

    Two rows are a choice, which fuses into what uses it and whose gradient is a masked sum. More (a row for each latent
    frame) are a gather whose gradient is a product with the matrix of ones that says which token has which row.
    """
    count = values.shape[1]
    if count <= 2:
        return jnp.where((rows == 0)[None, :, None], values[:, :1], values[:, count - 1 :])
    return _gather_rows(values, tuple(rows.tolist()))


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def _gather_rows(values: Array, rows: tuple[int, ...]) -> Array:
    return values[:, np.asarray(rows)]


def _gather_rows_forward(values: Array, rows: tuple[int, ...]) -> tuple[Array, int]:
    return _gather_rows(values, rows), values.shape[1]


def _gather_rows_backward(rows: tuple[int, ...], count: int, gradient: Array) -> tuple[Array]:
    has_row = jnp.asarray(np.equal(rows, np.arange(count)[:, None]), gradient.dtype)
    return (jnp.einsum("rs,bsd->brd", has_row, gradient, precision=jax.lax.Precision.HIGHEST),)


_gather_rows.defvjp(_gather_rows_forward, _gather_rows_backward)


def sinusoid(timestep: Array) -> Array:
    """Cosines, then sines [... 256] of float32 timesteps [...], as exact as Wan's float64 (to 2e-7; plain float32: 6e-5).

    A timestep times a frequency is split in a product of their upper halves, which float32 holds exactly, and a small
    rest, by which the angle is turned with the addition theorem.
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
"""Bits of a float32 that keep 12 of its 24 significant ones."""


def rounded_sinusoid(timestep: Array) -> Array:
    """`sinusoid` as FlowWAM has it: of the timestep in bfloat16 (steps of 4 from 512 on), itself rounded to bfloat16."""
    return sinusoid(timestep.astype(jnp.bfloat16).astype(jnp.float32)).astype(jnp.bfloat16).astype(jnp.float32)


def token_grid(shape: Sequence[int]) -> tuple[int, int, int]:
    """Frames, rows and columns of the tokens of latents [b t h w c] or of joint positions [b t 16]."""
    if len(shape) == 3:
        return shape[1], 1, 1
    return shape[1] // PATCH[0], shape[2] // PATCH[1], shape[3] // PATCH[2]


def token_rows(stream: Stream, grid: tuple[int, int, int]) -> np.ndarray:
    """Which noise level each token is told [s]: row 0 is clean, row 1 the sample's own."""
    frames = np.zeros(grid[0], int) if stream.timestep == "clean" else np.minimum(np.arange(grid[0]), 1)
    return np.repeat(frames, grid[1] * grid[2])


def rotary_angles(
    grid: tuple[int, int, int], head_dim: int, base: float = WAVELENGTH_BASE, times: Sequence[float] | None = None
) -> np.ndarray:
    """Rotation angles [s head_dim/2] float64 of the tokens of a grid; every stream counts from (0, 0, 0).

    The head is split among time, height and width as in Wan (44, 42, 42 of 128; 24, 20, 20 of 64), and each part has
    its own geometric series of frequencies.
    """
    part = 2 * (head_dim // 6)
    parts = (head_dim - 2 * part, part, part)
    axes = (np.arange(grid[0]) if times is None else np.asarray(times), np.arange(grid[1]), np.arange(grid[2]))
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
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


def _is_attention(primitive: Any, *_: Any, **__: Any) -> bool:
    """Results of cuDNN's attention (output and logarithms of its sums), which has no other name to be kept by."""
    return str(primitive.name).startswith("dot_product_attention_fwd")


_POLICIES = jax.checkpoint_policies
_KEEP_ATTENTION = _POLICIES.save_from_both_policies(_POLICIES.save_only_these_names("attention"), _is_attention)
REMAT: dict[str, Callable[..., bool] | None] = {
    "attention": _KEEP_ATTENTION,
    "dots": _POLICIES.save_from_both_policies(_POLICIES.dots_with_no_batch_dims_saveable, _KEEP_ATTENTION),
    "full": None,
}
"""What the backward pass finds kept beside each block's input, by name.

full       nothing: the forward pass is computed twice (4/3 of the work), the least memory
attention  results of attention, so that all but its quadratic part is computed twice; one width more a token and block
dots       results of all matrix products and of attention, so that only norms and activations are computed twice
none       everything that the backward pass reads
"""


def choose_attention(asked: AttentionName, head_dim: int, dtype: jnp.dtype) -> Literal["xla", "cudnn"]:
    """The implementation of `jax.nn.dot_product_attention` on this machine.

    "auto" is cuDNN's on a CUDA GPU of compute capability 8.0 and up, in bfloat16 or float16, where the width of a head is
    a multiple of 8 and at most 256 (128 before Hopper, 9.0); else XLA's, which forms [n s s]. cuDNN takes any number of
    tokens, so nothing is padded. (The limits are those that jax itself checks.)

    Raises:
        ConfigError: cuDNN was asked for and cannot do it.
    """
    if asked == "xla":
        return "xla"
    reason = _cudnn_lacks(head_dim, jnp.dtype(dtype))
    if reason and asked == "cudnn":
        raise ConfigError(f"attention: cudnn cannot be used: {reason}; set model.attention to auto or xla.")
    return "xla" if reason else "cudnn"


def _cudnn_lacks(head_dim: int, dtype: np.dtype) -> str:
    """Why cuDNN's attention cannot be used here; empty if it can."""
    device = jax.devices()[0]
    if device.platform != "gpu" or "cuda" not in device.client.platform_version:
        return f"it needs a CUDA GPU and JAX runs on {device.platform}"
    capability = tuple(int(part) for part in str(device.compute_capability).split("."))
    widest = 256 if capability >= (9, 0) else 128
    if capability < (8, 0):
        return f"it needs compute capability 8.0 and {device.device_kind} has {device.compute_capability}"
    if dtype not in (jnp.bfloat16, jnp.float16):
        return f"it needs model.dtype bfloat16 and the model has {dtype.name}"
    if head_dim % 8 or head_dim > widest:
        return f"it needs heads of a multiple of 8 and at most {widest} features and the model's have {head_dim}"
    return ""


def flops(
    size: ModelSize,
    grids: Sequence[tuple[int, int, int]],
    text_tokens: int | None = None,
    batch: int = 1,
    *,
    visibility: Visibility = "joint",
    cached: bool = False,
    channels: int = 48,
) -> float:
    """Floating-point operations of one forward pass: two for each multiply-add of the matrix products, nothing else.

    A training step is three times this (what remat computes again is not counted, as is usual for MFU).

    Args:
        size: of the model.
        grids: tokens (t', h', w') of each stream, RGB first, as from `token_grid`.
        text_tokens: the model's own number where left out.
        batch: samples.
        visibility: as of the model.
        cached: a step of sampling in which the condition tokens are read from a cache.
        channels: of the latents.
    """
    text = size.text_tokens if text_tokens is None else text_tokens
    counts = [int(np.prod(grid)) for grid in grids]
    rgb, conditions = counts[0], sum(counts[1:])
    tokens = rgb if cached else rgb + conditions
    pairs = rgb * (rgb + conditions) + (
        0 if cached else conditions * (conditions if visibility == "one_way" else rgb + conditions)
    )
    dim, features = size.dim, channels * int(np.prod(PATCH))
    of_block = tokens * (6 * dim * dim + 2 * dim * size.ffn_dim) + 2 * dim * pairs
    of_text = 2 * text * dim * dim + 2 * dim * tokens * text
    of_ends = (tokens + rgb) * features * dim + text * (size.text_dim + dim) * dim
    return 2.0 * batch * (size.depth * (of_block + of_text) + of_ends)


def compute_params(graph: nnx.GraphDef, params: Any) -> Any:
    """Parameters with every matrix in the type in which its product is computed; the others stay as they are.

    With it the rounding is done once, before the loop over blocks (and over the steps of a sampler), instead of in every
    block of every pass, and sharded parameters are gathered in half the bytes. Within a loss it is differentiable: the
    gradients leave it in the type of the master copy.
    """
    model = nnx.merge(graph, params)
    types = {path: module.dtype for path, module in nnx.iter_modules(model) if isinstance(module, nnx.Linear) and module.dtype}
    flat = nnx.to_flat_state(params)
    rounded = [
        (path, leaf.replace(leaf.get_value().astype(types[path[:-1]])) if path[:-1] in types else leaf) for path, leaf in flat
    ]
    return nnx.from_flat_state(rounded)


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


def _stacked_blocks(size: ModelSize, dtype: jnp.dtype, attention: AttentionName, rngs: nnx.Rngs) -> Block:
    """`depth` blocks as one whose parameters have a leading layer axis."""

    @nnx.split_rngs(splits=size.depth)
    @nnx.vmap(in_axes=0, out_axes=0)
    def create(layer_rngs: nnx.Rngs) -> Block:
        return Block(size, dtype, attention, layer_rngs)

    return create(rngs)

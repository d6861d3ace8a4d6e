"""One block of the network and what it is made of: attention, norms, feed-forward, and how they are computed on a device.

Reads  tokens [b s d] of all streams, modulations [b r 6 d], rotations, context [b l d]
Writes tokens [b s d]

Shape letters: as in dit.py. Names of modules and parameters are those of Wan's checkpoints where Wan has the thing.

Precision: matrix products and attention in `dtype`; norms, modulation and residual sums in float32 and written so that they
fuse: no [b s 6 d] is formed, and what enters several products is rounded once.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array
from jax.ad_checkpoint import checkpoint_name
from jax.typing import DTypeLike
from jaxtyping import Float, Int, Key

from xew.model.devices.sharding import shard_over_batch
from xew.model.network.mechanisms import FramedContext, linear
from xew.model.network.tokens import WAN_PATCH, WAVELENGTH_BASE, Patch

EPSILON = 1e-6
"""Added to the variance in every norm."""

Activation = Callable[[Array], Array]
Rotary = tuple[Float[Array, "s angles"], Float[Array, "s angles"]]
"""Cosine and sine [s head_dim/2] float32 of every token's rotation angles."""
Levels = Int[np.ndarray, " s"]
"""Index [s] of each token's noise level among the r of a sample: 0 is no noise, 1 the sample's own."""
RematName = Literal["none", "attention", "dots", "full"]


class ConditionCache(NamedTuple):
    """What every layer's RGB tokens read of the condition tokens, where these do not look back (`one_way`)."""

    keys: Float[Array, "*layers b s heads k"]
    """Rotated keys [layers b s n head_dim]; of one layer [b s n head_dim]."""
    values: Float[Array, "*layers b s heads k"]
    """Values of the same shape."""


@dataclass(frozen=True)
class ModelSize:
    """Everything that distinguishes one size of the network from another."""

    dim: int
    """Width of a token."""
    depth: int
    """Number of blocks."""
    heads: int
    ffn_dim: int
    """Width of the hidden layer of the feed-forward."""
    text_dim: int
    """Width of the text's embeddings."""
    text_tokens: int
    """Number of tokens that the text is padded to."""
    rotary_base: float = WAVELENGTH_BASE
    """Ratio of the slowest to the fastest rotation of positions; Wan's serves clips of hundreds of positions a side, and
    a model of few positions resolves them sooner with less."""
    epsilon: float = EPSILON
    """Number that all norms add to a mean square; Wan's, but for checkpoints whose config.json says otherwise."""
    patch: Patch = WAN_PATCH
    """Latent frames (always one), rows and columns of a token: smaller ones make finer pictures of more tokens."""

    @property
    def head_dim(self) -> int:
        """Width of an attention head."""
        return self.dim // self.heads


class Block(nnx.Module):
    """Self-attention over all streams, cross-attention to the text, feed-forward; modulated by the noise level."""

    def __init__(self, size: ModelSize, dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        self.dtype, self.epsilon = dtype, size.epsilon
        self.modulation = nnx.Param(scaled_normal(rngs.params(), (1, 6, size.dim)))
        self.self_attn = Attention(size, dtype, rngs)
        self.cross_attn = Attention(size, dtype, rngs)
        self.norm3 = nnx.LayerNorm(size.dim, epsilon=size.epsilon, use_fast_variance=False, dtype=jnp.float32, rngs=rngs)
        self.ffn = TwoLayer(size.dim, size.ffn_dim, size.dim, gelu, dtype, nnx.initializers.xavier_uniform(), rngs)

    def __call__(
        self,
        tokens: Float[Array, "b s d"],
        modulation: Float[Array, "b r 6 d"],
        levels: Levels,
        rotary: Rotary,
        text: Float[Array, "b l d"] | FramedContext,
        condition_start: int | None = None,
        cache: ConditionCache | None = None,
    ) -> Float[Array, "b s d"]:
        """One block's change of the tokens.

        Args:
            tokens: [b s d].
            modulation: [b r 6 d] float32, one for each noise level.
            levels: [s], which of them each token takes.
            rotary: rotations of the tokens' positions.
            text: [b l d], what cross-attention reads.
            condition_start: tokens from here on see none before them; those before see all. All see all if left out.
            cache: keys and values that the tokens before `condition_start` see too.

        Returns:
            Tokens [b s d].
        """
        shift_sa, scale_sa, gate_sa, shift_ffn, scale_ffn, gate_ffn = self._chunks(modulation, levels)
        modulated = modulate(tokens, shift_sa, scale_sa, self.dtype, self.epsilon)
        attended = self.self_attn(modulated, rotary=rotary, condition_start=condition_start, cache=cache)
        tokens = add(tokens, attended, gate_sa)
        asked = self.norm3(tokens).astype(self.dtype)
        read = self.cross_attn.attend_by_frame(asked, text) if isinstance(text, FramedContext) else self.cross_attn(asked, text)
        tokens = add(tokens, read)
        return add(tokens, self.ffn(modulate(tokens, shift_ffn, scale_ffn, self.dtype, self.epsilon)), gate_ffn)

    def keys_values(
        self, tokens: Float[Array, "b s d"], modulation: Float[Array, "b r 6 d"], levels: Levels, rotary: Rotary
    ) -> tuple[Float[Array, "b s heads k"], Float[Array, "b s heads k"]]:
        """What others' self-attention reads of these tokens: keys and values [b s n head_dim]; arguments as of `__call__`."""
        shift, scale = self._chunks(modulation, levels)[:2]
        return self.self_attn.keys_values(modulate(tokens, shift, scale, self.dtype, self.epsilon), rotary)

    def _chunks(self, modulation: Array, levels: np.ndarray) -> list[Array]:
        """Six [b s d]: shift, scale and gate of self-attention, then of the feed-forward; never formed at once."""
        chunks = self.modulation[...][None] + modulation
        return [select_levels(chunks[:, :, i], levels) for i in range(6)]


class Attention(nnx.Module):
    """Multi-head attention; queries and keys are normalized over the full width, before they are split into heads."""

    def __init__(self, size: ModelSize, dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        self.heads, self.dtype = size.heads, dtype
        self.q, self.k, self.v, self.o = (linear(size.dim, size.dim, dtype, rngs) for _ in range(4))
        self.norm_q, self.norm_k = (nnx.RMSNorm(size.dim, epsilon=size.epsilon, dtype=jnp.float32, rngs=rngs) for _ in range(2))

    def __call__(
        self,
        tokens: Float[Array, "b s d"],
        context: Float[Array, "b l d"] | None = None,
        rotary: Rotary | None = None,
        condition_start: int | None = None,
        cache: ConditionCache | None = None,
    ) -> Float[Array, "b s d"]:
        """Tokens attend to context, or to each other under rotary positions.

        Args:
            tokens: [b s d].
            context: [b l d]; the tokens themselves if left out.
            rotary: rotations of the tokens' positions.
            condition_start: tokens from here on see none before them, by two calls of attention instead of a mask [s s].
            cache: keys and values of one layer, attended to with the tokens' own.

        Returns:
            [b s d].
        """
        q = self._heads(self.norm_q(self.q(tokens)), rotary)
        k, v = self.keys_values(tokens if context is None else context, rotary)
        if cache is not None:
            k, v = jnp.concatenate([k, cache.keys], axis=1), jnp.concatenate([v, cache.values], axis=1)
        if condition_start is None:
            attended = self._attend(q, k, v)
        else:
            start = condition_start
            rgb, conditions = self._attend(q[:, :start], k, v), self._attend(q[:, start:], k[:, start:], v[:, start:])
            attended = jnp.concatenate([rgb, conditions], axis=1)
        return self.o(attended.reshape(tokens.shape))

    def attend_by_frame(self, tokens: Float[Array, "b s d"], context: FramedContext) -> Float[Array, "b s d"]:
        """Tokens [b s d] attend to the shared context, those of the first frames to their own frame's beside it: [b s d]."""
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

    def keys_values(
        self, context: Float[Array, "b s d"], rotary: Rotary | None
    ) -> tuple[Float[Array, "b s heads k"], Float[Array, "b s heads k"]]:
        """Keys (rotated where there are positions) and values [b s n head_dim] of context [b s d]."""
        return self._heads(self.norm_k(self.k(context)), rotary), self._heads(self.v(context), None)

    def _heads(self, values: Array, rotary: Rotary | None) -> Array:
        values = values.reshape(*values.shape[:2], self.heads, -1)
        return shard_over_batch((values if rotary is None else rotate(values, rotary)).astype(self.dtype))

    def _attend(self, q: Array, k: Array, v: Array) -> Array:
        implementation = choose_attention(q.shape[-1], self.dtype)
        if implementation == "cudnn":
            return attend_in_pairs(q, k, v, implementation)
        return checkpoint_name(jax.nn.dot_product_attention(q, k, v, implementation=implementation), "attention")


class Head(nnx.Module):
    """Norm modulated by the time embedding itself (not by its projection), then one linear layer, zero at the start."""

    def __init__(self, dim: int, features: int, rngs: nnx.Rngs, epsilon: float = EPSILON) -> None:
        self.epsilon = epsilon
        self.modulation = nnx.Param(scaled_normal(rngs.params(), (1, 2, dim)))
        self.head = nnx.Linear(dim, features, dtype=jnp.float32, kernel_init=nnx.initializers.zeros_init(), rngs=rngs)

    def __call__(
        self, tokens: Float[Array, "b s d"], time: Float[Array, "b r d"], levels: Levels
    ) -> Float[Array, "b s features"]:
        """Features [b s pt*ph*pw*c] float32 of tokens.

        Args:
            tokens: [b s d] float32.
            time: [b r d] float32, embeddings of the noise levels.
            levels: [s], which of them each token takes.
        """
        chunks = self.modulation[...][None] + time[:, :, None]
        shift, scale = (select_levels(chunks[:, :, part], levels) for part in (0, 1))
        return self.head(modulate(tokens, shift, scale, epsilon=self.epsilon))


class TwoLayer(nnx.Module):
    """Linear, activation, linear."""

    def __init__(
        self,
        features: int,
        hidden: int,
        out: int,
        activation: Activation,
        dtype: DTypeLike,
        init: nnx.Initializer,
        rngs: nnx.Rngs,
    ) -> None:
        self.activation = activation
        self.first = nnx.Linear(features, hidden, dtype=dtype, kernel_init=init, rngs=rngs)
        self.second = nnx.Linear(hidden, out, dtype=dtype, kernel_init=init, rngs=rngs)

    def __call__(self, values: Float[Array, "*n i"]) -> Float[Array, "*n o"]:
        """Values [... features] -> [... out]."""
        return self.second(self.activation(self.first(values)))


def modulate(
    tokens: Float[Array, "b s d"],
    shift: Float[Array, "b s d"],
    scale: Float[Array, "b s d"],
    dtype: DTypeLike = jnp.float32,
    epsilon: float = EPSILON,
) -> Float[Array, "b s d"]:
    """LayerNorm of tokens without parameters in float32, then scale and shift, rounded to `dtype` once for all who read it.

    All arrays are [b s d].
    """
    tokens = tokens.astype(jnp.float32)
    centered = tokens - tokens.mean(-1, keepdims=True)
    normed = centered * jax.lax.rsqrt(jnp.square(centered).mean(-1, keepdims=True) + epsilon)
    return (normed * (1 + scale) + shift).astype(dtype)


def add(
    tokens: Float[Array, "b s d"], change: Float[Array, "b s d"], gate: Float[Array, "b s d"] | None = None
) -> Float[Array, "b s d"]:
    """The sum tokens + change * gate, all [b s d], computed in float32 and given in the type of the tokens."""
    change = change.astype(jnp.float32)
    return (tokens.astype(jnp.float32) + (change if gate is None else change * gate)).astype(tokens.dtype)


def select_levels(values: Float[Array, "b r d"], levels: Levels) -> Float[Array, "b s d"]:
    """Values of each token's noise level, in forms whose gradient is no scatter (slow on every device).

    Two levels are a choice, which fuses into what uses it and whose gradient is a masked sum. More (one for each latent
    frame) are a gather whose gradient is a product with the matrix of ones that says which token has which level.

    Args:
        values: [b r d] float32, of each level.
        levels: [s], the level of each token.

    Returns:
        values[:, levels] [b s d] float32.
    """
    count = values.shape[1]
    if count <= 2:
        return jnp.where((levels == 0)[None, :, None], values[:, :1], values[:, count - 1 :])
    return _gather_levels(values, tuple(levels.tolist()))


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def _gather_levels(values: Array, levels: tuple[int, ...]) -> Array:
    return values[:, np.asarray(levels)]


def _gather_levels_forward(values: Array, levels: tuple[int, ...]) -> tuple[Array, int]:
    return _gather_levels(values, levels), values.shape[1]


def _gather_levels_backward(levels: tuple[int, ...], count: int, gradient: Array) -> tuple[Array]:
    has_level = jnp.asarray(np.equal(levels, np.arange(count)[:, None]), gradient.dtype)
    return (jnp.einsum("rs,bsd->brd", has_level, gradient, precision=jax.lax.Precision.HIGHEST),)


_gather_levels.defvjp(_gather_levels_forward, _gather_levels_backward)


def rotate(values: Float[Array, "b s heads k"], rotary: Rotary) -> Float[Array, "b s heads k"]:
    """Turn neighboring pairs of features of [b s n k] by each token's angles: [b s n k] float32."""
    cos, sin = (table[None, :, None, :, None] for table in rotary)
    pairs = values.reshape(*values.shape[:-1], -1, 2)
    return (pairs * cos + pairs[..., ::-1] * jnp.concatenate([-sin, sin], axis=-1)).reshape(values.shape)


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
"""Policy of what is kept for the backward pass besides each block's input, by name.

full       nothing: the forward pass is computed twice (4/3 of the work), the least memory
attention  results of attention, so that all but its quadratic part is computed twice; two widths more a token and block
dots       results of all matrix products and of attention, so that only norms and activations are computed twice
none       everything that the backward pass reads
"""


def choose_attention(head_dim: int, dtype: DTypeLike) -> Literal["xla", "cudnn"]:
    """The implementation of `jax.nn.dot_product_attention` on this machine.

    It is cuDNN's on a CUDA GPU of compute capability 8.0 and up, in bfloat16 or float16, where the width of a head is
    a multiple of 8 and at most 256 (128 before Hopper, 9.0); else XLA's, which forms [n s s]. (The limits are those that jax
    itself checks; `attend_in_pairs` sees to the one on the number of tokens.)
    """
    device = jax.devices()[0]
    if device.platform != "gpu" or "cuda" not in device.client.platform_version:
        return "xla"
    capability = tuple(int(part) for part in str(device.compute_capability).split("."))
    widest = 256 if capability >= (9, 0) else 128
    fits = head_dim % 8 == 0 and head_dim <= widest and jnp.dtype(dtype) in (jnp.bfloat16, jnp.float16)
    return "cudnn" if fits and capability >= (8, 0) else "xla"


def attend_in_pairs(
    q: Float[Array, "b q heads k"],
    k: Float[Array, "b s heads k"],
    v: Float[Array, "b s heads k"],
    implementation: Literal["xla", "cudnn"],
) -> Float[Array, "b q heads k"]:
    """Attention [b q heads k] of any numbers of queries [b q heads k] and keys and values [b s heads k], in even numbers.

    cuDNN's gradients take even numbers alone. An odd number gets one more, which is masked and cut off again.
    """
    queries, keys = q.shape[1], k.shape[1]
    if queries % 2 == 0 and keys % 2 == 0:
        return jax.nn.dot_product_attention(q, k, v, implementation=implementation)
    q, k, v = (jnp.pad(x, ((0, 0), (0, x.shape[1] % 2), (0, 0), (0, 0))) for x in (q, k, v))
    attended = jax.nn.dot_product_attention(
        q,
        k,
        v,
        query_seq_lengths=jnp.full(len(q), queries, jnp.int32),
        key_value_seq_lengths=jnp.full(len(k), keys, jnp.int32),
        implementation=implementation,
    )
    return attended[:, :queries]


def gelu(values: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Gelu of values [...] by its approximation with tanh, as Wan has it."""
    return nnx.gelu(values, approximate=True)


def scaled_normal(key: Key[Array, ""], shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Random start of modulations as Wan's: normal numbers float32 of `shape` [... d], over the root of the width d."""
    return jax.random.normal(key, shape, jnp.float32) / np.sqrt(shape[-1]).astype(np.float32)


def stacked_blocks(size: ModelSize, dtype: DTypeLike, rngs: nnx.Rngs) -> Block:
    """`depth` blocks as one whose parameters have a leading layer axis."""

    @nnx.split_rngs(splits=size.depth)
    @nnx.vmap(in_axes=0, out_axes=0)
    def create(layer_rngs: nnx.Rngs) -> Block:
        return Block(size, dtype, layer_rngs)

    return create(rngs)

"""One block of the network: attention, norms, feed-forward, and their implementation on a device.

Shape letters: as in dit.py. Modules and parameters have the names of Wan's checkpoints.

Precision: matrix products and attention in `dtype`; norms, modulation and residual sums in float32, without forming [b s 6 d].
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
"""Term added to the variance in every norm."""

Activation = Callable[[Array], Array]
Rotary = tuple[Float[Array, "s angles"], Float[Array, "s angles"]]
"""Cosine and sine [s head_dim/2] float32 of every token's rotation angles."""
Levels = Int[np.ndarray, " s"]
"""Index [s] of each token's noise level among the r of a sample: 0 is no noise, 1 the sample's own."""
RematName = Literal["none", "attention", "dots", "full"]


class ConditionCache(NamedTuple):
    """Keys (rotated) and values of the condition tokens of a `one_way` model, for the RGB tokens of every layer."""

    keys: Float[Array, "*layers b s heads k"]
    """[layers b s n head_dim]; of one layer [b s n head_dim]."""
    values: Float[Array, "*layers b s heads k"]


@dataclass(frozen=True)
class ModelSize:
    """Hyperparameters of the network."""

    dim: int
    """Width of a token."""
    depth: int
    """Number of blocks."""
    heads: int
    ffn_dim: int
    """Width of the hidden layer of the feed-forward."""
    text_dim: int
    """Width of the text embeddings."""
    text_tokens: int
    """Number of tokens to which the text is padded."""
    rotary_base: float = WAVELENGTH_BASE
    """Base of the wavelengths of rotary positions; with few positions a model learns sooner with a smaller base."""
    epsilon: float = EPSILON
    """Term that all norms add to a mean square."""
    patch: Patch = WAN_PATCH
    """Latent frames (always one), rows and columns of a token."""

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
        """Tokens [b s d] after the block.

        Args:
            tokens: [b s d].
            modulation: [b r 6 d] float32, one for each noise level.
            levels: [s], index of each token's level.
            rotary: rotations of the tokens' positions.
            text: [b l d], context of cross-attention.
            condition_start: index of the first condition token, which attend to one another only; None has none.
            cache: keys and values of condition tokens for the tokens before `condition_start`.
        """
        shift_sa, scale_sa, gate_sa, shift_ffn, scale_ffn, gate_ffn = self._chunks(modulation, levels)
        modulated = modulate(tokens, shift_sa, scale_sa, self.dtype, self.epsilon)
        attended = self.self_attn(modulated, rotary=rotary, condition_start=condition_start, cache=cache)
        tokens = add(tokens, attended, gate_sa)
        query = self.norm3(tokens).astype(self.dtype)
        read = self.cross_attn.attend_by_frame(query, text) if isinstance(text, FramedContext) else self.cross_attn(query, text)
        tokens = add(tokens, read)
        return add(tokens, self.ffn(modulate(tokens, shift_ffn, scale_ffn, self.dtype, self.epsilon)), gate_ffn)

    def keys_values(
        self, tokens: Float[Array, "b s d"], modulation: Float[Array, "b r 6 d"], levels: Levels, rotary: Rotary
    ) -> tuple[Float[Array, "b s heads k"], Float[Array, "b s heads k"]]:
        """Keys and values [b s n head_dim] of these tokens in self-attention; arguments as of `__call__`."""
        shift, scale = self._chunks(modulation, levels)[:2]
        return self.self_attn.keys_values(modulate(tokens, shift, scale, self.dtype, self.epsilon), rotary)

    def _chunks(self, modulation: Array, levels: np.ndarray) -> list[Array]:
        """Six [b s d]: shift, scale and gate of self-attention, then of the feed-forward."""
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
        """Attention [b s d] of tokens to a context, or to each other with rotary positions.

        Args:
            tokens: [b s d].
            context: [b l d]; by default the tokens.
            rotary: rotations of the tokens' positions.
            condition_start: as of `Block`; two calls of attention instead of a mask [s s].
            cache: additional keys and values of one layer.
        """
        q = self._heads(self.norm_q(self.q(tokens)), rotary)
        k, v = self.keys_values(tokens if context is None else context, rotary)
        if cache is not None:
            k, v = jnp.concatenate([k, cache.keys], axis=1), jnp.concatenate([v, cache.values], axis=1)
        attended = self._attend(q[:, :condition_start], k, v)
        if (start := condition_start) is not None:
            attended = jnp.concatenate([attended, self._attend(q[:, start:], k[:, start:], v[:, start:])], axis=1)
        return self.o(attended.reshape(tokens.shape))

    def attend_by_frame(self, tokens: Float[Array, "b s d"], context: FramedContext) -> Float[Array, "b s d"]:
        """Attention [b s d] of tokens [b s d] to the shared context and, for the first frames, to their frame's context."""
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
        """Keys (rotated if there are positions) and values [b s n head_dim] of context [b s d]."""
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
    """Norm, modulated by the time embedding, and a linear layer that starts at zero."""

    def __init__(self, dim: int, features: int, rngs: nnx.Rngs, epsilon: float = EPSILON) -> None:
        self.epsilon = epsilon
        self.modulation = nnx.Param(scaled_normal(rngs.params(), (1, 2, dim)))
        self.head = nnx.Linear(dim, features, dtype=jnp.float32, kernel_init=nnx.initializers.zeros_init(), rngs=rngs)

    def __call__(
        self, tokens: Float[Array, "b s d"], time: Float[Array, "b r d"], levels: Levels
    ) -> Float[Array, "b s features"]:
        """Tokens [b s d], time embeddings [b r d] of the levels and each token's level [s] -> [b s pt*ph*pw*c], all float32."""
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
    """LayerNorm of tokens without parameters in float32, then scale and shift, in `dtype`; all arrays are [b s d]."""
    tokens = tokens.astype(jnp.float32)
    centered = tokens - tokens.mean(-1, keepdims=True)
    normed = centered * jax.lax.rsqrt(jnp.square(centered).mean(-1, keepdims=True) + epsilon)
    return (normed * (1 + scale) + shift).astype(dtype)


def add(
    tokens: Float[Array, "b s d"], change: Float[Array, "b s d"], gate: Float[Array, "b s d"] | None = None
) -> Float[Array, "b s d"]:
    """The sum tokens + change * gate, all [b s d], in float32, cast to the type of the tokens."""
    change = change.astype(jnp.float32)
    return (tokens.astype(jnp.float32) + (change if gate is None else change * gate)).astype(tokens.dtype)


def select_levels(values: Float[Array, "b r d"], levels: Levels) -> Float[Array, "b s d"]:
    """values[:, levels] [b s d] float32 of values [b r d] by level, with a gradient that is not a slow scatter.

    Two levels are a `where`, which fuses, and more a gather whose gradient is a product with a one-hot matrix.
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
    """Rotate neighboring pairs of features of [b s n k] by each token's angles: [b s n k] float32."""
    cos, sin = (table[None, :, None, :, None] for table in rotary)
    pairs = values.reshape(*values.shape[:-1], -1, 2)
    return (pairs * cos + pairs[..., ::-1] * jnp.concatenate([-sin, sin], axis=-1)).reshape(values.shape)


def _is_attention(primitive: Any, *_: Any, **__: Any) -> bool:
    """Whether a primitive is cuDNN's attention, which `checkpoint_name` does not reach."""
    return str(primitive.name).startswith("dot_product_attention_fwd")


_POLICIES = jax.checkpoint_policies
_KEEP_ATTENTION = _POLICIES.save_from_both_policies(_POLICIES.save_only_these_names("attention"), _is_attention)
REMAT: dict[str, Callable[..., bool] | None] = {
    "attention": _KEEP_ATTENTION,
    "dots": _POLICIES.save_from_both_policies(_POLICIES.dots_with_no_batch_dims_saveable, _KEEP_ATTENTION),
    "full": None,
}
"""Gradient checkpointing policies: results that each block saves for the backward pass besides its input.

full       nothing: the forward pass is computed twice (4/3 of the work), the least memory
attention  results of attention: all but its quadratic part is computed twice
dots       results of attention and all matrix products: only norms and activations are computed twice
none       everything
"""


def choose_attention(head_dim: int, dtype: DTypeLike) -> Literal["xla", "cudnn"]:
    """The implementation of `jax.nn.dot_product_attention` on this machine.

    cuDNN's on a CUDA GPU of compute capability 8.0 and up, in bfloat16 or float16, for heads of a multiple of 8 and at most 256
    features (128 before 9.0), the limits of jax; else XLA's, which forms [n s s].
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
    """Attention [b q heads k] of queries [b q heads k] to keys and values [b s heads k], padded to even numbers of tokens.

    cuDNN's gradients need even numbers; the padding is masked and removed.
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
    """Gelu of values [...] with the tanh approximation, as in Wan."""
    return nnx.gelu(values, approximate=True)


def scaled_normal(key: Key[Array, ""], shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Initial modulations as in Wan: normal numbers float32 of `shape` [... d], over the root of the width d."""
    return jax.random.normal(key, shape, jnp.float32) / np.sqrt(shape[-1]).astype(np.float32)


def stack_layers(create: Callable[[nnx.Rngs], Any], depth: int, rngs: nnx.Rngs) -> Any:
    """`depth` layers as one module whose parameters have a leading layer axis."""
    return nnx.split_rngs(splits=depth)(nnx.vmap(create, in_axes=0, out_axes=0))(rngs)

"""UMT5's encoder (Flax NNX), the text encoder of Wan2.2.

Reads  token ids [b l], lengths [b]
Writes embeddings [b l d] float32, zero past each length, as the network takes them
To add a size: one line in UMT5S.

T5's encoder with a table of relative positions in every layer (Chung et al., arXiv 2304.09151), without biases, means in norms
and scaling of attention. Parity with transformers' UMT5EncoderModel is tested.
"""

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Bool, Float, Int

from xew.model.network.blocks import stack_layers
from xew.model.weights.filling import fill
from xew.model.weights.layout import Layout, Source
from xew.model.weights.reading import read_tensors

EPSILON = 1e-6


@dataclass(frozen=True)
class Umt5Size:
    """Hyperparameters of the encoder."""

    vocabulary: int
    dim: int
    depth: int
    heads: int
    head_dim: int
    ffn_dim: int
    buckets: int = 32
    """Number of rows of a table of relative positions."""
    max_distance: int = 128
    """Distance [tokens] from which on all share a row."""


UMT5S = {
    "tiny": Umt5Size(vocabulary=97, dim=32, depth=3, heads=4, head_dim=8, ffn_dim=64),
    "xxl": Umt5Size(vocabulary=256384, dim=4096, depth=24, heads=64, head_dim=64, ffn_dim=10240),
}


class Umt5Encoder(nnx.Module):
    """Embeds token ids.

    Args:
        size: one of `UMT5S`.
        dtype: of the matrix products; norms, softmax and the residual stream are float32.
        param_dtype: of the parameters, published in bfloat16 (11.4 GB).
    """

    def __init__(
        self, size: Umt5Size, *, dtype: DTypeLike = jnp.float32, param_dtype: DTypeLike = jnp.float32, rngs: nnx.Rngs
    ) -> None:
        self.size = size
        self.token_embedding = nnx.Embed(size.vocabulary, size.dim, dtype=dtype, param_dtype=param_dtype, rngs=rngs)
        self.blocks = stack_layers(lambda layer: EncoderBlock(size, dtype, param_dtype, layer), size.depth, rngs)
        self.norm = _norm(size.dim, param_dtype, rngs)

    def __call__(self, ids: Int[Array, "b l"], lengths: Int[Array, " b"]) -> Float[Array, "b l d"]:
        """Embeddings [b l d] float32 of ids [b l] int32 with valid lengths [b], zero past each length."""
        graph, layers = nnx.split(self.blocks)
        valid = jnp.arange(ids.shape[1])[None] < lengths[:, None]
        buckets = relative_buckets(ids.shape[1], self.size.buckets, self.size.max_distance)

        def block(tokens: Array, layer: nnx.State) -> tuple[Array, None]:
            return nnx.merge(graph, layer)(tokens, valid, buckets), None

        tokens = jax.lax.scan(block, self.token_embedding(ids).astype(jnp.float32), layers)[0]
        return jnp.where(valid[..., None], self.norm(tokens), 0)


class EncoderBlock(nnx.Module):
    """Residual self-attention and gated feed-forward, each after a norm."""

    def __init__(self, size: Umt5Size, dtype: DTypeLike, param_dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        self.norm1, self.norm2 = (_norm(size.dim, param_dtype, rngs) for _ in range(2))
        self.attn = Attention(size, dtype, param_dtype, rngs)
        self.ffn = GatedFeedForward(size, dtype, param_dtype, rngs)

    def __call__(
        self, tokens: Float[Array, "b l d"], valid: Bool[Array, "b l"], buckets: Int[np.ndarray, "l l"]
    ) -> Float[Array, "b l d"]:
        """Tokens [b l d], their valid mask [b l] and `relative_buckets` [l l] -> tokens [b l d], float32."""
        tokens = tokens + self.attn(self.norm1(tokens), valid, buckets).astype(jnp.float32)
        return tokens + self.ffn(self.norm2(tokens)).astype(jnp.float32)


class Attention(nnx.Module):
    """Multi-head self-attention to the valid tokens, with a bias by relative position."""

    def __init__(self, size: Umt5Size, dtype: DTypeLike, param_dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        inner = size.heads * size.head_dim
        self.heads, self.dtype = size.heads, dtype
        self.q, self.k, self.v = (_linear(size.dim, inner, dtype, param_dtype, rngs) for _ in range(3))
        self.o = _linear(inner, size.dim, dtype, param_dtype, rngs)
        self.position = nnx.Embed(size.buckets, size.heads, dtype=jnp.float32, param_dtype=param_dtype, rngs=rngs)

    def __call__(
        self, tokens: Float[Array, "b l d"], valid: Bool[Array, "b l"], buckets: Int[np.ndarray, "l l"]
    ) -> Float[Array, "b l d"]:
        """Tokens [b l d] -> [b l d]; arguments as of `EncoderBlock`."""
        q, k, v = (layer(tokens).reshape(*tokens.shape[:2], self.heads, -1) for layer in (self.q, self.k, self.v))
        bias = self.position(jnp.asarray(buckets)).transpose(2, 0, 1)[None]
        mask = valid[:, None, None, :]
        attended = jax.nn.dot_product_attention(q, k, v, bias=bias, mask=mask, scale=1.0)
        return self.o(attended.reshape(*tokens.shape[:2], -1))


class GatedFeedForward(nnx.Module):
    """Product of gelu(gate) and a linear layer, then another linear layer (Shazeer, arXiv 2002.05202)."""

    def __init__(self, size: Umt5Size, dtype: DTypeLike, param_dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        self.gate, self.first = (_linear(size.dim, size.ffn_dim, dtype, param_dtype, rngs) for _ in range(2))
        self.second = _linear(size.ffn_dim, size.dim, dtype, param_dtype, rngs)

    def __call__(self, tokens: Float[Array, "b l d"]) -> Float[Array, "b l d"]:
        """Tokens [b l d] -> [b l d]."""
        return self.second(nnx.gelu(self.gate(tokens), approximate=True) * self.first(tokens))


def relative_buckets(length: int, buckets: int, max_distance: int) -> Int[np.ndarray, "l l"]:
    """Row of the table of positions for each pair of a query and a key: [l l] int.

    Half of the rows are for keys after the query. Half of each half are for single distances, the others are logarithmic up to
    `max_distance`.
    """
    relative = np.arange(length)[None] - np.arange(length)[:, None]
    distance, half = np.abs(relative), buckets // 2
    exact = half // 2
    ratio = np.log(np.maximum(distance, 1).astype(np.float32) / np.float32(exact)) / np.log(max_distance / exact)
    widening = exact + (ratio * (half - exact)).astype(int)
    return np.where(distance < exact, distance, np.minimum(widening, half - 1)) + half * (relative > 0)


HF = "encoder.block.{}.layer."
NAMES = {
    "token_embedding.embedding": ("token_embedding.weight", "shared.weight"),
    "norm.scale": ("norm.weight", "encoder.final_layer_norm.weight"),
    "blocks.norm1.scale": ("blocks.{}.norm1.weight", f"{HF}0.layer_norm.weight"),
    "blocks.attn.position.embedding": (
        "blocks.{}.pos_embedding.embedding.weight",
        f"{HF}0.SelfAttention.relative_attention_bias.weight",
    ),
    "blocks.norm2.scale": ("blocks.{}.norm2.weight", f"{HF}1.layer_norm.weight"),
    "blocks.ffn.gate.kernel": ("blocks.{}.ffn.gate.0.weight", f"{HF}1.DenseReluDense.wi_0.weight"),
    "blocks.ffn.first.kernel": ("blocks.{}.ffn.fc1.weight", f"{HF}1.DenseReluDense.wi_1.weight"),
    "blocks.ffn.second.kernel": ("blocks.{}.ffn.fc2.weight", f"{HF}1.DenseReluDense.wo.weight"),
    **{
        f"blocks.attn.{part}.kernel": (f"blocks.{{}}.attn.{part}.weight", f"{HF}0.SelfAttention.{part}.weight")
        for part in "qkvo"
    },
}
"""Names of each leaf in Wan's .pth and in Hugging Face's files."""


def official_layout(size: Umt5Size) -> Layout:
    """Names in Wan's `models_t5_umt5-xxl-enc-bf16.pth` (242 tensors at full size)."""
    return _layout(size, 0)


def hf_layout(size: Umt5Size) -> Layout:
    """Names in Hugging Face's UMT5EncoderModel, besides an optional `HF_DUPLICATE`."""
    return _layout(size, 1)


HF_DUPLICATE = "encoder.embed_tokens.weight"
"""Duplicate of the token embedding, or its only name if `shared.weight` is missing."""


def load_umt5(path: Path, size: Umt5Size, dtype: DTypeLike = jnp.bfloat16) -> Umt5Encoder:
    """The encoder with a checkpoint's weights in `dtype`, in either layout.

    Raises:
        ConfigError: there is no such file, or it does not fit.
    """
    tensors = read_tensors(path)
    if "token_embedding.weight" in tensors:
        layout = official_layout(size)
    else:
        layout = hf_layout(size)
        if HF_DUPLICATE in tensors and "shared.weight" not in tensors:
            layout = {**layout, "token_embedding.embedding": Source((HF_DUPLICATE,))}
    encoder = nnx.eval_shape(lambda: Umt5Encoder(size, dtype=dtype, param_dtype=dtype, rngs=nnx.Rngs(0)))
    fill(encoder, tensors, layout, optional=(HF_DUPLICATE,))
    return encoder


def _layout(size: Umt5Size, column: int) -> Layout:
    layout = {}
    for leaf, names in NAMES.items():
        stacked = leaf.startswith("blocks.")
        keys = tuple(names[column].format(layer) for layer in range(size.depth if stacked else 1))
        layout[leaf] = Source(keys, "linear" if leaf.endswith("kernel") else "as_is", stacked=stacked)
    return layout


def _norm(features: int, param_dtype: DTypeLike, rngs: nnx.Rngs) -> nnx.RMSNorm:
    return nnx.RMSNorm(features, epsilon=EPSILON, dtype=jnp.float32, param_dtype=param_dtype, rngs=rngs)


def _linear(features: int, out: int, dtype: DTypeLike, param_dtype: DTypeLike, rngs: nnx.Rngs) -> nnx.Linear:
    return nnx.Linear(features, out, use_bias=False, dtype=dtype, param_dtype=param_dtype, rngs=rngs)

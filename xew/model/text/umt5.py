"""UMT5's encoder, whose embeddings of the instruction Wan2.2 reads (Flax NNX).

Reads  token ids [b l], lengths [b]
Writes embeddings [b l d] float32, zero past each length, as the network takes them
To add a size: one line in UMT5S.

It is T5's encoder with a table of relative positions in every layer (Chung et al., arXiv 2304.09151): no biases, norms
without a mean, products of queries and keys that are not divided by the root of their width. Parity with transformers'
UMT5EncoderModel is tested; `official_layout` and `hf_layout` are the names in Wan's .pth and in Hugging Face's files.
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

from xew.model.weights.filling import fill
from xew.model.weights.layout import Layout, Source
from xew.model.weights.reading import read_tensors

EPSILON = 1e-6


@dataclass(frozen=True)
class Umt5Size:
    """Everything that distinguishes one size of the encoder from another."""

    vocabulary: int
    dim: int
    depth: int
    heads: int
    head_dim: int
    ffn_dim: int
    buckets: int = 32
    """Number of rows of a table of relative positions."""
    max_distance: int = 128
    """Distance in tokens from which on all share a row."""


UMT5S = {
    "tiny": Umt5Size(vocabulary=97, dim=32, depth=3, heads=4, head_dim=8, ffn_dim=64),
    "xxl": Umt5Size(vocabulary=256384, dim=4096, depth=24, heads=64, head_dim=64, ffn_dim=10240),
}


class Umt5Encoder(nnx.Module):
    """Embeds token ids.

    Args:
        size: one of `UMT5S`.
        dtype: of the matrix products; norms, softmax and the residual stream stay float32.
        param_dtype: of the parameters; 5.7 billion of them are 11.4 GB in bfloat16, in which they are published.
    """

    def __init__(
        self, size: Umt5Size, *, dtype: DTypeLike = jnp.float32, param_dtype: DTypeLike = jnp.float32, rngs: nnx.Rngs
    ) -> None:
        self.size = size
        self.token_embedding = nnx.Embed(size.vocabulary, size.dim, dtype=dtype, param_dtype=param_dtype, rngs=rngs)
        self.blocks = _stacked_blocks(size, dtype, param_dtype, rngs)
        self.norm = _norm(size.dim, param_dtype, rngs)

    def __call__(self, ids: Int[Array, "b l"], lengths: Int[Array, " b"]) -> Float[Array, "b l d"]:
        """Embeddings of ids [b l] int32 of which the first `lengths` [b] count: [b l d] float32, zero from there on."""
        graph, layers = nnx.split(self.blocks)
        valid = jnp.arange(ids.shape[1])[None] < lengths[:, None]
        buckets = relative_buckets(ids.shape[1], self.size.buckets, self.size.max_distance)

        def block(tokens: Array, layer: nnx.State) -> tuple[Array, None]:
            return nnx.merge(graph, layer)(tokens, valid, buckets), None

        tokens = jax.lax.scan(block, self.token_embedding(ids).astype(jnp.float32), layers)[0]
        return jnp.where(valid[..., None], self.norm(tokens), 0)


class EncoderBlock(nnx.Module):
    """Self-attention, then a gated feed-forward, each on the norm of what it is added to."""

    def __init__(self, size: Umt5Size, dtype: DTypeLike, param_dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        self.norm1, self.norm2 = (_norm(size.dim, param_dtype, rngs) for _ in range(2))
        self.attn = Attention(size, dtype, param_dtype, rngs)
        self.ffn = GatedFeedForward(size, dtype, param_dtype, rngs)

    def __call__(
        self, tokens: Float[Array, "b l d"], valid: Bool[Array, "b l"], buckets: Int[np.ndarray, "l l"]
    ) -> Float[Array, "b l d"]:
        """One block's change of the tokens.

        Args:
            tokens: [b l d] float32.
            valid: [b l] bool, tokens of the text.
            buckets: [l l], row of the table of positions for each pair.

        Returns:
            Tokens [b l d] float32.
        """
        tokens = tokens + self.attn(self.norm1(tokens), valid, buckets).astype(jnp.float32)
        return tokens + self.ffn(self.norm2(tokens)).astype(jnp.float32)


class Attention(nnx.Module):
    """Multi-head self-attention to the valid tokens, biased by the layer's own table of relative positions."""

    def __init__(self, size: Umt5Size, dtype: DTypeLike, param_dtype: DTypeLike, rngs: nnx.Rngs) -> None:
        inner = size.heads * size.head_dim
        self.heads, self.dtype = size.heads, dtype
        self.q, self.k, self.v = (_linear(size.dim, inner, dtype, param_dtype, rngs) for _ in range(3))
        self.o = _linear(inner, size.dim, dtype, param_dtype, rngs)
        self.position = nnx.Embed(size.buckets, size.heads, dtype=jnp.float32, param_dtype=param_dtype, rngs=rngs)

    def __call__(
        self, tokens: Float[Array, "b l d"], valid: Bool[Array, "b l"], buckets: Int[np.ndarray, "l l"]
    ) -> Float[Array, "b l d"]:
        """Attention of tokens [b l d] to those that are `valid` [b l]; `buckets` [l l] as of `EncoderBlock`: [b l d]."""
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

    Half of the rows are for keys after the query. Of each half, half are for one distance each and the others widen with the
    logarithm of the distance up to `max_distance`.
    """
    relative = np.arange(length)[None] - np.arange(length)[:, None]
    distance, half = np.abs(relative), buckets // 2
    exact = half // 2
    ratio = np.log(np.maximum(distance, 1).astype(np.float32) / np.float32(exact)) / np.log(max_distance / exact)
    widening = exact + (ratio * (half - exact)).astype(int)
    return np.where(distance < exact, distance, np.minimum(widening, half - 1)) + half * (relative > 0)


def official_layout(size: Umt5Size) -> Layout:
    """Names in Wan's `models_t5_umt5-xxl-enc-bf16.pth` (242 tensors at full size)."""
    names = {
        "norm1.scale": "blocks.{}.norm1.weight",
        "attn.position.embedding": "blocks.{}.pos_embedding.embedding.weight",
        "norm2.scale": "blocks.{}.norm2.weight",
        "ffn.gate.kernel": "blocks.{}.ffn.gate.0.weight",
        "ffn.first.kernel": "blocks.{}.ffn.fc1.weight",
        "ffn.second.kernel": "blocks.{}.ffn.fc2.weight",
    }
    names |= {f"attn.{name}.kernel": f"blocks.{{}}.attn.{name}.weight" for name in "qkvo"}
    return _layout(size, "token_embedding.weight", names, "norm.weight")


def hf_layout(size: Umt5Size) -> Layout:
    """Names in Hugging Face's UMT5EncoderModel; `HF_DUPLICATE` may be there besides."""
    names = {
        "norm1.scale": "encoder.block.{}.layer.0.layer_norm.weight",
        "attn.position.embedding": "encoder.block.{}.layer.0.SelfAttention.relative_attention_bias.weight",
        "norm2.scale": "encoder.block.{}.layer.1.layer_norm.weight",
        "ffn.gate.kernel": "encoder.block.{}.layer.1.DenseReluDense.wi_0.weight",
        "ffn.first.kernel": "encoder.block.{}.layer.1.DenseReluDense.wi_1.weight",
        "ffn.second.kernel": "encoder.block.{}.layer.1.DenseReluDense.wo.weight",
    }
    names |= {f"attn.{part}.kernel": f"encoder.block.{{}}.layer.0.SelfAttention.{part}.weight" for part in "qkvo"}
    return _layout(size, "shared.weight", names, "encoder.final_layer_norm.weight")


HF_DUPLICATE = "encoder.embed_tokens.weight"
"""The token embedding a second time, or the only one where `shared.weight` is left out."""


def load_umt5(path: Path, size: Umt5Size, dtype: DTypeLike = jnp.bfloat16) -> Umt5Encoder:
    """The encoder with a checkpoint's weights, kept and multiplied in `dtype`; the names say which layout it is in.

    Raises:
        ConfigError: there is no such file, or it does not fit; what differs is named.
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


def _layout(size: Umt5Size, embedding: str, blocks: dict[str, str], norm: str) -> Layout:
    layout = {"token_embedding.embedding": Source((embedding,)), "norm.scale": Source((norm,))}
    for leaf, name in blocks.items():
        keys = tuple(name.format(layer) for layer in range(size.depth))
        layout[f"blocks.{leaf}"] = Source(keys, "linear" if leaf.endswith("kernel") else "as_is", stacked=True)
    return layout


def _norm(features: int, param_dtype: DTypeLike, rngs: nnx.Rngs) -> nnx.RMSNorm:
    return nnx.RMSNorm(features, epsilon=EPSILON, dtype=jnp.float32, param_dtype=param_dtype, rngs=rngs)


def _linear(features: int, out: int, dtype: DTypeLike, param_dtype: DTypeLike, rngs: nnx.Rngs) -> nnx.Linear:
    return nnx.Linear(features, out, use_bias=False, dtype=dtype, param_dtype=param_dtype, rngs=rngs)


def _stacked_blocks(size: Umt5Size, dtype: DTypeLike, param_dtype: DTypeLike, rngs: nnx.Rngs) -> EncoderBlock:
    """`depth` blocks as one whose parameters have a leading layer axis."""

    @nnx.split_rngs(splits=size.depth)
    @nnx.vmap(in_axes=0, out_axes=0)
    def create(layer_rngs: nnx.Rngs) -> EncoderBlock:
        return EncoderBlock(size, dtype, param_dtype, layer_rngs)

    return create(rngs)

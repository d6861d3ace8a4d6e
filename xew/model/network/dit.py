"""The diffusion transformer over token streams with Wan2.2-TI2V-5B's block stack (Flax NNX), its sizes and streams.

Reads  latents [b t h w c] of each stream, noise level, text embeddings [b l e]
Writes velocity [b t h w c] of the RGB stream
Options: spec.py. To add a size: one line in MODELS. To add a stream: one line in STREAMS. Published weights: dit_layouts.py.

Shape letters: b batch, t h w c latent video, s tokens (t' h' w' flattened), d width, n heads, r distinct noise levels of
a sample, l text tokens of e features, k tokens of context (in attention: features of a head).
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array
from jaxtyping import Float, Int

from xew.model.devices.sharding import gather_parameters, shard_over_batch
from xew.model.diffusion.flow_matching import velocity_of_residual
from xew.model.network.blocks import (
    REMAT,
    Block,
    ConditionCache,
    Head,
    Levels,
    ModelSize,
    Rotary,
    TwoLayer,
    gelu,
    scaled_normal,
    select_levels,
    stack_layers,
)
from xew.model.network.mechanisms import MECHANISMS, FramedContext, create_mechanism, linear, ray_maps
from xew.model.network.spec import Network
from xew.model.network.tokens import (
    TIME_FREQUENCIES,
    TokenGrid,
    patchify,
    rotary_angles,
    rounded_sinusoid,
    sinusoid,
    token_grid,
    unpatchify,
)
from xew.model.video.frames import TEMPORAL_FACTOR

TIMESTEPS = 1000.0
"""Factor from a noise level in [0, 1] to the network's timestep."""
EMBEDDING_INIT = nnx.initializers.normal(0.02)

Latents = Float[Array, "b t h w c"]
Conditions = Mapping[str, Float[Array, "b ..."]]
"""Latents [b t' h' w' c] or numbers [b t' n] by stream or mechanism."""
Text = Float[Array, "b l e"] | Int[Array, "b l"]
"""Embeddings [b l e] of a frozen encoder, or ids [b l] of words."""

MODELS = {
    "tiny": ModelSize(dim=32, depth=2, heads=2, ffn_dim=64, text_dim=16, text_tokens=8),
    "debug": ModelSize(dim=256, depth=4, heads=2, ffn_dim=768, text_dim=32, text_tokens=16, rotary_base=10.0),
    "small": ModelSize(768, 12, 6, 3072, text_dim=256, text_tokens=32, rotary_base=100.0, patch=(1, 1, 1)),
    "wan5b": ModelSize(dim=3072, depth=30, heads=24, ffn_dim=14336, text_dim=4096, text_tokens=512),
}


@dataclass(frozen=True)
class Stream:
    """One sequence of tokens. Only RGB is noised and has a head and a loss."""

    source: Literal["latents", "joints", "history"]
    """Encoded video [b t h w c], actions of 16 numbers [b t 16], or earlier RGB frames [b n h w c], each encoded alone."""
    timestep: Literal["shared", "clean"]
    """Noise level of its tokens: RGB's (0 in latent frame 0), as in FlowWAM, or 0."""


STREAMS = {
    "rgb": Stream("latents", "shared"),
    "action": Stream("latents", "shared"),
    "embodiment": Stream("latents", "clean"),
    "joints": Stream("joints", "shared"),
    "history": Stream("history", "clean"),
}


class WorldModel(nnx.Module):
    """Predicts the flow-matching velocity of the RGB stream from clean condition streams."""

    def __init__(self, network: Network) -> None:
        self.network = network
        size, channels, dtype, rngs = network.size, network.channels, self.dtype, nnx.Rngs(network.seed)
        # History tokens follow RGB's, so all tokens with a frame context (`FramedContext`) are contiguous.
        self.condition_streams = tuple(sorted((name for name in network.streams if name in STREAMS), key="history".__ne__))
        features = channels * int(np.prod(size.patch))
        self.patch_embedding = linear(features, size.dim, dtype, rngs)
        self.text_embedding = TwoLayer(size.text_dim, size.dim, size.dim, gelu, dtype, EMBEDDING_INIT, rngs)
        self.time_embedding = TwoLayer(TIME_FREQUENCIES, size.dim, size.dim, nnx.silu, jnp.float32, EMBEDDING_INIT, rngs)
        self.time_projection = linear(size.dim, 6 * size.dim, jnp.float32, rngs)
        self.blocks = stack_layers(lambda layer_rngs: Block(size, dtype, layer_rngs), size.depth, rngs)
        self.head = Head(size.dim, features, rngs, size.epsilon)
        words, normal = network.words, nnx.initializers.normal(1.0)
        self.words = nnx.Embed(words, size.text_dim, embedding_init=normal, rngs=rngs) if words else None
        self.stream_embeddings = nnx.data({})
        self.stream_inputs = nnx.data({})
        for name in self.condition_streams:
            self.stream_embeddings[name] = nnx.Param(scaled_normal(rngs.params(), (size.dim,)))
            if STREAMS[name].source != "history":
                self.stream_inputs[name] = self._stream_input(STREAMS[name], rngs)
        self.mechanisms = nnx.data({})
        for name in (name for name in network.streams if name not in STREAMS):
            self.mechanisms[name] = create_mechanism(name, size, channels, dtype, rngs)

    @property
    def size(self) -> ModelSize:
        """Size of the network."""
        return self.network.size

    @property
    def dtype(self) -> jnp.dtype:
        """Type of the matrix products and of the tokens between blocks."""
        return jnp.dtype(self.network.settings.dtype)

    @property
    def one_way(self) -> bool:
        """Whether condition tokens attend to condition tokens only."""
        return self.network.settings.visibility == "one_way"

    def _stream_input(self, stream: Stream, rngs: nnx.Rngs) -> nnx.Module:
        """Pixel streams start from a copy of RGB's patch embedding, as in FlowWAM and the paper."""
        if stream.source == "joints":
            return TwoLayer(16, self.size.dim, self.size.dim, nnx.silu, self.dtype, nnx.initializers.xavier_uniform(), rngs)
        return jax.tree.map(jnp.copy, self.patch_embedding)

    def __call__(
        self,
        latents: Latents,
        conditions: Conditions,
        sigma: Float[Array, " b"],
        text: Text,
        cache: ConditionCache | None = None,
    ) -> Latents:
        """Velocity [b t h w c] float32 of the RGB latents; frame 0 has no meaning.

        Args:
            latents: [b t h w c] float32; latent frame 0 is the clean reference.
            conditions: see `Conditions`; streams are not read if there is a cache.
            sigma: [b] float32, noise level in [0, 1] of latent frames from 1 on.
            text: [b l e] float32, zero-padded (without a mask, as in Wan); or ids [b l] int32 of `words`, 0 for padding.
            cache: of these conditions and this text, from `condition_cache`.
        """
        rgb = np.prod(token_grid(latents.shape, self.size.patch)).item()
        tokens, levels, rotary = self.embed_streams(latents, conditions, cached=cache is not None)
        time, levels = self.add_frame_vectors(self.embed_time(sigma), levels, latents.shape, conditions)
        context = self.framed_context(text, latents.shape, conditions)
        tokens = self.apply_blocks(tokens, self.modulation(time), levels, rotary, context, rgb, cache)
        features = self.head(tokens[:, :rgb].astype(jnp.float32), time, levels[:rgb])
        predicted = unpatchify(features, latents.shape, self.size.patch)
        if self.network.settings.prediction == "velocity":
            return predicted
        guess = conditions[self.network.guess] if self.network.guess else latents[:, :1]
        return velocity_of_residual(predicted, latents, sigma, guess)

    def condition_cache(self, conditions: Conditions, text: Text) -> ConditionCache:
        """Keys and values [layers b s n head_dim] of the condition tokens, for all sampling steps of a clip.

        Raises:
            ValueError: the model is not `one_way`, so condition tokens depend on the RGB tokens of each step.
        """
        if not self.one_way:
            raise ValueError("condition tokens can only be computed ahead in a model of visibility one_way.")
        tokens, levels, rotary = self._join({name: conditions[name] for name in self.condition_streams})
        modulation = self.modulation(self.embed_time(jnp.zeros(tokens.shape[0], jnp.float32)))
        context = self.context(text, conditions)
        graph, layers = nnx.split(self.blocks)

        def block(carry: Array, layer: nnx.State) -> tuple[Array, ConditionCache]:
            module, carry = nnx.merge(graph, gather_parameters(layer, layer=True)), shard_over_batch(carry)
            read = ConditionCache(*module.keys_values(carry, modulation, levels, rotary))
            return module(carry, modulation, levels, rotary, context), read

        return jax.lax.scan(block, tokens, layers, unroll=self.network.unroll)[1]

    def embed_streams(
        self, latents: Latents, conditions: Conditions, cached: bool = False
    ) -> tuple[Float[Array, "b s d"], Levels, Rotary]:
        """Tokens [b s d] of all streams, or of RGB alone if others are cached, with levels [s] and rotations [s angles]."""
        streams = {name: conditions[name] for name in self.condition_streams if not cached}
        tokens, levels, rotary = self._join({"rgb": latents} | streams)
        for name in self._entering("channels"):
            pictures = patchify(self._pictures(name, latents, conditions), self.size.patch)
            columns = self.mechanisms[name](pictures).astype(jnp.float32)
            tokens = tokens.at[:, : columns.shape[1]].add(columns.astype(self.dtype))
        return tokens, levels, rotary

    def _pictures(self, name: str, latents: Latents, conditions: Conditions) -> Float[Array, "b k h w features"]:
        """Pictures [b k h w features] that a mechanism adds to RGB's channels."""
        source = MECHANISMS[name].source
        if source == "reference":
            return jnp.broadcast_to(latents[:, :1], latents.shape)
        return ray_maps(conditions[name], latents.shape) if source == "camera" else conditions[name]

    def _join(self, inputs: Mapping[str, Array]) -> tuple[Array, np.ndarray, Rotary]:
        grids = {name: token_grid(array.shape, self.size.patch) for name, array in inputs.items()}
        tokens = jnp.concatenate([self._embed(name, array) for name, array in inputs.items()], axis=1)
        levels = np.concatenate([token_levels(self._stream(name), grid) for name, grid in grids.items()])
        head_dim, base, times = self.size.head_dim, self.size.rotary_base, {"history": self._history_times}
        angles = np.concatenate([rotary_angles(grid, head_dim, base, times.get(name)) for name, grid in grids.items()])
        rotary = jnp.asarray(np.cos(angles), jnp.float32), jnp.asarray(np.sin(angles), jnp.float32)
        return tokens.astype(self.dtype), levels, rotary

    @property
    def _history_times(self) -> tuple[float, ...]:
        """Times of the earlier frames relative to the clip's first [latent frames]."""
        return tuple(frame / TEMPORAL_FACTOR for frame in self.network.settings.history)

    def _stream(self, name: str) -> Stream:
        """A stream with its noise level in this model; in a `one_way` model condition tokens have level 0."""
        stream = STREAMS[name]
        return dataclasses.replace(stream, timestep="clean") if self.one_way and name != "rgb" else stream

    def _embed(self, name: str, array: Array) -> Array:
        if name == "rgb":
            return self.patch_embedding(patchify(array, self.size.patch)).astype(jnp.float32)
        values = array if STREAMS[name].source == "joints" else patchify(array, self.size.patch)
        embed = self.patch_embedding if STREAMS[name].source == "history" else self.stream_inputs[name]
        return embed(values).astype(jnp.float32) + self.stream_embeddings[name][None, None]

    def embed_time(self, sigma: Float[Array, " b"]) -> Float[Array, "b 2 d"]:
        """Time embeddings [b 2 d] float32 of the two noise levels of each sample: 0 and sigma [b]."""
        timesteps = jnp.stack([jnp.zeros_like(sigma), TIMESTEPS * sigma], axis=1)
        embed = rounded_sinusoid if self.network.settings.time == "flowwam" else sinusoid
        return self.time_embedding(embed(timesteps))

    def _entering(self, point: str) -> list[str]:
        """The model's mechanisms at an entry point of the network."""
        return [name for name in self.mechanisms if MECHANISMS[name].enters == point]

    def add_frame_vectors(
        self, time: Float[Array, "b r d"], levels: Levels, shape: Sequence[int], conditions: Conditions
    ) -> tuple[Float[Array, "b r2 d"], Levels]:
        """Add a time embedding for each latent frame of RGB, with the vectors of the mechanisms that enter there.

        Without such a mechanism the arguments are returned unchanged.

        Args:
            time: [b r d] float32, embeddings of the noise levels.
            levels: [s], index of each token's level.
            shape: of the RGB latents [b t h w c].
            conditions: as of `__call__`.

        Returns:
            Embeddings [b r+t' d] float32 and the index of each token's [s].
        """
        names = self._entering("time")
        if not names:
            return time, levels
        frames, height, width = token_grid(shape, self.size.patch)
        of_frames = select_levels(time, token_levels(STREAMS["rgb"], (frames, 1, 1)))
        vectors = sum((self.mechanisms[name](conditions[name]) for name in names), of_frames)
        own = np.repeat(time.shape[1] + np.arange(frames), height * width)
        return jnp.concatenate([time, vectors], axis=1), np.concatenate([own, levels[len(own) :]])

    def context(self, text: Text, conditions: Conditions | None = None) -> Float[Array, "b k d"]:
        """Context [b k d] of all tokens: the text [b l e] or [b l], and tokens of mechanisms next to it or instead of it."""
        names = self._entering("context")
        tokens = [self.mechanisms[name]((conditions or {})[name]).astype(self.dtype) for name in names]
        if any(MECHANISMS[name].replaces_text for name in names):
            return jnp.concatenate(tokens, axis=1)
        if self.words is not None:
            text = self.words(text) * (text > 0)[..., None].astype(jnp.float32)
        return jnp.concatenate([self.text_embedding(text), *tokens], axis=1)

    def framed_context(self, text: Text, shape: Sequence[int], conditions: Conditions) -> Float[Array, "b k d"] | FramedContext:
        """`context` [b k d], and if mechanisms have tokens of single frames, these [b f k d]: RGB's, then the history's.

        Args:
            text: as of `__call__`.
            shape: of the RGB latents [b t h w c].
            conditions: as of `__call__`.
        """
        shared, names = self.context(text, conditions), self._entering("frame")
        if not names:
            return shared
        frames, height, width = token_grid(shape, self.size.patch)
        framed = jnp.concatenate([self.mechanisms[name](conditions[name]).astype(self.dtype) for name in names], axis=2)
        earlier = framed.shape[1] - frames
        return FramedContext(shared, jnp.concatenate([framed[:, earlier:], framed[:, :earlier]], axis=1), height * width)

    def modulation(self, time: Float[Array, "b r d"]) -> Float[Array, "b r 6 d"]:
        """Adaptive-norm shifts, scales and gates [b r 6 d] float32 of time embeddings [b r d]."""
        return self.time_projection(nnx.silu(time)).reshape(*time.shape[:-1], 6, self.size.dim)

    def apply_blocks(
        self,
        tokens: Float[Array, "b s d"],
        modulation: Float[Array, "b r 6 d"],
        levels: Levels,
        rotary: Rotary,
        text: Float[Array, "b k d"] | FramedContext,
        rgb: int | None = None,
        cache: ConditionCache | None = None,
    ) -> Float[Array, "b s d"]:
        """Apply the block stack to tokens [b s d] as a scan over the layers.

        Arguments as of `Block.__call__`; `rgb` is the number of RGB's tokens, which come first.
        """
        graph, layers = nnx.split(self.blocks)
        start = rgb if self.one_way and rgb != tokens.shape[1] else None

        def block(carry: Array, xs: tuple[nnx.State, ConditionCache | None]) -> tuple[Array, None]:
            layer, read = xs
            module = nnx.merge(graph, gather_parameters(layer, layer=True))
            return module(shard_over_batch(carry), modulation, levels, rotary, text, start, read), None

        remat, unroll = self.network.settings.remat, self.network.unroll
        if remat != "none":
            # A loop keeps recomputation apart from the forward pass; without one it must be forced.
            block = jax.checkpoint(block, policy=REMAT[remat], prevent_cse=unroll >= self.size.depth)
        return jax.lax.scan(block, tokens, (layers, cache), unroll=unroll)[0]


@functools.lru_cache(maxsize=16)
def _split_shapes(network: Network) -> tuple[nnx.GraphDef, Any]:
    """Structure and shapes of a network; cached, because tracing takes a second."""
    return nnx.split(nnx.eval_shape(lambda: WorldModel(network)), nnx.Param)


def network_graph(network: Network) -> nnx.GraphDef:
    """The structure of a network without its parameters."""
    return _split_shapes(network)[0]


def network_shapes(network: Network) -> Any:
    """Shapes and types of a network's parameters, in their tree."""
    return jax.tree.map(lambda leaf: leaf, _split_shapes(network)[1])  # a copy, which the caller may change


def token_levels(stream: Stream, grid: TokenGrid) -> Levels:
    """Index [s] of the noise level of each token of a stream: 0 is no noise, 1 the sample's level."""
    frames = np.zeros(grid[0], int) if stream.timestep == "clean" else np.minimum(np.arange(grid[0]), 1)
    return np.repeat(frames, grid[1] * grid[2])


def cast_params(graph: nnx.GraphDef, params: Any) -> Any:
    """Cast every matrix of linear layers to the type of its product.

    The rounding is done once instead of in every pass, and sharded parameters are gathered in half the bytes. Gradients
    through it have the type of `params`.
    """
    model = nnx.merge(graph, params)
    types = {path: module.dtype for path, module in nnx.iter_modules(model) if isinstance(module, nnx.Linear) and module.dtype}
    flat = nnx.to_flat_state(params)
    rounded = [
        (path, leaf.replace(leaf.get_value().astype(types[path[:-1]])) if path[:-1] in types else leaf) for path, leaf in flat
    ]
    return nnx.from_flat_state(rounded)


def parameter_count(model: nnx.Module) -> int:
    """Number of parameters that the model learns."""
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))

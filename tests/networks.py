"""Networks with random parameters, made without compiling anything: every random array of JAX is a program of its own."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from xew.model.network.blocks import ModelSize
from xew.model.network.dit import MODELS, WorldModel
from xew.model.network.spec import Network, NetworkSettings

Module = TypeVar("Module", bound=nnx.Module)
WAN = NetworkSettings(history=(), dtype="float32", remat="none", visibility="joint", prediction="velocity")
"""The network as Wan has it, in float32."""


def world_model(
    size: ModelSize | str = "tiny",
    channels: int = 3,
    streams: Sequence[str] = (),
    *,
    words: int = 0,
    guess: str = "",
    seed: int = 0,
    **settings: Any,
) -> WorldModel:
    """A network at its random start, with Wan's settings but for those that are given."""
    size = MODELS[size] if isinstance(size, str) else size
    settings |= {"dtype": jnp.dtype(settings["dtype"]).name} if "dtype" in settings else {}
    spec = Network(size, channels, tuple(streams), guess, words, seed, replace(WAN, **settings), unrolled=False)
    return WorldModel(spec)


TINY_CODEC = Path(__file__).parent / "model" / "tiny_codec.safetensors"
"""Weights of a tiny codec: eight channels for 8x8 pixels and four frames. It was trained for a minute on synthetic episodes."""


def normal(seed: int, *shape: int) -> jax.Array:
    """Numbers N(0, 1), float32 of a shape."""
    return jnp.asarray(np.random.default_rng(seed).standard_normal(shape, np.float32))


def draw_network(create: Callable[[], Module], scale: float = 0.2, seed: int = 1) -> Module:
    """The network that a function creates, with all parameters N(0, scale), so that nothing hides behind a zero start."""
    network = nnx.eval_shape(create)
    rng = np.random.default_rng(seed)
    state = nnx.state(network)
    nnx.update(network, jax.tree.map(lambda leaf: jnp.asarray(_draw(rng, leaf, scale)), state))
    return network


def _draw(rng: np.random.Generator, leaf: jax.ShapeDtypeStruct, scale: float) -> np.ndarray:
    return (scale * rng.standard_normal(leaf.shape, np.float32)).astype(leaf.dtype)

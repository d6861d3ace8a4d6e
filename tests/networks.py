"""Networks with random parameters, made without compiling anything: every random array of JAX is a program of its own."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

Module = TypeVar("Module", bound=nnx.Module)

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

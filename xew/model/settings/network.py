"""The network of an experiment: everything that making it needs."""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from xew.model.network.dit import (
    ModelSize,
    WorldModel,
)
from xew.model.settings.settings import ModelSettings
from xew.model.video.frames import TEMPORAL_FACTOR


@dataclass(frozen=True)
class Network:
    """What the network is: everything that `create` needs."""

    size: ModelSize
    channels: int
    """Channels of the latents."""
    streams: tuple[str, ...]
    """Streams and mechanisms beside RGB."""
    words: int
    """Rows of the table of words that the network learns; 0 where a frozen encoder is used."""
    seed: int
    settings: ModelSettings

    @property
    def structure(self) -> nnx.GraphDef:
        """The network without its parameters, made without computing anything."""
        return _split_shapes(self)[0]

    @property
    def shapes(self) -> Any:
        """Shapes and types of the parameters, in their tree, without computing anything."""
        return jax.tree.map(lambda leaf: leaf, _split_shapes(self)[1])  # a tree of one's own: it can be changed

    def create(self) -> WorldModel:
        """Make the network at its random start; wrap in `nnx.eval_shape` for shapes only."""
        settings = self.settings
        return WorldModel(
            self.size,
            self.channels,
            self.streams,
            dtype=jnp.dtype(settings.dtype),
            residual=jnp.dtype(settings.residual),
            remat=settings.remat,
            unroll=settings.unroll,
            attention=settings.attention,
            visibility=settings.visibility,
            time=settings.time,
            history=tuple(frame / TEMPORAL_FACTOR for frame in settings.history),
            words=self.words,
            prediction=settings.prediction,
            rngs=nnx.Rngs(self.seed),
        )


@functools.lru_cache(maxsize=16)
def _split_shapes(network: Network) -> tuple[nnx.GraphDef, Any]:
    """Structure and shapes of a network. To trace its making takes a second, and a command asks several times."""
    return nnx.split(nnx.eval_shape(network.create), nnx.Param)

"""The network of an experiment: everything that making it needs, and whether it can be made."""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from xew.model.network.blocks import choose_attention
from xew.model.network.dit import ModelSize, WorldModel
from xew.model.network.dit_layouts import check_dit
from xew.model.settings.settings import ModelSettings
from xew.model.video.frames import TEMPORAL_FACTOR
from xew.model.weights.reading import read_tensors


@dataclass(frozen=True)
class Network:
    """What the network is: everything that `create` needs."""

    size: ModelSize
    channels: int
    """Channels of the latents."""
    streams: tuple[str, ...]
    """Streams and mechanisms beside RGB."""
    guess: str
    """The one of them that is a guess of the video; "" where none is."""
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
            guess=self.guess,
            rngs=nnx.Rngs(self.seed),
        )


def check_network(network: Network) -> None:
    """Raise ConfigError if the network cannot be computed here as asked, or its published weights do not fit."""
    settings = network.settings
    if settings.weights is not None:
        check_dit(nnx.eval_shape(network.create), read_tensors(settings.weights))
    choose_attention(settings.attention, network.size.head_dim, jnp.dtype(settings.dtype))


@functools.lru_cache(maxsize=16)
def _split_shapes(network: Network) -> tuple[nnx.GraphDef, Any]:
    """Structure and shapes of a network. To trace its making takes a second, and a command asks several times."""
    return nnx.split(nnx.eval_shape(network.create), nnx.Param)

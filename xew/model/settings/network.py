"""The network of an experiment: everything that making it needs, and whether it can be made."""

from dataclasses import dataclass

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
    words: int
    """Rows of the table of words that the network learns; 0 where a frozen encoder is used."""
    seed: int
    settings: ModelSettings

    @property
    def structure(self) -> nnx.GraphDef:
        """The network without its parameters, made without computing anything."""
        return nnx.split(nnx.eval_shape(self.create), nnx.Param)[0]

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


def check_network(network: Network) -> None:
    """Raise ConfigError if the network cannot be computed here as asked, or its published weights do not fit."""
    settings = network.settings
    if settings.weights is not None:
        check_dit(nnx.eval_shape(network.create), read_tensors(settings.weights))
    choose_attention(settings.attention, network.size.head_dim, jnp.dtype(settings.dtype))

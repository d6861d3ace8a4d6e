"""The network of an experiment: everything that making it needs."""

from dataclasses import dataclass

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

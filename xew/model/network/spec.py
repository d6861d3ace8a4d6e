"""Options of the network. A config's `model` section extends `NetworkSettings`; `dit.WorldModel` implements a `Network`."""

from dataclasses import dataclass, field, replace
from typing import Literal

from xew.model.network.blocks import ModelSize, RematName

Visibility = Literal["joint", "one_way"]
Prediction = Literal["velocity", "residual"]
TimeEmbedding = Literal["exact", "flowwam"]
UNROLL_AT_MOST = 12
"""Largest number of blocks that a training step compiles without a loop, which is faster but takes long to compile."""


@dataclass(frozen=True)
class NetworkSettings:
    """Network options of a config."""

    history: tuple[int, ...] = (-400,)
    """Earlier frames as further input, relative to the clip's first, as [-40, -20]; frames before the episode are its first
    frame, so [-400] is the episode's first frame."""
    dtype: Literal["float32", "bfloat16"] = "bfloat16"
    """Type of the matrix products and of the tokens between blocks; parameters, norms, modulation and sums are float32."""
    remat: RematName = "none"
    """Gradient checkpointing: none, attention, dots or full (blocks.REMAT)."""
    visibility: Visibility = "one_way"
    """joint: all tokens attend to all, as in Wan and FlowWAM. one_way: condition tokens attend to one another only, at noise
    level 0, so a sampler computes them once a clip."""
    time: TimeEmbedding = "exact"
    """Time embedding; flowwam has the rounding of FlowWAM's published weights."""
    prediction: Prediction = "residual"
    """velocity: the head predicts the velocity, as in Wan. residual: the residual of a linear estimate from the noisy latents
    and the pasted render, or the clip's first frame if the render is no condition."""


@dataclass(frozen=True)
class Network:
    """Definition of a network without its parameters."""

    size: ModelSize
    channels: int
    """Channels of the latents."""
    streams: tuple[str, ...] = ()
    """Names in `dit.STREAMS` besides rgb, and in `mechanisms.MECHANISMS`."""
    guess: str = ""
    """Stream or mechanism whose latents are the guess of a residual; "" takes the first frame."""
    words: int = 0
    """Size of the learned word table, with ids [b l] as text; 0 takes embeddings."""
    seed: int = 0
    """Seed of the initial parameters."""
    settings: NetworkSettings = field(default_factory=NetworkSettings)
    unrolled: bool = True
    """Whether the blocks of a small network are compiled without a loop."""

    @property
    def unroll(self) -> int:
        """Number of blocks compiled as one loop body."""
        return self.size.depth if self.unrolled and self.size.depth <= UNROLL_AT_MOST else 1

    @property
    def for_sampling(self) -> "Network":
        """The same network with a loop over blocks, which is as fast without a backward pass."""
        return replace(self, unrolled=False)

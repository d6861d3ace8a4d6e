"""What the network is: each of its options, written here once. A config's `model` section extends `NetworkSettings`.

`dit.WorldModel` computes a `Network`; nothing here needs its parameters.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

from xew.model.network.blocks import ModelSize, RematName

Visibility = Literal["joint", "one_way"]
Prediction = Literal["velocity", "residual"]
TimeEmbedding = Literal["exact", "flowwam"]
UNROLL_AT_MOST = 12
"""Largest number of blocks that a training step compiles as one body, not as a loop. It spares the backward pass its stacked
arrays, and takes long to compile: a minute and a half on a GPU at 12."""


@dataclass(frozen=True)
class NetworkSettings:
    """Options of the network that a config can choose."""

    history: tuple[int, ...] = (-400,)
    """Earlier frames that every clip is given too, counted from the clip's first, as [-40, -20]; before the episode its first
    frame counts, so that [-400] is the episode's first frame."""
    dtype: Literal["float32", "bfloat16"] = "bfloat16"
    """Type of the matrix products and of the tokens between blocks; parameters, norms, modulation and sums stay float32."""
    remat: RematName = "dots"
    """Part that the backward pass computes again: none, all but attention or matrix products, or everything (blocks.REMAT)."""
    visibility: Visibility = "one_way"
    """joint: all tokens attend to all, as in Wan and FlowWAM. one_way: condition tokens attend to condition tokens only and get
    the noise level 0, so that a sampler computes them once a clip."""
    time: TimeEmbedding = "exact"
    """flowwam: with the rounding under which FlowWAM's published weights were trained."""
    prediction: Prediction = "residual"
    """velocity: the head computes the velocity, as in Wan. residual: what a linear guess from the noisy latents and the pasted
    render (or the clip's first frame, where that is no condition) leaves of the clean ones."""


@dataclass(frozen=True)
class Network:
    """A network without its parameters: all that `WorldModel` needs."""

    size: ModelSize
    channels: int
    """Channels of the latents."""
    streams: tuple[str, ...] = ()
    """Names in `dit.STREAMS` besides rgb, and in `mechanisms.MECHANISMS`."""
    guess: str = ""
    """Stream or mechanism whose latents are the guess of a residual; "" takes the first frame, which stands still."""
    words: int = 0
    """Rows of the table of words that the network learns; text is then ids [b l], not embeddings. 0 has none."""
    seed: int = 0
    """Seed of the random start."""
    settings: NetworkSettings = field(default_factory=NetworkSettings)
    unrolled: bool = True
    """Whether the blocks of a small network are compiled as one body."""

    @property
    def unroll(self) -> int:
        """Number of blocks compiled as one loop body."""
        return self.size.depth if self.unrolled and self.size.depth <= UNROLL_AT_MOST else 1

    @property
    def for_sampling(self) -> "Network":
        """The same network, with the same parameters, as a sampler compiles it: without a backward pass a loop is as fast."""
        return replace(self, unrolled=False)

"""The video autoencoder of Wan2.2 at any size (Flax NNX), causal in time; a latent covers four frames and 8 or 16 pixels.

Reads  frames [b t h w 3] in [-1, 1], t = 4 k + 1
Writes means and log variances of latents [b k+1 h/factor w/factor c], and frames back
To add a size: one line in VAES.

A video is coded in one pass, or in chunks with the last input frames of each layer (`History`) and the same result. The first
frame is coded alone and never halved or doubled in time.

Source: Wan2.2 (github.com/Wan-Video/Wan2.2, vae2_2.py, Apache-2.0).
Shape letters: b batch, t h w c video, i o channels in and out.
"""

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
from flax import nnx
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from xew.config import ConfigError
from xew.files import read_json
from xew.model.codecs.vae_chunks import History, apply_in_chunks, even_chunk
from xew.model.codecs.vae_layers import (
    Downsample,
    FrameAttention,
    Layers,
    ResidualBlock,
    RmsNorm,
    Upsample,
    as_row,
    average_groups,
    check_frames,
    patchify,
    repeat_groups,
    unpatchify,
)

LOG_VARIANCE_RANGE = (-30.0, 20.0)
"""Limits that log variances are clipped to."""
PUBLISHED_STATISTICS = Path(__file__).with_name("wan22_latents.json")
"""Mean and standard deviation of Wan2.2's latents, from its code."""

Video = Float[Array, "b t h w 3"]
Latents = Float[Array, "b k y x c"]


@dataclass(frozen=True)
class VaeSize:
    """Hyperparameters of a `VideoVae`; stages are listed from pixels to latents, and all but the last halve the sides."""

    channels: int
    """Number of channels of the latents."""
    encoder_dim: int
    decoder_dim: int
    multipliers: tuple[int, ...]
    """Width of each stage as a multiple of the encoder's or decoder's width."""
    halve_time: tuple[bool, ...]
    """Whether each stage but the last halves time; exactly two do."""
    blocks: int = 2
    """Number of residual blocks in a stage of the encoder; the decoder has one more."""
    patch: int = 2
    """Side of the patches that become channels before the first layer [pixels]."""

    def __post_init__(self) -> None:
        if len(self.halve_time) != len(self.multipliers) - 1 or sum(self.halve_time) != 2:
            raise ValueError(f"{self}: expected halve_time for every stage but the last, true for exactly two")

    @property
    def spatial_factor(self) -> int:
        """Number of pixels per latent along a side."""
        return self.patch * 2 ** len(self.halve_time)

    @property
    def encoder_widths(self) -> list[int]:
        """Widths before each stage of the encoder and after the last."""
        return [self.encoder_dim * multiplier for multiplier in (1, *self.multipliers)]

    @property
    def decoder_widths(self) -> list[int]:
        """Widths before each stage of the decoder and after the last."""
        return [self.decoder_dim * multiplier for multiplier in (self.multipliers[-1], *self.multipliers[::-1])]


LARGEST_WIDTH, MOST_BLOCKS, LARGEST_MULTIPLIER = 4096, 64, 64
"""Largest values of a size that is read from a file."""


def check_size(size: VaeSize, source: str) -> None:
    """Raise ConfigError if a size that was read from a file is out of range."""
    widths, multipliers = (size.channels, size.encoder_dim, size.decoder_dim, size.patch), size.multipliers
    wrong = not 0 < min(widths) <= max(widths) <= LARGEST_WIDTH or not 0 < size.blocks <= MOST_BLOCKS
    if wrong or not multipliers or not 0 < min(multipliers) <= max(multipliers) <= LARGEST_MULTIPLIER:
        raise ConfigError(f"{source}: {size} is not a valid size of an autoencoder; copy the whole run again.")


VAES = {
    "tiny": VaeSize(48, encoder_dim=16, decoder_dim=16, multipliers=(1, 2, 2), halve_time=(True, True), blocks=1),
    "wan22": VaeSize(48, encoder_dim=160, decoder_dim=256, multipliers=(1, 2, 4, 4), halve_time=(False, True, True)),
}


class LatentStatistic(nnx.Variable):
    """Mean or standard deviation of the latents by channel; not trained."""


class VideoVae(nnx.Module):
    """Encoder and decoder.

    Args:
        size: one of `VAES`.
        dtype: of activations and matrix products; parameters and norms are float32.
    """

    def __init__(self, size: VaeSize, *, dtype: DTypeLike = jnp.float32, rngs: nnx.Rngs) -> None:
        self.size, self.dtype = size, dtype
        layers = Layers(jnp.dtype(dtype), rngs)
        self.encoder = Encoder(size, layers)
        self.quant = layers.pointwise(2 * size.channels, 2 * size.channels)
        self.post_quant = layers.pointwise(size.channels, size.channels)
        self.decoder = Decoder(size, layers)
        mean, std = initial_statistics(size)
        self.latents_mean, self.latents_std = LatentStatistic(mean), LatentStatistic(std)

    def moments(self, frames: Video, chunk: int = 0) -> tuple[Latents, Latents]:
        """Mean and log variance of the latents, not normalized.

        Args:
            frames: [b t h w 3] in [-1, 1]; t = 4 k + 1, sides multiples of the size's factor.
            chunk: largest number of latent frames computed at once; 0 computes all.

        Returns:
            Two of [b k+1 h' w' c] float32.
        """
        check_frames(frames.shape, self.size.spatial_factor)

        def step(part: Array, history: History) -> Array:
            return self.encoder(patchify(part, self.size.patch), history)

        encoded = apply_in_chunks(step, frames.astype(self.dtype), 4 * even_chunk(frames.shape[1] // 4, chunk))
        mean, log_variance = jnp.split(self.quant(encoded).astype(jnp.float32), 2, axis=-1)
        return mean, jnp.clip(log_variance, *LOG_VARIANCE_RANGE)

    def encode(self, frames: Video, chunk: int = 0) -> Latents:
        """Normalized mean latents [b k+1 h' w' c] float32 of frames [b t h w 3]; arguments as of `moments`."""
        mean = self.moments(frames, chunk)[0]
        return (mean - as_row(self.latents_mean[...])) / as_row(self.latents_std[...])

    def decode(self, latents: Latents, chunk: int = 0, *, last_only: bool = False) -> Video:
        """Frames [b t h w 3] float32 in [-1, 1] of normalized latents, t = 4 (t' - 1) + 1, or 1.

        Args:
            latents: [b t' h' w' c].
            chunk: largest number of latent frames computed at once; 0 computes all. Wan2.2 at 121 frames of 320x256 then
                makes tensors of more than 2^31 numbers, which not every convolution of cuDNN supports.
            last_only: return the last frame alone; a small `chunk` then saves memory.
        """

        def step(part: Array, history: History) -> Array:
            frames = unpatchify(self.decoder(part, history), self.size.patch)
            return frames[:, -1:] if last_only else frames

        chunk = even_chunk(latents.shape[1] - 1, chunk)
        means = latents.astype(jnp.float32) * as_row(self.latents_std[...]) + as_row(self.latents_mean[...])
        decoded = apply_in_chunks(step, self.post_quant(means.astype(self.dtype)), chunk)
        return jnp.clip((decoded[:, -1:] if last_only else decoded).astype(jnp.float32), -1, 1)


def abstract_vae(size: VaeSize, dtype: DTypeLike = jnp.float32) -> VideoVae:
    """An autoencoder without parameter values (its statistics have values), to load weights into."""
    vae = nnx.eval_shape(lambda: VideoVae(size, dtype=dtype, rngs=nnx.Rngs(0)))
    mean, std = initial_statistics(size)
    vae.latents_mean.set_value(mean)
    vae.latents_std.set_value(std)
    return vae


def initial_statistics(size: VaeSize) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Mean and standard deviation of the latents [c]: Wan2.2's published ones at its size, else 0 and 1."""
    if size != VAES["wan22"]:
        return jnp.zeros(size.channels), jnp.ones(size.channels)
    published = read_json(PUBLISHED_STATISTICS)
    return jnp.asarray(published["mean"], jnp.float32), jnp.asarray(published["std"], jnp.float32)


class Encoder(nnx.Module):
    """Patches of frames [b t h w 4*3] -> both moments of the latents [b t' h' w' 2c]."""

    def __init__(self, size: VaeSize, layers: Layers) -> None:
        widths = size.encoder_widths
        halve = (*size.halve_time, None)
        stages = zip(widths, widths[1:], halve, strict=False)
        self.conv_in = layers.causal(3 * size.patch**2, widths[0])
        self.stages = nnx.List([DownStage(i, o, size.blocks, time, layers) for i, o, time in stages])
        self.middle = Middle(widths[-1], layers)
        self.norm_out = RmsNorm(widths[-1])
        self.conv_out = layers.causal(widths[-1], 2 * size.channels)

    def __call__(self, x: Float[Array, "b t h w i"], history: History) -> Float[Array, "b t2 h2 w2 o"]:
        """Patches of frames [b t h w 4*3] -> mean and log variance of latents [b t' h' w' 2*c]."""
        x = self.conv_in(x, history)
        for stage in self.stages:
            x = stage(x, history)
        return self.conv_out(nnx.silu(self.norm_out(self.middle(x, history))), history)


class Decoder(nnx.Module):
    """Latents [b t' h' w' c] -> patches of frames [b t h w 4*3]."""

    def __init__(self, size: VaeSize, layers: Layers) -> None:
        widths = size.decoder_widths
        double = (*size.halve_time[::-1], None)
        stages = zip(widths, widths[1:], double, strict=False)
        self.conv_in = layers.causal(size.channels, widths[0])
        self.middle = Middle(widths[0], layers)
        self.stages = nnx.List([UpStage(i, o, size.blocks + 1, time, layers) for i, o, time in stages])
        self.norm_out = RmsNorm(widths[-1])
        self.conv_out = layers.causal(widths[-1], 3 * size.patch**2)

    def __call__(self, x: Float[Array, "b t h w i"], history: History) -> Float[Array, "b t2 h2 w2 o"]:
        """Latents [b t' h' w' c] -> patches of frames [b t h w 4*3]."""
        x = self.middle(self.conv_in(x, history), history)
        for stage in self.stages:
            x = stage(x, history)
        return self.conv_out(nnx.silu(self.norm_out(x)), history)


class DownStage(nnx.Module):
    """Residual blocks and downsampling, plus a shortcut that averages.

    Args:
        halve_time: whether frames are halved with the sides; None halves neither.
    """

    def __init__(self, i: int, o: int, blocks: int, halve_time: bool | None, layers: Layers) -> None:
        self.blocks = nnx.List([ResidualBlock(i if n == 0 else o, o, layers) for n in range(blocks)])
        self.resample = nnx.data(None if halve_time is None else Downsample(o, halve_time, layers))
        self.width, self.time, self.side = o, 2 if halve_time else 1, 1 if halve_time is None else 2

    def __call__(self, x: Float[Array, "b t h w i"], history: History) -> Float[Array, "b t2 h2 w2 o"]:
        """Features [b t h w i] -> [b t' h' w' o]."""
        shortcut = average_groups(x, self.width, self.time, self.side)
        for block in self.blocks:
            x = block(x, history)
        return shortcut + (x if self.resample is None else self.resample(x, history))


class UpStage(nnx.Module):
    """Residual blocks and upsampling, plus a shortcut that repeats.

    Args:
        double_time: whether frames are doubled with the sides; None doubles neither and has no shortcut.
    """

    def __init__(self, i: int, o: int, blocks: int, double_time: bool | None, layers: Layers) -> None:
        self.blocks = nnx.List([ResidualBlock(i if n == 0 else o, o, layers) for n in range(blocks)])
        self.resample = nnx.data(None if double_time is None else Upsample(o, double_time, layers))
        self.width, self.time = o, 2 if double_time else 1

    def __call__(self, x: Float[Array, "b t h w i"], history: History) -> Float[Array, "b t2 h2 w2 o"]:
        """Features [b t h w i] -> [b t' h' w' o]."""
        before, begins = x, history.begins
        for block in self.blocks:
            x = block(x, history)
        if self.resample is None:
            return x
        return self.resample(x, history) + repeat_groups(before, self.width, self.time, 2, begins)


class Middle(nnx.Module):
    """Residual block, attention within each frame, residual block: [b t h w c] -> [b t h w c]."""

    def __init__(self, width: int, layers: Layers) -> None:
        self.first = ResidualBlock(width, width, layers)
        self.attention = FrameAttention(width, layers)
        self.last = ResidualBlock(width, width, layers)

    def __call__(self, x: Float[Array, "b t h w i"], history: History) -> Float[Array, "b t2 h2 w2 o"]:
        """Features [b t h w c] -> [b t h w c]."""
        return self.last(self.attention(self.first(x, history)), history)

"""The video autoencoder of Wan2.2 at any size (Flax NNX): causal in time, four frames and 8 or 16 pixels a side a latent.

Reads  frames [b t h w 3] in [-1, 1], t = 4 k + 1
Writes means and log variances of latents [b k+1 h/factor w/factor c], and frames back
To add a size: one line in VAES.

Every layer looks only backwards in time, so a video may go through in one pass or chunk by chunk with the last frames of
each layer kept (`History`); both are the same function. The first frame is coded alone and never halved or doubled in time.

Source: Wan2.2 (github.com/Wan-Video/Wan2.2, vae2_2.py, Apache-2.0); its chunks of one and four frames are a special case.
Shape letters: b batch, t h w c video, i o channels in and out.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array, lax

SMALLEST_NORM = 1e-12
LOG_VARIANCE_RANGE = (-30.0, 20.0)
PUBLISHED_STATISTICS = Path(__file__).with_name("wan22_latents.json")
WINDOW = 3
"""Frames that a causal convolution sees, itself included."""

TimeTaps = Literal["frames", "volume"]
"""How three frames are convolved.

frames  side by side in the channels, by a 2-D convolution: the same products. XLA hands 2-D convolutions to cuDNN channels
        last, as tensor cores want them, and transposes around 3-D ones; on a CPU this is five times as fast as
volume  a 3-D convolution, which needs less memory.
"""


@dataclass(frozen=True)
class VaeSize:
    """Everything that distinguishes one size of the autoencoder from another."""

    channels: int
    """Of the latents."""
    encoder_dim: int
    decoder_dim: int
    multipliers: tuple[int, ...]
    """Of the widths, one a stage from pixels to latents; every stage but the last halves the sides."""
    halve_time: tuple[bool, ...]
    """Of every stage but the last, in the same order; two of them halve time, which makes four."""
    blocks: int = 2
    """Residual blocks a stage of the encoder; the decoder has one more."""
    patch: int = 2
    """Pixels a side that become channels before the first layer."""

    def __post_init__(self) -> None:
        if len(self.halve_time) != len(self.multipliers) - 1 or sum(self.halve_time) != 2:
            raise ValueError(f"{self}: every stage but the last either halves time or does not, and exactly two do")

    @property
    def spatial_factor(self) -> int:
        return self.patch * 2 ** len(self.halve_time)

    @property
    def encoder_widths(self) -> list[int]:
        """In front of each stage and after the last."""
        return [self.encoder_dim * multiplier for multiplier in (1, *self.multipliers)]

    @property
    def decoder_widths(self) -> list[int]:
        return [self.decoder_dim * multiplier for multiplier in (self.multipliers[-1], *self.multipliers[::-1])]


VAES = {
    "tiny": VaeSize(48, encoder_dim=16, decoder_dim=16, multipliers=(1, 2, 2), halve_time=(True, True), blocks=1),
    "small": VaeSize(48, encoder_dim=48, decoder_dim=64, multipliers=(1, 2, 4, 4), halve_time=(False, True, True), blocks=1),
    "wan22": VaeSize(48, encoder_dim=160, decoder_dim=256, multipliers=(1, 2, 4, 4), halve_time=(False, True, True)),
}


class LatentStatistic(nnx.Variable):
    """Mean or standard deviation of the latents, channel by channel; not trained."""


class VideoVae(nnx.Module):
    """Encoder and decoder.

    Args:
        size: one of `VAES`.
        dtype: of activations and products; parameters stay float32, norms are computed in it.
        taps: how three frames are convolved.
    """

    def __init__(self, size: VaeSize, *, dtype: jnp.dtype = jnp.float32, taps: TimeTaps = "frames", rngs: nnx.Rngs) -> None:
        self.size, self.dtype = size, dtype
        layers = Layers(jnp.dtype(dtype), taps, rngs)
        self.encoder = Encoder(size, layers)
        self.quant = layers.pointwise(2 * size.channels, 2 * size.channels)
        self.post_quant = layers.pointwise(size.channels, size.channels)
        self.decoder = Decoder(size, layers)
        mean, std = initial_statistics(size)
        self.latents_mean, self.latents_std = LatentStatistic(mean), LatentStatistic(std)

    def moments(self, frames: Array, chunk: int = 0) -> tuple[Array, Array]:
        """Mean and log variance of the latents, not normalized.

        Args:
            frames: [b t h w 3] in [-1, 1]; t = 4 k + 1, sides multiples of the size's factor.
            chunk: latent frames computed at once, at most, which bounds the memory; 0 computes all.

        Returns:
            Two of [b k+1 h' w' c] float32.
        """
        self._check(frames.shape)

        def step(part: Array, history: History) -> Array:
            return self.encoder(patchify(part, self.size.patch), history)

        encoded = apply_in_chunks(step, frames.astype(self.dtype), 4 * even_chunk(frames.shape[1] // 4, chunk))
        mean, log_variance = jnp.split(self.quant(encoded).astype(jnp.float32), 2, axis=-1)
        return mean, jnp.clip(log_variance, *LOG_VARIANCE_RANGE)

    def encode(self, frames: Array, chunk: int = 0) -> Array:
        """Normalized mean latents [b k+1 h' w' c] float32; arguments as of `moments`."""
        return self.normalize(self.moments(frames, chunk)[0])

    def decode(self, latents: Array, chunk: int = 0, *, last_only: bool = False) -> Array:
        """Frames of normalized latents.

        Args:
            latents: [b t' h' w' c].
            chunk: latent frames computed at once, at most; 0 computes all, which at Wan2.2's size and 121 frames of
                320x256 makes tensors of more than 2^31 numbers, where not every convolution of cuDNN follows.
            last_only: give the last frame alone; with a small `chunk` the others never lie in memory together.

        Returns:
            [b t h w 3] float32 in [-1, 1], t = 4 (t' - 1) + 1, or 1.
        """
        return jnp.clip(self.decode_moments(self.denormalize(latents), chunk, last_only=last_only), -1, 1)

    def decode_moments(self, latents: Array, chunk: int = 0, *, last_only: bool = False) -> Array:
        """`decode` of latents as `moments` gives them, and not clipped: what training takes."""

        def step(part: Array, history: History) -> Array:
            frames = unpatchify(self.decoder(part, history), self.size.patch)
            return frames[:, -1:] if last_only else frames

        chunk = even_chunk(latents.shape[1] - 1, chunk)
        decoded = apply_in_chunks(step, self.post_quant(latents.astype(self.dtype)), chunk)
        return (decoded[:, -1:] if last_only else decoded).astype(jnp.float32)

    def normalize(self, mean: Array) -> Array:
        """Latents of about unit size."""
        return (mean - _row(self.latents_mean[...])) / _row(self.latents_std[...])

    def denormalize(self, latents: Array) -> Array:
        """The inverse of `normalize`."""
        return latents.astype(jnp.float32) * _row(self.latents_std[...]) + _row(self.latents_mean[...])

    def _check(self, shape: tuple[int, ...]) -> None:
        factor = self.size.spatial_factor
        if len(shape) != 5 or shape[1] % 4 != 1 or shape[2] % factor or shape[3] % factor or shape[4] != 3:
            raise ValueError(f"frames are {shape}; expected [b t h w 3] with t = 4 k + 1 and sides in {factor}s")


def abstract_vae(size: VaeSize, dtype: jnp.dtype = jnp.float32, taps: TimeTaps = "frames") -> VideoVae:
    """An autoencoder of which only the statistics have values yet; weights are loaded into it."""
    vae = nnx.eval_shape(lambda: VideoVae(size, dtype=dtype, taps=taps, rngs=nnx.Rngs(0)))
    mean, std = initial_statistics(size)
    vae.latents_mean.set_value(mean)
    vae.latents_std.set_value(std)
    return vae


def initial_statistics(size: VaeSize) -> tuple[Array, Array]:
    """Mean and deviation of the latents [c]: those published with Wan2.2 at its size, else 0 and 1 until they are measured."""
    if size != VAES["wan22"]:
        return jnp.zeros(size.channels), jnp.ones(size.channels)
    published = json.loads(PUBLISHED_STATISTICS.read_text())
    return jnp.asarray(published["mean"], jnp.float32), jnp.asarray(published["std"], jnp.float32)


# Time.


class History:
    """The frames that causal layers keep between the chunks of a video, in the order in which the layers run.

    Without frames kept it is the beginning of a video: layers see zeros before the first frame.
    """

    def __init__(self, kept: Sequence[Array] | None = None) -> None:
        self.before = kept
        self.after: list[Array] = []

    @property
    def begins(self) -> bool:
        return self.before is None

    def extend(self, x: Array, frames: int = WINDOW - 1) -> Array:
        """x [b t h w c] with the frames before it, which are zeros at the beginning."""
        if self.before is None:
            extended = jnp.pad(x, ((0, 0), (frames, 0), (0, 0), (0, 0), (0, 0)))
        else:
            extended = jnp.concatenate([self.before[len(self.after)], x], axis=1)
        self.after.append(extended[:, extended.shape[1] - frames :])
        return extended

    def follow(self, x: Array) -> Array:
        """x with the one frame before it, if there is one: for a layer that passes the first frame by."""
        if self.before is not None:
            return self.extend(x, 1)
        self.after.append(x[:, -1:])
        return x


def apply_in_chunks(step: Callable[[Array, History], Array], video: Array, size: int) -> Array:
    """A causal function of a video, all at once or chunk by chunk.

    Args:
        step: frames [b n ...] and history -> frames [b m ...].
        video: [b t ...]; its first frame is a chunk of its own.
        size: frames of the other chunks; 0 makes one chunk of everything.
    """
    if size == 0:
        return step(video, History())
    begin = History()
    parts = [step(video[:, :1], begin)]
    kept, rest = begin.after, video[:, 1:]
    b, count = rest.shape[0], rest.shape[1] // size
    if count:

        def scanned(kept: list[Array], chunk: Array) -> tuple[list[Array], Array]:
            history = History(kept)
            made = step(chunk, history)
            return history.after, made

        chunks = jnp.moveaxis(rest[:, : count * size].reshape(b, count, size, *rest.shape[2:]), 1, 0)
        kept, made = lax.scan(scanned, kept, chunks)
        parts.append(jnp.moveaxis(made, 0, 1).reshape(b, count * made.shape[2], *made.shape[3:]))
    if rest.shape[1] % size:
        parts.append(step(rest[:, count * size :], History(kept)))
    return jnp.concatenate(parts, axis=1)


def even_chunk(count: int, most: int) -> int:
    """The largest chunk up to `most` that divides `count`, so that no shorter one is compiled beside it.

    Where that is less than half of `most`, `most` itself; 0 stays 0.
    """
    even = next((size for size in range(min(most, count), 0, -1) if count % size == 0), most)
    return even if 2 * even >= most else most


# Stages.


@dataclass(frozen=True)
class Layers:
    """Makes layers of one type."""

    dtype: jnp.dtype
    taps: TimeTaps
    rngs: nnx.Rngs

    def causal(self, i: int, o: int) -> "Conv":
        return Conv((WINDOW, 3, 3, i, o), self)

    def pointwise(self, i: int, o: int, *, zero: bool = False, axes: int = 3) -> "Conv":
        return Conv((1,) * axes + (i, o), self, zero=zero)


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

    def __call__(self, x: Array, history: History) -> Array:
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

    def __call__(self, x: Array, history: History) -> Array:
        x = self.middle(self.conv_in(x, history), history)
        for stage in self.stages:
            x = stage(x, history)
        return self.conv_out(nnx.silu(self.norm_out(x)), history)


class DownStage(nnx.Module):
    """Residual blocks, then half the sides and perhaps half the frames; all of it beside an average without parameters.

    Args:
        halve_time: None leaves sides and frames as they are.
    """

    def __init__(self, i: int, o: int, blocks: int, halve_time: bool | None, layers: Layers) -> None:
        self.blocks = nnx.List([ResidualBlock(i if n == 0 else o, o, layers) for n in range(blocks)])
        self.resample = nnx.data(None if halve_time is None else Downsample(o, halve_time, layers))
        self.width, self.time, self.side = o, 2 if halve_time else 1, 1 if halve_time is None else 2

    def __call__(self, x: Array, history: History) -> Array:
        shortcut = average_groups(x, self.width, self.time, self.side)
        for block in self.blocks:
            x = block(x, history)
        return shortcut + (x if self.resample is None else self.resample(x, history))


class UpStage(nnx.Module):
    """Residual blocks, then double the sides and perhaps the frames, beside a repetition without parameters.

    Args:
        double_time: None leaves sides and frames as they are, and there is nothing beside.
    """

    def __init__(self, i: int, o: int, blocks: int, double_time: bool | None, layers: Layers) -> None:
        self.blocks = nnx.List([ResidualBlock(i if n == 0 else o, o, layers) for n in range(blocks)])
        self.resample = nnx.data(None if double_time is None else Upsample(o, double_time, layers))
        self.width, self.time = o, 2 if double_time else 1

    def __call__(self, x: Array, history: History) -> Array:
        before = x
        for block in self.blocks:
            x = block(x, history)
        if self.resample is None:
            return x
        begins = history.begins
        return self.resample(x, history) + repeat_groups(before, self.width, self.time, 2, begins)


class Middle(nnx.Module):
    """Residual block, attention within each frame, residual block."""

    def __init__(self, width: int, layers: Layers) -> None:
        self.first = ResidualBlock(width, width, layers)
        self.attention = FrameAttention(width, layers)
        self.last = ResidualBlock(width, width, layers)

    def __call__(self, x: Array, history: History) -> Array:
        return self.last(self.attention(self.first(x, history)), history)


class ResidualBlock(nnx.Module):
    """Two normed causal convolutions beside a shortcut."""

    def __init__(self, i: int, o: int, layers: Layers) -> None:
        self.norm1, self.norm2 = RmsNorm(i), RmsNorm(o)
        self.conv1, self.conv2 = layers.causal(i, o), layers.causal(o, o)
        self.shortcut = nnx.data(None if i == o else layers.pointwise(i, o))

    def __call__(self, x: Array, history: History) -> Array:
        y = self.conv1(nnx.silu(self.norm1(x)), history)
        y = self.conv2(nnx.silu(self.norm2(y)), history)
        return y + (x if self.shortcut is None else self.shortcut(x))


class FrameAttention(nnx.Module):
    """Self-attention with one head over the positions of each frame."""

    def __init__(self, width: int, layers: Layers) -> None:
        self.norm = RmsNorm(width)
        self.to_qkv = layers.pointwise(width, 3 * width, axes=2)
        self.proj = layers.pointwise(width, width, zero=True, axes=2)

    def __call__(self, x: Array) -> Array:
        b, t, h, w, c = x.shape
        q, k, v = jnp.split(self.to_qkv(self.norm(x)).reshape(b * t, h * w, 1, 3 * c), 3, axis=-1)
        attended = jax.nn.dot_product_attention(q, k, v)
        return x + self.proj(attended.reshape(b, t, h, w, c))


class Downsample(nnx.Module):
    """Half the sides by a strided convolution of each frame; half the frames, the first passed by, by one over time."""

    def __init__(self, width: int, halve_time: bool, layers: Layers) -> None:
        self.conv = Conv((3, 3, width, width), layers)
        self.time = nnx.data(Conv((WINDOW, 1, 1, width, width), layers) if halve_time else None)

    def __call__(self, x: Array, history: History) -> Array:
        x = apply_to_frames(x, lambda frames: self.conv.apply(frames, stride=2, padding=((0, 1), (0, 1))))
        if self.time is None:
            return x
        begins = history.begins
        extended = history.follow(x)
        halved = [self.time.apply_over_time(extended, stride=2)] if extended.shape[1] >= WINDOW else []
        return jnp.concatenate(([x[:, :1]] if begins else []) + halved, axis=1)


class Upsample(nnx.Module):
    """Double the frames, the first passed by, by a convolution over time; double the sides by repeating and convolving."""

    def __init__(self, width: int, double_time: bool, layers: Layers) -> None:
        self.conv = Conv((3, 3, width, width), layers)
        self.time = nnx.data(Conv((WINDOW, 1, 1, width, 2 * width), layers) if double_time else None)

    def __call__(self, x: Array, history: History) -> Array:
        if self.time is not None:
            x = double_time(x, self.time, history)
        return apply_to_frames(x, lambda frames: double_sides(frames, self.conv))


def double_time(x: Array, conv: "Conv", history: History) -> Array:
    """Two frames for each by a convolution [3 1 1 c 2c]: [b t h w c] -> [b 2t h w c].

    The first frame of a video stays one, and those that follow do not see it.
    """
    first, later = (x[:, :1], x[:, 1:]) if history.begins else (x[:, :0], x)
    b, t, h, w, c = later.shape
    extended = history.extend(later)
    if t == 0:
        return first
    pairs = conv.apply_over_time(extended).reshape(b, t, h, w, 2, c)
    return jnp.concatenate([first, jnp.moveaxis(pairs, 4, 2).reshape(b, 2 * t, h, w, c)], axis=1)


# Layers.


class RmsNorm(nnx.Module):
    """Unit root mean square over the channels, in float32, times a learned scale."""

    def __init__(self, width: int) -> None:
        self.gamma = nnx.Param(jnp.ones(width))

    def __call__(self, x: Array) -> Array:
        values = x.astype(jnp.float32)
        squares = jnp.sum(jnp.square(values), axis=-1, keepdims=True)
        scale = lax.rsqrt(jnp.maximum(squares, SMALLEST_NORM**2)) * np.float32(x.shape[-1] ** 0.5)
        return (values * scale * _row(self.gamma[...], x.ndim)).astype(x.dtype)


class Conv(nnx.Module):
    """A convolution [*kernel i o] with bias, channels last: causal over three frames, pointwise, or of single frames."""

    def __init__(self, shape: tuple[int, ...], layers: Layers, *, zero: bool = False) -> None:
        self.dtype, self.taps = layers.dtype, layers.taps
        init = nnx.initializers.zeros if zero else nnx.initializers.lecun_normal()
        self.kernel = nnx.Param(init(layers.rngs.params(), shape, jnp.float32))
        self.bias = nnx.Param(jnp.zeros(shape[-1]))

    def __call__(self, x: Array, history: History | None = None) -> Array:
        """x [b t h w i] -> [b t h w o]; a kernel over three frames asks the history for the two before."""
        if history is None:
            kernel = self.kernel[...].reshape(self.kernel.shape[-2:])
            return self.biased(x.astype(self.dtype) @ kernel.astype(self.dtype))
        extended, kernel = history.extend(x.astype(self.dtype)), self.kernel[...].astype(self.dtype)
        return self.biased((_as_volume if self.taps == "volume" else _as_frames)(extended, kernel))

    def apply(self, frames: Array, stride: int, padding: Sequence[tuple[int, int]]) -> Array:
        """A kernel of single frames: [n h w i] -> [n h' w' o]."""
        return self.biased(_conv(frames.astype(self.dtype), self.kernel[...].astype(self.dtype), (stride, stride), padding))

    def apply_over_time(self, x: Array, stride: int = 1) -> Array:
        """A kernel [3 1 1 i o] without padding: [b t h w i] -> [b (t - 3) // stride + 1 h w o], as one matrix product."""
        kernel = self.kernel[...].reshape(WINDOW * self.kernel.shape[-2], self.kernel.shape[-1])
        return self.biased(concatenate_windows(x.astype(self.dtype), stride) @ kernel.astype(self.dtype))

    def biased(self, x: Array) -> Array:
        return x + _row(self.bias[...], x.ndim).astype(x.dtype)


def _as_volume(x: Array, kernel: Array) -> Array:
    """[b t+2 h w i] -> [b t h w o] by one 3-D convolution."""
    return _conv(x, kernel, (1, 1, 1), ((0, 0), (1, 1), (1, 1)))


def _as_frames(x: Array, kernel: Array) -> Array:
    """[b t+2 h w i] -> [b t h w o] by a 2-D convolution of frames that have their two predecessors in their channels."""
    i, o = kernel.shape[-2:]
    flat = jnp.moveaxis(kernel, 0, 2).reshape(3, 3, WINDOW * i, o)
    return apply_to_frames(concatenate_windows(x), lambda frames: _conv(frames, flat, (1, 1), ((1, 1), (1, 1))))


def concatenate_windows(x: Array, stride: int = 1) -> Array:
    """Every window of three frames as channels: [b t h w i] -> [b (t - 3) // stride + 1 h w 3i]."""
    stop = x.shape[1] - WINDOW + 1
    return jnp.concatenate([x[:, tap : tap + stop : stride] for tap in range(WINDOW)], axis=-1)


def _conv(x: Array, kernel: Array, strides: Sequence[int], padding: Sequence[tuple[int, int]]) -> Array:
    axes = "DHW"[3 - len(strides) :]
    names = (f"N{axes}C", f"{axes}IO", f"N{axes}C")
    return lax.conv_general_dilated(x, kernel, strides, padding, dimension_numbers=names)


def apply_to_frames(x: Array, function: Callable[[Array], Array]) -> Array:
    """Apply a function of frames [n h w c] to a video [b t h w c]."""
    b, t = x.shape[:2]
    made = function(x.reshape(b * t, *x.shape[2:]))
    return made.reshape(b, t, *made.shape[1:])


FOLDED_ROWS = np.array([[[1, 0, 0], [0, 1, 1]], [[1, 1, 0], [0, 0, 1]]], np.float32)
"""[phase tap row]: which rows of a 3x3 kernel meet the same pixel of a picture whose rows were repeated."""


def double_sides(frames: Array, conv: Conv) -> Array:
    """Repeat every pixel 2x2 times and convolve 3x3: [n h w i] -> [n 2h 2w o].

    A window of three repeated pixels sees only two different ones, so each of the four phases of the output is a 2x2
    convolution of the small frames, with the kernel's rows and columns summed: 16 products for 36, and no large input.
    """
    n, h, w, _ = frames.shape
    kernel = conv.kernel[...]
    i, o = kernel.shape[-2:]
    folded = jnp.einsum("apy,bqx,yxio->pqiabo", FOLDED_ROWS, FOLDED_ROWS, kernel, precision=lax.Precision.HIGHEST)
    phases = _conv(frames, folded.reshape(2, 2, i, 4 * o).astype(conv.dtype), (1, 1), ((1, 1), (1, 1)))
    phases = phases.reshape(n, h + 1, w + 1, 2, 2, o)
    rows = [jnp.stack([phases[:, a : a + h, b : b + w, a, b] for b in range(2)], axis=3) for a in range(2)]
    return conv.biased(jnp.stack(rows, axis=2).reshape(n, 2 * h, 2 * w, o))


# Shapes.


def patchify(frames: Array, patch: int) -> Array:
    """[b t h w c] -> [b t h/p w/p c*p*p]; in the channels, the column within a patch comes before the row."""
    b, t, h, w, c = frames.shape
    cut = frames.reshape(b, t, h // patch, patch, w // patch, patch, c)
    return cut.transpose(0, 1, 2, 4, 6, 5, 3).reshape(b, t, h // patch, w // patch, c * patch**2)


def unpatchify(patches: Array, patch: int) -> Array:
    """The inverse of `patchify`."""
    b, t, h, w, c = patches.shape
    cut = patches.reshape(b, t, h, w, c // patch**2, patch, patch)
    return cut.transpose(0, 1, 2, 6, 3, 5, 4).reshape(b, t, h * patch, w * patch, c // patch**2)


def average_groups(x: Array, width: int, time: int, side: int) -> Array:
    """Fold `time` frames and `side` x `side` pixels into the channels and average groups of these down to `width`.

    Frames that do not fill a fold are filled up by zeros in front: [b t h w i] -> [b ceil(t/time) h/side w/side width].
    """
    x = jnp.pad(x, ((0, 0), (-x.shape[1] % time, 0), (0, 0), (0, 0), (0, 0)))
    b, t, h, w, i = x.shape
    cut = x.reshape(b, t // time, time, h // side, side, w // side, side, i).transpose(0, 1, 3, 5, 7, 2, 4, 6)
    return cut.reshape(*cut.shape[:4], width, i * time * side**2 // width).mean(axis=-1)


def repeat_groups(x: Array, width: int, time: int, side: int, begins: bool) -> Array:
    """Repeat channels and unfold them into `time` frames and `side` x `side` pixels of `width` channels.

    At the beginning of a video the first frame becomes one: [b t h w i] -> [b t*time h*side w*side width].
    """
    b, t, h, w, i = x.shape
    repeated = jnp.repeat(x, width * time * side**2 // i, axis=-1)
    cut = repeated.reshape(b, t, h, w, width, time, side, side).transpose(0, 1, 5, 2, 6, 3, 7, 4)
    unfolded = cut.reshape(b, t * time, h * side, w * side, width)
    return unfolded[:, time - 1 :] if begins else unfolded


def _row(vector: Array, ndim: int = 5) -> Array:
    """[c] -> [1 ... 1 c]."""
    return jnp.reshape(vector, (1,) * (ndim - 1) + (-1,))

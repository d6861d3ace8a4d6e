"""Layers of the video autoencoder: causal convolutions, norms, attention within a frame, down- and upsampling.

Shape letters: b batch, t h w c video, i o channels in and out, n frames of all videos of a batch.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array, lax
from jaxtyping import Float

from xew.model.codecs.vae_chunks import WINDOW, History

SMALLEST_NORM = 1e-12
"""Least norm that `RmsNorm` divides by."""


@dataclass(frozen=True)
class Layers:
    """Factory of layers that compute in one type."""

    dtype: jnp.dtype
    rngs: nnx.Rngs

    def causal(self, i: int, o: int) -> "Conv":
        """A convolution over three frames, causal in time."""
        return Conv((WINDOW, 3, 3, i, o), self)

    def pointwise(self, i: int, o: int, *, zero: bool = False, axes: int = 3) -> "Conv":
        """A 1x1 convolution."""
        return Conv((1,) * axes + (i, o), self, zero=zero)


class ResidualBlock(nnx.Module):
    """Residual block of two causal convolutions after norms: [b t h w i] -> [b t h w o]."""

    def __init__(self, i: int, o: int, layers: Layers) -> None:
        self.norm1, self.norm2 = RmsNorm(i), RmsNorm(o)
        self.conv1, self.conv2 = layers.causal(i, o), layers.causal(o, o)
        self.shortcut = nnx.data(None if i == o else layers.pointwise(i, o))

    def __call__(self, x: Float[Array, "b t h w i"], history: History) -> Float[Array, "b t h w o"]:
        """Features [b t h w i] -> [b t h w o]."""
        y = self.conv1(nnx.silu(self.norm1(x)), history)
        y = self.conv2(nnx.silu(self.norm2(y)), history)
        return y + (x if self.shortcut is None else self.shortcut(x))


class FrameAttention(nnx.Module):
    """Self-attention with one head over the positions of each frame: [b t h w c] -> [b t h w c]."""

    def __init__(self, width: int, layers: Layers) -> None:
        self.norm = RmsNorm(width)
        self.to_qkv = layers.pointwise(width, 3 * width, axes=2)
        self.proj = layers.pointwise(width, width, zero=True, axes=2)

    def __call__(self, x: Float[Array, "b t h w c"]) -> Float[Array, "b t h w c"]:
        """Features [b t h w c] -> [b t h w c]."""
        b, t, h, w, c = x.shape
        q, k, v = jnp.split(self.to_qkv(self.norm(x)).reshape(b * t, h * w, 1, 3 * c), 3, axis=-1)
        attended = jax.nn.dot_product_attention(q, k, v)
        return x + self.proj(attended.reshape(b, t, h, w, c))


class Downsample(nnx.Module):
    """Halve the sides by a strided convolution of each frame, then the frames after the first by one over time."""

    def __init__(self, width: int, halve_time: bool, layers: Layers) -> None:
        self.conv = Conv((3, 3, width, width), layers)
        self.time = nnx.data(Conv((WINDOW, 1, 1, width, width), layers) if halve_time else None)

    def __call__(self, x: Float[Array, "b t h w c"], history: History) -> Float[Array, "b t2 h2 w2 c"]:
        """Features [b t h w c] -> [b t' h/2 w/2 c]."""
        x = apply_to_frames(x, lambda frames: self.conv.apply(frames, stride=2, padding=((0, 1), (0, 1))))
        if self.time is None:
            return x
        begins = history.begins
        extended = history.follow(x)
        halved = [self.time.apply_over_time(extended, stride=2)] if extended.shape[1] >= WINDOW else []
        return jnp.concatenate(([x[:, :1]] if begins else []) + halved, axis=1)


class Upsample(nnx.Module):
    """Double the frames after the first by a convolution over time, then the sides by repeating and convolving."""

    def __init__(self, width: int, double_time: bool, layers: Layers) -> None:
        self.conv = Conv((3, 3, width, width), layers)
        self.time = nnx.data(Conv((WINDOW, 1, 1, width, 2 * width), layers) if double_time else None)

    def __call__(self, x: Float[Array, "b t h w c"], history: History) -> Float[Array, "b t2 h2 w2 c"]:
        """Features [b t h w c] -> [b t' 2*h 2*w c]."""
        if self.time is not None:
            x = double_time(x, self.time, history)
        return apply_to_frames(x, lambda frames: double_sides(frames, self.conv))


def double_time(x: Float[Array, "b t h w c"], conv: "Conv", history: History) -> Float[Array, "b t2 h w c"]:
    """Double the frames by a convolution [3 1 1 c 2c]: [b t h w c] -> [b 2t h w c].

    The first frame of a video stays single and is not in the window of later frames.
    """
    first, later = (x[:, :1], x[:, 1:]) if history.begins else (x[:, :0], x)
    b, t, h, w, c = later.shape
    extended = history.extend(later)
    if t == 0:
        return first
    pairs = conv.apply_over_time(extended).reshape(b, t, h, w, 2, c)
    return jnp.concatenate([first, jnp.moveaxis(pairs, 4, 2).reshape(b, 2 * t, h, w, c)], axis=1)


class RmsNorm(nnx.Module):
    """RMS norm over the channels of [... c], in float32, times a learned scale."""

    def __init__(self, width: int) -> None:
        self.gamma = nnx.Param(jnp.ones(width))

    def __call__(self, x: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
        """Features [... c] -> [... c]."""
        values = x.astype(jnp.float32)
        squares = jnp.sum(jnp.square(values), axis=-1, keepdims=True)
        scale = lax.rsqrt(jnp.maximum(squares, SMALLEST_NORM**2)) * np.float32(x.shape[-1] ** 0.5)
        return (values * scale * as_row(self.gamma[...], x.ndim)).astype(x.dtype)


class Conv(nnx.Module):
    """A convolution [*kernel i o] with bias, channels last: causal over three frames, pointwise, or of single frames."""

    def __init__(self, shape: tuple[int, ...], layers: Layers, *, zero: bool = False) -> None:
        self.dtype = layers.dtype
        init = nnx.initializers.zeros if zero else nnx.initializers.lecun_normal()
        self.kernel = nnx.Param(init(layers.rngs.params(), shape, jnp.float32))
        self.bias = nnx.Param(jnp.zeros(shape[-1]))

    def __call__(self, x: Float[Array, "*b h w i"], history: History | None = None) -> Float[Array, "*b h w o"]:
        """Video [b t h w i] -> [b t h w o]; a kernel over three frames takes the two previous ones from the history."""
        if history is None:
            kernel = self.kernel[...].reshape(self.kernel.shape[-2:])
            return self.add_bias(x.astype(self.dtype) @ kernel.astype(self.dtype))
        extended, kernel = history.extend(x.astype(self.dtype)), self.kernel[...].astype(self.dtype)
        return self.add_bias(_convolve_frames(extended, kernel))

    def apply(
        self, frames: Float[Array, "n h w i"], stride: int, padding: Sequence[tuple[int, int]]
    ) -> Float[Array, "n h2 w2 o"]:
        """Apply a kernel of single frames: [n h w i] -> [n h' w' o]."""
        return self.add_bias(_conv(frames.astype(self.dtype), self.kernel[...].astype(self.dtype), (stride, stride), padding))

    def apply_over_time(self, x: Float[Array, "b t h w i"], stride: int = 1) -> Float[Array, "b t2 h w o"]:
        """Apply a kernel [3 1 1 i o] without padding, as one matrix product: [b t h w i] -> [b (t - 3) // stride + 1 h w o]."""
        kernel = self.kernel[...].reshape(WINDOW * self.kernel.shape[-2], self.kernel.shape[-1])
        return self.add_bias(concatenate_windows(x.astype(self.dtype), stride) @ kernel.astype(self.dtype))

    def add_bias(self, x: Float[Array, "*n o"]) -> Float[Array, "*n o"]:
        """Add the bias to [... o]."""
        return x + as_row(self.bias[...], x.ndim).astype(x.dtype)


def _convolve_frames(x: Array, kernel: Array) -> Array:
    """[b t+2 h w i] -> [b t h w o] by a 2-D convolution of frames with their two predecessors in the channels.

    XLA passes 2-D convolutions to cuDNN channels last but transposes around 3-D ones; on a CPU 2-D is five times as fast.
    """
    i, o = kernel.shape[-2:]
    flat = jnp.moveaxis(kernel, 0, 2).reshape(3, 3, WINDOW * i, o)
    return apply_to_frames(concatenate_windows(x), lambda frames: _conv(frames, flat, (1, 1), ((1, 1), (1, 1))))


def concatenate_windows(x: Float[Array, "b t h w i"], stride: int = 1) -> Float[Array, "b t2 h w c"]:
    """Concatenate every window of three frames in the channels: [b t h w i] -> [b (t - 3) // stride + 1 h w 3i]."""
    stop = x.shape[1] - WINDOW + 1
    return jnp.concatenate([x[:, tap : tap + stop : stride] for tap in range(WINDOW)], axis=-1)


def _conv(x: Array, kernel: Array, strides: Sequence[int], padding: Sequence[tuple[int, int]]) -> Array:
    axes = "DHW"[3 - len(strides) :]
    names = (f"N{axes}C", f"{axes}IO", f"N{axes}C")
    return lax.conv_general_dilated(x, kernel, strides, padding, dimension_numbers=names)


def apply_to_frames(x: Float[Array, "b t h w i"], function: Callable[[Array], Array]) -> Float[Array, "b t h2 w2 o"]:
    """Apply a function of frames [n h w i] -> [n h' w' o] to a video [b t h w i]: [b t h' w' o]."""
    b, t = x.shape[:2]
    frames = function(x.reshape(b * t, *x.shape[2:]))
    return frames.reshape(b, t, *frames.shape[1:])


FOLDED_ROWS = np.array([[[1, 0, 0], [0, 1, 1]], [[1, 1, 0], [0, 0, 1]]], np.float32)
"""Rows [phase tap row] of a 3x3 kernel that meet the same pixel of a picture with repeated rows."""


def double_sides(frames: Float[Array, "n h w i"], conv: Conv) -> Float[Array, "n h2 w2 o"]:
    """Repeat every pixel 2x2 times and convolve 3x3: [n h w i] -> [n 2h 2w o].

    A window of three repeated pixels has only two different ones, so each of the four output phases is a 2x2 convolution of
    the small frames with summed rows and columns of the kernel: 16 products instead of 36.
    """
    n, h, w, _ = frames.shape
    kernel = conv.kernel[...]
    i, o = kernel.shape[-2:]
    folded = jnp.einsum("apy,bqx,yxio->pqiabo", FOLDED_ROWS, FOLDED_ROWS, kernel, precision=lax.Precision.HIGHEST)
    phases = _conv(frames, folded.reshape(2, 2, i, 4 * o).astype(conv.dtype), (1, 1), ((1, 1), (1, 1)))
    phases = phases.reshape(n, h + 1, w + 1, 2, 2, o)
    rows = [jnp.stack([phases[:, a : a + h, b : b + w, a, b] for b in range(2)], axis=3) for a in range(2)]
    return conv.add_bias(jnp.stack(rows, axis=2).reshape(n, 2 * h, 2 * w, o))


def patchify(frames: Float[Array, "b t h w c"], patch: int) -> Float[Array, "b t h2 w2 features"]:
    """Frames [b t h w c] -> patches [b t h/p w/p c*p*p]; in the channels, columns of a patch come before rows."""
    b, t, h, w, c = frames.shape
    cut = frames.reshape(b, t, h // patch, patch, w // patch, patch, c)
    return cut.transpose(0, 1, 2, 4, 6, 5, 3).reshape(b, t, h // patch, w // patch, c * patch**2)


def unpatchify(patches: Float[Array, "b t h w features"], patch: int) -> Float[Array, "b t h2 w2 c"]:
    """Patches [b t h w c*p*p] -> frames [b t h*p w*p c], the inverse of `patchify`."""
    b, t, h, w, c = patches.shape
    cut = patches.reshape(b, t, h, w, c // patch**2, patch, patch)
    return cut.transpose(0, 1, 2, 6, 3, 5, 4).reshape(b, t, h * patch, w * patch, c // patch**2)


def average_groups(x: Float[Array, "b t h w i"], width: int, time: int, side: int) -> Float[Array, "b t2 h2 w2 {width}"]:
    """Fold `time` frames and `side` x `side` pixels into the channels, then average groups of channels down to `width`.

    Missing frames are zeros in front: [b t h w i] -> [b ceil(t/time) h/side w/side width].
    """
    x = jnp.pad(x, ((0, 0), (-x.shape[1] % time, 0), (0, 0), (0, 0), (0, 0)))
    b, t, h, w, i = x.shape
    cut = x.reshape(b, t // time, time, h // side, side, w // side, side, i).transpose(0, 1, 3, 5, 7, 2, 4, 6)
    return cut.reshape(*cut.shape[:4], width, i * time * side**2 // width).mean(axis=-1)


def repeat_groups(
    x: Float[Array, "b t h w i"], width: int, time: int, side: int, begins: bool
) -> Float[Array, "b t2 h2 w2 {width}"]:
    """Repeat channels and unfold them into `time` frames and `side` x `side` pixels of `width` channels.

    At the beginning of a video the first frame stays single: [b t h w i] -> [b t*time h*side w*side width].
    """
    b, t, h, w, i = x.shape
    repeated = jnp.repeat(x, width * time * side**2 // i, axis=-1)
    cut = repeated.reshape(b, t, h, w, width, time, side, side).transpose(0, 1, 5, 2, 6, 3, 7, 4)
    unfolded = cut.reshape(b, t * time, h * side, w * side, width)
    return unfolded[:, time - 1 :] if begins else unfolded


def check_frames(shape: tuple[int, ...], factor: int) -> None:
    """Raise ValueError unless frames of this shape [b t h w 3] can be encoded by an autoencoder of this spatial factor."""
    if len(shape) != 5 or shape[1] % 4 != 1 or shape[2] % factor or shape[3] % factor or shape[4] != 3:
        raise ValueError(f"frames are {shape}; expected [b t h w 3] with t = 4 k + 1 and sides in {factor}s")


def as_row(vector: Float[Array, " c"], ndim: int = 5) -> Float[Array, "... c"]:
    """Vector [c] -> [1 ... 1 c] of `ndim` axes."""
    return jnp.reshape(vector, (1,) * (ndim - 1) + (-1,))

"""A head behind the decoder that sees what every rollout is given: the commanded render and the scene, or its first frame.

Reads  decoded frames [b t h w 3] in [-1, 1], and `GivenFrames`
Writes frames [b t h w 3] in [-1, 1]

A codec of a few numbers per pixel cannot keep a robot's edges. A rollout knows them: they are in the render of its commands.
The head mixes the render and the scene into what was decoded, and corrects the rest. It begins as the identity. An arm
lags its command, so the head is given the render one frame earlier and later too. A U-Net (Ronneberger et al., arXiv
1505.04597) over squares of two pixels lets it see where objects, shadows and occlusion overrule the render.

Shape letters: b batch, t h w video, n frames of all videos of a batch, i o channels in and out.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
from flax import nnx
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from xew.model.codecs.contract import GivenFrames, to_signed
from xew.model.codecs.conv_autoencoder import Inputs, Outputs, Stage, convolve, fill_leaves, read_stored_size
from xew.model.codecs.vae_layers import Conv, Layers, RmsNorm, patchify, unpatchify

Frames = Float[Array, "b t h w 3"]
WHITE = 0.96
"""Least value of all channels, in [-1, 1], of the white ground of a render."""
SOURCES = 4
"""Pictures that are mixed in: the render of the frame before, of the frame, of the frame after, and the scene."""


@dataclass(frozen=True)
class HeadSize:
    """Size of a head."""

    widths: tuple[int, ...] = (48, 64, 96)
    """Widths of the levels, from two pixels a side on; between two levels the sides are halved."""
    blocks: tuple[int, ...] = (1, 1, 2)
    """Numbers of residual blocks of the levels, on the way down and on the way up."""


class RenderHead(nnx.Module):
    """Frames [b t h w 3], decoded, to frames closer to the truth.

    Args:
        size: widths and numbers of blocks.
        dtype: type of activations and products; parameters stay float32.
    """

    def __init__(self, size: HeadSize, *, dtype: DTypeLike = jnp.float32, rngs: nnx.Rngs) -> None:
        self.size, self.dtype = size, dtype
        layers, widths = Layers(jnp.dtype(dtype), rngs), size.widths
        channels = 4 * (3 + SOURCES * 3 + SOURCES - 1)
        self.conv_in = Conv((3, 3, channels, widths[0]), layers)
        self.down = nnx.List([Stage(w, n, layers) for w, n in zip(widths, size.blocks, strict=True)])
        self.halve = nnx.List([layers.pointwise(4 * i, o, axes=2) for i, o in itertools.pairwise(widths)])
        self.double = nnx.List([layers.pointwise(i, 4 * o, axes=2) for o, i in itertools.pairwise(widths)])
        self.up = nnx.List([Stage(w, n, layers) for w, n in zip(widths[:-1], size.blocks[:-1], strict=True)])
        self.norm_out = RmsNorm(widths[0])
        self.conv_out = Conv((3, 3, widths[0], 4 * (SOURCES + 3)), layers, zero=True)

    def __call__(self, decoded: Frames, given: GivenFrames) -> Frames:
        """Decoded frames [b t h w 3] in [-1, 1] -> frames [b t h w 3] in [-1, 1]; the sides are multiples of 8."""
        b, t, h, w, _ = decoded.shape
        render, scene = to_signed(given.render), to_signed(given.scene)
        sources = [render[:, :-2], render[:, 1:-1], render[:, 2:], jnp.broadcast_to(scene, decoded.shape)]
        masks = [robot_pixels(render) for render in sources[:-1]]
        stacked = jnp.concatenate([decoded, *sources, *masks], axis=-1).reshape(b * t, 1, h, w, -1)
        features = self._unet(patchify(stacked.astype(self.dtype), 2)[:, 0])
        out = unpatchify(convolve(self.conv_out, nnx.silu(self.norm_out(features)))[:, None], 2)[:, 0]
        out = out.astype(jnp.float32).reshape(b, t, h, w, -1)
        mixed = decoded + out[..., SOURCES:]
        for number, source in enumerate(sources):
            mixed += out[..., number : number + 1] * (source - decoded)
        return jnp.clip(mixed, -1, 1)

    def _unet(self, x: Inputs) -> Outputs:
        """Features [n y x i] -> [n y x o]; each level on the way up adds what the same level had on the way down."""
        x, skips = convolve(self.conv_in, x), []
        for number, stage in enumerate(self.down):
            x = stage(x)
            if number < len(self.halve):
                skips.append(x)
                x = self.halve[number](patchify(x[:, None], 2)[:, 0])
        for stage, double, skip in zip(self.up[::-1], self.double[::-1], skips[::-1], strict=True):
            x = stage(skip + unpatchify(double(x)[:, None], 2)[:, 0])
        return x


def robot_pixels(render: Frames) -> Float[Array, "b t h w 1"]:
    """Where a render [b t h w 3] in [-1, 1] shows the robot: 1, and 0 on its white ground."""
    return (render < WHITE).any(axis=-1, keepdims=True).astype(jnp.float32)


def abstract_head(size: HeadSize, dtype: DTypeLike = jnp.float32) -> RenderHead:
    """A head whose leaves have no values yet; weights are loaded into it."""
    return nnx.eval_shape(lambda: RenderHead(size, dtype=dtype, rngs=nnx.Rngs(0)))


def load_head(path: Path, dtype: DTypeLike = jnp.float32) -> RenderHead:
    """Read a head that `save_weights` wrote. Raises ConfigError if the file is broken or of another kind."""
    head = abstract_head(read_stored_size(HeadSize, path, path.stat().st_mtime_ns), dtype)
    fill_leaves(head, path)
    return head

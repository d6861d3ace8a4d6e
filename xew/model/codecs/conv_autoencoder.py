"""A small two-dimensional convolutional autoencoder that codes each group of four frames independently (Flax NNX).

Reads  frames [b t h w 3] in [-1, 1], t = 4 k + 1; the first frame, repeated four times, is a group
Writes latents [b k+1 h/factor w/factor c], and frames back
To add a size: one line in AUTOENCODERS.

The frames of a group and patches of pixels are stacked in the channels, so there is no convolution over time. Sides are
halved by moving 2x2 pixels into the channels and mixing these (Shi et al., arXiv 1609.05158, in both directions).

Shape letters: b batch, n groups, t h w video, i o channels in and out.
"""

import functools
import itertools
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
from flax import nnx
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from xew.config import ConfigError, parse
from xew.files import demand_regular, parse_json, replacing
from xew.model.codecs.vae import LatentStatistic
from xew.model.codecs.vae_layers import Conv, Layers, RmsNorm, as_row, check_frames, patchify, unpatchify
from xew.model.video.frames import TEMPORAL_FACTOR
from xew.model.weights.filling import fill
from xew.model.weights.layout import Source, module_leaves
from xew.model.weights.reading import read_tensors

T = TypeVar("T")
Groups = Float[Array, "n 4 h w 3"]
Features = Float[Array, "n y x c"]
Inputs = Float[Array, "n y x i"]
Outputs = Float[Array, "n y2 x2 o"]
HEAD_FILE = "render_head.safetensors"
"""Name of the file, next to an autoencoder's weights, of the head behind its decoder."""
SIZE = "size"
"""Metadata key of a weights file with the size of the autoencoder, in JSON."""


@dataclass(frozen=True)
class AutoencoderSize:
    """Hyperparameters of a `ConvAutoencoder`; stages are listed from pixels to latents and halve the sides in between."""

    encoder_widths: tuple[int, ...]
    encoder_blocks: tuple[int, ...]
    """Numbers of residual blocks of the encoder's stages."""
    decoder_widths: tuple[int, ...]
    decoder_blocks: tuple[int, ...]
    channels: int = 48
    """Number of channels of the latents."""
    patch: int = 4
    """Side of the patches that become channels before the first layer [pixels]."""

    def __post_init__(self) -> None:
        stages = (self.encoder_widths, self.encoder_blocks, self.decoder_widths, self.decoder_blocks)
        if len({len(stage) for stage in stages}) != 1:
            raise ValueError(f"{self}: expected as many stages, each with a width and blocks, in the encoder as in the decoder")

    @property
    def spatial_factor(self) -> int:
        """Number of pixels per latent along a side."""
        return self.patch * 2 ** (len(self.encoder_widths) - 1)


AUTOENCODERS = {
    "tiny": AutoencoderSize((16, 24, 32), (1, 1, 1), (16, 24, 32), (1, 1, 1)),
    "base": AutoencoderSize((64, 128, 176), (2, 2, 2), (96, 192, 256), (4, 4, 3)),
}


class ConvAutoencoder(nnx.Module):
    """Encoder and decoder of groups of four frames.

    Args:
        size: one of `AUTOENCODERS`.
        dtype: of activations and matrix products; parameters and norms are float32.
    """

    def __init__(self, size: AutoencoderSize, *, dtype: DTypeLike = jnp.float32, rngs: nnx.Rngs) -> None:
        self.size, self.dtype = size, dtype
        layers = Layers(jnp.dtype(dtype), rngs)
        self.encoder, self.decoder = Encoder(size, layers), Decoder(size, layers)
        self.latents_mean = LatentStatistic(jnp.zeros(size.channels))
        self.latents_std = LatentStatistic(jnp.ones(size.channels))

    def encode_groups(self, groups: Groups) -> Features:
        """Groups of frames [n 4 h w 3] in [-1, 1] -> latents [n h' w' c] float32, not standardized."""
        n, _, h, w, _ = groups.shape
        stacked = groups.astype(self.dtype).transpose(0, 2, 3, 1, 4).reshape(n, 1, h, w, TEMPORAL_FACTOR * 3)
        return self.encoder(patchify(stacked, self.size.patch)[:, 0]).astype(jnp.float32)

    def decode_groups(self, latents: Features) -> Groups:
        """Latents [n h' w' c], not standardized -> groups of frames [n 4 h w 3] float32, not clipped."""
        stacked = unpatchify(self.decoder(latents.astype(self.dtype))[:, None], self.size.patch)[:, 0]
        n, h, w, _ = stacked.shape
        return stacked.astype(jnp.float32).reshape(n, h, w, TEMPORAL_FACTOR, 3).transpose(0, 3, 1, 2, 4)

    def encode(self, frames: Float[Array, "b t h w 3"]) -> Float[Array, "b k y x c"]:
        """Frames [b t h w 3] in [-1, 1], t = 4 k + 1 -> standardized latents [b k+1 h' w' c] float32."""
        check_frames(frames.shape, self.size.spatial_factor)
        b, _, h, w, _ = frames.shape
        first = jnp.repeat(frames[:, :1], TEMPORAL_FACTOR - 1, axis=1)
        groups = jnp.concatenate([first, frames], axis=1).reshape(-1, TEMPORAL_FACTOR, h, w, 3)
        latents = self.encode_groups(groups)
        standard = (latents - as_row(self.latents_mean[...], 4)) / as_row(self.latents_std[...], 4)
        return standard.reshape(b, -1, *standard.shape[1:])

    def decode(self, latents: Float[Array, "b k y x c"]) -> Float[Array, "b t h w 3"]:
        """Standardized latents [b k+1 h' w' c] -> frames [b t h w 3] float32 in [-1, 1]; frame 0 is the mean of its group."""
        b, k = latents.shape[:2]
        groups = self._decode_standard(latents.reshape(b * k, *latents.shape[2:]))
        groups = groups.reshape(b, k, *groups.shape[1:])
        first = groups[:, 0].mean(axis=1, keepdims=True)
        later = groups[:, 1:].reshape(b, -1, *groups.shape[3:])
        return jnp.clip(jnp.concatenate([first, later], axis=1), -1, 1)

    def decode_last(self, latents: Float[Array, "b k y x c"]) -> Float[Array, "b 1 h w 3"]:
        """Latents [b k+1 h' w' c] -> the last frame [b 1 h w 3] of `decode`, without decoding other groups."""
        groups = self._decode_standard(latents[:, -1])
        last = groups[:, -1:] if latents.shape[1] > 1 else groups.mean(axis=1, keepdims=True)
        return jnp.clip(last, -1, 1)

    def _decode_standard(self, latents: Array) -> Array:
        raw = latents.astype(jnp.float32) * as_row(self.latents_std[...], 4) + as_row(self.latents_mean[...], 4)
        return self.decode_groups(raw)


class Encoder(nnx.Module):
    """Patches of groups [n h/patch w/patch 12*patch^2] -> latents [n h' w' c]."""

    def __init__(self, size: AutoencoderSize, layers: Layers) -> None:
        widths = size.encoder_widths
        self.conv_in = Conv((3, 3, TEMPORAL_FACTOR * 3 * size.patch**2, widths[0]), layers)
        counts = size.encoder_blocks
        self.stages = nnx.List([Stage(width, count, layers) for width, count in zip(widths, counts, strict=True)])
        pairs = itertools.pairwise(widths)
        self.halve = nnx.List([layers.pointwise(4 * i, o, axes=2) for i, o in pairs])
        self.norm_out = RmsNorm(widths[-1])
        self.conv_out = Conv((3, 3, widths[-1], size.channels), layers)

    def __call__(self, x: Inputs) -> Outputs:
        """Patches [n y x i] -> latents [n h' w' c]."""
        x = convolve(self.conv_in, x)
        for number, stage in enumerate(self.stages):
            x = stage(x)
            if number < len(self.halve):
                x = self.halve[number](patchify(x[:, None], 2)[:, 0])
        return convolve(self.conv_out, nnx.silu(self.norm_out(x)))


class Decoder(nnx.Module):
    """Latents [n h' w' c] -> patches of groups [n h/patch w/patch 12*patch^2]."""

    def __init__(self, size: AutoencoderSize, layers: Layers) -> None:
        widths, counts = size.decoder_widths[::-1], size.decoder_blocks[::-1]
        self.conv_in = Conv((3, 3, size.channels, widths[0]), layers)
        self.stages = nnx.List([Stage(width, count, layers) for width, count in zip(widths, counts, strict=True)])
        pairs = itertools.pairwise(widths)
        self.double = nnx.List([layers.pointwise(i, 4 * o, axes=2) for i, o in pairs])
        self.norm_out = RmsNorm(widths[-1])
        self.conv_out = Conv((3, 3, widths[-1], TEMPORAL_FACTOR * 3 * size.patch**2), layers)

    def __call__(self, x: Inputs) -> Outputs:
        """Latents [n h' w' c] -> patches [n y x o]."""
        x = convolve(self.conv_in, x)
        for number, stage in enumerate(self.stages):
            x = stage(x)
            if number < len(self.double):
                x = unpatchify(self.double[number](x)[:, None], 2)[:, 0]
        return convolve(self.conv_out, nnx.silu(self.norm_out(x)))


class Stage(nnx.Module):
    """Residual blocks of one width: [n y x c] -> [n y x c]."""

    def __init__(self, width: int, count: int, layers: Layers) -> None:
        self.blocks = nnx.List([Block(width, layers) for _ in range(count)])

    def __call__(self, x: Features) -> Features:
        """Features [n y x c] -> [n y x c]."""
        for block in self.blocks:
            x = block(x)
        return x


class Block(nnx.Module):
    """Residual block of two convolutions after norms: [n y x c] -> [n y x c]. It starts as the identity."""

    def __init__(self, width: int, layers: Layers) -> None:
        self.norm1, self.norm2 = RmsNorm(width), RmsNorm(width)
        self.conv1 = Conv((3, 3, width, width), layers)
        self.conv2 = Conv((3, 3, width, width), layers, zero=True)

    def __call__(self, x: Features) -> Features:
        """Features [n y x c] -> [n y x c]."""
        y = convolve(self.conv1, nnx.silu(self.norm1(x)))
        return x + convolve(self.conv2, nnx.silu(self.norm2(y)))


def convolve(conv: Conv, x: Inputs) -> Float[Array, "n y x o"]:
    """Convolve pictures [n y x i] with a kernel [3 3 i o] and zero padding: [n y x o]."""
    return conv.apply(x, stride=1, padding=((1, 1), (1, 1)))


def abstract_autoencoder(size: AutoencoderSize, dtype: DTypeLike = jnp.float32) -> ConvAutoencoder:
    """An autoencoder without parameter values, to load weights into."""
    return nnx.eval_shape(lambda: ConvAutoencoder(size, dtype=dtype, rngs=nnx.Rngs(0)))


def save_weights(module: Any, path: Path) -> None:
    """Write a module and its `size`, a dataclass, as .safetensors: kernels in bfloat16, the rest in float32.

    Raises:
        ConfigError: the file cannot be written.
    """
    tensors = {}
    for name, variable in module_leaves(module, {}).items():
        value = np.asarray(jax.device_get(variable.get_value()))
        tensors[name] = value.astype(ml_dtypes.bfloat16) if name.endswith(".kernel") else value
    try:
        with replacing(path, within=path.parent) as partial:
            save_file(tensors, partial, metadata={SIZE: json.dumps(asdict(module.size))})
            partial.chmod(0o644)
    except (OSError, SafetensorError) as error:
        raise ConfigError(f"cannot write the weights {path}: {error}.") from error


def load_autoencoder(path: Path, dtype: DTypeLike = jnp.float32) -> ConvAutoencoder:
    """Read an autoencoder that `save_weights` wrote, from its file or the folder of that file.

    Raises:
        ConfigError: there is no such file, it is broken, or it is of another kind.
    """
    autoencoder = abstract_autoencoder(read_size(path), dtype)
    fill_leaves(autoencoder, find_weights(path))
    return autoencoder


def fill_leaves(module: nnx.Module, file: Path) -> None:
    """Fill a module in place from a file that `save_weights` wrote. Raises ConfigError if it does not fit."""
    fill(module, read_tensors(file), {name: Source((name,)) for name in module_leaves(module, {})})


def read_size(path: Path) -> AutoencoderSize:
    """Size of an autoencoder, from the header of its weights. Raises ConfigError as `load_autoencoder`."""
    file = find_weights(path)
    if not file.is_file():
        raise ConfigError(f"there are no weights at {file}; set codec.weights to a file or folder that exists.")
    return read_stored_size(AutoencoderSize, file, file.stat().st_mtime_ns)


@functools.lru_cache(maxsize=8)
def read_stored_size(kind: type[T], file: Path, changed: int) -> T:
    """The size in the header of weights that `save_weights` wrote; `changed` is the file's time, for the cache.

    Raises:
        ConfigError: the file is broken, or of another kind.
    """
    try:
        with safe_open(demand_regular(file), framework="numpy") as stored:
            metadata = stored.metadata() or {}
    except SafetensorError as error:
        raise ConfigError(f"{file} is not a whole safetensors file ({error}); copy it again.") from error
    if SIZE not in metadata:
        raise ConfigError(f"{file} does not hold the size of its network; expected weights that xew wrote.")
    try:
        size = parse_json(metadata[SIZE])
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{file} is damaged: the size of its network is no JSON ({error}); copy it again.") from error
    return parse(kind, size, str(file))


def find_weights(path: Path) -> Path:
    """The path itself, or the only weights of an autoencoder in a folder.

    Raises:
        ConfigError: the folder has none or several.
    """
    if not path.is_dir():
        return path
    files = sorted(file for file in path.glob("[!.]*.safetensors") if file.name != HEAD_FILE)
    if len(files) != 1:
        names = ", ".join(file.name for file in files) or "no .safetensors"
        raise ConfigError(f"{path} holds {names}; expected the path of one file of weights.")
    return files[0]

"""What every codec promises: frames to latents and back, causally, the first frame alone and then groups of four.

Reads  uint8 [t h w 3], or on the device float [b t h w 3] in [-1, 1]; t = 4 k + 1
Writes float32 latents [k + 1, h / factor, w / factor, channels] of about unit size
To add a codec: a class with the methods of `Codec`, and one line in CODECS (codec.py).

A codec is a JAX pytree of its arrays, so that it is passed to compiled functions and is no constant in them.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, UInt8

from xew.model.video.frames import TEMPORAL_FACTOR

Pictures = UInt8[np.ndarray, "t h w 3"]
Latents = Float[np.ndarray, "k y x c"]
FrameBatch = Float[Array, "b t h w 3"]
LatentBatch = Float[Array, "b k y x c"]


@dataclass(frozen=True)
class CodecSettings:
    """The `codec` section of a config."""

    name: str = "conv_autoencoder"
    """One of CODECS."""
    weights: Path | None = None
    """Weights of conv_autoencoder; the package's own if left out. Of wan_vae: Wan2.2_VAE.pth, or the vae folder of the
    diffusers layout."""
    vae: str = "wan22"
    """Size of wan_vae, one of VAES."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the activations of wan_vae and conv_autoencoder."""
    chunk: int = 8
    """Number of latent frames that go through wan_vae at once; more is faster and takes more memory, 0 takes all."""


class LatentSize(NamedTuple):
    """What a network needs to know of its latents."""

    spatial_factor: int
    """Number of pixels a side of a latent."""
    channels: int


class Codec(ABC):
    """What the rest of the package asks of a codec."""

    groups_independent: ClassVar[bool] = False
    """Whether the first frame and each later group of four are coded independently, so a video may be coded in pieces."""
    hash: str
    """Text that changes whenever latents would."""

    @property
    @abstractmethod
    def spatial_factor(self) -> int:
        """Number of pixels a side of a latent."""

    @property
    @abstractmethod
    def channels(self) -> int:
        """Number of channels of the latents."""

    def encode(self, video: Pictures) -> Latents:
        """Video uint8 [t h w 3] -> latents float32 [t' h' w' c]; t must be 4 k + 1 and the sides multiples of the factor.

        Later frames never change earlier latents.
        """
        check_clip_shape(video.shape, self.spatial_factor)
        return np.asarray(encode_pictures(self, video[None]))[0]

    def decode(self, latents: Latents) -> Pictures:
        """Latents float32 [t' h' w' c] -> video uint8 [t h w 3]."""
        return np.asarray(decode_to_pictures(self, latents[None]))[0]

    @abstractmethod
    def encode_batch(self, frames: FrameBatch) -> LatentBatch:
        """Frames [b t h w 3] in [-1, 1] -> latents [b t' h' w' c] float32; may be traced."""

    @abstractmethod
    def decode_batch(self, latents: LatentBatch) -> FrameBatch:
        """Latents [b t' h' w' c] -> frames [b t h w 3] float32, about in [-1, 1]; may be traced."""

    @abstractmethod
    def next_reference(self, latents: LatentBatch) -> Float[Array, "b 1 y x c"]:
        """The last frame of a decoded clip, encoded alone: [b t' h' w' c] -> [b 1 h' w' c]; may be traced.

        It is rounded as if it had been a picture in between, so it is what a rollout begins its next chunk with.
        """

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write all that `load` needs into a folder, under names of its own."""

    @classmethod
    @abstractmethod
    def load(cls, folder: Path) -> "Codec":
        """The codec that was saved in a folder."""

    @classmethod
    @abstractmethod
    def latent_size(cls, settings: CodecSettings) -> LatentSize:
        """Spatial factor and channels of a config's codec; at most the header of its weights is read.

        Raises:
            ConfigError: the settings or the weights cannot be used.
        """

    @classmethod
    @abstractmethod
    def open(cls, settings: CodecSettings) -> "Codec":
        """The codec of a config. Raises ConfigError if its weights are missing, broken or of another kind."""


@jax.jit
def encode_pictures(codec: Any, videos: UInt8[Array, "b t h w 3"]) -> LatentBatch:
    """Videos uint8 [b t h w 3] -> latents float32 [b t' h' w' c]."""
    return codec.encode_batch(to_signed(videos))


@jax.jit
def decode_to_pictures(codec: Any, latents: LatentBatch) -> UInt8[Array, "b t h w 3"]:
    """Latents [b t' h' w' c] -> videos uint8 [b t h w 3]."""
    return to_pictures(codec.decode_batch(latents))


def to_signed(pictures: UInt8[Array, "*n"]) -> Float[Array, "*n"]:
    """Pictures uint8 [...] -> float32 [...] in [-1, 1]."""
    return pictures.astype(jnp.float32) / 127.5 - 1


def to_pictures(frames: Float[Array, "*n"]) -> UInt8[Array, "*n"]:
    """Frames [...], about in [-1, 1] -> uint8 [...]."""
    return jnp.clip(jnp.rint((frames + 1) * 127.5), 0, 255).astype(jnp.uint8)


def check_clip_shape(shape: tuple[int, ...], spatial_factor: int) -> None:
    """Raise ValueError unless a clip [t h w 3] can be encoded."""
    t, h, w, _ = shape
    if t % TEMPORAL_FACTOR != 1 or h % spatial_factor or w % spatial_factor:
        raise ValueError(f"a clip of {t} frames {w}x{h} cannot be encoded: it needs 4 k + 1 frames, sides in {spatial_factor}s")


def latent_frames(frames: int) -> int:
    """Number of latent frames that 4 k + 1 frames of video become."""
    return (frames - 1) // TEMPORAL_FACTOR + 1

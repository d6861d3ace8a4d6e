"""The interface and settings of codecs (by default conv_autoencoder): frames to latents and back, causally.

The first frame is coded alone, then groups of four.

Reads  uint8 [t h w 3], or on the device float [b t h w 3] in [-1, 1]; t = 4 k + 1
Writes float32 latents [k + 1, h / factor, w / factor, channels] of about unit size

A codec is a JAX pytree of its arrays, so it is an argument of compiled functions and not a constant.
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
    """Weights of conv_autoencoder (default: the packaged ones), or of wan_vae: Wan2.2_VAE.pth or diffusers' vae folder."""
    vae: str = "wan22"
    """Size of wan_vae, one of VAES."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the activations."""
    chunk: int = 8
    """Number of latent frames that wan_vae codes at once, 0 for all; more is faster and takes more memory."""


class GivenFrames(NamedTuple):
    """Pictures that a rollout is given of the frames that are decoded, for decoders that use them.

    They come from the commands and the first frame alone, so no decoder can show the future.
    """

    render: Any
    """[b t+2 h w 3] uint8, the commanded robot on white, from one frame before the first to one after the last."""
    scene: Any
    """[b t h w 3] uint8, the scene around the robot, from commands and first frame alone; or [b 1 h w 3], the first frame."""


class LatentSize(NamedTuple):
    """Spatial factor and channels of a codec's latents."""

    spatial_factor: int
    """Number of pixels per latent along a side."""
    channels: int


class Codec(ABC):
    """The interface of a codec."""

    groups_independent: ClassVar[bool] = False
    """Whether the first frame and each later group of four are coded independently, so a video may be coded in pieces."""
    hash: str
    """Identifier that changes whenever the latents would."""

    @property
    def decoder_hash(self) -> str:
        """Identifier that changes whenever decoded frames would."""
        return self.hash

    @property
    def sees_render(self) -> bool:
        """Whether `decode_batch` uses `GivenFrames`."""
        return False

    @property
    @abstractmethod
    def spatial_factor(self) -> int:
        """Number of pixels per latent along a side."""

    @property
    @abstractmethod
    def channels(self) -> int:
        """Number of channels of the latents."""

    def encode(self, video: Pictures) -> Latents:
        """Video uint8 [t h w 3] -> latents float32 [t' h' w' c]; t must be 4 k + 1 and the sides multiples of the factor.

        Later frames never change earlier latents. Raises ValueError for other shapes.
        """
        return np.asarray(encode_pictures(self, video[None]))[0]

    def decode(self, latents: Latents, given: GivenFrames | None = None) -> Pictures:
        """Latents float32 [t' h' w' c] -> video uint8 [t h w 3]; `given` has no axis of videos."""
        batched = None if given is None else GivenFrames(given.render[None], given.scene[None])
        return np.asarray(decode_to_pictures(self, latents[None], batched))[0]

    @abstractmethod
    def encode_batch(self, frames: FrameBatch) -> LatentBatch:
        """Frames [b t h w 3] in [-1, 1] -> latents [b t' h' w' c] float32; may be traced."""

    @abstractmethod
    def decode_batch(self, latents: LatentBatch, given: GivenFrames | None = None) -> FrameBatch:
        """Latents [b t' h' w' c] -> frames [b t h w 3] float32, about in [-1, 1]; may be traced."""

    @abstractmethod
    def next_reference(self, latents: LatentBatch) -> Float[Array, "b 1 y x c"]:
        """The last frame of a decoded clip, encoded alone: [b t' h' w' c] -> [b 1 h' w' c]; may be traced.

        The frame is rounded to uint8 in between, as the reference of a rollout's next chunk is.
        """

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write the files that `load` needs into a folder."""

    @classmethod
    @abstractmethod
    def load(cls, folder: Path) -> "Codec":
        """Load a codec that `save` wrote."""

    @classmethod
    @abstractmethod
    def latent_size(cls, settings: CodecSettings) -> LatentSize:
        """Size of a config's latents, from at most the header of the weights. Raises ConfigError if it cannot be read."""

    @classmethod
    @abstractmethod
    def open(cls, settings: CodecSettings) -> "Codec":
        """The codec of a config. Raises ConfigError if its weights are missing, broken or of another kind."""


@jax.jit
def encode_pictures(codec: Any, videos: UInt8[Array, "b t h w 3"]) -> LatentBatch:
    """Videos uint8 [b t h w 3] -> latents float32 [b t' h' w' c]."""
    return codec.encode_batch(to_signed(videos))


@jax.jit
def decode_to_pictures(codec: Any, latents: LatentBatch, given: GivenFrames | None = None) -> UInt8[Array, "b t h w 3"]:
    """Latents [b t' h' w' c] -> videos uint8 [b t h w 3]."""
    return to_pictures(codec.decode_batch(latents, given))


def given_frames(render: Any, scene: Any, start: int, frames: int) -> GivenFrames:
    """What a rollout is given of `frames` frames of episodes from `start` on.

    Args:
        render: [... t h w 3] uint8, the commanded robot in the whole episode; its ends are repeated.
        scene: [... t h w 3] uint8, the scene in the whole episode, whose end is repeated; or [... 1 h w 3], its first frame.
    """
    around = np.clip(np.arange(start - 1, start + frames + 1), 0, render.shape[-4] - 1)
    shown = np.clip(np.arange(start, start + (frames if scene.shape[-4] > 1 else 1)), 0, scene.shape[-4] - 1)
    return GivenFrames(render[..., around, :, :, :], scene[..., shown, :, :, :])


def to_signed(pictures: UInt8[Array, "*n"]) -> Float[Array, "*n"]:
    """Pictures uint8 [...] -> float32 [...] in [-1, 1]."""
    return pictures.astype(jnp.float32) / 127.5 - 1


def to_pictures(frames: Float[Array, "*n"]) -> UInt8[Array, "*n"]:
    """Frames [...], about in [-1, 1] -> uint8 [...]."""
    return jnp.clip(jnp.rint((frames + 1) * 127.5), 0, 255).astype(jnp.uint8)


def latent_frames(frames: int) -> int:
    """Number of latent frames of 4 k + 1 frames of video."""
    return (frames - 1) // TEMPORAL_FACTOR + 1

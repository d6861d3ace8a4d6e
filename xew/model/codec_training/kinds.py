"""Kinds of autoencoders: what training asks of one, and where its weights go.

To add a kind: a class with the methods of `Kind`, and one line in KINDS.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array
from jaxtyping import Float, Key

from xew.config import pick
from xew.model.codecs.autoencoders import ConvAutoencoderCodec, OfSize, WanVaeCodec
from xew.model.codecs.contract import Codec
from xew.model.codecs.conv_autoencoder import AUTOENCODERS, AutoencoderSize, ConvAutoencoder, save_autoencoder
from xew.model.codecs.vae import VAES, VaeSize, VideoVae
from xew.model.codecs.vae_layouts import save_vae
from xew.model.video.frames import TEMPORAL_FACTOR

Clips = Float[Array, "b t h w 3"]


@runtime_checkable
class Kind(Protocol):
    """A kind of autoencoder at one size."""

    file: ClassVar[str]
    """Name of the file of its weights, and of its report, without ending."""

    @property
    def size(self) -> Any:
        """Size of the autoencoder, a dataclass."""

    @property
    def name(self) -> str:
        """Name of the size."""

    @property
    def spatial_factor(self) -> int:
        """Number of pixels a side of a latent."""

    @property
    def channels(self) -> int:
        """Number of channels of the latents."""

    @classmethod
    def of_size(cls, name: str) -> "Kind":
        """The kind at the size of this name. Raises ConfigError if there is none."""

    def clip_frames(self, frames: int) -> int:
        """Number of frames of a training clip, where the config says `frames`."""

    def create(self, dtype: str, rngs: nnx.Rngs) -> nnx.Module:
        """The autoencoder at its random start, with leaves `latents_mean` and `latents_std` [c]."""

    def reconstruct(self, module: Any, clips: Clips, key: Key[Array, ""], noise: float) -> tuple[Clips, Array]:
        """Clips [b t h w 3] in [-1, 1] after the autoencoder, not clipped, and a scalar that keeps latents small."""

    def latents(self, module: Any, clips: Clips) -> Float[Array, "n y x c"]:
        """Latents [n h' w' c] of clips [b t h w 3], not standardized."""

    def save(self, module: Any, path: Path) -> None:
        """Write the weights as .safetensors."""

    def open(self, path: Path, dtype: str) -> Codec:
        """The codec of a file of weights."""

    def describe(self, codec: Any) -> Mapping[str, Any]:
        """What the report's file says of the codec beside its hash and size."""

    def options(self, weights: Path) -> str:
        """Options that tell `latents` and `train` to use the weights in a folder."""


@dataclass(frozen=True)
class ConvKind(OfSize):
    """The autoencoder of groups of four frames."""

    file: ClassVar[str] = "autoencoder"

    name: str
    size: AutoencoderSize

    @classmethod
    def of_size(cls, name: str) -> "ConvKind":
        return cls(name, pick(AUTOENCODERS, name, "size of conv_autoencoder"))

    def clip_frames(self, frames: int) -> int:
        return TEMPORAL_FACTOR

    def create(self, dtype: str, rngs: nnx.Rngs) -> ConvAutoencoder:
        return ConvAutoencoder(self.size, dtype=jnp.dtype(dtype), rngs=rngs)

    def reconstruct(self, module: ConvAutoencoder, clips: Clips, key: Key[Array, ""], noise: float) -> tuple[Clips, Array]:
        """Groups [b 4 h w 3] after noise on their latents, and the latents' mean square."""
        latents = module.encode_groups(clips)
        noisy = latents + noise * jax.random.normal(key, latents.shape, latents.dtype)
        return module.decode_groups(noisy), jnp.square(latents).mean()

    def latents(self, module: ConvAutoencoder, clips: Clips) -> Float[Array, "n y x c"]:
        """Latents [b h' w' c] of groups [b 4 h w 3]."""
        return module.encode_groups(clips)

    def save(self, module: ConvAutoencoder, path: Path) -> None:
        save_autoencoder(module, path)

    def open(self, path: Path, dtype: str) -> ConvAutoencoderCodec:
        return ConvAutoencoderCodec.from_weights(path, dtype)

    def describe(self, codec: Any) -> Mapping[str, Any]:
        return {}

    def options(self, weights: Path) -> str:
        chosen = f"--codec.name conv_autoencoder --codec.weights {weights}"
        return f"{chosen} --codec.spatial-factor {self.spatial_factor} --codec.channels {self.channels}"


@dataclass(frozen=True)
class VaeKind(OfSize):
    """The video autoencoder of Wan2.2's kind; latents are drawn from what the encoder gives."""

    file: ClassVar[str] = "vae"

    name: str
    size: VaeSize

    @classmethod
    def of_size(cls, name: str) -> "VaeKind":
        return cls(name, pick(VAES, name, "size of wan_vae"))

    def clip_frames(self, frames: int) -> int:
        return frames

    def create(self, dtype: str, rngs: nnx.Rngs) -> VideoVae:
        return VideoVae(self.size, dtype=jnp.dtype(dtype), rngs=rngs)

    def reconstruct(self, module: VideoVae, clips: Clips, key: Key[Array, ""], noise: float) -> tuple[Clips, Array]:
        """Clips [b t h w 3] from latents drawn at random, and their divergence from the unit normal distribution."""
        mean, log_variance = module.moments(clips)
        latents = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape, mean.dtype)
        divergence = 0.5 * (jnp.square(mean) + jnp.exp(log_variance) - 1 - log_variance).mean()
        return module.decode_moments(latents), divergence

    def latents(self, module: VideoVae, clips: Clips) -> Float[Array, "n y x c"]:
        """Means of the latents [b*t' h' w' c] of clips [b t h w 3]."""
        means = module.moments(clips, chunk=8)[0]
        return means.reshape(-1, *means.shape[2:])

    def save(self, module: VideoVae, path: Path) -> None:
        save_vae(module, path)

    def open(self, path: Path, dtype: str) -> WanVaeCodec:
        return WanVaeCodec.from_weights(path, self.size, dtype)

    def describe(self, codec: Any) -> Mapping[str, Any]:
        return {"chunk": codec.chunk}

    def options(self, weights: Path) -> str:
        chosen = f"--codec.name wan_vae --codec.vae {self.name} --codec.weights {weights}"
        return f"{chosen} --codec.spatial-factor {self.spatial_factor} --codec.channels {self.channels}"


KINDS: dict[str, type[Kind]] = {"conv_autoencoder": ConvKind, "wan_vae": VaeKind}
"""Kinds by the name of the codec that uses them."""

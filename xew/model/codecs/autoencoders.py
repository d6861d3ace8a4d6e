"""Codecs of trained autoencoders: the project's own (`conv_autoencoder`, the default) and Wan2.2's (`wan_vae`)."""

import functools
import hashlib
import json
from abc import abstractmethod
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array
from jaxtyping import Float

from xew.config import ConfigError, parse, pick
from xew.files import read_json, write_text
from xew.model.codecs.contract import Codec, CodecSettings, FrameBatch, LatentBatch, LatentSize, to_pictures, to_signed
from xew.model.codecs.conv_autoencoder import (
    AutoencoderSize,
    ConvAutoencoder,
    load_autoencoder,
    read_size,
    save_autoencoder,
)
from xew.model.codecs.vae import VAES, VaeSize, VideoVae, abstract_vae, check_size
from xew.model.codecs.vae_layouts import load_vae, save_vae

PACKAGED_WEIGHTS = Path(__file__).with_name("conv_autoencoder.safetensors")
"""Weights of conv_autoencoder that come with the package."""


class AutoencoderCodec(Codec):
    """What the codecs of autoencoders share: the network, and that its weights are written once."""

    file: ClassVar[str]
    """Name of the files of the codec, without ending."""

    params: Any
    graph: nnx.GraphDef
    size: Any
    dtype: str

    @property
    def spatial_factor(self) -> int:
        return self.size.spatial_factor

    @property
    def channels(self) -> int:
        return self.size.channels

    @property
    def autoencoder(self) -> Any:
        """The autoencoder itself."""
        return nnx.merge(self.graph, self.params)

    @abstractmethod
    def write_weights(self, path: Path) -> None:
        """Write the weights as .safetensors."""

    def describe(self) -> dict[str, Any]:
        """What `load` needs beside the weights."""
        return {"size": asdict(self.size), "dtype": self.dtype}

    def save(self, folder: Path) -> None:
        """Write <file>.safetensors and <file>.json; weights that are there already are not written again."""
        file = folder / f"{self.file}.json"
        if not file.exists() or read_json(file)["hash"] != self.hash:
            self.write_weights(file.with_suffix(".safetensors"))
        write_text(file, json.dumps(self.describe() | {"hash": self.hash}, indent=1) + "\n")


@dataclass(frozen=True)
class _KeptVae:
    """Contents of vae.json."""

    size: VaeSize
    dtype: Literal["float32", "bfloat16"]
    chunk: int
    hash: str


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=("params",), meta_fields=("graph", "size", "dtype", "chunk", "hash")
)
@dataclass(frozen=True)
class WanVaeCodec(AutoencoderCodec):
    """Wan2.2's autoencoder, or a smaller one of its kind, with trained weights; see `xew.model.codecs.vae`."""

    file: ClassVar[str] = "vae"

    params: Any
    """State of a `VideoVae` with the statistics of its latents."""
    graph: nnx.GraphDef
    size: VaeSize
    dtype: str
    chunk: int
    hash: str

    def encode_batch(self, frames: FrameBatch) -> LatentBatch:
        """Frames [b t h w 3] in [-1, 1] -> latents [b t' h' w' c] float32: normalized means, as Wan's diffusion takes them."""
        return self.autoencoder.encode(frames, self.chunk)

    def decode_batch(self, latents: LatentBatch) -> FrameBatch:
        """Latents [b t' h' w' c] -> frames [b t h w 3] float32 in [-1, 1]."""
        return self.autoencoder.decode(latents, self.chunk)

    def next_reference(self, latents: LatentBatch) -> Float[Array, "b 1 y x c"]:
        """The last decoded frame as a picture, encoded alone: [b t' h' w' c] -> [b 1 h' w' c].

        It decodes two latents at a time, so that it fits beside a network in training.
        """
        last = self.autoencoder.decode(latents, chunk=2, last_only=True)
        return self.autoencoder.encode(to_signed(to_pictures(last)))

    def write_weights(self, path: Path) -> None:
        save_vae(self.autoencoder, path)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"chunk": self.chunk}

    @classmethod
    def load(cls, folder: Path) -> "WanVaeCodec":
        """Read vae.safetensors and vae.json."""
        stored = read_json(folder / "vae.json")
        kept = parse(_KeptVae, stored, str(folder / "vae.json"))
        check_size(kept.size, str(folder / "vae.json"))
        return cls.from_weights(folder / "vae.safetensors", kept.size, kept.dtype, kept.chunk)

    @classmethod
    def latent_size(cls, settings: CodecSettings) -> LatentSize:
        size = pick(VAES, settings.vae, "autoencoder")
        if settings.chunk < 0:
            raise ConfigError(f"codec.chunk is {settings.chunk}; expected latent frames at once, or 0 for all.")
        return LatentSize(size.spatial_factor, size.channels)

    @classmethod
    def open(cls, settings: CodecSettings) -> "WanVaeCodec":
        if settings.weights is None:
            raise ConfigError(
                "the codec wan_vae needs codec.weights: Wan2.2_VAE.pth, or the vae folder of Wan2.2-TI2V-5B-Diffusers."
            )
        return cls.from_weights(settings.weights, pick(VAES, settings.vae, "autoencoder"), settings.dtype, settings.chunk)

    @classmethod
    def from_weights(cls, weights: Path, size: VaeSize, dtype: str = "float32", chunk: int = 8) -> "WanVaeCodec":
        """A codec from a file of weights of any known kind."""
        vae = abstract_vae(size, jnp.dtype(dtype))
        load_vae(vae, weights)
        return cls.from_vae(vae, chunk)

    @classmethod
    def from_vae(cls, vae: VideoVae, chunk: int = 8) -> "WanVaeCodec":
        """The codec of an autoencoder."""
        graph, params = nnx.split(vae)
        dtype = jnp.dtype(vae.dtype).name
        return cls(params, graph, vae.size, dtype, chunk, hash_leaves(f"wan_vae {vae.size} {dtype}", params))


@functools.partial(jax.tree_util.register_dataclass, data_fields=("params",), meta_fields=("graph", "size", "dtype", "hash"))
@dataclass(frozen=True)
class ConvAutoencoderCodec(AutoencoderCodec):
    """The project's own autoencoder of groups of four frames; see `xew.model.codecs.conv_autoencoder`.

    Groups are independent: of the latents and decoded frames, only the first depends on the first frame.
    """

    file: ClassVar[str] = "autoencoder"
    groups_independent: ClassVar[bool] = True

    params: Any
    """State of a `ConvAutoencoder` with the statistics of its latents."""
    graph: nnx.GraphDef
    size: AutoencoderSize
    dtype: str
    hash: str

    def encode_batch(self, frames: FrameBatch) -> LatentBatch:
        """Frames [b t h w 3] in [-1, 1] -> standardized latents [b t' h' w' c] float32."""
        return self.autoencoder.encode(frames)

    def decode_batch(self, latents: LatentBatch) -> FrameBatch:
        """Latents [b t' h' w' c] -> frames [b t h w 3] float32 in [-1, 1]."""
        return self.autoencoder.decode(latents)

    def next_reference(self, latents: LatentBatch) -> Float[Array, "b 1 y x c"]:
        """The last decoded frame as a picture, encoded alone: [b t' h' w' c] -> [b 1 h' w' c]; one group is decoded."""
        autoencoder = self.autoencoder
        return autoencoder.encode(to_signed(to_pictures(autoencoder.decode_last(latents))))

    def write_weights(self, path: Path) -> None:
        save_autoencoder(self.autoencoder, path)

    @classmethod
    def load(cls, folder: Path) -> "ConvAutoencoderCodec":
        """Read autoencoder.safetensors and autoencoder.json."""
        stored = read_json(folder / "autoencoder.json")
        return cls.from_weights(folder / "autoencoder.safetensors", stored["dtype"])

    @classmethod
    def latent_size(cls, settings: CodecSettings) -> LatentSize:
        size = read_size(settings.weights or PACKAGED_WEIGHTS)
        return LatentSize(size.spatial_factor, size.channels)

    @classmethod
    def open(cls, settings: CodecSettings) -> "ConvAutoencoderCodec":
        return cls.from_weights(settings.weights or PACKAGED_WEIGHTS, settings.dtype)

    @classmethod
    def from_weights(cls, weights: Path, dtype: str = "float32") -> "ConvAutoencoderCodec":
        """A codec from a file of weights, or from the folder that holds it."""
        return cls.from_autoencoder(load_autoencoder(weights, jnp.dtype(dtype)))

    @classmethod
    def from_autoencoder(cls, autoencoder: ConvAutoencoder) -> "ConvAutoencoderCodec":
        """The codec of an autoencoder."""
        graph, params = nnx.split(autoencoder)
        dtype = jnp.dtype(autoencoder.dtype).name
        name = f"conv_autoencoder {autoencoder.size} {dtype}"
        return cls(params, graph, autoencoder.size, dtype, hash_leaves(name, params))


def hash_leaves(name: str, params: Any) -> str:
    """SHA-256 of a name and of all leaves of a module's state with their paths."""
    digest = hashlib.sha256(name.encode())
    for path, leaf in sorted(nnx.to_flat_state(params), key=lambda item: str(item[0])):
        digest.update(f"{path}".encode())
        digest.update(np.asarray(jax.device_get(leaf.get_value())).tobytes())
    return digest.hexdigest()

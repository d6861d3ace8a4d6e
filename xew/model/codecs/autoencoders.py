"""Codecs from trained autoencoders: the package's (`conv_autoencoder`, the default) and Wan2.2's (`wan_vae`)."""

import errno
import functools
import hashlib
import json
from abc import abstractmethod
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from xew.config import ConfigError, parse, pick
from xew.files import read_json, write_text
from xew.model.codecs.contract import (
    Codec,
    CodecSettings,
    FrameBatch,
    GivenFrames,
    LatentBatch,
    LatentSize,
    to_pictures,
    to_signed,
)
from xew.model.codecs.conv_autoencoder import (
    HEAD_FILE,
    ConvAutoencoder,
    find_weights,
    load_autoencoder,
    read_size,
    save_weights,
)
from xew.model.codecs.render_head import RenderHead, load_head
from xew.model.codecs.vae import VAES, VaeSize, VideoVae, abstract_vae, check_size
from xew.model.codecs.vae_layouts import load_vae, save_vae

PACKAGED_WEIGHTS = Path(__file__).with_name("conv_autoencoder.safetensors")
"""Packaged weights of conv_autoencoder."""


@dataclass(frozen=True)
class AutoencoderCodec(Codec):
    """Base class of both codecs: the network, and saving its weights once."""

    file: ClassVar[str]
    """Name of the codec's files, without suffix."""

    params: Any
    """State of the autoencoder, with the statistics of its latents."""
    graph: nnx.GraphDef
    size: Any
    dtype: str
    hash: str

    @property
    def spatial_factor(self) -> int:
        return self.size.spatial_factor

    @property
    def channels(self) -> int:
        return self.size.channels

    @property
    def autoencoder(self) -> Any:
        """The autoencoder's module."""
        return nnx.merge(self.graph, self.params)

    @abstractmethod
    def decode_last(self, latents: LatentBatch) -> FrameBatch:
        """Latents [b t' h' w' c] -> the last frame [b 1 h w 3] that `decode_batch` gives."""

    def next_reference(self, latents: LatentBatch) -> LatentBatch:
        return self.encode_batch(to_signed(to_pictures(self.decode_last(latents))))

    @abstractmethod
    def write_weights(self, path: Path) -> None:
        """Write the weights as .safetensors."""

    def describe(self) -> dict[str, Any]:
        """Settings that `load` needs besides the weights."""
        return {"size": asdict(self.size), "dtype": self.dtype}

    def save(self, folder: Path) -> None:
        """Write <file>.safetensors, unless it exists with the same hash, and <file>.json."""
        file = folder / f"{self.file}.json"
        try:
            same = read_json(file)["hash"] == self.hash
        except (OSError, ValueError, KeyError, TypeError):  # there is none, or it is damaged
            same = False
        if not same:
            self.write_weights(file.with_suffix(".safetensors"))
        write_text(file, json.dumps(self.describe() | {"hash": self.hash}, indent=1) + "\n", within=folder)


@dataclass(frozen=True)
class _StoredVae:
    """Content of vae.json."""

    size: VaeSize
    dtype: Literal["float32", "bfloat16"]
    chunk: int
    hash: str


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=("params",), meta_fields=("graph", "size", "dtype", "hash", "chunk")
)
@dataclass(frozen=True)
class WanVaeCodec(AutoencoderCodec):
    """Wan2.2's autoencoder, or a smaller size, with trained weights; see `xew.model.codecs.vae`."""

    file: ClassVar[str] = "vae"

    chunk: int

    def encode_batch(self, frames: FrameBatch) -> LatentBatch:
        return self.autoencoder.encode(frames, self.chunk)

    def decode_batch(self, latents: LatentBatch, given: GivenFrames | None = None) -> FrameBatch:
        return self.autoencoder.decode(latents, self.chunk)

    def decode_last(self, latents: LatentBatch) -> FrameBatch:
        """Decode two latents at a time, to leave memory for a network in training."""
        return self.autoencoder.decode(latents, chunk=2, last_only=True)

    def write_weights(self, path: Path) -> None:
        save_vae(self.autoencoder, path)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"chunk": self.chunk}

    @classmethod
    def load(cls, folder: Path) -> "WanVaeCodec":
        file = folder / "vae.json"
        stored = parse(_StoredVae, read_json(file), str(file))
        check_size(stored.size, str(file))
        return cls.from_weights(folder / "vae.safetensors", stored.size, stored.dtype, stored.chunk)

    @classmethod
    def latent_size(cls, settings: CodecSettings) -> LatentSize:
        size = pick(VAES, settings.vae, "autoencoder")
        if settings.chunk < 0:
            raise ConfigError(f"codec.chunk is {settings.chunk}; expected a number of latent frames, or 0 for all.")
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
        """A codec from weights in any known layout."""
        vae = abstract_vae(size, jnp.dtype(dtype))
        load_vae(vae, weights)
        return cls.from_vae(vae, chunk)

    @classmethod
    def from_vae(cls, vae: VideoVae, chunk: int = 8) -> "WanVaeCodec":
        """The codec of an autoencoder."""
        graph, params = nnx.split(vae)
        dtype = jnp.dtype(vae.dtype).name
        return cls(params, graph, vae.size, dtype, hash_leaves(f"wan_vae {vae.size} {dtype}", params), chunk)


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("params", "head_params"),
    meta_fields=("graph", "size", "dtype", "hash", "head_graph", "head_hash"),
)
@dataclass(frozen=True)
class ConvAutoencoderCodec(AutoencoderCodec):
    """The package's autoencoder of groups of four frames, with or without a render head behind its decoder.

    See `xew.model.codecs.conv_autoencoder` and `xew.model.codecs.render_head`.
    """

    file: ClassVar[str] = "autoencoder"
    groups_independent: ClassVar[bool] = True

    head_params: Any = None
    """State of the head, or None."""
    head_graph: nnx.GraphDef | None = None
    head_hash: str = ""

    @property
    def decoder_hash(self) -> str:
        return f"{self.hash} {self.head_hash}".strip()

    @property
    def sees_render(self) -> bool:
        return self.head_graph is not None

    @property
    def head(self) -> RenderHead:
        """The head's module."""
        assert self.head_graph is not None, "sees_render says whether there is a head"
        return nnx.merge(self.head_graph, self.head_params)

    def encode_batch(self, frames: FrameBatch) -> LatentBatch:
        return self.autoencoder.encode(frames)

    def decode_batch(self, latents: LatentBatch, given: GivenFrames | None = None) -> FrameBatch:
        decoded = self.autoencoder.decode(latents)
        return decoded if given is None or not self.sees_render else self.head(decoded, given)

    def decode_last(self, latents: LatentBatch) -> FrameBatch:
        return self.autoencoder.decode_last(latents)

    def write_weights(self, path: Path) -> None:
        save_weights(self.autoencoder, path)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"head": self.head_hash}

    def save(self, folder: Path) -> None:
        """Write the autoencoder and, if there is one, the head."""
        super().save(folder)
        if self.sees_render:
            save_weights(self.head, folder / HEAD_FILE)

    @classmethod
    def load(cls, folder: Path) -> "ConvAutoencoderCodec":
        stored = read_json(folder / "autoencoder.json")
        if stored["head"] and not (folder / HEAD_FILE).exists():
            raise FileNotFoundError(errno.ENOENT, "is missing", HEAD_FILE)
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
        """A codec from a file of weights, or from its folder, with the head that lies next to them if there is one."""
        codec = cls.from_autoencoder(load_autoencoder(weights, jnp.dtype(dtype)))
        head = find_weights(weights).with_name(HEAD_FILE)
        return codec.with_head(load_head(head, jnp.dtype(dtype))) if head.exists() else codec

    @classmethod
    def from_autoencoder(cls, autoencoder: ConvAutoencoder) -> "ConvAutoencoderCodec":
        """The codec of an autoencoder, without a head."""
        graph, params = nnx.split(autoencoder)
        dtype = jnp.dtype(autoencoder.dtype).name
        name = f"conv_autoencoder {autoencoder.size} {dtype}"
        return cls(params, graph, autoencoder.size, dtype, hash_leaves(name, params))

    def with_head(self, head: RenderHead) -> "ConvAutoencoderCodec":
        """The same codec with a head behind its decoder."""
        graph, params = nnx.split(head)
        return replace(self, head_params=params, head_graph=graph, head_hash=hash_leaves(f"render_head {head.size}", params))


def hash_leaves(name: str, params: Any) -> str:
    """SHA-256 of a name and a module's state."""
    digest = hashlib.sha256(name.encode())
    for path, leaf in sorted(nnx.to_flat_state(params), key=lambda item: str(item[0])):
        digest.update(f"{path}".encode())
        digest.update(np.asarray(jax.device_get(leaf.get_value())).tobytes())
    return digest.hexdigest()

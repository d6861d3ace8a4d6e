"""Video codecs: frames to latents and back. Every codec is causal: the first frame alone, then groups of four.

Reads  uint8 [t h w 3], or on the device float [b t h w 3] in [-1, 1]; t = 4 k + 1
Writes float32 latents [k + 1, h / factor, w / factor, channels] of about unit size
To add a codec: a class with the methods of `Codec` (most come with `BatchCodec`), and one line in CODECS.

A codec is a JAX pytree of its arrays, so that it is passed to compiled functions and is no constant in them.
"""

import functools
import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array, lax
from jaxtyping import Float, Shaped, UInt8

from xew.config import ConfigError, parse, pick
from xew.files import demand_regular, read_json, replacing, write_text
from xew.model.codecs.conv_autoencoder import (
    AutoencoderSize,
    ConvAutoencoder,
    find_weights,
    load_autoencoder,
    save_autoencoder,
)
from xew.model.codecs.vae import VAES, VaeSize, VideoVae, abstract_vae, check_size
from xew.model.codecs.vae_layers import as_row
from xew.model.codecs.vae_layouts import load_vae, save_vae
from xew.model.video.frames import TEMPORAL_FACTOR

Pictures = UInt8[np.ndarray, "t h w 3"]
Latents = Float[np.ndarray, "k y x c"]
FrameBatch = Float[Array, "b t h w 3"]
LatentBatch = Float[Array, "b k y x c"]
PACKAGED_WEIGHTS = Path(__file__).with_name("conv_autoencoder.safetensors")
"""Weights of conv_autoencoder that come with the package."""
PACKAGED_SHAPE = (16, 48)
"""Spatial factor and channels of the packaged weights."""


@dataclass(frozen=True)
class CodecSettings:
    """The `codec` section of a config."""

    name: str = "patch_pca"
    """One of CODECS."""
    spatial_factor: int = 8
    """Number of pixels a side of a latent."""
    channels: int = 48
    """Number of channels of the latents."""
    fit_clips: int = 64
    """Number of clips of training episodes from which patch_pca computes its components."""
    vae: str = "wan22"
    """Size of wan_vae, one of VAES."""
    weights: Path | None = None
    """Weights of wan_vae: Wan2.2_VAE.pth, the vae folder of the diffusers layout, or what `train_codec` wrote. Of
    conv_autoencoder: what `train_codec` wrote; those of the package where left out."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the activations of wan_vae and conv_autoencoder."""
    chunk: int = 8
    """Number of latent frames that go through wan_vae at once; more is faster and takes more memory, 0 takes all."""


@runtime_checkable
class Codec(Protocol):
    """What the rest of the room asks of a codec."""

    fitted: ClassVar[bool]
    """Whether it is fitted to the training episodes, and not read from weights."""
    relative: ClassVar[bool]
    """Whether later latents are coded relative to the first frame, so that another first frame changes them."""

    @property
    def spatial_factor(self) -> int:
        """Number of pixels a side of a latent."""

    @property
    def channels(self) -> int:
        """Number of channels of the latents."""

    @property
    def hash(self) -> str:
        """Text that changes whenever latents would."""

    def encode(self, video: Pictures) -> Latents:
        """Video uint8 [t h w 3] -> latents float32 [t' h' w' c]. Later frames never change earlier latents."""

    def decode(self, latents: Latents) -> Pictures:
        """Latents float32 [t' h' w' c] -> video uint8 [t h w 3]."""

    def encode_batch(self, frames: FrameBatch) -> LatentBatch:
        """Frames [b t h w 3] in [-1, 1] -> latents [b t' h' w' c] float32; may be traced."""

    def decode_batch(self, latents: LatentBatch) -> FrameBatch:
        """Latents [b t' h' w' c] -> frames [b t h w 3] float32, about in [-1, 1]; may be traced."""

    def next_reference(self, latents: LatentBatch) -> Float[Array, "b 1 y x c"]:
        """The last frame of a decoded clip, encoded alone: [b t' h' w' c] -> [b 1 h' w' c]; may be traced.

        It is rounded as if it had been a picture in between, so it is what a rollout begins its next chunk with.
        """

    def replace_reference(self, latents: LatentBatch, reference: Float[Array, "b 1 y x c"]) -> LatentBatch:
        """Latents of the same later frames behind another first frame; may be traced.

        Args:
            latents: [b t' h' w' c] of a clip.
            reference: [b 1 h' w' c], the latent of another first frame.

        Returns:
            [b t' h' w' c], which begin with the reference and decode to the clip's later frames.
        """

    def save(self, folder: Path) -> None:
        """Write all that `load` needs into a folder, under names of its own."""

    @classmethod
    def load(cls, folder: Path) -> "Codec":
        """The codec that was saved in a folder."""

    @classmethod
    def check(cls, settings: CodecSettings) -> None:
        """Raise ConfigError where settings contradict one another; reads no weights."""

    @classmethod
    def prepare(cls, settings: CodecSettings, clips: Callable[[], list[np.ndarray]]) -> "Codec":
        """The codec of a config; `clips` gives uint8 [t h w 3] of training episodes to one that is fitted to them."""


class BatchCodec:
    """A codec's functions on pictures and on single clips, from its `encode_batch` and `decode_batch`."""

    relative: ClassVar[bool] = False
    spatial_factor: int
    encode_batch: Callable[[Array], Array]
    decode_batch: Callable[[Array], Array]

    def encode(self, video: np.ndarray) -> np.ndarray:
        """Video uint8 [t h w 3] -> latents float32 [t' h' w' c]; t must be 4 k + 1 and the sides multiples of the factor."""
        check_clip_shape(video.shape, self.spatial_factor)
        return np.asarray(encode_pictures(self, video[None]))[0]

    def decode(self, latents: Latents) -> Pictures:
        """Latents float32 [t' h' w' c] -> video uint8 [t h w 3]."""
        return np.asarray(decode_to_pictures(self, latents[None]))[0]

    def next_reference(self, latents: LatentBatch) -> Float[Array, "b 1 y x c"]:
        """The last decoded frame as a picture, encoded alone: [b t' h' w' c] -> [b 1 h' w' c]."""
        return self.encode_batch(to_signed(to_pictures(self.decode_batch(latents)[:, -1:])))

    def replace_reference(self, latents: LatentBatch, reference: Float[Array, "b 1 y x c"]) -> LatentBatch:
        """Put another first latent [b 1 h' w' c] before those that follow, which do not depend on it: [b t' h' w' c]."""
        return jnp.concatenate([reference, latents[:, 1:]], axis=1)


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


@functools.partial(jax.tree_util.register_dataclass, data_fields=("mean", "directions", "scale"), meta_fields=())
@dataclass(frozen=True)
class Basis:
    """An affine map between patches [p] and latent channels [c]."""

    mean: Any
    """Mean patch [p] float32."""
    directions: Any
    """Orthonormal columns [p c] float32."""
    scale: Any
    """Divisors [c] float32 of the coordinates along the directions."""

    def encode(self, patches: Float[Array, "*n p"]) -> Float[Array, "*n c"]:
        """Patches [... p] -> latents [... c], at the highest precision: TF32, the default of some GPUs, costs decibels."""
        centered = patches - as_row(self.mean, patches.ndim)
        return jnp.matmul(centered, self.directions, precision=lax.Precision.HIGHEST) / as_row(self.scale, patches.ndim)

    def decode(self, latents: Float[Array, "*n c"]) -> Float[Array, "*n p"]:
        """Latents [... c] -> patches [... p]."""
        scaled = latents * as_row(self.scale, latents.ndim)
        patches = jnp.matmul(scaled, self.directions.T, precision=lax.Precision.HIGHEST)
        return patches + as_row(self.mean, latents.ndim)


@functools.partial(jax.tree_util.register_dataclass, data_fields=("first", "later"), meta_fields=("spatial_factor",))
@dataclass(frozen=True)
class PatchCodec(BatchCodec):
    """A linear codec without pretrained weights: principal components of square patches.

    Frame 0 is coded as it is; a group of four later frames as its difference from frame 0, as video codecs code frames
    between key frames. What stays still is zero, so copying the reference asks nothing of the model.
    """

    fitted: ClassVar[bool] = True
    relative: ClassVar[bool] = True

    spatial_factor: int
    first: Basis
    """Map of patches [factor factor 3] of the first frame."""
    later: Basis
    """Map of patches [4 factor factor 3] of differences from the first frame; its mean is zero."""

    @property
    def channels(self) -> int:
        return len(self.first.scale)

    @property
    def hash(self) -> str:
        digest = hashlib.sha256(f"patch_pca {self.spatial_factor}".encode())
        for basis in (self.first, self.later):
            for field in fields(Basis):
                digest.update(np.ascontiguousarray(getattr(basis, field.name)).tobytes())
        return digest.hexdigest()

    def encode_batch(self, frames: FrameBatch) -> LatentBatch:
        """Frames [b t h w 3] in [-1, 1] -> latents [b t' h' w' c] float32."""
        first, later = cut_patches(frames, self.spatial_factor)
        return jnp.concatenate([self.first.encode(first), self.later.encode(later)], axis=1)

    def decode_batch(self, latents: LatentBatch) -> FrameBatch:
        """Latents [b t' h' w' c] -> frames [b t h w 3] float32, about in [-1, 1]."""
        return join_patches(self.first.decode(latents[:, :1]), self.later.decode(latents[:, 1:]), self.spatial_factor)

    def replace_reference(self, latents: LatentBatch, reference: Float[Array, "b 1 y x c"]) -> LatentBatch:
        """Latents [b t' h' w' c] of the same later frames as differences from another first frame [b 1 h' w' c].

        The part of the change that the components hold is taken from every difference; their mean is zero.
        """
        change = self.first.decode(reference) - self.first.decode(latents[:, :1])
        shifted = latents[:, 1:] - self.later.encode(jnp.tile(change, TEMPORAL_FACTOR))
        return jnp.concatenate([reference, shifted], axis=1)

    def save(self, folder: Path) -> None:
        """Write codec.npz."""
        arrays = {
            f"{name}_{f.name}": getattr(getattr(self, name), f.name) for name in ("first", "later") for f in fields(Basis)
        }
        with replacing(folder / "codec.npz") as temporary, temporary.open("wb") as file:
            np.savez(file, spatial_factor=self.spatial_factor, **arrays)

    @classmethod
    def load(cls, folder: Path) -> "PatchCodec":
        """Read codec.npz."""
        with demand_regular(folder / "codec.npz").open("rb") as file, np.load(file) as stored:
            if wrong := [name for name in stored.files if not np.isfinite(stored[name]).all()]:
                raise ConfigError(f"{folder / 'codec.npz'} holds NaN or infinite numbers in {wrong[0]}; copy or make it again.")
            first, later = (Basis(*(stored[f"{name}_{f.name}"] for f in fields(Basis))) for name in ("first", "later"))
            for basis, frames in ((first, 1), (later, TEMPORAL_FACTOR)):
                patch, channels = 3 * frames * int(stored["spatial_factor"]) ** 2, first.scale.size
                if [np.shape(getattr(basis, f.name)) for f in fields(Basis)] != [(patch,), (patch, channels), (channels,)]:
                    raise ValueError(f"codec.npz holds no basis of patches [{patch}] and channels [{channels}]")
            return cls(int(stored["spatial_factor"]), first, later)

    @classmethod
    def check(cls, settings: CodecSettings) -> None:
        directions = 3 * settings.spatial_factor**2
        if not 0 < settings.channels <= directions:
            raise ConfigError(
                f"codec.channels is {settings.channels}; square patches of codec.spatial_factor {settings.spatial_factor}"
                f" have {directions} directions, so give 1 to {directions}."
            )
        if settings.fit_clips < 2:
            raise ConfigError(f"codec.fit_clips is {settings.fit_clips}; it must be at least 2, a scene's and a robot's.")

    @classmethod
    def prepare(cls, settings: CodecSettings, clips: Callable[[], list[np.ndarray]]) -> "PatchCodec":
        """Fit the codec of a config on the clips."""
        return cls.fit(clips(), settings.spatial_factor, settings.channels)

    @classmethod
    def fit(
        cls, clips: list[UInt8[np.ndarray, "_ h w 3"]], spatial_factor: int, channels: int, whitening: float = 0.5
    ) -> "PatchCodec":
        """Fit on clips; deterministic.

        Args:
            clips: [t h w 3] uint8 each.
            spatial_factor: pixels a side of a patch.
            channels: number of components.
            whitening: 1 gives every channel unit variance, 0 keeps the patches' own proportions; the scale is such that
                the mean variance over channels is 1 either way.
        """
        cut = [cut_patches(clip[None].astype(np.float32) / 127.5 - 1, spatial_factor) for clip in clips]
        first = np.concatenate([np.reshape(part, (-1, part.shape[-1])) for part, _ in cut])
        later = np.concatenate([np.reshape(part, (-1, part.shape[-1])) for _, part in cut])
        return cls(spatial_factor, _fit(first, channels, whitening, True), _fit(later, channels, whitening, False))


@dataclass(frozen=True)
class _KeptVae:
    """What vae.json says."""

    size: VaeSize
    dtype: Literal["float32", "bfloat16"]
    chunk: int
    hash: str


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=("params",), meta_fields=("graph", "size", "dtype", "chunk", "hash")
)
@dataclass(frozen=True)
class WanVaeCodec(BatchCodec):
    """Wan2.2's autoencoder, or a smaller one of its kind, with trained weights; see `xew.model.codecs.vae`."""

    fitted: ClassVar[bool] = False

    params: Any
    """State of a `VideoVae` with the statistics of its latents."""
    graph: nnx.GraphDef
    size: VaeSize
    dtype: str
    chunk: int
    hash: str

    @property
    def spatial_factor(self) -> int:  # type: ignore[override]
        return self.size.spatial_factor

    @property
    def channels(self) -> int:
        return self.size.channels

    @property
    def vae(self) -> VideoVae:
        """The autoencoder itself."""
        return nnx.merge(self.graph, self.params)

    def encode_batch(self, frames: FrameBatch) -> LatentBatch:
        """Frames [b t h w 3] in [-1, 1] -> latents [b t' h' w' c] float32: normalized means, as Wan's diffusion takes them."""
        return self.vae.encode(frames, self.chunk)

    def decode_batch(self, latents: LatentBatch) -> FrameBatch:
        """Latents [b t' h' w' c] -> frames [b t h w 3] float32 in [-1, 1]."""
        return self.vae.decode(latents, self.chunk)

    def next_reference(self, latents: LatentBatch) -> Float[Array, "b 1 y x c"]:
        """The last decoded frame as a picture, encoded alone: [b t' h' w' c] -> [b 1 h' w' c].

        It decodes two latents at a time, so that it fits beside a network in training.
        """
        last = self.vae.decode(latents, chunk=2, last_only=True)
        return self.vae.encode(to_signed(to_pictures(last)))

    def save(self, folder: Path) -> None:
        """Write vae.safetensors and vae.json; weights that are there already are not written again."""
        description = {"size": asdict(self.size), "dtype": self.dtype, "chunk": self.chunk, "hash": self.hash}
        file = folder / "vae.json"
        if not file.exists() or read_json(file)["hash"] != self.hash:
            save_vae(self.vae, folder / "vae.safetensors")
        write_text(file, json.dumps(description, indent=1) + "\n")

    @classmethod
    def load(cls, folder: Path) -> "WanVaeCodec":
        """Read vae.safetensors and vae.json."""
        stored = read_json(folder / "vae.json")
        kept = parse(_KeptVae, stored, str(folder / "vae.json"))
        check_size(kept.size, str(folder / "vae.json"))
        return cls.from_weights(folder / "vae.safetensors", kept.size, kept.dtype, kept.chunk)

    @classmethod
    def check(cls, settings: CodecSettings) -> None:
        size = pick(VAES, settings.vae, "autoencoder")
        if (settings.spatial_factor, settings.channels) != (size.spatial_factor, size.channels):
            raise ConfigError(
                f"codec.spatial_factor is {settings.spatial_factor} and codec.channels {settings.channels}; the autoencoder"
                f" {settings.vae} has {size.spatial_factor} and {size.channels}: write those."
            )
        if settings.chunk < 0:
            raise ConfigError(f"codec.chunk is {settings.chunk}; expected latent frames at once, or 0 for all.")

    @classmethod
    def prepare(cls, settings: CodecSettings, clips: Callable[[], list[np.ndarray]]) -> "WanVaeCodec":
        """Read the weights of a config.

        Raises:
            ConfigError: none are named, or they are missing, broken or of another size.
        """
        if settings.weights is None:
            raise ConfigError(
                "the codec wan_vae needs codec.weights: Wan2.2_VAE.pth, the vae folder of Wan2.2-TI2V-5B-Diffusers, or the"
                " folder of an autoencoder trained by `python -m xew.model.train_codec CONFIG`."
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
class ConvAutoencoderCodec(BatchCodec):
    """The project's own autoencoder of groups of four frames; see `xew.model.codecs.conv_autoencoder`.

    Groups stand alone, so that no latent and no decoded frame depends on the first frame but the first itself.
    """

    fitted: ClassVar[bool] = False

    params: Any
    """State of a `ConvAutoencoder` with the statistics of its latents."""
    graph: nnx.GraphDef
    size: AutoencoderSize
    dtype: str
    hash: str

    @property
    def spatial_factor(self) -> int:  # type: ignore[override]
        return self.size.spatial_factor

    @property
    def channels(self) -> int:
        return self.size.channels

    @property
    def autoencoder(self) -> ConvAutoencoder:
        """The autoencoder itself."""
        return nnx.merge(self.graph, self.params)

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

    def save(self, folder: Path) -> None:
        """Write autoencoder.safetensors and autoencoder.json; weights that are there already are not written again."""
        description = {"size": asdict(self.size), "dtype": self.dtype, "hash": self.hash}
        file = folder / "autoencoder.json"
        if not file.exists() or read_json(file)["hash"] != self.hash:
            save_autoencoder(self.autoencoder, folder / "autoencoder.safetensors")
        write_text(file, json.dumps(description, indent=1) + "\n")

    @classmethod
    def load(cls, folder: Path) -> "ConvAutoencoderCodec":
        """Read autoencoder.safetensors and autoencoder.json."""
        stored = read_json(folder / "autoencoder.json")
        return cls.from_weights(folder / "autoencoder.safetensors", stored["dtype"])

    @classmethod
    def check(cls, settings: CodecSettings) -> None:
        found = settings.spatial_factor, settings.channels
        if settings.weights is None and found != PACKAGED_SHAPE:
            raise ConfigError(
                f"codec.spatial_factor is {found[0]} and codec.channels {found[1]}; the packaged conv_autoencoder has"
                f" {PACKAGED_SHAPE[0]} and {PACKAGED_SHAPE[1]}: write those, or name others by codec.weights."
            )

    @classmethod
    def prepare(cls, settings: CodecSettings, clips: Callable[[], list[np.ndarray]]) -> "ConvAutoencoderCodec":
        """Read the weights of a config, or those of the package.

        Raises:
            ConfigError: they are missing or broken, or have another factor or number of channels.
        """
        weights = settings.weights or PACKAGED_WEIGHTS
        if settings.weights is None and not weights.exists():
            raise ConfigError(
                "this copy of the package has no weights for the codec conv_autoencoder; train one by `python -m"
                " xew.model.train_codec configs/codec.yaml` and name its folder by codec.weights."
            )
        codec = cls.from_weights(weights, settings.dtype)
        if (codec.spatial_factor, codec.channels) != (settings.spatial_factor, settings.channels):
            raise ConfigError(
                f"codec.spatial_factor is {settings.spatial_factor} and codec.channels {settings.channels};"
                f" {find_weights(weights)} has {codec.spatial_factor} and {codec.channels}: write those."
            )
        return codec

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


CODECS: dict[str, type[Codec]] = {
    "patch_pca": PatchCodec,
    "conv_autoencoder": ConvAutoencoderCodec,
    "wan_vae": WanVaeCodec,
}


def hash_leaves(name: str, params: Any) -> str:
    """SHA-256 of a name and of all leaves of a module's state with their paths."""
    digest = hashlib.sha256(name.encode())
    for path, leaf in sorted(nnx.to_flat_state(params), key=lambda item: str(item[0])):
        digest.update(f"{path}".encode())
        digest.update(np.asarray(jax.device_get(leaf.get_value())).tobytes())
    return digest.hexdigest()


def codec_class(settings: CodecSettings) -> type[Any]:
    """The class of codec that a config names, with what `Codec` asks. Raises ConfigError if there is none of that name."""
    return pick(CODECS, settings.name, "codec")


def check_clip_shape(shape: tuple[int, ...], spatial_factor: int) -> None:
    """Raise ValueError unless a clip [t h w 3] can be encoded."""
    t, h, w, _ = shape
    if t % TEMPORAL_FACTOR != 1 or h % spatial_factor or w % spatial_factor:
        raise ValueError(f"a clip of {t} frames {w}x{h} cannot be encoded: it needs 4 k + 1 frames, sides in {spatial_factor}s")


def latent_frames(frames: int) -> int:
    """Number of latent frames that 4 k + 1 frames of video become."""
    return (frames - 1) // TEMPORAL_FACTOR + 1


def cut_patches(frames: Shaped[Array | np.ndarray, "b t h w 3"], factor: int) -> tuple[Any, Any]:
    """Cut frames into square patches.

    Args:
        frames: [b t h w 3] float32.
        factor: pixels a side.

    Returns:
        Patches of the first frame [b 1 h' w' p], and of the later groups' differences from it [b k h' w' 4p].
    """
    b, t, h, w, _ = frames.shape
    rows, columns, patch = h // factor, w // factor, factor * factor * 3
    cut = frames.reshape(b, t, rows, factor, columns, factor, 3).transpose(0, 1, 2, 4, 3, 5, 6)
    groups = (cut[:, 1:] - cut[:, :1]).reshape(b, (t - 1) // TEMPORAL_FACTOR, TEMPORAL_FACTOR, *cut.shape[2:])
    later = groups.transpose(0, 1, 3, 4, 2, 5, 6, 7)
    return cut[:, :1].reshape(b, 1, rows, columns, patch), later.reshape(*later.shape[:4], TEMPORAL_FACTOR * patch)


def join_patches(first: Float[Array, "b 1 y x p"], later: Float[Array, "b k y x q"], factor: int) -> FrameBatch:
    """Frames [b t h w 3] of patches [b 1 h' w' p] and [b k h' w' 4p], the inverse of `cut_patches`."""
    b, k, h, w, _ = later.shape
    groups = later.reshape(b, k, h, w, TEMPORAL_FACTOR, factor, factor, 3).transpose(0, 1, 4, 2, 3, 5, 6, 7)
    cut = first.reshape(b, 1, h, w, factor, factor, 3)
    frames = jnp.concatenate([cut, cut + groups.reshape(b, k * TEMPORAL_FACTOR, *cut.shape[2:])], axis=1)
    return frames.transpose(0, 1, 2, 4, 3, 5, 6).reshape(b, -1, h * factor, w * factor, 3)


def _fit(patches: np.ndarray, channels: int, whitening: float, centered: bool) -> Basis:
    """Leading principal directions of patches [m p], by the eigenvectors of their second moments."""
    mean = patches.mean(0) if centered else np.zeros(patches.shape[1], np.float32)
    centered_patches = patches - mean
    moments = centered_patches.T.astype(np.float64) @ centered_patches.astype(np.float64) / len(patches)
    values, vectors = np.linalg.eigh(moments)
    variance = np.maximum(values[::-1][:channels], 1e-8)
    directions = vectors[:, ::-1][:, :channels]
    directions = directions * np.sign(directions[np.abs(directions).argmax(0), np.arange(channels)])
    scale = variance ** (whitening / 2)
    scale *= np.sqrt((variance / scale**2).mean())
    return Basis(mean.astype(np.float32), directions.astype(np.float32), scale.astype(np.float32))

"""The linear codec `patch_pca`: principal components of square patches, fitted to the training episodes."""

import functools
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Shaped, UInt8

from xew.config import ConfigError
from xew.files import demand_regular, replacing
from xew.model.codecs.contract import BatchCodec, CodecSettings, FrameBatch, LatentBatch
from xew.model.codecs.vae_layers import as_row
from xew.model.video.frames import TEMPORAL_FACTOR


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

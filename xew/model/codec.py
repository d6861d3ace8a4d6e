"""Video codecs: uint8 frames to latents and back. Every codec is causal: the first frame alone, then groups of four.

Reads  uint8 [t h w 3], t = 4 k + 1
Writes float32 latents [k + 1, h / factor, w / factor, channels] of about unit size
To add a codec: a class with the methods of `Codec`, and one line in CODECS.
"""

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Protocol, Self

import numpy as np

TEMPORAL_FACTOR = 4


class Codec(Protocol):
    """What the rest of the room asks of a codec."""

    @property
    def spatial_factor(self) -> int:
        """Pixels a side of what one latent covers."""

    @property
    def channels(self) -> int:
        """Of the latents."""

    @property
    def hash(self) -> str:
        """Changes whenever latents would."""

    def encode(self, video: np.ndarray) -> np.ndarray:
        """uint8 [t h w 3] -> float32 [t' h' w' c]. Later frames never change earlier latents."""

    def decode(self, latents: np.ndarray) -> np.ndarray:
        """float32 [t' h' w' c] -> uint8 [t h w 3]."""

    def save(self, path: Path) -> None: ...

    @classmethod
    def load(cls, path: Path) -> Self: ...


@dataclass(frozen=True)
class Basis:
    """An affine map between patches [p] and latent channels [c]."""

    mean: np.ndarray
    """[p] float32."""
    directions: np.ndarray
    """[p c] float32, orthonormal columns."""
    scale: np.ndarray
    """[c] float32, divides the coordinates along the directions."""

    def encode(self, patches: np.ndarray) -> np.ndarray:
        """[... p] -> [... c]."""
        return (patches - self.mean) @ self.directions / self.scale

    def decode(self, latents: np.ndarray) -> np.ndarray:
        """[... c] -> [... p]."""
        return (latents * self.scale) @ self.directions.T + self.mean


@dataclass(frozen=True)
class PatchCodec:
    """A linear codec without pretrained weights: principal components of square patches.

    Frame 0 is coded as it is; a group of four later frames as its difference from frame 0, as video codecs code frames
    between key frames. What stays still is zero, so copying the reference asks nothing of the model.
    """

    spatial_factor: int
    first: Basis
    """Of patches [factor factor 3] of the first frame."""
    later: Basis
    """Of patches [4 factor factor 3] of differences from the first frame; its mean is zero."""

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

    def encode(self, video: np.ndarray) -> np.ndarray:
        """uint8 [t h w 3] -> float32 [t' h' w' c]; t must be 4 k + 1 and the sides multiples of the factor."""
        check_clip_shape(video.shape, self.spatial_factor)
        first, later = cut_patches(video, self.spatial_factor)
        return np.concatenate([self.first.encode(first)[None], self.later.encode(later)])

    def decode(self, latents: np.ndarray) -> np.ndarray:
        """float32 [t' h' w' c] -> uint8 [t h w 3]."""
        return join_patches(self.first.decode(latents[0]), self.later.decode(latents[1:]), self.spatial_factor)

    def save(self, path: Path) -> None:
        arrays = {
            f"{name}_{f.name}": getattr(getattr(self, name), f.name) for name in ("first", "later") for f in fields(Basis)
        }
        np.savez(path, spatial_factor=self.spatial_factor, **arrays)

    @classmethod
    def load(cls, path: Path) -> "PatchCodec":
        with np.load(path) as stored:
            first, later = (Basis(*(stored[f"{name}_{f.name}"] for f in fields(Basis))) for name in ("first", "later"))
            return cls(int(stored["spatial_factor"]), first, later)

    @classmethod
    def fit(cls, clips: list[np.ndarray], spatial_factor: int, channels: int, whitening: float = 0.5) -> "PatchCodec":
        """Fit on uint8 clips [t h w 3]; deterministic.

        Args:
            whitening: 1 gives every channel unit variance, 0 keeps the patches' own proportions; the scale is such that
                the mean variance over channels is 1 either way.
        """
        cut = [cut_patches(clip, spatial_factor) for clip in clips]
        first = np.concatenate([part.reshape(-1, part.shape[-1]) for part, _ in cut])
        later = np.concatenate([part.reshape(-1, part.shape[-1]) for _, part in cut])
        return cls(spatial_factor, _fit(first, channels, whitening, True), _fit(later, channels, whitening, False))


CODECS = {"patch_pca": PatchCodec}


def check_clip_shape(shape: tuple[int, ...], spatial_factor: int) -> None:
    """Raise ValueError unless a clip [t h w 3] can be encoded."""
    t, h, w, _ = shape
    if t % TEMPORAL_FACTOR != 1 or h % spatial_factor or w % spatial_factor:
        raise ValueError(f"a clip of {t} frames {w}x{h} cannot be encoded: it needs 4 k + 1 frames, sides in {spatial_factor}s")


def latent_frames(frames: int) -> int:
    """How many latent frames `frames` = 4 k + 1 pixels frames become."""
    return (frames - 1) // TEMPORAL_FACTOR + 1


def cut_patches(video: np.ndarray, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """uint8 [t h w 3] -> first frame's patches [h' w' p] and later groups' difference patches [k h' w' 4p], in [-1, 1]."""
    t, h, w, _ = video.shape
    values = video.astype(np.float32) / 127.5 - 1
    cut = values.reshape(t, h // factor, factor, w // factor, factor, 3).transpose(0, 1, 3, 2, 4, 5)
    groups = (cut[1:] - cut[:1]).reshape(-1, TEMPORAL_FACTOR, *cut.shape[1:]).transpose(0, 2, 3, 1, 4, 5, 6)
    patch = factor * factor * 3
    return cut[0].reshape(*cut.shape[1:3], patch), groups.reshape(*groups.shape[:3], TEMPORAL_FACTOR * patch)


def join_patches(first: np.ndarray, later: np.ndarray, factor: int) -> np.ndarray:
    """The inverse of `cut_patches`, rounded to uint8."""
    h, w = first.shape[:2]
    groups = later.reshape(-1, h, w, TEMPORAL_FACTOR, factor, factor, 3).transpose(0, 3, 1, 2, 4, 5, 6)
    cut = first.reshape(1, h, w, factor, factor, 3)
    frames = np.concatenate([cut, cut + groups.reshape(-1, *cut.shape[1:])])
    values = frames.transpose(0, 1, 3, 2, 4, 5).reshape(-1, h * factor, w * factor, 3)
    return np.clip(np.rint((values + 1) * 127.5), 0, 255).astype(np.uint8)


def reconstruction_psnr(codec: Codec, clips: list[np.ndarray]) -> float:
    """Mean over clips of the PSNR [dB] of decode(encode(clip)): the ceiling of every rollout at the model's size."""
    errors = [np.square(codec.decode(codec.encode(clip)).astype(np.float32) - clip).mean() for clip in clips]
    return float(np.mean(10 * np.log10(255**2 / np.maximum(errors, 1e-6))))


def _fit(patches: np.ndarray, channels: int, whitening: float, centred: bool) -> Basis:
    """Leading principal directions of patches [m p], by the eigenvectors of their second moments."""
    mean = patches.mean(0) if centred else np.zeros(patches.shape[1], np.float32)
    centred_patches = patches - mean
    moments = centred_patches.T.astype(np.float64) @ centred_patches.astype(np.float64) / len(patches)
    values, vectors = np.linalg.eigh(moments)
    variance = np.maximum(values[::-1][:channels], 1e-8)
    directions = vectors[:, ::-1][:, :channels]
    directions = directions * np.sign(directions[np.abs(directions).argmax(0), np.arange(channels)])
    scale = variance ** (whitening / 2)
    scale *= np.sqrt((variance / scale**2).mean())
    return Basis(mean.astype(np.float32), directions.astype(np.float32), scale.astype(np.float32))

"""The codec ceiling: the quality of true video after the codec, which no rollout can exceed."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from xew.model.codecs.contract import Codec, given_frames
from xew.model.video.frames import picture_size, to_camera_size, to_model_size

T = TypeVar("T")
Video = UInt8[np.ndarray, "_ h w 3"]

LPIPS_EVERY = 3
"""Interval of the frames graded by LPIPS; 3 and not 4, to cover all positions in a group of four."""


@dataclass(frozen=True)
class Ceiling:
    """Reconstruction of true video at the camera's size, mean over clips."""

    psnr: float
    """Mean PSNR [dB], as `xew.metrics.psnr`."""
    lpips: float
    """Mean LPIPS, as `xew.metrics.lpips`, on every third frame."""
    clips: int
    """Number of clips."""

    def __str__(self) -> str:
        return f"PSNR {self.psnr:.2f} dB, LPIPS {self.lpips:.4f} at camera size over {self.clips} clips"


def check_lpips() -> None:
    """Raise ConfigError unless the weights of LPIPS are installed."""
    from xew.metrics.grading.settings import check_weights

    check_weights(("lpips",))


def measure_ceiling(
    codec: Codec, videos: Iterable[tuple[Video, Video | None, Video | None]], frames: int, height: int, width: int
) -> Ceiling:
    """Grade the reconstruction of the first `frames` frames of each true video.

    `videos` are the truth, the commanded robot's render and the scene (`GivenFrames`), uint8 [t 240 320 3], or None for the
    last two where the decoder gets none.
    """
    from xew.metrics import lpips, psnr

    scores = []
    for video, *given in videos:
        decoded = reconstruct(codec, video[:frames], frames, height, width, *given)
        pair = jnp.asarray(decoded), jnp.asarray(video[:frames])
        scores.append((np.mean(psnr(*pair)), np.mean(lpips(*(video[::LPIPS_EVERY] for video in pair)))))
    means = np.mean(scores, axis=0)
    return Ceiling(float(means[0]), float(means[1]), len(scores))


def reconstruct(
    codec: Codec, truth: Video, frames: int, height: int, width: int, render: Video | None = None, scene: Video | None = None
) -> Video:
    """Reconstruction of a video of at most `frames` frames by the codec, at the camera's size: [t 240 320 3] uint8.

    A shorter video is padded with its last frame for the codec. With a render, the decoder is given what a rollout
    is given; without a scene, the first frame is the scene.
    """
    clip = to_model_size(truth[np.minimum(np.arange(frames), len(truth) - 1)], height, width)
    shown = clip[:1] if scene is None else to_model_size(scene, height, width)
    given = None if render is None else given_frames(to_model_size(render, height, width), shown, 0, frames)
    return to_camera_size(codec.decode(codec.encode(clip), given), picture_size(truth))[: len(truth)]


def choose_evenly(items: Sequence[T], count: int) -> list[T]:
    """At most `count` of the items, evenly spaced."""
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, min(len(items), count)).astype(int))]

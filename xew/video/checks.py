"""What every video of a rollout must be, and how much of one is decoded."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from xew.episode import MOST_PIXELS, EpisodeError
from xew.files import LoadedFile

MOST_BYTES = 2**30
"""Largest size of a decoded video [bytes]. A few kilobytes can declare more than a machine's memory."""

Fit = Callable[[np.ndarray], np.ndarray]
"""Function of a frame [h w 3] uint8 to the frame that is kept."""


class RolloutError(EpisodeError):
    """A rollout is missing or invalid; the message says what to do."""


def check_size(file: LoadedFile, height: int, width: int, frames: int = 1) -> None:
    """Raise RolloutError if a video is too large to decode, by what its header declares."""
    size = 3 * height * width * frames
    if height * width > MOST_PIXELS or size > MOST_BYTES:
        raise RolloutError(
            f"{file} declares {frames} frames of {width}x{height}, {size / 1e9:.1f} GB of pixels; expected frames of at most "
            f"{MOST_PIXELS} pixels and {MOST_BYTES / 1e9:.1f} GB in all. Write it smaller or shorter."
        )


def stack_frames(files: Sequence[LoadedFile], frames: Iterable[np.ndarray]) -> np.ndarray:
    """The video [t h w 3] of frames [h w 3] uint8 from one file, or from a file each.

    Raises RolloutError if there is no frame, sizes differ, or they are too large in all.
    """
    kept: list[np.ndarray] = []
    file = files[0]
    for frame in frames:
        file = files[min(len(kept), len(files) - 1)]
        if kept and frame.shape != kept[0].shape:
            sizes = " to ".join(f"{image.shape[1]}x{image.shape[0]}" for image in (kept[0], frame))
            raise RolloutError(f"{file} changes its size at frame {len(kept)}, from {sizes}; expected one size.")
        kept.append(frame)
        check_size(file, frame.shape[0], frame.shape[1], len(kept))
    if not kept:
        raise RolloutError(f"{file} holds no readable frame; make this rollout again.")
    return np.stack(kept)


def check_video(file: LoadedFile, video: np.ndarray) -> np.ndarray:
    """The same video. Raises RolloutError unless it is [t h w 3] uint8 with at least one frame."""
    if video.dtype == np.uint8 and video.ndim == 4 and video.shape[-1] == 3 and video.size:
        return video
    kind = ""
    if np.issubdtype(video.dtype, np.floating) and not np.isfinite(video).all():
        kind = ", with NaN or infinite values"
    elif video.ndim in (3, 4) and not video.size:
        kind = ", no frame at all"
    elif video.ndim == 3 or (video.ndim == 4 and video.shape[-1] == 1):
        kind = ", gray"
    elif video.ndim == 4 and video.shape[-1] == 4:
        kind = ", with an alpha channel"
    raise RolloutError(f"{file}: found {video.dtype} {video.shape}{kind}, expected uint8 [t h w 3]; convert before grading.")


def drop_alpha(file: LoadedFile, image: np.ndarray) -> np.ndarray:
    """A picture [h w 4] without its alpha channel [h w 3]. Raises RolloutError if that hides something."""
    if image[..., 3].min() < 255:
        raise RolloutError(f"{file} has an alpha channel that is not opaque; convert before grading.")
    return image[..., :3]

"""One H.264 file for all videos of a scene, as rows and columns of tiles: they stay synchronized, and a step is one seek."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import Colorspace

from xew.episode import exact_rate
from xew.files import replacing

__all__ = ["Row", "difference_video", "tile_frames", "tile_size", "write_film"]

ENCODER = {"crf": "18", "g": "12", "bf": "0", "preset": "veryfast"}
"""Settings of libx264, with a key frame every 12 frames for fast seeking."""
DIFFERENCE_FULL = 96
"""Least difference that is drawn black, in levels of 255, as in reports."""

Row = Sequence[np.ndarray | None]
"""Videos [t h w 3] uint8 by column, or None."""


def tile_size(rows: Sequence[Row]) -> tuple[int, int]:
    """Height and width of the largest video, rounded up to even numbers for the codec [pixels]."""
    sizes = np.array([video.shape[1:3] for row in rows for video in row if video is not None])
    height, width = sizes.max(0)
    return int(height + height % 2), int(width + width % 2)


def tile_frames(rows: Sequence[Row], count: int) -> Iterator[np.ndarray]:
    """Frames [H W 3] uint8 of a film; each video is at the upper left of its tile and stops at its last frame.

    Args:
        rows: videos [t h w 3] uint8, as many columns in every row.
        count: number of frames.
    """
    height, width = tile_size(rows)
    for t in range(count):
        frame = np.full((len(rows) * height, len(rows[0]) * width, 3), 255, np.uint8)
        for i, row in enumerate(rows):
            for j, video in enumerate(row):
                if video is not None:
                    picture = video[min(t, len(video) - 1)]
                    top, left = i * height, j * width
                    frame[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
        yield frame


def difference_video(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Largest channel difference of two videos [t h w 3] uint8 as a gray video [t h w 3] uint8, as long as the shorter one.

    White is no difference, black is DIFFERENCE_FULL or more.
    """
    count = min(len(prediction), len(truth))
    high = np.maximum(prediction[:count], truth[:count]) - np.minimum(prediction[:count], truth[:count])
    scaled = np.minimum(high.max(-1).astype(np.uint16) * 255 // DIFFERENCE_FULL, 255)
    return np.repeat((255 - scaled).astype(np.uint8)[..., None], 3, -1)


def write_film(path: Path, frames: Iterable[np.ndarray], frame_rate: float, *, within: Path) -> None:
    """Write frames [h w 3] uint8 RGB of even height and width as H.264 for browsers, in MP4; frame k begins at k / rate.

    Raises:
        OSError: the file cannot be written, or the disk is full.
    """
    rate = exact_rate(frame_rate)
    with replacing(path, within=within) as temporary:
        options = {"movflags": "+faststart", "fflags": "+bitexact"}
        with av.open(str(temporary), "w", format="mp4", container_options=options) as container:
            stream = container.add_stream("libx264", rate=rate, options=ENCODER)
            stream.codec_context.thread_count = 1
            stream.codec_context.colorspace = Colorspace.SMPTE170M  # as FFmpeg converts; browsers guess by size
            for number, image in enumerate(frames):
                if number == 0:
                    stream.height, stream.width, stream.pix_fmt = *image.shape[:2], "yuv420p"
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
                frame.pts, frame.time_base = number, 1 / rate
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))

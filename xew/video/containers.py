"""Containers of any model's making: Matroska, WebM, MP4, MOV and AVI, with FFmpeg's decoders.

Header entries that every player obeys are obeyed here: turned and mirrored pictures, edit lists. Pixels that are not square are
refused. Sizes are checked by the header, before anything is decoded.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import av
import numpy as np
from av.stream import Disposition

from xew.episode import open_video, take_pixels
from xew.files import LoadedFile
from xew.video.checks import Fit, RolloutError, check_size, drop_alpha, stack_frames

RATE_TOLERANCE = 0.01
"""Largest relative difference of frame rates; containers round times to a tick, and people 16.667 to two digits."""
GAP_TOLERANCE = 0.1
"""Largest relative difference of the gaps between frames at a constant rate; at least 1.5 ticks of the container's clock."""
AVI = "avi"
"""Container whose header counts ticks of its clock, not frames, and in which frames have times in the order of storage."""
DISPLAY_ONE = 1 << 16
"""The number 1 in a display matrix."""


def read_container(
    file: LoadedFile, frame_rate: float | None = None, most: int | None = None, fit: Fit | None = None
) -> np.ndarray:
    """The frames as players show them, uint8 RGB [t h w 3].

    Args:
        file: the video.
        frame_rate: required rate [Hz]; None accepts any.
        most: number of frames after which reading ends; None for all.
        fit: what is done with each frame before it is kept.

    Raises:
        RolloutError: the video is damaged, not of 8 bits RGB, too large, or differs from its own header.
    """
    times: list[float] = []
    try:
        with open_video(file) as container:
            stream = _find_stream(file, container)
            _check_pixels(file, stream.codec_context.format)
            _check_aspect(file, stream)
            declared = _declared_frames(container, stream)
            check_size(file, stream.height, stream.width, 1 if fit else max(1, min(declared, most or declared)))
            video = stack_frames([file], itertools.islice(_decode(file, container, stream, times, fit), most))
            if container.format.name == AVI:
                times.sort()
            tick, promised = float(stream.time_base), _promised_frames(container, stream, times)
    except (av.FFmpegError, OSError, ValueError, MemoryError) as error:
        after = f"breaks off after {len(times)} frames" if times else "holds no readable frame"
        reason = getattr(error, "strerror", None) or error
        raise RolloutError(f"{file} {after} ({reason}); make this rollout again.") from error
    if len(video) < promised and len(video) != most:
        raise RolloutError(
            f"{file} is cut off, or its header is wrong: {len(video)} of {promised} frames can be read; "
            "make this rollout again."
        )
    if frame_rate is not None and len(video) > 1:
        _check_rate(file, np.array(times[: len(video)]), tick, frame_rate)
    return video


def _find_stream(file: LoadedFile, container: Any) -> Any:
    """The only video. A cover picture is none."""
    streams = [stream for stream in container.streams.video if not stream.disposition & Disposition.attached_pic]
    if len(streams) != 1:
        raise RolloutError(f"{file} holds {len(streams)} videos, expected one.")
    return streams[0]


def _check_pixels(file: LoadedFile, pixels: Any) -> None:
    """Raise RolloutError unless the format is color with 8 bits a channel."""
    components = pixels.components if pixels else ()  # the format is None if too little can be read
    kind = ""
    if len(components) == 1 and not pixels.has_palette:
        kind = "gray frames"
    elif any(component.bits > 8 for component in components):
        kind = f"{max(component.bits for component in components)} bits a channel"
    if kind:
        raise RolloutError(f"{file} holds {kind} ({pixels.name}), expected RGB of 8 bits; convert before grading.")


def _check_aspect(file: LoadedFile, stream: Any) -> None:
    """Raise RolloutError if players stretch the video by a pixel or more, because its pixels are not square."""
    aspect = stream.sample_aspect_ratio or 1
    shown = round(stream.width * aspect)
    if abs(aspect - 1) * stream.width >= 1:
        raise RolloutError(
            f"{file} is {stream.width}x{stream.height} with pixels of {aspect.numerator}:{aspect.denominator}, so players show "
            f"{shown}x{stream.height}; scale it to that (ffmpeg -i IN -vf scale={shown}:{stream.height},setsar=1 OUT)."
        )


def _decode(file: LoadedFile, container: Any, stream: Any, times: list[float], fit: Fit | None) -> Iterator[np.ndarray]:
    """Frames as RGB [h w 3]; the time of each is added to `times` [s], NaN where it has none."""
    stream.codec_context.thread_count = 1
    stream.codec_context.options = {"err_detect": "explode"}  # otherwise FFmpeg conceals lost blocks
    for frame in container.decode(stream):
        check_size(file, frame.height, frame.width)
        image = _turn(file, frame, _rgb(file, frame))
        times.append(float(frame.pts * frame.time_base) if frame.pts is not None else np.nan)
        yield image if fit is None else fit(image)


def _rgb(file: LoadedFile, frame: Any) -> np.ndarray:
    """A decoded frame as RGB [h w 3]. An opaque alpha channel, as OpenCV writes for FFV1, is dropped; others are errors."""
    if not any(component.is_alpha for component in frame.format.components):
        return take_pixels(frame)
    return drop_alpha(file, take_pixels(frame, "rgba"))


def _turn(file: LoadedFile, frame: Any, image: np.ndarray) -> np.ndarray:
    """An image [h w 3] as its display matrix says, turned by quarters or mirrored: a view of it.

    The matrix takes a pixel in column x, row y to column ax + cy, row bx + dy.

    Raises:
        RolloutError: the matrix turns the image by another angle, scales or skews it.
    """
    stored = frame.side_data.get("DISPLAYMATRIX")
    if stored is None:
        return image
    a, b, _, c, d = (int(number) for number in np.frombuffer(stored, np.int32)[:5])
    if sorted(map(abs, (a, b, c, d))) != [0, 0, DISPLAY_ONE, DISPLAY_ONE] or abs(a) != abs(d):
        raise RolloutError(
            f"{file} is to be shown turned by {-frame.rotation} degrees, scaled or skewed, as its header says; expected "
            "quarter turns and mirroring. Convert it without this entry before grading."
        )
    upright = image if a else image.swapaxes(0, 1)
    return upright[:: 1 if b + d > 0 else -1, :: 1 if a + c > 0 else -1]


def _declared_frames(container: Any, stream: Any) -> int:
    """Number of frames by the header, before any is decoded; 0 if unknown. What an edit list hides is not counted."""
    if stream.frames:
        return sum(not entry.is_discard for entry in stream.index_entries)
    if container.duration is None or len(container.streams) != 1 or not stream.average_rate:
        return 0
    return round(container.duration / av.time_base * stream.average_rate)


def _promised_frames(container: Any, stream: Any, times: list[float]) -> int:
    """Number of frames by the header and the frames' times; 0 if unknown."""
    if stream.frames and container.format.name != AVI:
        return _declared_frames(container, stream)
    if container.duration is None or len(container.streams) != 1 or len(times) < 2 or times[-1] <= times[0]:
        return 0
    gap = (times[-1] - times[0]) / (len(times) - 1)
    last = max(gap, float(1 / stream.average_rate) if stream.average_rate else 0.0)  # duration of the last frame
    return len(times) + round((container.duration / av.time_base - times[-1] - last) / gap)


def _check_rate(file: LoadedFile, times: np.ndarray, tick: float, frame_rate: float) -> None:
    """Raise RolloutError unless the rate is constant and equals `frame_rate`."""
    gaps = np.diff(times)
    otherwise = "if its frames match the episode's one by one, pass --allow rate."
    if not (gaps > 0).all():
        raise RolloutError(f"{file} gives frames no times, or several the same; write the episode's rate, or, {otherwise}")
    middle = float(np.median(gaps))
    if not np.all(np.abs(gaps - middle) <= max(1.5 * tick, GAP_TOLERANCE * middle)):
        raise RolloutError(
            f"{file} has a variable frame rate (from frame to frame {1000 * gaps.min():.0f} to {1000 * gaps.max():.0f} ms), "
            f"expected a constant one; {otherwise}"
        )
    rate = 1 / float(np.mean(gaps))
    if abs(rate / frame_rate - 1) > RATE_TOLERANCE:
        raise RolloutError(
            f"{file} has {rate:.2f} frames per second, its episode {frame_rate:.2f}; write the episode's rate, or, {otherwise}"
        )

"""Folders of PNG files, a file for each frame, in the order of the numbers in their names."""

import contextlib
import itertools
import re
import struct
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image

from xew.files import LoadedFile
from xew.video.checks import Fit, RolloutError, check_size, check_video, drop_alpha, stack_frames

FRAME_NAME = re.compile(r"((?:.*(?:[^\W\d_][.-]?|[_ ]))?)([0-9]+)")
"""Form of a frame's name without .png: its number, alone or after a text that ends in a letter, `_` or a space. Only after a
letter may a dot or hyphen follow, so a number has no sign and no fraction: neither frame_-1 nor 0.06 is one."""
PNG_END = b"IEND\xaeB`\x82"
PLAIN_PIXELS = struct.pack(">II", 1, 1)
"""Begin of the chunk pHYs of a PNG with square pixels: how many there are per unit across and down."""
SHOWN_NAMES = 3
"""Largest number of names in a message."""


def order_frames(folder: Path, paths: Collection[Path]) -> tuple[Path, ...]:
    """The PNG files of one video in the order of their numbers.

    Args:
        folder: of the rollout, for messages.
        paths: its PNG files.

    Raises:
        RolloutError: they lie in several folders, or their names are not one text and numbers that count by one step.
    """
    expected = "expected the frames of one video, numbered 0.png, 1.png, or with one text before the number, frame_000.png"
    if len(parents := {path.parent for path in paths}) > 1:
        raise RolloutError(f"{folder}: found PNG files in the folders {_list(path.name for path in parents)}; {expected}.")
    names = {path: FRAME_NAME.fullmatch(path.stem) for path in paths}
    if odd := [path.name for path, match in names.items() if match is None]:
        raise RolloutError(f"{folder}: found PNG files named {_list(odd)}; {expected}.")
    numbered = sorted((int(match[2]), match[1], path) for path, match in names.items() if match)
    if len(texts := {text for _, text, _ in numbered}) > 1:
        raise RolloutError(f"{folder}: found PNG files named {_list(f'{text}*.png' for text in texts)}; {expected}.")
    steps = [after - before for (before, *_), (after, *_) in itertools.pairwise(numbered)]
    for step, (*_, before), (*_, after) in zip(steps, numbered, numbered[1:], strict=False):
        if step != steps[0] or not step:
            raise RolloutError(f"{folder}: {before.name} is followed by {after.name}; {expected}, each by the same step.")
    return tuple(path for *_, path in numbered)


def _list(names: Iterable[str]) -> str:
    """Names in a message, of many the first few."""
    every = sorted(names)
    return ", ".join(every[:SHOWN_NAMES]) + (f" … ({len(every)})" if len(every) > SHOWN_NAMES else "")


def read_frames(files: Sequence[LoadedFile], most: int | None = None, fit: Fit | None = None) -> np.ndarray:
    """The frames, uint8 RGB [t h w 3].

    Args:
        files: PNG files in the order of the frames.
        most: number of frames after which reading ends; None for all.
        fit: what is done with each frame before it is kept.

    Raises:
        RolloutError: a file is damaged or not RGB of 8 bits, sizes differ, or they are too large.
    """
    images = map(_read_png, files[:most])
    return stack_frames(files, images if fit is None else map(fit, images))


def _read_png(file: LoadedFile) -> np.ndarray:
    """RGB of 8 bits [h w 3]; other formats and truncated files, which OpenCV would accept, are errors."""
    image = None
    with contextlib.suppress(struct.error, KeyError, cv2.error):
        _check_header(file, _header_chunks(file.content))
        if file.content.rstrip(b"\0").endswith(PNG_END):
            image = cv2.imdecode(np.frombuffer(file.content, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RolloutError(f"{file} is no readable PNG or is cut off; make this rollout again.")
    if image.ndim == 3 and image.shape[2] == 4 and image.dtype == np.uint8:
        image = drop_alpha(file, image)
    check_video(file, image[None])
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _header_chunks(content: bytes) -> dict[bytes, bytes]:
    """Contents of a PNG file's chunks before its pixels, by name. Raises struct.error if it is cut off."""
    chunks: dict[bytes, bytes] = {}
    place, name = 8, b""
    while name != b"IDAT":
        length, name = struct.unpack_from(">I4s", content, place)
        chunks[name] = content[place + 8 : place + 8 + length]
        place += 12 + length
    return chunks


def _check_header(file: LoadedFile, chunks: Mapping[bytes, bytes]) -> None:
    """Check what OpenCV would ignore, and the size before it is decoded.

    Raises:
        RolloutError: the picture is animated, turned, too large, or its pixels are not square.
        struct.error, KeyError: the header is damaged.
    """
    width, height = struct.unpack_from(">II", chunks[b"IHDR"])
    check_size(file, height, width)
    if b"acTL" in chunks:
        raise RolloutError(f"{file} is animated; write each frame as a PNG file.")
    x, y = struct.unpack_from(">II", chunks.get(b"pHYs", PLAIN_PIXELS))
    exif = Image.Exif()
    exif.load(chunks.get(b"eXIf", b""))
    turned = exif.get(ExifTags.Base.Orientation, 1) != 1
    if turned or abs(x - y) * width > max(x, y):
        kind = "turned by its EXIF orientation" if turned else f"of pixels of {y}:{x}"
        raise RolloutError(f"{file} is {kind}, which viewers obey; write it as it is to be seen, without this entry.")

"""Pictures in HDF5 files of others: encoded or raw, decoded to RGB at an episode's size.

RoboTwin's older files encode RGB arrays as if they were BGR, so a viewer shows red as blue. Newer files hold ordinary JPEGs and
mark each of them by a comment.
"""

import io
from collections.abc import Iterator
from typing import Any, Literal

import cv2
import h5py
import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from xew.episode import HEIGHT, WIDTH

Colors = Literal["marked", "ordinary", "swapped"]
"""Encoding of pictures: as each JPEG's comment says, with true colors, or with red and blue swapped."""
RGB_MARK = b"XPL-RGB1"
"""JPEG comment of pictures that are ordinary JPEGs."""
FORMATS = ("JPEG", "PNG")
LARGEST_PICTURE = 4096 * 3072
"""Largest number of pixels of a picture."""
BLOCK = 16
"""Number of pictures that are read from a file at once."""


def read_pictures(stored: h5py.Dataset, colors: Colors, largest: int) -> tuple[np.ndarray, int]:
    """Decode a dataset of encoded pictures [t], or of raw RGB pictures [t h w 3] uint8.

    Args:
        stored: the dataset.
        colors: encoding of its pictures.
        largest: size of all pictures, as they are decoded, that is not exceeded [bytes].

    Returns:
        Video [t HEIGHT WIDTH 3] uint8 RGB, and the width of the stored pictures.

    Raises:
        ValueError: a picture cannot be decoded or has another size or shape than the first, or the pictures are too large.
    """
    if stored.ndim != 4 and (stored.ndim != 1 or stored.dtype.kind not in "SO"):
        raise ValueError(f"is {stored.dtype} {stored.shape}; expected encoded pictures [t], or raw ones uint8 [t h w 3]")
    if len(stored) * HEIGHT * WIDTH * 3 > largest:
        raise ValueError(f"promises {len(stored):,} pictures; expected pictures of {largest:,} bytes at most in such a file")
    video, decoded = np.empty((len(stored), HEIGHT, WIDTH, 3), np.uint8), 0
    sizes: set[tuple[int, ...]] = set()
    for frame, entry in enumerate(_read_blocks(stored)):
        try:
            picture = _check_raw(entry) if stored.ndim == 4 else decode_picture(bytes(entry), colors)
        except ValueError as error:
            raise ValueError(f"at frame {frame} {error}") from error
        decoded += picture.nbytes
        if decoded > largest:
            raise ValueError(f"decodes to more than the {largest:,} bytes that are expected of such a file")
        sizes.add(picture.shape[:2])
        height, width = picture.shape[:2]
        if len(sizes) > 1 or width * HEIGHT != height * WIDTH:
            raise ValueError(f"holds pictures of (height, width) {sorted(sizes)}; expected one size, {WIDTH}:{HEIGHT}")
        fits = (height, width) == (HEIGHT, WIDTH)
        video[frame] = picture if fits else cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return video, next(iter(sizes))[1]


def _read_blocks(stored: h5py.Dataset) -> Iterator[Any]:
    """The entries of a dataset [t ...], read in blocks, because all of them may not fit into memory."""
    for start in range(0, len(stored), BLOCK):
        yield from stored[start : start + BLOCK]


def _check_raw(picture: np.ndarray) -> np.ndarray:
    if picture.dtype != np.uint8 or picture.shape[-1] != 3 or picture.shape[0] * picture.shape[1] > LARGEST_PICTURE:
        raise ValueError(f"is {picture.dtype} {picture.shape}; expected uint8 [h w 3], encoded or raw")
    return picture


def decode_picture(encoded: bytes, colors: Colors = "marked") -> np.ndarray:
    """An encoded picture as uint8 RGB [h w 3].

    Raises:
        ValueError: it cannot be decoded or is too large, or nothing says how its colors were encoded.
    """
    try:
        with Image.open(io.BytesIO(encoded), formats=FORMATS) as image:
            if image.width * image.height > LARGEST_PICTURE:
                raise ValueError(f"has {image.width}x{image.height} pixels")  # before they are decoded
            picture = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
            form, comments = image.format, [content for name, content in getattr(image, "applist", ()) if name == "COM"]
    except UnidentifiedImageError as error:
        raise ValueError(f"begins with {encoded[:8]!r}; expected a JPEG picture") from error
    except Exception as error:  # Pillow raises many types for damaged files
        raise ValueError(f"cannot be decoded: {' '.join(str(error).split())[:100]}; expected a JPEG picture") from error
    if colors == "marked" and form != "JPEG":
        raise ValueError(
            f"is a {form}, which has no place for RoboTwin's mark; pass --colors ordinary if a viewer shows its true colors, "
            "or --colors swapped if red looks blue"
        )
    is_ordinary = colors == "ordinary" or (colors == "marked" and RGB_MARK in comments)
    return picture if is_ordinary else np.ascontiguousarray(picture[..., ::-1])

"""PNG files: their order is certain or refused, and what OpenCV ignores is refused, too."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from xew.files import load_file
from xew.video.checks import RolloutError
from xew.video.frame_files import order_frames, read_frames

PICTURE = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)


def order(*names: str) -> list[str]:
    folder = Path("tree")
    return [path.relative_to(folder).as_posix() for path in order_frames(folder, [folder / name for name in names])]


@pytest.mark.parametrize(
    "names",
    [
        tuple(f"{i}.png" for i in range(12)),
        tuple(f"frame{i}.PNG" for i in range(8, 12)),
        ("frame_0000.png", "frame_0005.png", "frame_0010.png"),
        ("rgb.0098.png", "rgb.0099.png", "rgb.0100.png"),
        ("frames/episode3-frame 9.png", "frames/episode3-frame 10.png"),
        ("seed1000000_1.png", "seed1000000_2.png"),
        ("2026-11-27_000.png", "2026-11-27_001.png"),
        ("кадр-1.png", "кадр-2.png"),
    ],
)
def test_frames_are_in_the_order_of_their_numbers(names: tuple[str, ...]) -> None:
    assert order(*sorted(names, reverse=True)) == list(names)


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (("0.png", "0.06.png", "0.12.png"), "0.06.png, 0.12.png"),
        (("t_0s.png", "t_1s.png"), "t_0s.png, t_1s.png"),
        (("t_0.5.png", "t_1.0.png"), "t_0.5.png, t_1.0.png"),
        (("frame_-1.png", "frame_0.png"), "frame_-1.png"),
        (("-1.png", "-2.png"), "-1.png, -2.png"),
        (("1e-05.png", "0.png"), "*.png, 1e-*.png"),
        (("0_59.png", "1_00.png"), "0_*.png, 1_*.png"),
        (("7f_001.png", "a1_002.png"), "7f_*.png, a1_*.png"),
        (("head_0.png", "wrist_0.png"), "head_*.png, wrist_*.png"),
        (("head/0.png", "wrist/0.png"), "folders head, wrist"),
        (("step0_of_9.png", "step1_of_9.png"), "step0_of_*.png, step1_of_*.png"),
        (("0_rgb.png", "1_rgb.png"), "0_rgb.png, 1_rgb.png"),
        (("0.png", "1.png", "3.png"), "1.png is followed by 3.png"),
        (("0.png", "1.png", "01.png"), "is followed by"),
        (("rgb.png",), "rgb.png"),
    ],
)
def test_an_order_that_is_not_certain_is_refused(names: tuple[str, ...], found: str) -> None:
    with pytest.raises(RolloutError) as error:
        order(*names)
    assert str(error.value).startswith("tree: ") and found in str(error.value) and "0.png, 1.png" in str(error.value)


def test_of_many_names_a_few_are_shown() -> None:
    with pytest.raises(RolloutError, match=r"named 0\.0\.png, 0\.1\.png, 0\.2\.png … \(9\)"):
        order(*(f"0.{i}.png" for i in range(9)))


def chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def saved(path: Path, picture: np.ndarray, mode: str | None = None, *chunks: bytes) -> Path:
    """Write a PNG, with further chunks after its header."""
    image = Image.fromarray(picture)
    (image.convert(mode) if mode else image).save(path)
    content = path.read_bytes()
    path.write_bytes(content[:33] + b"".join(chunks) + content[33:])
    return path


def exif(orientation: int) -> bytes:
    data = Image.Exif()
    data[0x0112] = orientation
    return chunk(b"eXIf", data.tobytes()[6:])


@pytest.mark.parametrize(
    ("mode", "chunks"),
    [(None, ()), ("RGBA", ()), (None, (chunk(b"pHYs", struct.pack(">IIB", 2835, 2835, 1)),)), (None, (exif(1),))],
)
def test_what_changes_nothing_is_accepted(mode: str | None, chunks: tuple[bytes, ...], tmp_path: Path) -> None:
    path = saved(tmp_path / "0.png", PICTURE, mode, *chunks)
    assert (read_frames([load_file(path)]) == PICTURE).all()


def sized(width: int, height: int) -> bytes:
    return chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))


@pytest.mark.parametrize(
    ("chunks", "word"),
    [
        ((chunk(b"acTL", struct.pack(">II", 2, 0)),), "is animated"),
        ((chunk(b"pHYs", struct.pack(">IIB", 1, 2, 0)),), "pixels of 2:1"),
        ((exif(6),), "EXIF orientation"),
        ((sized(100_000, 100_000),), "declares 1 frames of 100000x100000"),
        ((sized(2**31, 1),), "declares 1 frames of 2147483648x1"),
        ((chunk(b"IHDR", b""),), "no readable PNG"),
    ],
)
def test_what_a_viewer_shows_otherwise_is_refused(chunks: tuple[bytes, ...], word: str, tmp_path: Path) -> None:
    path = saved(tmp_path / "0.png", PICTURE, None, *chunks)
    with pytest.raises(RolloutError, match=word) as error:
        read_frames([load_file(path)])
    assert str(path) in str(error.value)


@pytest.mark.parametrize("size", [0, 7, 20, 40, -20])
def test_a_cut_file_is_called_cut(size: int, tmp_path: Path) -> None:
    path = saved(tmp_path / "0.png", PICTURE)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(RolloutError, match="no readable PNG or is cut off"):
        read_frames([load_file(path)])


def test_alpha_that_hides_something_and_16_bits_are_refused(tmp_path: Path) -> None:
    half = np.dstack([PICTURE, np.full(PICTURE.shape[:2], 128, np.uint8)])
    with pytest.raises(RolloutError, match="not opaque"):
        read_frames([load_file(saved(tmp_path / "0.png", half))])


def test_many_frames_are_bounded_and_only_as_many_as_asked_are_decoded(tmp_path: Path) -> None:
    files = [load_file(saved(tmp_path / "0.png", PICTURE))]
    (tmp_path / "1.png").write_bytes(b"broken")
    files.append(load_file(tmp_path / "1.png"))
    assert read_frames(files, most=1, fit=lambda frame: frame[:1]).shape == (1, 1, 32, 3)

"""Containers of any model's making show what players show, are read in bounded memory, or are refused by name."""

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition

from xew.files import load_file
from xew.video.checks import RolloutError
from xew.video.containers import read_container

RATE = Fraction(50, 3)
ONE = 1 << 16
FRAMES, HEIGHT, WIDTH = 8, 48, 64
UPRIGHT = np.zeros((FRAMES, HEIGHT, WIDTH, 3), np.uint8)
UPRIGHT[:, : HEIGHT // 2, : WIDTH // 2] = 220, 30, 30
UPRIGHT[:, HEIGHT // 2 :, WIDTH // 2 :] = 30, 200, 30
UPRIGHT += np.arange(FRAMES, dtype=np.uint8)[:, None, None, None] * 4


def write(
    path: Path,
    video: np.ndarray,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    *,
    rate: Fraction = RATE,
    aspect: Fraction | None = None,
    matrix: list[int] | None = None,
    hidden: int = 0,
    cover: bool = False,
) -> None:
    """Write a video; an edit list hides its first frames, and a cover picture is a second stream."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options={"crf": "8"} if codec == "libx264" else {})
        stream.height, stream.width, stream.pix_fmt = *video.shape[1:3], pixels
        stream.codec_context.sample_aspect_ratio = aspect or Fraction(1)
        if matrix is not None:
            stream.set_display_matrix(matrix)
        if cover:
            picture = container.add_stream("mjpeg", rate=1)
            picture.height, picture.width, picture.pix_fmt = *video.shape[1:3], "yuvj420p"
            picture.disposition = Disposition.attached_pic
        for image in (*video, None):
            frame = None if image is None else av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            for packet in stream.encode(frame):
                if hidden:
                    earlier = int(hidden / rate / packet.time_base)
                    packet.pts, packet.dts = packet.pts - earlier, packet.dts - earlier
                container.mux(packet)
        if cover:
            container.mux(picture.encode(av.VideoFrame.from_ndarray(video[0], format="rgb24")))


def read(path: Path, **options: object) -> np.ndarray:
    return read_container(load_file(path), **options)  # type: ignore[arg-type]


def refusal(path: Path, **options: object) -> str:
    with pytest.raises(RolloutError) as error:
        read(path, **options)
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    return str(error.value)


def difference(video: np.ndarray, expected: np.ndarray = UPRIGHT) -> float:
    assert video.shape == expected.shape
    return float(np.abs(video.astype(int) - expected).mean())


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv"])
@pytest.mark.parametrize(
    ("matrix", "coded"),
    [
        ((ONE, 0, 0, ONE), UPRIGHT),
        ((-ONE, 0, 0, -ONE), UPRIGHT[:, ::-1, ::-1]),
        ((-ONE, 0, 0, ONE), UPRIGHT[:, :, ::-1]),
        ((ONE, 0, 0, -ONE), UPRIGHT[:, ::-1]),
        ((0, ONE, -ONE, 0), np.rot90(UPRIGHT, 1, (1, 2))),
        ((0, -ONE, ONE, 0), np.rot90(UPRIGHT, -1, (1, 2))),
        ((0, ONE, ONE, 0), UPRIGHT.swapaxes(1, 2)),
    ],
    ids=["plain", "half turn", "mirrored", "upside down", "quarter turn", "quarter turn back", "transposed"],
)
def test_a_video_is_read_as_its_display_matrix_shows_it(
    matrix: tuple[int, ...], coded: np.ndarray, name: str, tmp_path: Path
) -> None:
    a, b, c, d = matrix
    write(tmp_path / name, coded, matrix=[a, b, 0, c, d, 0, 0, 0, 1 << 30])
    assert difference(read(tmp_path / name)) < 3


@pytest.mark.parametrize("matrix", [(56756, 32768, -32768, 56756), (2 * ONE, 0, 0, 2 * ONE), (ONE, ONE, 0, ONE)])
def test_other_display_matrices_are_refused(matrix: tuple[int, ...], tmp_path: Path) -> None:
    a, b, c, d = matrix
    write(tmp_path / "a.mp4", UPRIGHT, matrix=[a, b, 0, c, d, 0, 0, 0, 1 << 30])
    assert "quarter turns and mirroring" in refusal(tmp_path / "a.mp4")


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
@pytest.mark.parametrize(("aspect", "shown"), [(Fraction(2), "128x48"), (Fraction(1, 2), "32x48"), (Fraction(16, 15), "68x48")])
def test_pixels_that_are_not_square_are_refused(aspect: Fraction, shown: str, name: str, tmp_path: Path) -> None:
    write(tmp_path / name, UPRIGHT, aspect=aspect)
    message = refusal(tmp_path / name)
    assert f"pixels of {aspect.numerator}:{aspect.denominator}" in message and shown in message


def test_a_stretch_of_less_than_a_pixel_is_none(tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", UPRIGHT, aspect=Fraction(1280, 1281))
    assert difference(read(tmp_path / "a.mp4")) < 3


def test_frames_that_an_edit_list_hides_are_not_missed(tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", UPRIGHT, hidden=3)
    assert difference(read(tmp_path / "a.mp4", frame_rate=float(RATE)), UPRIGHT[3:]) < 3


def test_a_cover_picture_is_no_video(tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", UPRIGHT, cover=True)
    assert difference(read(tmp_path / "a.mp4")) < 3


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [("a.webm", "libvpx-vp9", "yuv420p"), ("a.avi", "libx264", "yuv420p"), ("a.avi", "mjpeg", "yuvj420p")],
)
def test_other_containers_are_read_in_order_at_their_rate(name: str, codec: str, pixels: str, tmp_path: Path) -> None:
    """AVI with B frames, too, whose times FFmpeg gives in the order of storage."""
    write(tmp_path / name, UPRIGHT, codec, pixels)
    assert difference(read(tmp_path / name, frame_rate=float(RATE))) < 8
    assert "16.67 frames per second, its episode 30.00" in refusal(tmp_path / name, frame_rate=30.0)


def test_frames_of_one_time_have_no_rate(tmp_path: Path) -> None:
    write(tmp_path / "a.mkv", UPRIGHT, rate=Fraction(1_000_000))
    assert "several the same" in refusal(tmp_path / "a.mkv", frame_rate=float(RATE))
    assert len(read(tmp_path / "a.mkv")) == FRAMES


def test_a_size_that_changes_is_named(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("mjpeg", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuvj420p"
        container.start_encoding()
        for i, image in enumerate((UPRIGHT[0], UPRIGHT[0, ::2, ::2])):
            encoder = av.CodecContext.create("mjpeg", "w")
            encoder.width, encoder.height, encoder.pix_fmt = *image.shape[1::-1], "yuvj420p"
            encoder.time_base = 1 / RATE
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24").reformat(format="yuvj420p")
            for packet in (*encoder.encode(frame), *encoder.encode()):
                packet.stream, packet.pts, packet.dts, packet.time_base = stream, i, i, 1 / RATE
                container.mux(packet)
    assert "changes its size at frame 1, from 64x48 to 32x24" in refusal(tmp_path / "a.mkv")


def test_reading_ends_after_most_frames(tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", UPRIGHT)
    assert difference(read(tmp_path / "a.mp4", most=3, frame_rate=float(RATE)), UPRIGHT[:3]) < 3


def test_each_frame_is_fitted(tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", UPRIGHT)
    assert difference(read(tmp_path / "a.mp4", fit=lambda frame: frame[::2, ::2]), UPRIGHT[:, ::2, ::2]) < 3


BOMB = """
import resource, sys
from pathlib import Path
from xew.files import load_file
from xew.video.containers import RolloutError, read_container
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    read_container(load_file(Path(sys.argv[1])))
except RolloutError as error:
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024, error)
"""


@pytest.mark.parametrize(
    ("name", "codec", "size", "frames"), [("a.mp4", "mpeg4", (640, 480), 1200), ("a.mkv", "mjpeg", (8192, 4096), 1)]
)
def test_a_bomb_is_refused_by_its_header(name: str, codec: str, size: tuple[int, int], frames: int, tmp_path: Path) -> None:
    """Black frames: a small file declares gigabytes."""
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream(codec, rate=RATE)
        (stream.width, stream.height), stream.pix_fmt = size, "yuvj420p" if codec == "mjpeg" else "yuv420p"
        black = av.VideoFrame.from_ndarray(np.zeros((*size[::-1], 3), np.uint8), format="rgb24")
        content = b"".join(map(bytes, [*stream.encode(black), *stream.encode()]))
        for i in range(frames):
            packet = av.Packet(content)
            packet.stream, packet.pts, packet.dts, packet.time_base = stream, i, i, 1 / RATE
            container.mux(packet)
    done = subprocess.run([sys.executable, "-c", BOMB, str(tmp_path / name)], capture_output=True, text=True, timeout=60)
    megabytes, _, message = done.stdout.partition(" ")
    assert f"declares {frames} frames of {size[0]}x{size[1]}" in message, done.stderr
    assert int(megabytes) < 100


@pytest.mark.parametrize(("name", "codec", "pixels"), [("a.avi", "mjpeg", "yuvj420p"), ("a.webm", "libvpx-vp9", "yuv420p")])
def test_a_file_that_is_cut_off_is_no_video(name: str, codec: str, pixels: str, tmp_path: Path) -> None:
    write(tmp_path / name, UPRIGHT, codec, pixels)
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    assert "make this rollout again" in refusal(tmp_path / name)

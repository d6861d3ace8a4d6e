"""Rollouts of anybody's making are read whole or not at all, and nothing outside their tree is."""

import errno
import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from xew.episode import write_video
from xew.files import digest_files
from xew.rollout import RolloutError, find_rollouts, read_as_graded, read_rollout, read_rollout_video, write_rollout

RATE = 1000 / 60
FRAMES = 12
VIDEO = np.random.default_rng(0).integers(0, 255, (FRAMES, 48, 64, 3), dtype=np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "theirs" / "stack_bowls" / "1000000" / "piper"
    folder.mkdir(parents=True)
    return folder


def write(path: Path, pixels: str = "yuv420p", codec: str = "libx264", times: Callable[[int], int] | None = None) -> None:
    """VIDEO by PyAV, its frames at multiples of 60 ms or where `times` says [ms]."""
    with av.open(str(path), "w", options={"movflags": "faststart"} if path.suffix == ".mp4" else {}) as container:
        stream = container.add_stream(codec, rate=Fraction(RATE).limit_denominator(1000))
        stream.width, stream.height, stream.pix_fmt = VIDEO.shape[2], VIDEO.shape[1], pixels
        stream.codec_context.time_base = Fraction(1, 1000)
        for i, image in enumerate(VIDEO):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pixels)
            frame.pts, frame.time_base = (times or (lambda i: 60 * i))(i), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def read(folder: Path) -> np.ndarray:
    return read_rollout_video(read_rollout(folder), RATE)


def refusal(folder: Path) -> str:
    """The error of reading a folder's rollout, which names the folder."""
    with pytest.raises(RolloutError) as error:
        read(folder)
    assert str(folder) in str(error.value)
    return str(error.value)


def test_what_we_write_is_read_exactly_and_opencvs_too(folder: Path) -> None:
    write_video(folder / "rgb.mkv", VIDEO)
    assert (read(folder) == VIDEO).all()
    writer = cv2.VideoWriter(str(folder / "rgb.mkv"), cv2.VideoWriter_fourcc(*"FFV1"), RATE, (VIDEO.shape[2], VIDEO.shape[1]))
    for frame in VIDEO:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()
    assert (read(folder) == VIDEO).all()


def write_png(path: Path) -> None:
    cv2.imwrite(str(path), VIDEO[0])


@pytest.mark.parametrize(
    ("name", "store"),
    [("rgb.mkv", lambda path: write(path)), ("v.npz", lambda path: np.savez(path, VIDEO)), ("0.png", write_png)],
)
def test_what_is_read_has_the_digest_that_was_asked_for(name: str, store: Callable[[Path], None], folder: Path) -> None:
    store(folder / name)
    rollout = read_rollout(folder)
    digest = digest_files(rollout.video)
    assert read_rollout_video(rollout, digest=digest).shape[1:] == VIDEO.shape[1:]
    (folder / name).write_bytes((folder / name).read_bytes() + b"0")
    with pytest.raises(RolloutError, match="was replaced while this command ran"):
        read_rollout_video(rollout, digest=digest)


@pytest.mark.parametrize("name", ["rgb.mkv", "rgb.mp4"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.95, 0.98])
def test_a_file_that_is_cut_off_is_no_video(folder: Path, name: str, share: float) -> None:
    write(folder / name)
    whole = (folder / name).read_bytes()
    assert read(folder).shape == VIDEO.shape
    (folder / name).write_bytes(whole[: int(share * len(whole))])
    message = refusal(folder)
    assert name in message and "make this rollout again" in message


def test_bits_that_are_lost_are_not_painted_over(folder: Path) -> None:
    write(folder / "rgb.mp4")
    content = bytearray((folder / "rgb.mp4").read_bytes())
    lost = len(content) // 4  # a few bytes less may by chance read as another picture
    content[len(content) // 2 : len(content) // 2 + lost] = bytes(lost)
    (folder / "rgb.mp4").write_bytes(content)
    assert "make this rollout again" in refusal(folder)


@pytest.mark.parametrize(
    ("pixels", "codec", "word"),
    [("gray", "ffv1", "gray frames"), ("yuv420p10le", "ffv1", "10 bits a channel"), ("yuva420p", "ffv1", None)],
)
def test_only_rgb_of_8_bits_is_read(folder: Path, pixels: str, codec: str, word: str | None) -> None:
    write(folder / "rgb.mkv", pixels, codec)
    if word is None:  # alpha that hides nothing
        assert read(folder).shape == VIDEO.shape
    else:
        assert word in refusal(folder)


def test_alpha_that_hides_something_is_an_error(folder: Path) -> None:
    with av.open(str(folder / "rgb.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=16)
        stream.width, stream.height, stream.pix_fmt = VIDEO.shape[2], VIDEO.shape[1], "bgra"
        half = np.full((*VIDEO.shape[1:3], 1), 128, np.uint8)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(np.concatenate([VIDEO[0], half], -1), format="rgba")))
        container.mux(stream.encode())
    assert "alpha" in refusal(folder)


def test_a_changing_rate_is_an_error_and_rounding_is_none(folder: Path) -> None:
    write(folder / "rgb.mkv", times=lambda i: 60 * i + i % 2)
    assert read(folder).shape == VIDEO.shape
    for times in (lambda i: 60 * i + 30 * (i % 2), lambda i: 60 * i + (60 if i > 5 else 0)):
        write(folder / "rgb.mkv", times=times)
        message = refusal(folder)
        assert "variable frame rate" in message and "--allow rate" in message
        assert len(read_rollout_video(read_rollout(folder))) == FRAMES
    write(folder / "rgb.mkv", times=lambda i: 40 * i)
    assert "25.00 frames per second, its episode 16.67" in refusal(folder)


def png(folder: Path, number: int, image: np.ndarray) -> Path:
    path = folder / f"{number}.png"
    assert cv2.imwrite(str(path), image)
    return path


def test_pngs_are_in_the_order_of_their_numbers_and_are_whole(folder: Path) -> None:
    for i, frame in enumerate(VIDEO):
        png(folder, i, cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    assert (read(folder) == VIDEO).all()
    path = folder / "7.png"
    path.write_bytes(path.read_bytes()[:-30])
    message = refusal(folder)
    assert "7.png" in message and "cut off" in message
    path.write_bytes(b"")
    message = refusal(folder)
    assert "7.png" in message and "no readable PNG" in message
    path.unlink()
    path.mkdir()
    message = refusal(folder)
    assert "7.png" in message and "cannot be read" in message
    path.rmdir()
    for image, word in (
        (VIDEO[0][..., 0], "gray"),
        (np.dstack([VIDEO[0], VIDEO[0][..., :1]]), "alpha"),
        (VIDEO[0].astype(np.uint16), "uint16"),
        (VIDEO[0][:-1], "changes its size at frame 7"),
    ):
        png(folder, 7, image)
        message = refusal(folder)
        assert "7.png" in message and word in message


@pytest.mark.parametrize(
    ("arrays", "word"),
    [
        ({"a": VIDEO / np.float32(255)}, "float32"),
        ({"a": np.full(VIDEO.shape, np.nan)}, "NaN"),
        ({"a": VIDEO.astype(np.int64)}, "int64"),
        ({"a": VIDEO[:0]}, "no frame"),
        ({"a": VIDEO[..., 0]}, "gray"),
        ({"a": VIDEO[..., :1]}, "gray"),
        ({"a": np.concatenate([VIDEO, VIDEO[..., :1]], -1)}, "alpha"),
        ({"a": np.array([{}], object)}, "damaged"),
        ({"a": VIDEO, "b": VIDEO}, "['a', 'b']"),
        ({}, "[]"),
    ],
)
def test_an_array_that_is_no_video_is_named_as_what_it_is(folder: Path, arrays: dict, word: str) -> None:
    np.savez(folder / "rgb.npz", **arrays)
    message = refusal(folder)
    assert "rgb.npz" in message and word in message


def test_links_out_of_the_tree_are_not_followed(folder: Path, tmp_path: Path) -> None:
    write_video(tmp_path / "secret.mkv", VIDEO)
    (folder / "rgb.mkv").symlink_to(tmp_path / "secret.mkv")
    message = refusal(folder)
    assert "secret.mkv" in message and "is not below" in message
    (folder / "rgb.mkv").unlink()
    write_video(folder / "rgb.mkv", VIDEO)
    (folder / "rollout.json").symlink_to(tmp_path / "elsewhere.json")
    (tmp_path / "elsewhere.json").write_text("{}")
    message = refusal(folder)
    assert "elsewhere.json" in message and "is not below" in message
    (folder / "rollout.json").unlink()
    (folder / "rollout.json").symlink_to("rollout.json")
    message = refusal(folder)
    assert "rollout.json" in message and "cannot be resolved" in message
    (folder / "rollout.json").unlink()
    folder.rename(tmp_path / "moved")
    folder.symlink_to(tmp_path / "moved")
    message = refusal(folder)
    assert "moved" in message and "is not below" in message
    linked = tmp_path / "linked"
    folder.unlink()
    (tmp_path / "moved").rename(folder)
    linked.symlink_to(folder.parents[2])
    assert len(find_rollouts(linked)) == 1, "the tree itself may be a link"


@pytest.mark.parametrize("name", ["../up", "/etc/passwd", "~root", "a/../../b", "..", "a\\b", "line\nbreak", 3, None, ["a"]])
@pytest.mark.parametrize("key", ["model", "condition"])
def test_a_name_is_a_name(folder: Path, key: str, name: object) -> None:
    np.savez(folder / "rgb.npz", VIDEO)
    (folder / "rollout.json").write_text(json.dumps({key: name}))
    message = refusal(folder)
    assert "rollout.json" in message and key in message


def test_names_with_a_slash_are_fine(folder: Path) -> None:
    np.savez(folder / "rgb.npz", VIDEO)
    (folder / "rollout.json").write_text(json.dumps({"model": "lab/model-1..2", "condition": "flow + clip"}))
    assert read_rollout(folder).model == "lab/model-1..2"


def test_problems_are_told_one_by_one_if_asked(folder: Path) -> None:
    np.savez(folder / "rgb.npz", VIDEO)
    other = folder.with_name("franka_panda")
    other.mkdir()
    with pytest.raises(RolloutError, match="franka_panda"):
        find_rollouts(folder.parents[2])
    problems: list[str] = []
    assert [rollout.robot for rollout in find_rollouts(folder.parents[2], problems)] == ["piper"]
    assert len(problems) == 1 and str(other) in problems[0]


@pytest.mark.parametrize("name", ["RGB.MKV", "video.Mp4", "a b.mov", "prédiction.avi"])
def test_endings_in_any_case_are_videos_and_hidden_files_are_none(folder: Path, name: str) -> None:
    write(folder / f"rgb{Path(name).suffix.lower()}", codec="mpeg4")
    (folder / f"rgb{Path(name).suffix.lower()}").rename(folder / name)
    (folder / f"._{name}").write_bytes(b"\0\5\x16\7")
    (folder / ".cache").mkdir()
    (folder / ".cache" / "0.png").write_bytes(b"")
    assert read_rollout(folder).video == (folder / name,)
    assert read(folder).shape == VIDEO.shape


def test_what_is_found_instead_of_a_video_is_named(folder: Path) -> None:
    for name in ("0.jpg", "1.jpg", "rgb.gif", "rollout.json"):
        (folder / name).write_text("{}")
    assert "found videos none and 0 PNG files, 1 .gif, 2 .jpg; expected one video (.mkv, .mp4, .mov" in refusal(folder)


def test_an_npz_of_zeros_is_no_bomb(folder: Path) -> None:
    np.savez_compressed(folder / "rgb.npz", np.zeros((1000, 480, 640, 3), np.uint8))
    assert "unpack to 921600" in refusal(folder)


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("size", [(24, 32), (12, 16), (48, 64)])
def test_a_rollout_is_shown_as_it_was_graded(size: tuple[int, int], given: bool, folder: Path) -> None:
    """At the episode's size, frame by frame, and no longer than the episode."""
    truth = np.full((FRAMES, 24, 32, 3), 40, np.uint8) + np.arange(FRAMES, dtype=np.uint8)[:, None, None, None] * 10
    np.savez(folder / "rgb.npz", np.stack([cv2.resize(frame, size[::-1]) for frame in (*truth[not given :], truth[0])]))
    assert np.array_equal(read_as_graded(read_rollout(folder), truth, given), truth)


def test_a_file_larger_than_memory_is_not_read(folder: Path) -> None:
    with (folder / "rgb.mp4").open("wb") as file:
        file.truncate(2**40)
    assert "to 1099511627776 bytes, expected at most 1073741824" in refusal(folder)


def test_a_full_disk_is_said_without_the_temporary_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, *arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr("xew.rollout.write_video", full)
    with pytest.raises(RolloutError) as error:
        write_rollout(tmp_path, "stack_bowls", 7, "piper", VIDEO, {})
    assert str(error.value).endswith("piper: No space left on device. Free some space or choose another --out.")
    assert ".writing" not in str(error.value)

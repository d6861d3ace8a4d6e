"""The contract between rooms: what is written is what is read, exactly, and what is damaged says so."""

import errno
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from xew import episode
from xew.dataset import find_accepted, find_records, read_dataset, remove_left_overs
from xew.episode import (
    HEIGHT,
    SCHEMA_VERSION,
    WIDTH,
    EpisodeError,
    Record,
    States,
    array_hash,
    episode_folder,
    read_npz,
    read_pixels,
    read_record,
    read_states,
    read_video,
    states_hash,
    verify_episode,
    write_episode,
    write_video,
)
from xew.names import name_of_folder

ROOT = Path(__file__).parents[1]
FRAMES, OBJECTS, KEYPOINTS = 5, 2, 3


def some_states(seed: int = 0) -> States:
    rng = np.random.default_rng(seed)

    def number(*shape: int) -> np.ndarray:
        return rng.normal(size=(FRAMES, *shape)).astype(np.float32)

    def flag(*shape: int) -> np.ndarray:
        return rng.random((FRAMES, *shape)) < 0.5

    return States(
        number(16), number(16), number(16), number(2, 7), number(OBJECTS, 7), number(OBJECTS), flag(2, OBJECTS),
        number(OBJECTS), number(KEYPOINTS, 2), flag(KEYPOINTS), flag(HEIGHT, WIDTH),
        rng.normal(size=(3, 3)), rng.normal(size=(4, 4)),
    )  # fmt: skip


def noise(seed: int = 0, frames: int = FRAMES) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (frames, HEIGHT, WIDTH, 3), dtype=np.uint8)


RECORD = Record(
    "grab_roller", 7, "piper", True, None, "", "use both arms", FRAMES, 1000 / 60, ("roller", "cup"),
    ("left/link1", "left/link2", "left/link3"), "abc", {}, {"xew": "0"}, "a processor",
)  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_episode(tmp_path, RECORD, some_states(), noise(1), noise(2))


def test_every_field_comes_back(folder: Path) -> None:
    record, states, expected = read_record(folder), read_states(folder), some_states()
    assert record == replace(RECORD, hashes=record.hashes, files=record.files)
    assert set(record.hashes) == {"states", "rgb", "robot"} and set(record.files) == {"states.npz", "rgb.mkv", "robot.mkv"}
    for field in fields(States):
        found, wanted = getattr(states, field.name), getattr(expected, field.name)
        assert found.dtype == wanted.dtype, field.name
        np.testing.assert_array_equal(found, wanted, err_msg=field.name)
    assert states.frame_count == FRAMES
    assert verify_episode(folder) == record


def test_an_unchanged_episode_of_the_head_camera_has_the_header_of_versions_without_views_and_changes(folder: Path) -> None:
    header = (folder / "episode.json").read_text()
    assert not {"camera", "change"} & json.loads(header).keys()


def test_a_folder_says_task_seed_and_robot(folder: Path, tmp_path: Path) -> None:
    assert folder == episode_folder(tmp_path, "grab_roller", 7, "piper") == tmp_path / "grab_roller" / "0000007" / "piper"
    assert sorted(path.name for path in folder.iterdir()) == ["episode.json", "rgb.mkv", "robot.mkv", "states.npz"]


@pytest.mark.parametrize("video", [noise(3), np.zeros((2, HEIGHT, WIDTH, 3), np.uint8), noise(4, frames=30)])
def test_video_is_exact(video: np.ndarray, tmp_path: Path) -> None:
    write_video(tmp_path / "v.mkv", video)
    np.testing.assert_array_equal(read_video(tmp_path / "v.mkv"), video)
    assert cv2.VideoCapture(str(tmp_path / "v.mkv")).get(cv2.CAP_PROP_FPS) == pytest.approx(1000 / 60, rel=1e-3)


def test_hashes_see_type_shape_and_every_bit() -> None:
    array = np.arange(6, dtype=np.float32)
    others = [array.astype(np.float64), array.reshape(2, 3), np.nextafter(array, np.float32(9)), array[::-1]]
    assert len({array_hash(a) for a in [array, *others]}) == 5
    assert array_hash(np.asfortranarray(array.reshape(2, 3))) == array_hash(array.reshape(2, 3))
    states = some_states()
    touched = replace(states, contact=~states.contact)
    assert states_hash(states) == states_hash(some_states()) != states_hash(touched)


def test_writing_again_replaces_all_of_it(folder: Path, tmp_path: Path) -> None:
    rejected = replace(RECORD, success=False, failure="slip", failure_detail="lost")
    assert write_episode(tmp_path, rejected) == folder
    assert [path.name for path in folder.iterdir()] == ["episode.json"]
    assert read_record(folder) == replace(rejected, hashes={})


def edit(folder: Path, **changes: object) -> None:
    header = json.loads((folder / "episode.json").read_text())
    (folder / "episode.json").write_text(json.dumps(header | changes))


def test_another_schema_version_is_refused(folder: Path) -> None:
    edit(folder, schema_version=SCHEMA_VERSION + 1)
    with pytest.raises(EpisodeError, match=f"schema version {SCHEMA_VERSION + 1}, expected {SCHEMA_VERSION}; generate"):
        read_record(folder)


def flip_a_byte(path: Path) -> None:
    """In the middle, where a video has its pixels."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x5A
    path.write_bytes(content)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize("name", ["states.npz", "rgb.mkv", "robot.mkv"])
@pytest.mark.parametrize("damage", [flip_a_byte, cut, Path.unlink])
def test_damage_is_found_and_named(folder: Path, name: str, damage: object) -> None:
    damage(folder / name)  # type: ignore[operator]
    with pytest.raises(EpisodeError, match=r"piper.*(damaged|missing|does not exist|has hash)"):
        verify_episode(folder)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"schema_version": 2}', '{"schema_version": 2, "object_names": []}', "\udcff"]
)
def test_a_broken_header_is_named(folder: Path, text: str) -> None:
    (folder / "episode.json").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(EpisodeError, match=r"episode.json is damaged .*; delete its folder and run generate again"):
        read_record(folder)


def flip_bits(folder: Path) -> None:
    """In the packets of the first frames, so that FFmpeg by itself would conceal them."""
    path, rng = folder / "rgb.mkv", np.random.default_rng(1)
    content = bytearray(path.read_bytes())
    for place in rng.integers(1000, len(content) // 5, 40):
        content[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(content)


def exchange(folder: Path) -> None:
    shutil.copy(folder / "robot.mkv", folder / "rgb.mkv")


def add_a_frame(folder: Path) -> None:
    write_video(folder / "rgb.mkv", np.concatenate([noise(1), noise(2)]))


@pytest.mark.parametrize("earlier", [False, True], ids=["", "without digests of files"])
@pytest.mark.parametrize("damage", [flip_bits, exchange, add_a_frame])
def test_a_video_is_that_of_its_header(damage: Callable[[Path], None], earlier: bool, folder: Path) -> None:
    if earlier:
        edit(folder, files={})
    np.testing.assert_array_equal(read_pixels(folder, "rgb"), noise(1))
    np.testing.assert_array_equal(read_pixels(folder, "rgb", most=2), noise(1)[:2])
    damage(folder)
    for most in (1, None):
        with pytest.raises(EpisodeError, match=r"piper.*(is damaged: it holds|rgb has hash .*, expected)"):
            read_pixels(folder, "rgb", most)


@pytest.mark.parametrize("most", [None, 9])
def test_a_video_is_as_long_as_its_header_says(most: int | None, folder: Path) -> None:
    edit(folder, frame_count=9)
    with pytest.raises(EpisodeError, match="has 5 frames, its header says 9"):
        read_pixels(folder, "rgb", most)


def test_a_video_that_was_encoded_again_is_compared_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(folder / "rgb.mkv", noise(1), frame_rate=25)
    hashed: list[int] = []
    monkeypatch.setattr(episode, "array_hash", lambda video: hashed.append(len(video)) or array_hash(video))
    for _ in range(3):
        np.testing.assert_array_equal(read_pixels(folder, "rgb", 1), noise(1)[:1])
    assert hashed == [FRAMES]


def test_frames_of_any_size_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episode, "MOST_PIXELS", WIDTH * HEIGHT - 1)
    write_video(tmp_path / "v.mkv", noise())
    with pytest.raises(EpisodeError, match="frames of 320x240 pixels"):
        read_video(tmp_path / "v.mkv")


def test_only_the_readers_of_this_module_decode_episodes() -> None:
    """Others read them by `read_pixels`, which compares what it reads."""
    sources = [*(ROOT / "xew").rglob("*.py"), *(ROOT / "lab").rglob("*.py")]
    assert [path.name for path in sources if re.search(r"\bread_video\b", path.read_text())] == ["episode.py"]


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("action", lambda a: a[:, :3], "action is float32 [5, 3], expected float32 [5, 16]"),
        ("action", lambda a: a[:-1], "joint_pos is float32 [5, 16], expected float32 [4, 16]"),
        ("joint_vel", lambda a: a.astype(np.float64), "joint_vel is float64 [5, 16], expected float32 [5, 16]"),
        ("tool_pose", lambda a: a[:, :1], "tool_pose is float32 [5, 1, 7], expected float32 [5, 2, 7]"),
        ("object_pose", lambda a: np.float32(1), "object_pose is float32 [], expected float32 [5, 'o', 7]"),
        ("object_joint", lambda a: a[:, :1], "object_joint is float32 [5, 1], expected float32 [5, 2]"),
        ("contact", lambda a: a.astype(np.uint8), "contact is uint8 [5, 2, 2], expected bool [5, 2, 2]"),
        ("penetration", lambda a: a * np.inf, "penetration has NaN or infinite numbers"),
        ("keypoints", lambda a: a[:, :2], "keypoint_visible is bool [5, 3], expected bool [5, 2]"),
        ("keypoints", lambda a: a * np.nan, "keypoints has NaN or infinite numbers"),
        ("robot_mask", lambda a: np.uint8(1), "is damaged"),
        ("robot_mask", lambda a: a[:3], "robot_mask is bool [3, 240, 320], expected bool [5, 240, 320]"),
        ("robot_mask", lambda a: a.astype(np.float32), "is damaged"),
        ("intrinsics", lambda a: a[:2], "intrinsics is float64 [2, 3], expected float64 [3, 3]"),
        ("extrinsics", lambda a: a.astype(object), "is damaged"),
        ("keypoint_visible", lambda a: None, "is damaged"),
    ],
)  # fmt: skip
def test_states_of_another_form_are_refused(name: str, change: Callable, said: str, folder: Path) -> None:
    with np.load(folder / "states.npz") as stored:
        arrays = dict(stored)
    np.savez(folder / "states.npz", **arrays | {name: change(arrays[name])})
    edit(folder, files={})
    with pytest.raises(EpisodeError, match=re.escape(said)):
        read_states(folder)


def test_states_are_those_of_their_header(folder: Path, tmp_path: Path) -> None:
    other = write_episode(tmp_path, replace(RECORD, seed=8), some_states(1))
    shutil.copy(other / "states.npz", folder / "states.npz")
    with pytest.raises(EpisodeError, match=r"piper: states has hash .*, expected"):
        read_states(folder)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frame_count": 9}, "5 frames, its header 9"),
        ({"object_names": ["cup"]}, "2 objects, its header 1"),
        ({"keypoint_names": []}, "3 keypoints, its header 0"),
    ],
)
def test_states_fit_their_header(change: dict[str, object], said: str, folder: Path) -> None:
    edit(folder, **change)
    with pytest.raises(EpisodeError, match=said):
        read_states(folder)


def test_numbers_that_are_unknown_or_out_of_sight_may_be_nan(tmp_path: Path) -> None:
    states = some_states()
    states.keypoints[~states.keypoint_visible] = np.nan
    unknown = replace(states, joint_pos=states.joint_pos * np.nan)
    write_episode(tmp_path, replace(RECORD, source="elsewhere", unknown=("joint_pos",)), unknown)
    assert np.isnan(read_states(episode_folder(tmp_path, "grab_roller", 7, "piper")).joint_pos).all()


def test_an_archive_that_unpacks_to_gigabytes_is_not_unpacked(folder: Path) -> None:
    np.savez_compressed(folder / "states.npz", action=np.zeros(2**28, np.uint8))
    assert (folder / "states.npz").stat().st_size < 300_000
    with pytest.raises(EpisodeError, match=r"is damaged \(\d+ bytes unpack to 2684\d+\)"):
        read_states(folder)
    np.savez_compressed(folder / "states.npz", mask=np.zeros(2**26, bool))
    assert read_npz(folder / "states.npz")["mask"].nbytes == 2**26


@pytest.mark.parametrize("place", ["grab_roller/0000007/ur5_wsg", "grab_roller/0000008/piper", "lift_pot/0000007/piper"])
def test_a_folder_that_was_copied_or_renamed_is_refused(place: str, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / place)
    for read in (read_record, read_states, verify_episode, lambda folder: read_pixels(folder, "rgb")):
        with pytest.raises(EpisodeError, match=r"is the header of grab_roller/0000007/piper, in a folder that was copied"):
            read(tmp_path / place)
    problems: list[str] = []
    assert [found for found, _ in read_dataset(tmp_path, problems).cells] == [folder] and len(problems) == 1


def test_a_folder_may_be_named_in_any_way_that_leads_there(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "linked").symlink_to(tmp_path)
    monkeypatch.chdir(folder)
    for named in (Path(), Path("../piper"), tmp_path / "linked" / folder.relative_to(tmp_path), folder / ".." / "piper"):
        assert read_record(named).robot == "piper"


def test_an_unknown_key_and_an_unknown_hash_are_named(folder: Path) -> None:
    edit(folder, hashes={"depth": "0"})
    with pytest.raises(EpisodeError, match="names a hash of 'depth', expected states, rgb, robot"):
        verify_episode(folder)
    edit(folder, color="red")
    with pytest.raises(EpisodeError, match="color"):
        read_record(folder)


def test_what_does_not_exist_is_told_with_the_way_to_make_it(tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match=r"does not exist; `python -m xew.sim_warp.generate` makes episodes"):
        read_record(tmp_path)
    with pytest.raises(EpisodeError, match="the cell was rejected or its folder is damaged"):
        read_states(tmp_path)
    with pytest.raises(EpisodeError, match=r"no accepted episode under .* --out"):
        find_accepted(tmp_path)


@pytest.mark.parametrize("inside", ["grab_roller", "grab_roller/0000003", "grab_roller/0000003/piper"])
def test_a_part_of_a_data_set_is_told_from_an_empty_folder(inside: str, tmp_path: Path) -> None:
    write_episode(tmp_path, Record("grab_roller", 3, "piper", False, "grasp"))
    with pytest.raises(EpisodeError) as error:
        find_accepted(tmp_path / inside)
    assert str(error.value) == f"{tmp_path / inside} lies inside a data set; pass the data set's root: {tmp_path}."


def cells(data: Path, seed: int, **successes: bool | None) -> None:
    """Write cells of one seed: True with an episode, False failed, None succeeded but without pictures."""
    for robot, success in successes.items():
        record = replace(
            RECORD, seed=seed, robot=robot, success=success is not False, failure="slip" if success is False else None
        )
        write_episode(data, record, some_states() if success else None)


def test_a_seed_counts_only_when_all_robots_succeeded(tmp_path: Path) -> None:
    cells(tmp_path, 0, piper=True, arx_x5=True)
    cells(tmp_path, 1, piper=False, arx_x5=None)
    cells(tmp_path, 2, arx_x5=None)  # stopped before piper was written
    cells(tmp_path, 3, piper=True, arx_x5=False)
    found = [(record.seed, record.robot) for _, record in find_accepted(tmp_path)]
    assert found == [(0, "arx_x5"), (0, "piper")]
    assert [(record.seed, record.robot, record.success) for _, record in find_records(tmp_path)] == [
        (0, "arx_x5", True), (0, "piper", True), (1, "arx_x5", True), (1, "piper", False),
        (2, "arx_x5", True), (3, "arx_x5", False), (3, "piper", True),
    ]  # fmt: skip


def test_half_written_episodes_are_not_found_and_can_be_swept(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as killed:  # as if the process had gone before it could clean up
        killed.setattr(episode.shutil, "rmtree", lambda *args, **kwargs: None)
        killed.setattr(episode.os, "rename", lambda *args: (_ for _ in ()).throw(OSError(errno.EIO, "gone")))
        with pytest.raises(EpisodeError):
            write_episode(tmp_path, replace(RECORD, robot="arx_x5"), some_states())
    (tmp_path / "grab_roller" / "0000007" / ".a-folder-of-the-user").mkdir()
    assert len(list(folder.parent.iterdir())) == 3
    assert [found for found, _ in find_records(tmp_path)] == [folder]
    remove_left_overs(tmp_path)
    assert sorted(path.name for path in folder.parent.iterdir()) == [".a-folder-of-the-user", "piper"]


@pytest.mark.parametrize("name", ["write_video", "np.savez_compressed"])
def test_a_full_disk_leaves_what_was_there(folder: Path, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: object, **kwargs: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    before = read_record(folder)
    monkeypatch.setattr(f"xew.episode.{name}", full)
    with pytest.raises(EpisodeError, match=r"No space left on device. Free some space or choose another --out"):
        write_episode(tmp_path, RECORD, some_states(1), noise(5), noise(6))
    monkeypatch.undo()
    assert verify_episode(folder) == before
    assert [path.name for path in folder.parent.iterdir()] == ["piper"]


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from tests.test_episode import RECORD, noise, some_states
from xew.episode import EpisodeError, write_episode
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, 1_500_000))
try:
    write_episode(Path(sys.argv[1]), RECORD, None, noise(0, frames=20))
except EpisodeError as error:
    print(error)
"""


def test_a_video_that_does_not_fit_is_not_taken_for_one(tmp_path: Path) -> None:
    """A real limit on the size of files."""
    run = subprocess.run([sys.executable, "-c", FULL_DISK, str(tmp_path)], capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert "cannot write the episode" in run.stdout and "File too large" in run.stdout, run.stderr
    assert list((tmp_path / "grab_roller" / "0000007").iterdir()) == []


def test_a_file_in_the_way_is_told(tmp_path: Path) -> None:
    (tmp_path / "grab_roller").write_text("not a folder")
    with pytest.raises(EpisodeError, match=r"cannot write the episode .*piper"):
        write_episode(tmp_path, RECORD)


def test_folders_have_no_colon(tmp_path: Path) -> None:
    """Windows allows none, and scp takes what is before one for a host; folders of earlier versions have one and are found."""
    folder = episode_folder(tmp_path, "my_tasks:TASK", 3, "lab:ROBOT")
    assert folder == tmp_path / "my_tasks@TASK" / "0000003" / "lab@ROBOT"
    assert [name_of_folder(part) for part in (folder.parts[-3], folder.name)] == ["my_tasks:TASK", "lab:ROBOT"]
    earlier = tmp_path / "my_tasks:TASK" / "0000003" / "lab:ROBOT"
    earlier.mkdir(parents=True)
    assert episode_folder(tmp_path, "my_tasks:TASK", 3, "lab:ROBOT") == earlier


def test_others_may_read_what_the_user_s_mask_lets_them(tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    folder = write_episode(tmp_path / "data", Record("task", 0, "robot", False, "plan"))
    assert folder.stat().st_mode == (tmp_path / "plain").stat().st_mode

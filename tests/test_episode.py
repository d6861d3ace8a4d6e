"""The contract between rooms: what is written is what is read, exactly, and what is damaged says so."""

import errno
import json
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from xew import episode
from xew.dataset import find_accepted, find_records
from xew.episode import (
    HEIGHT,
    SCHEMA_VERSION,
    WIDTH,
    EpisodeError,
    Record,
    States,
    array_hash,
    episode_folder,
    read_record,
    read_states,
    read_video,
    remove_left_overs,
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
    "grab_roller", 7, "piper", True, None, "", "use both arms", FRAMES, 1000 / 60, ("roller",), ("left/link1",), "abc", {},
    {"xew": "0"}, "a processor",
)  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_episode(tmp_path, RECORD, some_states(), noise(1), noise(2))


def test_every_field_comes_back(folder: Path) -> None:
    record, states, expected = read_record(folder), read_states(folder), some_states()
    assert record == replace(RECORD, hashes=record.hashes) and set(record.hashes) == {"states", "rgb", "robot"}
    for field in fields(States):
        found, wanted = getattr(states, field.name), getattr(expected, field.name)
        assert found.dtype == wanted.dtype, field.name
        np.testing.assert_array_equal(found, wanted, err_msg=field.name)
    assert states.frame_count == FRAMES
    assert verify_episode(folder) == record


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

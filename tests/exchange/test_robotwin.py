"""RoboTwin's HDF5 files become episodes: colors, quaternions, commands, what stays unknown, and what is told of bad files."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from tests.exchange import robotwin_file as made
from xew.dataset import find_accepted
from xew.episode import (
    HEIGHT,
    WIDTH,
    EpisodeError,
    Record,
    demand_known,
    read_record,
    read_states,
    read_video,
    verify_episode,
    write_episode,
)
from xew.exchange import robotwin
from xew.exchange.hdf5 import ReadOptions, read_robotwin, tool_center
from xew.exchange.pictures import Colors, decode_picture
from xew.exchange.robotwin import Args, find_episodes, fit_bases, import_all, main
from xew.protocol import LEFT_ARM, LEFT_GRIPPER, RIGHT_ARM, RIGHT_GRIPPER
from xew.sim_warp.geometry.camera import HEAD_CAMERA
from xew.sim_warp.robots import ROBOTS, get_robot

LEGACY = Path("place_cup/ARX-X5_clean_50/data/episode3.hdf5")
MODERN = Path("demo_clean/place_cup/ARX-X5/data/episode_0000003.hdf5")
ROBOT = "arx_x5_robotwin"


@pytest.fixture(scope="module", params=["legacy", "1.0"])
def imported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an episode that was imported from either layout."""
    root = tmp_path_factory.mktemp("imported")
    if request.param == "legacy":
        made.write_legacy(root / LEGACY)
        (root / LEGACY.parents[1] / "seed.txt").write_text("0 1 5 17 ")
    else:
        made.write_modern(root / MODERN)
    records, refused = import_all(find_episodes(root), Args(root, root / "out"))
    assert not refused and len(records) == 1
    return next((root / "out").glob("*/*/*/episode.json")).parent


def test_a_red_block_stays_red(imported: Path) -> None:
    block = read_video(imported / "rgb.mkv")[:, HEIGHT // 4 + 8 : HEIGHT // 2 - 8, WIDTH // 4 + 8 : WIDTH // 2 - 8]
    assert np.abs(block.reshape(-1, 3).astype(int) - made.RED).max() <= 4, "what JPEG does to a flat color"


def test_a_quaternion_stays_itself(imported: Path) -> None:
    found, expected = read_states(imported).tool_pose, made.tool_poses()
    assert np.abs(found[..., :3] - expected[..., :3]).max() < 1e-6
    assert np.abs(np.abs((found[..., 3:] * expected[..., 3:]).sum(-1)) - 1).max() < 1e-6
    assert np.abs(expected[..., 3] - expected[..., 6]).min() > 0.05, "where x and w differ the order shows"


def test_drive_targets_are_commands_and_nothing_is_made_up(imported: Path) -> None:
    states, record = read_states(imported), read_record(imported)
    assert np.allclose(states.action[:, LEFT_ARM][:, :6], made.joints()[:, 0]) and (states.action[:, 6] == 0).all()
    assert np.allclose(states.action[:, RIGHT_ARM][:, :6], made.joints()[:, 1])
    assert np.allclose(states.action[:, [LEFT_GRIPPER, RIGHT_GRIPPER]], made.grippers())
    assert set(record.unknown) == set(robotwin.UNKNOWN)
    assert np.isnan(states.joint_pos).all() and np.isnan(states.joint_vel).all() and not states.robot_mask.any()
    assert states.object_pose.shape == (made.FRAMES, 0, 7) and record.object_names == ()
    demand_known(imported, "action", "tool_pose")
    with pytest.raises(EpisodeError, match=r"imported from RoboTwin HDF5.*does not record joint_pos, robot_mask; exclude it"):
        demand_known(imported, "joint_pos", "action", "robot_mask")


def test_the_header_says_where_it_comes_from(imported: Path) -> None:
    record = verify_episode(imported)
    assert (record.task, record.robot, record.success, record.frame_count) == ("place_cup", ROBOT, True, made.FRAMES)
    assert record.seed == (17 if record.source.endswith("(legacy)") else 3), "by seed.txt, or the number of the file"
    assert record.instruction == "put the block on the mat"
    assert find_accepted(imported.parents[2]) == [(imported, record)]


def test_the_camera_is_the_file_s(imported: Path) -> None:
    states = read_states(imported)
    assert np.allclose(states.intrinsics, HEAD_CAMERA.intrinsics)
    assert np.allclose(states.extrinsics, HEAD_CAMERA.extrinsics), "world to camera, whichever way it was stored"


def test_the_robot_is_found_and_rendered_where_it_stood(imported: Path) -> None:
    kept = get_robot(ROBOT, imported.parents[2])
    for arm, base in zip(kept.arms, made.BASES, strict=True):
        assert np.allclose(arm.root_pose[:3], base[:3], atol=1e-6) and np.allclose(arm.tool_pose, (0.12, 0, 0, 0, 0, 0, 1))
    record, states = read_record(imported), read_states(imported)
    assert record.keypoint_names[0] == "left/link1" and states.keypoints.shape == (made.FRAMES, 16, 2)
    video = read_video(imported / "robot.mkv")
    assert (video != 255).any(-1).sum((1, 2)).min() > 500, "the robot is in the picture"
    seen = states.keypoints[0][((states.keypoints[0] > 8) & (states.keypoints[0] < [WIDTH - 8, HEIGHT - 8])).all(1)]
    assert len(seen) >= 2, "fingers at the edge of the picture"
    for x, y in seen.round().astype(int):
        assert (video[0, y - 6 : y + 7, x - 6 : x + 7] != 255).any(), "a keypoint is on the robot"


def test_what_is_there_is_not_imported_again(imported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*args: object, **kwargs: object) -> None:
        raise AssertionError("nothing was missing")

    monkeypatch.setattr(robotwin, "write_episode", none)
    root = imported.parents[3]
    assert import_all(find_episodes(root), Args(root, root / "out")) == ([read_record(imported)], [])


def test_two_configurations_of_a_task_are_not_taken_for_one(tmp_path: Path) -> None:
    """Both count their seeds from 0: the second file must not pass for imported."""
    clean, randomized = tmp_path / LEGACY, tmp_path / str(LEGACY).replace("clean_50", "randomized_500")
    made.write_legacy(clean)
    made.write_legacy(randomized)
    with h5py.File(randomized, "r+") as file:
        file["joint_action/left_gripper"][:] = 0.5
    records, refused = import_all([clean, randomized], Args(tmp_path, tmp_path / "out"))
    assert len(records) == 1 and len(refused) == 1
    assert refused[0].startswith(f"{randomized}: ") and "holds another recording of that task, seed and robot" in refused[0]
    records, refused = import_all([randomized], Args(tmp_path, tmp_path / "out", task="place_cup_randomized"))
    assert not refused and records[0].task == "place_cup_randomized"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"frame_rate": 25.0}, "with another frame rate; delete it"),
        ({"instruction": ""}, "with another instruction; delete it"),
        ({"colors": "other"}, "with another picture; delete it"),
        ({"frame_rate": 25.0, "colors": "other"}, "with another frame rate and picture; delete it"),
    ],
)
def test_an_episode_that_was_read_otherwise_is_not_kept_in_silence(
    options: dict[str, Any], said: str, imported: Path, tmp_path: Path
) -> None:
    root, legacy = imported.parents[3], read_record(imported).source.endswith("(legacy)")
    if "colors" in options:
        options = options | {"colors": "ordinary" if legacy else "swapped"}
    _, refused = import_all(find_episodes(root), Args(root, root / "out", **options))
    assert len(refused) == 1 and f"{imported} holds this recording {said}" in refused[0]


def test_a_seed_that_was_simulated_is_another_scene(tmp_path: Path) -> None:
    path = made.write_legacy(tmp_path / LEGACY)
    write_episode(tmp_path / "out", Record("place_cup", 3, "piper", False, "plan"))
    records, refused = import_all([path], Args(tmp_path, tmp_path / "out"))
    assert not records and "was simulated here; RoboTwin's seed 3 is another scene" in refused[0]
    assert len(list((tmp_path / "out" / "place_cup").glob("*/*"))) == 1
    records, refused = import_all([path], Args(tmp_path, tmp_path / "out", task="place_cup_robotwin"))
    assert len(records) == 1 and not refused


def test_files_may_be_named_from_their_own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made.write_legacy(tmp_path / LEGACY)
    beside = tmp_path / LEGACY.parents[1]
    (beside / "instructions" / "episode3.json").write_text('["put the cup on the mat"]')
    (beside / "seed.txt").write_text("0 1 5 17")
    monkeypatch.chdir(tmp_path / LEGACY.parent)
    records, refused = import_all(find_episodes(Path()), Args(Path(), tmp_path / "out"))
    assert not refused and (records[0].task, records[0].seed) == ("place_cup", 17)
    assert records[0].instruction == "put the cup on the mat"


def test_another_robot_is_not_taken_for_it(tmp_path: Path) -> None:
    recorded = read_robotwin(made.write_legacy(tmp_path / LEGACY))
    assert fit_bases(ROBOTS["arx_x5"], recorded) is not None
    assert fit_bases(ROBOTS["piper"], recorded) is None and fit_bases(ROBOTS["franka_panda"], recorded) is None
    records, refused = import_all([tmp_path / LEGACY], Args(tmp_path, tmp_path / "out", robot="franka_panda"))
    assert not records and "has arms of 6 joints, Franka (Panda) has 7; pass another --robot" in refused[0]
    records, refused = import_all([tmp_path / LEGACY], Args(tmp_path, tmp_path / "out", robot="piper"))
    assert not refused and set(records[0].hashes) == {"states", "rgb"} and records[0].keypoint_names == ()


def test_a_robot_that_moved_is_told(tmp_path: Path) -> None:
    made.write_legacy(tmp_path / LEGACY)
    moved = tmp_path / LEGACY.with_name("episode4.hdf5")
    shutil.copy(tmp_path / LEGACY, moved)
    with h5py.File(moved, "r+") as file:
        file["endpose/left_endpose"][:, 0] += 0.05
    records, refused = import_all([tmp_path / LEGACY, moved], Args(tmp_path, tmp_path / "out", instruction=""))
    assert len(records) == 1 and len(refused) == 1
    assert "the base of ARX-X5 is 50 mm from its place" in refused[0] and "another --out" in refused[0]


def test_end_poses_may_be_absent(tmp_path: Path) -> None:
    path = made.write_legacy(tmp_path / LEGACY)
    with h5py.File(path, "r+") as file:
        del file["endpose"]
    records, _ = import_all([path], Args(path, tmp_path / "out"))
    assert "tool_pose" in records[0].unknown and "robot" not in records[0].hashes


@pytest.mark.parametrize("camera", ["observation/head_camera", "vision/cam_head"])
def test_the_camera_may_be_given_as_opengl_has_it(camera: str, tmp_path: Path) -> None:
    """What RoboTwin's collector writes: camera to world, y up and z backward, one a frame or one for all."""
    turned = np.linalg.inv(HEAD_CAMERA.extrinsics) @ np.diag([1, -1, -1, 1])
    legacy = camera.startswith("observation")
    path = made.write_legacy(tmp_path / LEGACY) if legacy else made.write_modern(tmp_path / MODERN)
    with h5py.File(path, "a") as file:
        del file[f"{camera}/{'extrinsic_cv' if legacy else 'extrinsics_matrix'}"]
        name, stored = ("cam2world_gl", np.tile(turned, (made.FRAMES, 1, 1))) if legacy else ("extrinsics_matrix", turned)
        file[f"{camera}/{name}"] = stored
    assert np.allclose(read_robotwin(path).extrinsics, HEAD_CAMERA.extrinsics, atol=1e-6)


@pytest.mark.parametrize(("steps", "milliseconds"), [(10, 40), (15, 60), (30, 120)])
def test_frames_are_as_far_apart_as_the_file_says(steps: int, milliseconds: int, tmp_path: Path) -> None:
    """Its `frequency` counts steps of 4 ms."""
    path = made.write_modern(tmp_path / MODERN)
    with h5py.File(path, "a") as file:
        file["additional_info/frequency"][()] = steps
    assert 1000 / read_robotwin(path).frame_rate == pytest.approx(milliseconds)
    records, _ = import_all([path], Args(path, tmp_path / "out"))
    assert 1000 / records[0].frame_rate == pytest.approx(milliseconds)


@pytest.mark.parametrize(
    ("frequency", "texts", "rate"),
    [
        (10, {"instructions": '["a"]'}, 25),  # RoboTwin counts steps of 4 ms
        (25, {"instruction": "a"}, 25),  # RoboDojo has frames per second
        (30, {"instruction": "a"}, 30),
        (None, {"instructions": '["a"]'}, 50 / 3),
        (25, {}, "--frame-rate 10 or --frame-rate 25"),
        (None, {"instruction": "a"}, "no additional_info/frequency, and the file is not RoboTwin's; expected --frame-rate HZ"),
        (0, {"instruction": "a"}, "expected one number from 1 to 250"),
    ],
)
def test_the_meaning_of_frequency_is_detected_or_asked_for(
    frequency: int | None, texts: dict[str, str], rate: float | str, tmp_path: Path
) -> None:
    path = made.write_modern(tmp_path / MODERN)
    with h5py.File(path, "a") as file:
        del file["instructions"], file["additional_info/frequency"]
        for name, value in (texts | ({} if frequency is None else {"additional_info/frequency": frequency})).items():
            file[name] = value
    if isinstance(rate, str):
        with pytest.raises(EpisodeError, match=rate):
            read_robotwin(path, ReadOptions(instruction=""))
    else:
        assert read_robotwin(path).frame_rate == pytest.approx(rate)
    assert read_robotwin(path, ReadOptions(frame_rate=20, instruction="")).frame_rate == 20


TEXT = "put the block on the mat"


@pytest.mark.parametrize(
    ("stored", "beside", "expected"),
    [
        ({"instructions": np.array([TEXT, "b"], h5py.string_dtype())}, None, TEXT),
        ({"instructions": f'["", "{TEXT}"]'}, None, TEXT),
        ({"instruction": TEXT}, None, TEXT),
        ({"instructions": "[]", "instruction": TEXT}, None, TEXT),
        ({}, '{"seen": [], "unseen": ["put the block on the mat"]}', TEXT),
        ({}, '{"instruction": "put the block on the mat"}', TEXT),
        ({}, f'"{TEXT}"', TEXT),
        ({}, TEXT, TEXT),
        ({}, None, "expected a text in one of them, or --instruction TEXT"),
        ({}, '{"texts": ["a"]}', "expected a text in one of them, or --instruction TEXT"),
        ({"instructions": "[1, 2]", "instruction": " "}, None, "expected a text in one of them, or --instruction TEXT"),
        ({"instructions": 3.0}, None, "instructions is float64 .*; expected texts"),
        ({"instruction": np.bytes_(b"\xe9")}, None, "not UTF-8"),
    ],
)
def test_an_instruction_is_found_or_asked_for(
    stored: dict[str, object], beside: str | None, expected: str, tmp_path: Path
) -> None:
    path = made.write_modern(tmp_path / MODERN)
    with h5py.File(path, "a") as file:
        del file["instructions"]
        for name, value in stored.items():
            file[name] = value
    if beside is not None:
        (path.parents[1] / "instructions").mkdir()
        (path.parents[1] / "instructions" / f"{path.stem}.json").write_text(beside)
    if expected == TEXT:
        assert read_robotwin(path, ReadOptions(frame_rate=25)).instruction == TEXT
    else:
        with pytest.raises(EpisodeError, match=expected):
            read_robotwin(path, ReadOptions(frame_rate=25))
    assert read_robotwin(path, ReadOptions(frame_rate=25, instruction="")).instruction == ""


@pytest.mark.parametrize(
    ("folder", "robot"),
    [
        ("aloha-agilex_clean_50", "aloha_agilex"),
        ("aloha_agilex", "aloha_agilex"),
        ("ARX-X5_randomized_500", "arx_x5"),
        ("arx_x5", "arx_x5"),
        ("UR5-WSG_demo_clean", "ur5_wsg"),
        ("franka-panda", "franka_panda"),
        ("piper_clean", "piper"),
    ],
)
def test_the_folder_above_data_names_the_robot(folder: str, robot: str) -> None:
    assert robotwin._embodiment(Path("/sandpiper/place_cup") / folder / "data" / "episode3.hdf5") == robot


@pytest.mark.parametrize(
    ("name", "seeds", "expected"),
    [
        ("episode3.hdf5", None, 3),
        ("episode_0000003.hdf5", None, 3),
        ("episode3.hdf5", "7 8 9 10", 10),
        ("episode3_v2.hdf5", None, "the file's name gives no seed; rename it to episodeN.hdf5"),
        ("episode_3_arx_x5.hdf5", None, "the file's name gives no seed"),
        ("episode.hdf5", None, "the file's name gives no seed"),
        ("episode-3.hdf5", None, "the file's name gives no seed"),
        ("episode3.hdf5", "7 8", r"seed.txt has 2 entries and no seed of episode3.hdf5; correct it"),
        ("episode3.hdf5", "7 8 9 -1", "seed.txt has 4 entries and no seed of episode3.hdf5; correct it"),
    ],
)
def test_the_seed_is_the_number_of_the_name(name: str, seeds: str | None, expected: int | str, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    if seeds is not None:
        (tmp_path / "seed.txt").write_text(seeds)
    if isinstance(expected, int):
        assert robotwin._seed(tmp_path / "data" / name) == expected
    else:
        with pytest.raises(EpisodeError, match=expected):
            robotwin._seed(tmp_path / "data" / name)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"observations/qpos": np.zeros((5, 14)), "action": np.zeros((5, 14))}, "holds an episode of ALOHA or ACT"),
        ({"data/demo_0/actions": np.zeros((5, 7))}, "holds demonstrations of robomimic or LIBERO"),
        ({"anything": 1}, "has no joint_action/left_arm .at its top: anything"),
    ],
)
def test_files_of_other_projects_are_refused_by_name(content: dict[str, object], said: str, tmp_path: Path) -> None:
    path = tmp_path / "demo.hdf5"
    with h5py.File(path, "w") as file:
        for name, value in content.items():
            file[name] = value
    with pytest.raises(EpisodeError, match=said) as error:
        read_robotwin(path)
    assert ("docs/exchange.md" in str(error.value)) == ("holds" in said)
    with pytest.raises(EpisodeError, match=r"no episode\*.hdf5 at .*; there are demo.hdf5; pass"):
        find_episodes(tmp_path)


def test_a_file_that_its_writer_holds_open_is_named(tmp_path: Path) -> None:
    path = made.write_modern(tmp_path / MODERN)
    code = f"import h5py; file = h5py.File({str(path)!r}, 'r+'); print('open', flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None and writer.stdout.readline()
        with pytest.raises(EpisodeError, match="is open in another program"):
            read_robotwin(path)
        writer.communicate(b"\n")


def test_large_pictures_are_halved_with_their_camera(tmp_path: Path) -> None:
    recorded = read_robotwin(made.write_legacy(tmp_path / LEGACY, (2 * WIDTH, 2 * HEIGHT)))
    assert recorded.rgb.shape[1:] == (HEIGHT, WIDTH, 3) and np.allclose(recorded.intrinsics, HEAD_CAMERA.intrinsics)


def segment(marker: int, content: bytes) -> bytes:
    """A segment of a JPEG file."""
    return bytes([0xFF, marker]) + (len(content) + 2).to_bytes(2, "big") + content


COMMENT, APP1 = 0xFE, 0xE1
ORDINARY = made.encoded(made.picture()[..., ::-1])
SWAPPED = made.encoded(made.picture())


@pytest.mark.parametrize(
    ("encoded", "colors"),
    [
        (SWAPPED, "marked"),
        (ORDINARY[:2] + segment(COMMENT, b"XPL-RGB1") + ORDINARY[2:], "marked"),
        (ORDINARY[:2] + segment(APP1, bytes(5000)) + segment(COMMENT, b"XPL-RGB1") + ORDINARY[2:], "marked"),
        (SWAPPED[:2] + segment(COMMENT, b"no XPL-RGB1") + SWAPPED[2:], "marked"),
        (SWAPPED[:2] + segment(APP1, b"XPL-RGB1") + SWAPPED[2:], "marked"),
        (ORDINARY, "ordinary"),
        (cv2.imencode(".png", made.picture()[..., ::-1])[1].tobytes(), "ordinary"),
        (cv2.imencode(".png", made.picture())[1].tobytes(), "swapped"),
    ],
)
def test_a_red_block_is_red_as_its_comment_or_the_option_says(encoded: bytes, colors: Colors) -> None:
    block = decode_picture(encoded, colors)[HEIGHT // 3, WIDTH // 3]
    assert np.abs(block.astype(int) - made.RED).max() <= 4


@pytest.mark.parametrize(
    ("encoded", "said"),
    [
        (b"no picture", "begins with b'no pictu'; expected a JPEG"),
        (b"", "begins with b''; expected a JPEG"),
        (SWAPPED[: len(SWAPPED) // 2], "cannot be decoded: image file is truncated"),
        (cv2.imencode(".png", made.picture())[1].tobytes(), "is a PNG, which has no place for RoboTwin's mark; pass --colors"),
        (cv2.imencode(".jpg", np.zeros((4096, 4096, 3), np.uint8))[1].tobytes(), "has 4096x4096 pixels"),
    ],
)
def test_a_picture_that_cannot_be_read_is_refused(encoded: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        decode_picture(encoded)


@pytest.mark.parametrize("name", ["observation/head_camera/rgb", "vision/cam_head/colors"])
@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (2 * WIDTH, 2 * HEIGHT)])
def test_raw_pictures_are_rgb(name: str, size: tuple[int, int], tmp_path: Path) -> None:
    legacy = name.startswith("observation")
    path = made.write_legacy(tmp_path / LEGACY) if legacy else made.write_modern(tmp_path / MODERN)
    rewrite(name, np.repeat(made.picture(size)[None], made.FRAMES, 0))(path)
    rgb = read_robotwin(path).rgb
    assert rgb.shape == (made.FRAMES, HEIGHT, WIDTH, 3) and (rgb[:, HEIGHT // 3, WIDTH // 3] == made.RED).all()


def test_the_camera_of_robotwin_s_converter_is_found(tmp_path: Path) -> None:
    """It writes `extrinsic_matrix`; observations have `extrinsics_matrix`."""
    path = made.write_modern(tmp_path / MODERN)
    with h5py.File(path, "a") as file:
        file.move("vision/cam_head/extrinsics_matrix", "vision/cam_head/extrinsic_matrix")
    assert np.allclose(read_robotwin(path).extrinsics, HEAD_CAMERA.extrinsics)


def test_tool_center_of_a_hand_that_points_down() -> None:
    down = np.array([[0.1, 0.2, 1.0, 0.5**0.5, 0.0, 0.5**0.5, 0.0]])  # w x y z: a quarter turn about y
    assert np.allclose(tool_center(down), [[0.1, 0.2, 0.88, 0.0, 0.5**0.5, 0.0, 0.5**0.5]])


# --- What is told of bad files.


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def rewrite(name: str, value: object) -> Callable[[Path], None]:
    """Replace a data set, or remove it where the value is None."""

    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            del file[name]
            if value is not None:
                file[name] = value

    return change


HEAD = "observation/head_camera"


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (truncated, "cannot be read as HDF5"),
        (lambda path: path.write_text("not HDF5"), "cannot be read as HDF5"),
        (rewrite("joint_action/left_arm", None), r"has no joint_action/left_arm \(at its top: endpose, joint_action, obs"),
        (rewrite(f"{HEAD}/rgb", None), f"has no {HEAD}/rgb"),
        (rewrite("joint_action", None), "has no joint_action/left_arm"),
        (rewrite("joint_action/left_arm", np.zeros((made.FRAMES, 5))), "the arms have 5 and 6 joints; expected six or seven"),
        (rewrite("joint_action/left_arm", np.zeros(made.FRAMES)), r"left_arm is float64 of shape \(5,\); expected numbers"),
        (rewrite("joint_action/left_arm", np.full((made.FRAMES, 6), np.nan)), "left_arm holds numbers that are not finite"),
        (rewrite("joint_action/left_arm", np.full((made.FRAMES, 6), 90.0)), "the arms' joints reach 90; expected radians"),
        (rewrite("joint_action/left_gripper", np.linspace(0, 90, made.FRAMES)), "the grippers go from 0 to 90; expected 0 "),
        (rewrite("joint_action/left_gripper", np.linspace(-1, 1, made.FRAMES)), "the grippers go from -1 to 1; expected 0 "),
        (rewrite("joint_action/left_gripper", np.zeros(3)), "have 5, 5, 3, 5, 5, 5 frames; expected as many of each"),
        (rewrite("endpose/left_endpose", np.zeros((made.FRAMES, 7))), "quaternions that are not of length 1"),
        (rewrite("endpose/left_endpose", np.zeros((made.FRAMES, 6))), "the end poses have another shape"),
        (rewrite(f"{HEAD}/rgb", np.array([b"jpeg"] * made.FRAMES)), "at frame 0 begins with b'jpeg'; expected a JPEG"),
        (rewrite(f"{HEAD}/rgb", np.array([b"jpeg"])), "has 1 pictures; expected one for each of 5 frames"),
        (rewrite(f"{HEAD}/intrinsic_cv", np.eye(4)), "intrinsic_cv has shape"),
        (rewrite(f"{HEAD}/extrinsic_cv", np.eye(4)), "extrinsic_cv does not see the table"),
        (rewrite(f"{HEAD}/extrinsic_cv", np.zeros((3, 4))), "extrinsic_cv holds no rotation"),
        (rewrite(f"{HEAD}/extrinsic_cv", np.arange(60.0).reshape(5, 3, 4)), "changes during the episode"),
    ],
)  # fmt: skip
def test_a_bad_file_ends_in_one_line(damage: Callable[[Path], None], told: str, tmp_path: Path) -> None:
    path = made.write_legacy(tmp_path / LEGACY)
    damage(path)
    with pytest.raises(EpisodeError, match=told) as error:
        read_robotwin(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def declare(name: str, shape: tuple[int, ...], kind: object, **options: object) -> Callable[[Path], None]:
    """Replace a data set by one of which nothing is stored."""

    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            del file[name]
            file.create_dataset(name, shape, kind, **options)

    return change


def promise_pictures(path: Path) -> None:
    """One stored picture, of which every frame is a copy without a cost."""
    frames = 5000
    for name in ("joint_action/left_arm", "joint_action/right_arm"):
        rewrite(name, np.zeros((frames, 6), np.float32))(path)
    for name in ("joint_action/left_gripper", "joint_action/right_gripper"):
        rewrite(name, np.zeros(frames, np.float32))(path)
    rewrite("endpose", None)(path)
    with h5py.File(path, "r+") as file:
        del file[f"{HEAD}/rgb"]
        file.create_dataset(f"{HEAD}/rgb", data=np.array([SWAPPED] * frames), compression="gzip")


def share_a_picture(path: Path) -> None:
    """Large pictures of one color, compressed once more."""
    large = cv2.imencode(".jpg", np.zeros((3072, 4096, 3), np.uint8))[1].tobytes()
    with h5py.File(path, "r+") as file:
        del file[f"{HEAD}/rgb"]
        file.create_dataset(f"{HEAD}/rgb", data=np.array([large] * made.FRAMES), compression="gzip")
        file["padding"] = np.zeros(200_000, np.uint8)


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (declare("joint_action/left_arm", (10**9, 6), "f8", chunks=(1024, 6)), "left_arm declares 48,000,000,000 bytes, of a"),
        (
            declare("joint_action/left_arm", (5, 6), "f8", chunks=(10**8, 6), maxshape=(None, 6)),
            "left_arm declares 4,800,000,000",
        ),
        (declare(f"{HEAD}/rgb", (5, 16384, 8192, 3), "u1", chunks=(1, 64, 64, 3)), "rgb declares 2,013,265,920 bytes, of a"),
        (
            declare(f"{HEAD}/rgb", (5,), "S1000000", chunks=(1,)),
            "rgb promises pictures of 1,000,000 bytes; expected at most the",
        ),
        (declare(f"{HEAD}/intrinsic_cv", (10**8, 3, 3), "f8", chunks=(1024, 3, 3)), "intrinsic_cv declares 7,200,000,000"),
        (promise_pictures, "rgb promises 5,000 pictures; expected pictures of"),
        (share_a_picture, "rgb decodes to more than the"),
    ],
)
def test_sizes_are_checked_before_anything_is_read(damage: Callable[[Path], None], told: str, tmp_path: Path) -> None:
    path = made.write_legacy(tmp_path / LEGACY)
    damage(path)
    with pytest.raises(EpisodeError, match=told):
        read_robotwin(path)


@pytest.mark.parametrize("name", ["seed.txt", "instructions/episode3.json"])
def test_a_bad_file_beside_it_is_named(name: str, tmp_path: Path) -> None:
    beside = tmp_path / LEGACY.parents[1] / name
    path = made.write_legacy(tmp_path / LEGACY)
    beside.write_bytes(b"\xff\xfe\x00")
    records, refused = import_all([path], Args(tmp_path, tmp_path / "out"))
    assert not records and len(refused) == 1 and refused[0].startswith(f"{beside} cannot be read as text")


def test_the_command_imports_what_it_can_and_names_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    made.write_legacy(tmp_path / LEGACY)
    broken = tmp_path / LEGACY.with_name("episode4.hdf5")
    broken.write_bytes((tmp_path / LEGACY).read_bytes()[:3000])
    unnamed = made.write_legacy(tmp_path / "somewhere" / "episode0.hdf5")
    monkeypatch.setattr("sys.argv", ["robotwin", str(tmp_path), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as left:
        main()
    told = capsys.readouterr()
    assert left.value.code == 2 and "1 episodes under" in told.out
    assert f"error: 2 of 3 files were not imported:\n{broken} cannot be read as HDF5" in told.err
    assert f"{unnamed} is not at <task>/<robot>/data/episodeN.hdf5" in told.err
    assert len(find_accepted(tmp_path / "out")) == 1


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        ((), "RoboTwin's layout; pass --robot"),
        (("--robot", "pipper"), "did you mean 'piper'"),
        (("--robot", "piper"), "RoboTwin's layout; pass --task"),
        (("--frame-rate", "0"), "the frame rate is 0, expected 1 to 1000"),
    ],
)
def test_mistakes_are_told_in_a_line(
    flags: tuple[str, ...], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    path = made.write_legacy(tmp_path / "episode0.hdf5")
    monkeypatch.setattr("sys.argv", ["robotwin", str(path), "--out", str(tmp_path / "out"), *flags])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2 and told in capsys.readouterr().err


def test_no_episode_is_told(tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match=r"no episode\*.hdf5 at"):
        find_episodes(tmp_path)

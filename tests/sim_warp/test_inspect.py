"""The command that looks into data: yields, hashes, rendering again, pictures."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.sim_warp.small import SLOW, TASK, WITH_SLOW, produce
from xew.config import ConfigError
from xew.dataset import VIEWS, list_views, view_episode
from xew.episode import EpisodeError, States, episode_folder, read_record, read_states, read_video, write_episode
from xew.model.episodes.commands import episode_command
from xew.names import folder_name
from xew.sim_warp.cameras import place_camera
from xew.sim_warp.inspect import main, read_headers
from xew.sim_warp.inspection.pictures import (
    GAP,
    LABEL_HEIGHT,
    LABEL_WIDTH,
    SHEET_TIMES,
    STRIP_FRAMES,
    busy_instants,
    contact_sheet,
    grid,
    strip,
    tile,
)
from xew.sim_warp.inspection.visibility import visibility_section
from xew.sim_warp.production.cells import Job
from xew.sim_warp.production.surfaces import Seen, Visibility, count_visible, read_surfaces
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import get_robot
from xew.sim_warp.stage import TABLE_TOP

ROBOTS = ("franka_panda", SLOW)
Inspect = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One accepted seed and one rejected."""
    out = tmp_path_factory.mktemp("data")
    produce([Job(TASK, seed, ROBOTS) for seed in (0, 1)], out, Renderer("cpu"), robots=WITH_SLOW)
    return out


@pytest.fixture
def data(made: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(made, tmp_path / "data"))


@pytest.fixture
def inspect(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> Inspect:
    """Give the command; exit code, standard output, what was told as error."""

    def run(*flags: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["inspect", *map(str, flags)])
        code = 0
        try:
            main()
        except SystemExit as left:
            code = int(left.code or 0)
        told = capsys.readouterr()
        return code, told.out, told.err[told.err.find("error: ") :] if "error: " in told.err else ""

    return run


def test_yields_and_reasons_are_told(made: Path, inspect: Inspect) -> None:
    code, out, _ = inspect(made)
    assert code == 0 and "all robots together: 1 of 2 seeds accepted" in out
    assert f"{episode_folder(made, TASK, 1, SLOW)}: plan: left joint" in out


def test_sound_data_is_verified_and_rendered_again(made: Path, inspect: Inspect) -> None:
    code, out, _ = inspect(made, "--verify", "--rerender", 5)
    assert code == 0
    assert "2 of 2 episodes agree with their hashes" in out
    assert "2 episodes rendered again from their states agree with their hashes" in out


def test_videos_that_were_left_out_are_made_on_demand(made: Path, tmp_path: Path, inspect: Inspect) -> None:
    data = tmp_path / "states"
    produce([Job(TASK, 0, ROBOTS)], data, Renderer("cpu"), videos=False, robots=WITH_SLOW)
    folders = [episode_folder(data, TASK, 0, robot) for robot in ROBOTS]
    assert not any((folder / "rgb.mkv").exists() for folder in folders)
    code, _, told = inspect(data, "--pictures", tmp_path / "sheets")
    assert code == 2 and "--render" in told
    code, out, _ = inspect(data, "--render")
    assert code == 0 and "videos of 2 episodes made" in out
    for folder, robot in zip(folders, ROBOTS, strict=True):
        written = episode_folder(made, TASK, 0, robot)
        np.testing.assert_array_equal(read_video(folder / "rgb.mkv"), read_video(written / "rgb.mkv"))
    assert "2 of 2 episodes agree with their hashes" in inspect(data, "--verify")[1]
    assert "videos of 0 episodes made" in inspect(data, "--render")[1]


def tree_bytes(root: Path) -> dict[str, bytes]:
    """Content of all files below a folder, by path; without the views."""
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): path.read_bytes() for path in files if VIEWS not in path.relative_to(root).parts}


def test_views_are_added_and_the_head_camera_s_episodes_keep_their_bytes(data: Path, tmp_path: Path, inspect: Inspect) -> None:
    before = tree_bytes(data)
    code, out, _ = inspect(data, "--render", "--cameras", "head", "wrist_left", "--size", "160x120")
    assert code == 0 and "view head_160x120: 2 of 2 episodes new\nview wrist_left_160x120: 2 of 2 episodes new" in out
    assert tree_bytes(data) == before
    header = before[f"{folder_name(TASK)}/0000000/franka_panda/episode.json"]
    assert b"camera" not in header and b"table" not in header
    assert list_views(data) == ["head_160x120", "wrist_left_160x120"]
    assert "view head_160x120: 0 of 2 episodes new" in inspect(data, "--render", "--cameras", "head", "--size", "160x120")[1]
    out = inspect(data, "--verify", "--rerender", 6)[1]
    assert "6 of 6 episodes agree with their hashes" in out and "6 episodes rendered again" in out
    folder = view_episode(episode_folder(data, TASK, 0, "franka_panda"), "wrist_left_160x120")
    record, states = read_record(folder), read_states(folder)
    assert record.camera.fixed_to == "left_tool" and record.camera.position[2] > 0.07 and record.table == TABLE_TOP
    assert states.extrinsics.shape == (12, 4, 4) and states.robot_mask.shape == (12, 120, 160)
    assert read_video(folder / "rgb.mkv").shape == read_video(folder / "robot.mkv").shape == (12, 120, 160, 3)
    assert states.robot_mask.any((1, 2)).all()
    assert inspect(data, "--pictures", tmp_path / "sheets", "--views", "head", "wrist_left_160x120")[0] == 0
    sheet = cv2.imread(str(tmp_path / "sheets" / f"{folder_name(TASK)}_0.png"))
    assert sheet.shape[1] == LABEL_WIDTH + 6 * (320 + GAP)
    view = data / "views" / "wrist_left_160x120"
    assert inspect(view, "--grid", tmp_path / "grid.png")[0] == 0
    assert f"{view} is a view; add views to its data set: {data}" in inspect(view, "--render", "--cameras", "side")[2]


def test_conditions_of_a_view_are_drawn_for_its_commanded_camera(data: Path, inspect: Inspect) -> None:
    """The camera of a tiled view's lower picture is on the hand, as the commands move it."""
    views = ("side_160x120", "wrist_right_160x120")
    inspect(data, "--render", "--cameras", "side", "wrist_right", "--size", "160x120", "--tile", *views)
    base = episode_folder(data, TASK, 0, "franka_panda")
    above, below, tiled = (view_episode(base, view) for view in (*views, "+".join(views)))
    robot = read_video(tiled / "robot.mkv")
    np.testing.assert_array_equal(robot, np.concatenate([read_video(part / "robot.mkv") for part in (above, below)], axis=1))
    command = episode_command(tiled, read_record(tiled))
    np.testing.assert_array_equal(command.streams.render, robot)
    assert command.streams.mask[:, 120:].any() and command.streams.optical_flow.shape == (12, 240, 160, 2)
    on_hand = episode_command(below, read_record(below))
    states = read_states(below)
    expected = place_camera(read_record(below).camera, get_robot("franka_panda"), states.action)
    np.testing.assert_array_equal(on_hand.extrinsics, expected.extrinsics)
    assert np.abs(states.action - states.joint_pos).max() > 1e-4 and not np.array_equal(on_hand.extrinsics, states.extrinsics)
    with pytest.raises(ConfigError, match="carried_render needs one camera that stands still"):
        _ = on_hand.carried_scene
    out = inspect(data, "--verify", "--rerender", 9)[1]
    assert "8 of 8 episodes agree" in out and "6 episodes rendered again" in out


def test_a_view_of_an_earlier_version_without_a_table_is_rendered_again(data: Path, inspect: Inspect) -> None:
    views = ("side_160x120", "head_160x120")
    add_views = ("--render", "--cameras", "side", "head", "--size", "160x120", "--tile", *views)
    inspect(data, *add_views)
    base = episode_folder(data, TASK, 0, "franka_panda")
    side, head, tiled = (view_episode(base, view) for view in (*views, "+".join(views)))
    kept = {folder: read_record(folder) for folder in (side, head, tiled)}
    for folder in (side, tiled):
        edit_header(folder, table=None)
        with pytest.raises(EpisodeError, match="no table hides the robot; run `inspect DATA --render --cameras …`"):
            episode_command(folder, read_record(folder))
    assert episode_command(head, read_record(head)).table is None
    out = inspect(data, *add_views)[1]
    for view, new in ((views[0], 1), (views[1], 0), ("+".join(views), 1)):
        assert f"view {view}: {new} of 2 episodes new" in out
    assert {folder: read_record(folder) for folder in kept} == kept


def test_a_damaged_view_is_named(data: Path, inspect: Inspect) -> None:
    inspect(data, "--render", "--cameras", "side", "--size", "160x120")
    folder = view_episode(episode_folder(data, TASK, 0, "franka_panda"), "side_160x120")
    edit_header(folder, hashes=read_record(folder).hashes | {"robot": "0" * 64})
    code, _, told = inspect(data, "--verify")
    assert code == 2 and f"{folder}: robot has hash" in told


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--cameras", "wrist_left"), "wrist_left: views are made by --render; add it"),
        (("--render", "--cameras", "wrist"), "there is no camera 'wrist'"),
        (("--render", "--cameras", "head", "--size", "640x481"), "the size is '640x481'; expected WIDTHxHEIGHT"),
        (("--render", "--cameras", "none.yaml"), "cannot read the config none.yaml"),
        (("--pictures", "sheets", "--views", "wrist_left"), "has no view 'wrist_left', but head; add it by"),
    ],
)
def test_views_that_cannot_be_made_or_shown_are_told_in_one_line(
    flags: tuple[str, ...], message: str, made: Path, tmp_path: Path, inspect: Inspect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, told = inspect(made, *flags)
    assert code == 2 and message in told and told.count("\n") == 1


def test_every_damaged_episode_is_named(data: Path, inspect: Inspect) -> None:
    panda, piper = (episode_folder(data, TASK, 0, robot) for robot in ROBOTS)
    content = bytearray((panda / "rgb.mkv").read_bytes())
    content[len(content) // 2] ^= 0xFF
    (panda / "rgb.mkv").write_bytes(content)
    (piper / "states.npz").write_bytes((piper / "states.npz").read_bytes()[:-100])
    broken = episode_folder(data, TASK, 1, SLOW) / "episode.json"
    broken.write_text("{")
    code, out, told = inspect(data, "--verify")
    assert code == 2 and "0 of 2 episodes agree" in out
    assert f"{panda}: rgb has hash" in told or f"{panda / 'rgb.mkv'} is damaged" in told
    assert f"{piper / 'states.npz'} is damaged" in told and f"{broken} is damaged" in told
    assert "error: 3 damaged:\n" in told and "Traceback" not in told


def test_altered_states_do_not_pass_for_the_rendered_ones(data: Path, inspect: Inspect) -> None:
    """A header that was made to agree with altered pixels fails when they are rendered again."""
    panda, piper = (episode_folder(data, TASK, 0, robot) for robot in ROBOTS)
    shutil.copy(piper / "rgb.mkv", panda / "rgb.mkv")
    edit_header(panda, hashes=read_record(panda).hashes | {"rgb": read_record(piper).hashes["rgb"]})
    code, _, told = inspect(data, "--rerender", 2)
    assert code == 2 and "rendered again on CPU" in told


def test_pictures_are_drawn(made: Path, tmp_path: Path, inspect: Inspect) -> None:
    assert inspect(made, "--pictures", tmp_path / "sheets")[0] == 0
    names = {path.name for path in (tmp_path / "sheets").iterdir()}
    task = folder_name(TASK)
    assert {f"{task}_0.png", *(f"{task}_0_{folder_name(robot)}.png" for robot in ROBOTS)} <= names
    assert not any(name.startswith(f"{task}_1") for name in names), "the rejected seed has no pictures"
    sheet = cv2.imread(str(tmp_path / "sheets" / f"{task}_0.png"))
    assert sheet.shape == (LABEL_HEIGHT + len(ROBOTS) * (240 + GAP), LABEL_WIDTH + len(SHEET_TIMES) * (320 + GAP), 3)
    folders = [episode_folder(made, TASK, 0, robot) for robot in ROBOTS]
    np.testing.assert_array_equal(sheet[..., ::-1], contact_sheet([(folder, read_record(folder)) for folder in folders]))
    last = read_video(folders[1] / "rgb.mkv")[-1]
    np.testing.assert_array_equal(sheet[-240 - GAP : -GAP, -320 - GAP : -GAP, ::-1], last)
    assert (sheet[:LABEL_HEIGHT] < 128).any() and (sheet[LABEL_HEIGHT:, :LABEL_WIDTH] < 128).any(), "instruction and names"
    assert strip(folders[0]).shape == (2 * (240 + GAP), STRIP_FRAMES * (320 + GAP), 3)


def test_a_grid_of_tasks_and_robots_is_drawn(made: Path, tmp_path: Path, inspect: Inspect) -> None:
    """One column a task, one row a robot, names on the outside."""
    code, out, _ = inspect(made, "--grid", tmp_path / "new" / "grid.png")
    assert code == 0 and "grid.png: 0." in out
    drawn = cv2.imread(str(tmp_path / "new" / "grid.png"))
    height, width = LABEL_HEIGHT + len(ROBOTS) * (120 + GAP), LABEL_WIDTH + 160 + GAP
    assert drawn.shape == (height, width, 3)
    for row in range(len(ROBOTS)):
        tile = drawn[LABEL_HEIGHT + row * (120 + GAP) :, LABEL_WIDTH:][:120, :160]
        assert (tile < 250).any(-1).mean() > 0.5
        assert (drawn[LABEL_HEIGHT + row * (120 + GAP) :, :LABEL_WIDTH][:120] < 128).any(), "the robot's name"
    assert (drawn[:LABEL_HEIGHT, LABEL_WIDTH:] < 128).any(), "the task's name"


def test_a_grid_has_bands_of_equal_length(made: Path) -> None:
    cells = [(folder, record) for folder, record in read_headers(made)[0] if record.hashes]
    column = LABEL_HEIGHT + len(ROBOTS) * (120 + GAP)
    for tasks, bands, length in ((4, 1, 4), (9, 2, 5)):
        assert grid([cells] * tasks).shape == (bands * column, LABEL_WIDTH + length * (160 + GAP), 3)


def test_the_instant_of_a_grid_is_one_at_which_all_robots_touch_something() -> None:
    contact = np.zeros((2, 21, 2, 1), bool)
    assert busy_instants(list(contact)) == [12, 12]
    contact[0, 3:11], contact[1, 8:20] = True, True
    assert busy_instants(list(contact)) == [10, 10]
    contact[0, 11:15] = True
    assert busy_instants(list(contact)) == [12, 12]


def test_imported_episodes_of_one_seed_may_differ_in_length(made: Path, data: Path) -> None:
    """They share no clock: each is shown at its own instant, and drawing them does not fail."""
    assert busy_instants([np.zeros((21, 2, 0), bool), np.zeros((11, 2, 1), bool)]) == [12, 6]
    short = episode_folder(data, TASK, 0, SLOW)
    states = read_states(short)
    halved = {field.name: getattr(states, field.name) for field in fields(States)}
    halved = {name: array[:6] if len(array) == states.frame_count else array for name, array in halved.items()}
    write_episode(data, replace(read_record(short), frame_count=6), States(**halved), read_video(short / "rgb.mkv")[:6])
    cells = [(folder, record) for folder, record in read_headers(data)[0] if record.hashes]
    assert grid([cells]).shape == (LABEL_HEIGHT + 2 * (120 + GAP), LABEL_WIDTH + 160 + GAP, 3)


def test_tiles_lie_in_rows_with_white_between() -> None:
    red, blue = (np.full((2, 3, 3), color, np.uint8) for color in ((255, 0, 0), (0, 0, 255)))
    picture = tile([[red, blue]])
    assert (picture[:2, :3] == [255, 0, 0]).all() and (picture[:2, 3 + GAP : 6 + GAP] == [0, 0, 255]).all()
    assert (picture[2:] == 255).all() and (picture[:, 3 : 3 + GAP] == 255).all()


def test_nothing_there_is_told_with_the_way_to_make_it(made: Path, data: Path, tmp_path: Path, inspect: Inspect) -> None:
    code, _, told = inspect(tmp_path / "nowhere")
    assert code == 2 and "no episode under" in told and "python -m xew.sim_warp.generate --out" in told
    shutil.rmtree(data / folder_name(TASK) / "0000000")
    code, _, told = inspect(data, "--rerender", 1)
    assert code == 2 and "is accepted; expected at least one to render or draw" in told
    assert inspect(data, "--grid", tmp_path / "grid.png")[0] == 2 and not (tmp_path / "grid.png").exists()
    (tmp_path / "file").write_text("")
    code, _, told = inspect(made, "--pictures", tmp_path / "file")
    assert code == 2 and "Choose another folder with --pictures." in told
    code, _, told = inspect(made, "--grid", tmp_path / "file" / "grid.png")
    assert code == 2 and "Choose another folder with --grid." in told


def test_visibility_is_counted_by_task_and_robot(data: Path, inspect: Inspect) -> None:
    """The block of the small task never moves; so only the robot's points are asked for."""
    code, out, _ = inspect(data, "--visibility")
    (row,) = [line for line in out.splitlines() if line.startswith(f"| `{TASK}`")]
    assert code == 0 and row == f"| `{TASK}` | 100 / 100 | 100 / 100 | nothing moves |"
    assert "Below the aims" not in out
    edit_header(episode_folder(data, TASK, 0, SLOW), fault="push:40", progress=0.5)
    without, with_faults = (inspect(data, "--visibility", *flags)[1] for flags in ((), ("--faults",)))
    assert "| task | `franka_panda` | seen least |" in without and "omitted: 1 episodes of faulty commands" in without
    assert with_faults.endswith(out[out.index("Share of frames") :]) and "omitted" not in with_faults


def test_shapes_that_are_not_known_cannot_be_counted(data: Path, inspect: Inspect) -> None:
    for folder, _ in read_headers(data)[0]:
        edit_header(folder, source="elsewhere")
    code, _, told = inspect(data, "--visibility")
    assert code == 2 and "has no episode with known shapes" in told


def test_what_is_seen_too_little_is_named_with_its_size() -> None:
    """The can has too few points in one of five frames, where it is 40 pixels large, with one robot of two."""
    robot, whole = Seen(np.full(20, 9), np.full(20, 500)), Seen(np.full(5, 4), np.full(5, 90))
    hidden = Seen(np.array([4, 4, 4, 4, 3]), np.array([90, 90, 90, 90, 40]))
    cells = {"piper": {"red_can": whole, "lid": whole}, "ur5_wsg": {"red_can": hidden, "lid": whole}}
    found = {("pour", name): [Visibility(robot, things)] for name, things in cells.items()}
    text = visibility_section(found | {("rest", "piper"): [Visibility(Seen(np.arange(20), np.arange(20)), {})]})
    lines = text.splitlines()
    assert "The first is met in 2 of 3 cells, with 9 to 10 points in the mean, the second in 2." in text
    assert [line for line in lines if line.startswith("| `")] == [
        "| `pour` | 100 / 80 | 100 / 100 | red can |",
        "| `rest` | – | 60 / 100 | nothing moves |",
        "| `pour` | `ur5_wsg` | red can | 80 | 40 |",
        "| `rest` | `piper` | robot | 60 | 4 |",
    ]


def test_a_scene_that_its_task_makes_no_more_has_no_known_shapes(data: Path) -> None:
    folder = next(folder for folder, record in read_headers(data)[0] if record.success)
    tracks = read_surfaces(folder)
    assert tracks is not None and "block" in tracks.names
    few, seen = replace(tracks, visible=tracks.visible & (np.arange(len(tracks.body)) < 3)), count_visible(tracks)
    assert count_visible(few).robot.points.max() <= 3 < seen.robot.points.min() and not seen.things
    moved = count_visible(replace(tracks, displacement=tracks.displacement + 1, step=tracks.step + 1))
    assert set(moved.things) == {"block"} and (moved.things["block"].points >= 4).all()
    assert (moved.things["block"].pixels > 20).all() and (seen.robot.pixels > moved.things["block"].pixels).all()
    for change in ({"scene_hash": "another"}, {"source": "elsewhere"}):
        edit_header(folder, **change)
        assert read_surfaces(folder) is None
    edit_header(folder, task="no_such_task")
    (data / "no_such_task/0000000").mkdir(parents=True)
    assert read_surfaces(folder.rename(data / "no_such_task/0000000" / folder.name)) is None


def edit_header(folder: Path, **changes: Any) -> None:
    path = folder / "episode.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))

"""What the explorer writes: films, overlays, the choice of scenes, and the page's files; test_explorer_page.py plays them."""

import json
import shutil
import sys
from dataclasses import fields, replace
from pathlib import Path

import av
import numpy as np
import pytest

from tests.synthetic import write_synthetic_data, write_synthetic_view
from xew.dataset import find_accepted, view_episode
from xew.episode import EpisodeError, Record, States, read_record, read_states, read_video
from xew.protocol import CameraSpec
from xew.rollout import write_rollout
from xew.sim_warp.inspect import main
from xew.sim_warp.inspection.explorer import Page, choose_scenes, find_predictions, write_page
from xew.sim_warp.inspection.films import difference_video, tile_frames, tile_size, write_film
from xew.sim_warp.inspection.overlays import contact_spans, frame_psnr, mask_outline, overlay_data
from xew.sim_warp.rendering import streams

FRAMES = 5
ROBOTS = ("piper", "ur5_wsg")
CELLS = [
    (Path(f"{task}/{seed}/{robot}"), Record(task, seed, robot, True))
    for task in ("a", "b")
    for seed in (0, 3, 7)
    for robot in ("piper", "arx_x5")
]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One scene of two robots."""
    root = tmp_path_factory.mktemp("data")
    write_synthetic_data(root, seeds=(4,), robots=ROBOTS, frames=FRAMES)
    return root


@pytest.fixture(scope="module")
def folder(data: Path) -> Path:
    """Its first episode."""
    return data / "place_empty_cup" / "0000004" / "piper"


def test_a_film_holds_every_video_in_its_tile_and_a_frame_at_its_time(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 255, (3, 30, 1, 1, 3))
    first, second, third = (np.broadcast_to(c, (30, 21, 32, 3)).astype(np.uint8) for c in colors)
    rows = [[first, second[:20, :20]], [None, third]]
    assert tile_size(rows) == (22, 32)
    write_film(tmp_path / "film.mp4", tile_frames(rows, 30), 1000 / 60, within=tmp_path)
    film = read_video(tmp_path / "film.mp4").astype(int)
    assert film.shape == (30, 44, 64, 3)
    for row, column, video in ((0, 0, first), (0, 1, second[[*range(20), *[19] * 10], :20]), (1, 1, third)):
        inside = film[:, 22 * row + 4 : 22 * row + 16, 32 * column + 4 : 32 * column + 28]
        assert np.abs(inside - video[:, 4:16, 4:28]).mean() < 4
    assert film[:, 26:40, 4:28].min() > 245, "no video is white"
    with av.open(str(tmp_path / "film.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        frames = list(container.decode(stream))
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(30) * 0.06, atol=1e-4)
    keys = [number for number, frame in enumerate(frames) if frame.key_frame]
    assert max(np.diff([*keys, 30])) <= 12, "a browser decodes at most 12 frames to reach one"


def test_differences_and_errors_of_frames() -> None:
    truth = np.full((3, 4, 4, 3), 100, np.uint8)
    prediction = truth.copy()
    prediction[1] += 10
    prediction[2, ..., 1] = 4
    assert frame_psnr(prediction, truth) == [None, 28.13, round(10 * np.log10(255**2 / (96**2 / 3)), 2)]
    assert difference_video(prediction, truth)[:, 0, 0].tolist() == [[255] * 3, [229] * 3, [0] * 3]
    assert len(frame_psnr(prediction[:2], truth)) == len(difference_video(prediction[:2], truth)) == 2


def test_an_outline_goes_round_a_mask_and_its_hole() -> None:
    mask = np.zeros((40, 60), bool)
    mask[5:30, 10:50] = True
    mask[12:20, 20:30] = False
    outer, inner = sorted(mask_outline(mask), key=lambda points: min(points))
    assert {tuple(point) for point in np.reshape(outer, (-1, 2))} == {(10, 5), (49, 5), (49, 29), (10, 29)}
    hole = np.reshape(inner, (-1, 2))
    assert np.abs(hole - [24.5, 15.5]).max() < 7 and len(hole) >= 4
    assert mask_outline(np.zeros((4, 4), bool)) == []


def test_contacts_are_spans_of_frames() -> None:
    contact = np.zeros((8, 2, 2), bool)
    contact[2:5, 0, 1] = contact[7, 0, 1] = contact[:, 1, 0] = True
    assert contact_spans(contact) == [[0, 1, 2, 4], [0, 1, 7, 7], [1, 0, 0, 7]]


def test_overlays_are_the_episodes_own_and_none_where_unknown(folder: Path) -> None:
    record, states = read_record(folder), read_states(folder)
    overlays = overlay_data(record, states)
    keypoints = np.reshape(overlays["keypoints"], (FRAMES, -1, 3))
    np.testing.assert_allclose(keypoints[..., :2], states.keypoints, atol=0.051)
    np.testing.assert_array_equal(keypoints[..., 2], states.keypoint_visible)
    hand = states.object_pose[2, 0, :2]
    np.testing.assert_allclose(overlays["objects"][2], [159.5 + 320 * hand[0], 119.5 - 320 * hand[1]], atol=0.06)
    assert len(overlays["outlines"]) == FRAMES and overlays["contacts"] == contact_spans(states.contact)
    missing = {f.name: getattr(states, f.name) for f in fields(States)}
    missing["keypoints"] = np.full_like(states.keypoints, np.nan)
    names = ("robot_mask", "contact", "object_pose")
    overlays = overlay_data(replace(record, unknown=names), States(**missing))
    assert overlays["outlines"] is overlays["contacts"] is overlays["objects"] is None
    assert overlays["keypoints"][0][:2] == [None, None]
    json.dumps(overlays, allow_nan=False)
    assert overlay_data(replace(record, unknown=("keypoints",)), states)["keypoints"] is None


def test_scenes_are_chosen_by_name_and_number() -> None:
    def names(wanted: tuple[str, ...], most: int = 6) -> list[str]:
        return [f"{scene.task}{scene.seed}" for scene in choose_scenes(CELLS, wanted, most, {})[0]]

    assert names((), 2) == ["a0", "b0"] and names((), 3) == ["a0", "a3", "b0"] and len(names(())) == 6
    assert names(("b",)) == ["b0", "b3", "b7"] and names(("b/3", "a/0000007")) == ["a7", "b3"]
    scenes, left_out = choose_scenes(CELLS, (), 2, {})
    assert left_out == 4 and [record.robot for _, record in scenes[0].cells] == ["arx_x5", "piper"]
    with pytest.raises(EpisodeError, match=r"no scene c, a/1 .*of the tasks a, b"):
        names(("c", "b", "a/1"))
    many = [(Path(str(n)), Record("a", 0, f"robot{n:02d}", True)) for n in range(12)]
    ((scene,), _) = choose_scenes(many, (), 6, {})
    assert len(scene.cells) == 10 and scene.left_out == 2


def test_rollouts_choose_their_scenes_and_are_of_one_tree(tmp_path: Path) -> None:
    video = np.zeros((1, 4, 4, 3), np.uint8)
    for tree in ("one", "two"):
        write_rollout(tmp_path / tree, "b", 3, "piper", video, {"model": "m", "condition": "c"})
    found = find_predictions([tmp_path / "one"])
    assert list(found) == ["m · c"] and list(found["m · c"]) == [("b", 3, "piper")]
    scenes, left_out = choose_scenes(CELLS, (), 6, found)
    assert [(scene.task, scene.seed) for scene in scenes] == [("b", 3)] and left_out == 5
    with pytest.raises(EpisodeError, match="has a rollout"):
        choose_scenes(CELLS, ("a",), 6, found)
    with pytest.raises(EpisodeError, match="both of the model 'm'"):
        find_predictions([tmp_path / "one", tmp_path / "two"])


def read_script(path: Path) -> dict:
    """The content of a scene's script."""
    return json.loads(path.read_text().partition(", ")[2].removesuffix(");\n"))


def test_the_command_writes_a_page(
    data: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    truth = read_video(folder / "rgb.mkv")
    write_rollout(tmp_path / "tree", "place_empty_cup", 4, "piper", truth[:4, ::2, ::2], {"model": "m"})
    flags = [data, "--no-flow", "--page", tmp_path / "page", "--rollouts", tmp_path / "tree"]
    monkeypatch.setattr(sys, "argv", ["inspect", *map(str, flags)])
    main()
    assert f"{tmp_path / 'page' / 'index.html'}: 1 scene, 0." in capsys.readouterr().out
    stem = "scenes/000_place_empty_cup_4"
    written = {path.relative_to(tmp_path / "page").as_posix() for path in (tmp_path / "page").rglob("*") if path.is_file()}
    assert written == {"index.html", f"{stem}.js", f"{stem}_0.mp4"}
    content = read_script(tmp_path / "page" / f"{stem}.js")
    (film,) = content["films"]
    assert film["rows"] == ["video", "prediction", "difference"] and film["tile"] == [320, 240] and film["label"] == "m"
    assert len(film["psnr"][1]) == 4 and film["psnr"][0] is None, "only one robot is predicted, and shorter"
    assert [robot["title"] for robot in content["robots"]] == ["UR5", "Piper"]
    frames = read_video(tmp_path / "page" / f"{stem}_0.mp4")
    assert frames.shape == (FRAMES, 720, 640, 3) and np.abs(frames[:, :240, 320:].astype(int) - truth).mean() < 4


def test_other_views_are_rows_of_the_film(data: Path, tmp_path: Path) -> None:
    """They have the size of the first row, and white where their aspect ratio leaves some."""
    copy = Path(shutil.copytree(data, tmp_path / "data"))
    write_synthetic_view(copy, CameraSpec("shelf", size=(160, 80)))
    scenes, _ = choose_scenes(find_accepted(copy), (), 6, {})
    write_page(Page("t", scenes, 0, {}, flow=False, views=("head", "shelf_160x80")), tmp_path / "page")
    (film,) = read_script(next((tmp_path / "page" / "scenes").glob("*.js")))["films"]
    assert film["rows"] == ["video", "shelf_160x80"] and film["tile"] == [320, 240]
    frames = read_video(next((tmp_path / "page" / "scenes").glob("*.mp4")))
    seen = read_video(view_episode(scenes[0].cells[0][0], "shelf_160x80") / "rgb.mkv")
    assert np.abs(frames[:, 240:400:2, 0:320:2].astype(int) - seen).mean() < 8 and frames[:, 405:, :].min() > 240


def test_flow_is_a_row_of_the_film(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flow = np.zeros((FRAMES, 240, 320, 2), np.float32)
    flow[:, 100:200, 100:200] = [25, 0]
    asked = []

    class Streams:
        optical_flow = flow

    monkeypatch.setattr(streams, "command_streams", lambda robot, action, camera, table: asked.append(robot.key) or Streams)
    cells = [(path.parent, read_record(path.parent)) for path in sorted(data.rglob("episode.json"))]
    write_page(Page("t", choose_scenes(cells, (), 6, {})[0], 0, {}), tmp_path / "page")
    assert asked == ["ur5_wsg", "piper"]
    frames = read_video(next((tmp_path / "page" / "scenes").glob("*.mp4")))
    assert frames.shape == (FRAMES, 480, 640, 3)
    assert (np.abs(frames[2, 390, 150].astype(int) - [0, 255, 255]) < 30).all() and frames[2, 260, 300].min() > 240


def test_rollouts_may_begin_with_frame_1(folder: Path, tmp_path: Path) -> None:
    truth = read_video(folder / "rgb.mkv")
    write_rollout(tmp_path / "tree", "place_empty_cup", 4, "piper", truth[1:], {"model": "m"})
    predictions = find_predictions([tmp_path / "tree"])
    scenes, _ = choose_scenes([(folder, read_record(folder))], (), 6, predictions)
    write_page(Page("t", scenes, 0, predictions, flow=False, given=False), tmp_path / "page")
    content = read_script(next((tmp_path / "page" / "scenes").glob("*.js")))
    assert content["films"][0]["psnr"] == [[None] * FRAMES]


def test_a_frame_rate_that_no_film_has_is_an_error(folder: Path, tmp_path: Path) -> None:
    cells = [(folder, read_record(folder))]
    for change in ({"frame_rate": 1e-9}, {"frame_rate": 1e9}):
        with pytest.raises(EpisodeError, match="expected 1 to 1000 frames per second"):
            write_page(
                Page("t", choose_scenes([(folder, replace(cells[0][1], **change))], (), 6, {})[0], 0, {}), tmp_path / "b"
            )


def test_a_scene_has_one_frame_rate(folder: Path, tmp_path: Path) -> None:
    record = read_record(folder)
    scenes, _ = choose_scenes([(folder, record), (folder, replace(record, robot="ur5_wsg", frame_rate=25.0))], (), 6, {})
    with pytest.raises(EpisodeError, match=r"at 16.67 \(1\) and at 25.00 \(1\) frames per second, which cannot be mixed"):
        write_page(Page("t", scenes, 0, {}, flow=False), tmp_path / "page")


def test_another_page_is_kept_and_an_own_one_replaced(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("mine")
    with pytest.raises(EpisodeError, match="choose another folder with --page"):
        write_page(Page("t", [], 0, {}), tmp_path)
    assert (tmp_path / "index.html").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1
    (tmp_path / "file").write_text("")
    with pytest.raises(EpisodeError, match="Choose another folder with --page"):
        write_page(Page("t", [], 0, {}), tmp_path / "file" / "page")
    for title in ("first", "second"):
        write_page(Page(title, [], 0, {}), tmp_path / "own")
    assert "<title>second</title>" in (tmp_path / "own" / "index.html").read_text()

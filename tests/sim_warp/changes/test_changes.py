"""One change at a time: what it changes, that it changes nothing else, and how wrong requests are refused."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.sim_warp.small import CLOSE, TASK, produce
from xew.dataset import demand_one_change
from xew.episode import EpisodeError, Record, States, array_hash, episode_folder, read_record, read_states
from xew.protocol import FACTORS, HEAD_SPEC, SHARED_MOTION, Change, parse_change, split_key
from xew.sim_warp import generate
from xew.sim_warp.changes import patterns
from xew.sim_warp.changes.clutter import AREA, find_struck
from xew.sim_warp.changes.looks import camera_of, stage_of
from xew.sim_warp.changes.scenes import change_of, demand_change, make_plan, make_scene, raised_by
from xew.sim_warp.geometry.camera import HEAD_CAMERA, spec_camera
from xew.sim_warp.inspect import main as inspect
from xew.sim_warp.inspection.checks import find_problem
from xew.sim_warp.physics import Motion, World, simulate
from xew.sim_warp.physics.gpu import simulate_batch
from xew.sim_warp.production.cells import Job
from xew.sim_warp.production.rerender import render_changed
from xew.sim_warp.production.seeds import Family
from xew.sim_warp.production.surfaces import read_surfaces
from xew.sim_warp.production.warm_up import stand_at_home
from xew.sim_warp.rendering.observe import Recording, observe, scene_recording
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.scene import scene_hash
from xew.sim_warp.tasks import TASKS, get_task

NAMES = ("franka_panda", "piper")
VIEW = {"keypoints", "keypoint_visible", "robot_mask", "intrinsics", "extrinsics"}
"""Arrays of States that are what the camera sees."""
MAY_DIFFER = {"clutter": {"keypoint_visible", "robot_mask"}, "camera": VIEW}
"""Arrays that a change without physics may change."""


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer("cpu")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, renderer: Renderer) -> Callable[[str], Path]:
    """A data set of one seed and two robots with a change, made once."""
    made: dict[str, Path] = {}

    def make(change: str) -> Path:
        if change not in made:
            made[change] = tmp_path_factory.mktemp("data")
            (records,) = produce([Job(TASK, 0, NAMES, change=change)], made[change], renderer)
            assert all(record.success and record.change == change for record in records), records
        return made[change]

    return make


@pytest.mark.parametrize("factor", [factor for factor in FACTORS if factor != "height"])
def test_a_change_of_the_view_leaves_states_and_commands_to_the_byte(factor: str, data: Callable[[str], Path]) -> None:
    for robot in NAMES:
        before, after = (episode_folder(data(change), TASK, 0, robot) for change in ("", f"{factor}:3"))
        old, new = read_states(before), read_states(after)
        differ = {f.name for f in fields(States) if array_hash(getattr(old, f.name)) != array_hash(getattr(new, f.name))}
        assert differ <= MAY_DIFFER.get(factor, set())
        hashes = read_record(before).hashes, read_record(after).hashes
        assert hashes[0]["rgb"] != hashes[1]["rgb"]
        assert (hashes[0]["robot"] == hashes[1]["robot"]) == (factor != "camera"), "the robot alone, by its commands"
        assert find_problem(after) == ""


def test_another_height_is_planned_and_simulated_again(data: Callable[[str], Path]) -> None:
    old, new = (read_states(episode_folder(data(change), TASK, 0, "piper")) for change in ("", "height:1"))
    height = raised_by(Change("height", 1))
    assert np.allclose(new.object_pose - old.object_pose, [0, 0, height, 0, 0, 0, 0], atol=1e-4)
    assert np.array_equal(new.action[0], old.action[0]) and not np.array_equal(new.action[-1], old.action[-1])
    assert np.allclose(new.tool_pose[-1, 0] - old.tool_pose[-1, 0], [0, 0, height, 0, 0, 0, 0], atol=2e-3)
    assert find_problem(episode_folder(data("height:1"), TASK, 0, "piper")) == ""


@pytest.mark.parametrize("change", ["clutter:2", "height:1"])
def test_robots_share_a_changed_scene(change: str, data: Callable[[str], Path]) -> None:
    hashes = {read_record(episode_folder(data(change), TASK, 0, robot)).scene_hash for robot in NAMES}
    assert hashes == {scene_hash(make_scene(CLOSE, TASK, 0, change))} != {scene_hash(make_scene(CLOSE, TASK, 0))}


def test_surfaces_know_the_clutter_and_the_height(data: Callable[[str], Path]) -> None:
    cluttered, raised = (read_surfaces(episode_folder(data(c), TASK, 0, "piper")) for c in ("clutter:2", "height:1"))
    assert cluttered is not None and cluttered.names[-5:] == ("block", *(f"clutter {n}" for n in (1, 2, 3, 4)))
    assert raised is not None and raised.visible[:, raised.body == raised.names.index("block")].any()


@pytest.mark.parametrize("factor", FACTORS)
def test_levels_grow_and_stay_in_view(factor: str, renderer: Renderer) -> None:
    pictures = []
    for level in range(4):
        change = parse_change(f"{factor}:{level}")
        scene = make_scene(CLOSE, TASK, 0, str(change or ""))
        pose = np.array([thing.pose for thing in scene.objects])[None]
        seen = scene_recording(ROBOTS["piper"], scene, stand_at_home(ROBOTS["piper"], 1), pose, np.zeros((1, 1)))
        view = observe(renderer, [seen], spec_camera(camera_of(change)), stage_of(change))[0]
        assert view.robot_mask.mean() > 0.02
        pictures.append(view.rgb.astype(float))
    differences = [np.abs(picture - pictures[0]).mean() for picture in pictures]
    assert differences == sorted(set(differences))


@pytest.mark.parametrize("name", TASKS)
def test_clutter_lies_on_the_table_away_from_everything(name: str) -> None:
    task = get_task(name)
    counts = []
    for seed in (0, 1):
        weak, strong = (make_scene(task, name, seed, change) for change in ("clutter:1", "clutter:3"))
        assert [thing.pose for thing in weak.clutter] == [thing.pose for thing in strong.clutter[: len(weak.clutter)]]
        things = [*strong.objects, *strong.clutter]
        radii = [np.hypot(*thing.shape.mesh.vertices[:, :2].T).max() for thing in things]
        for first, own in enumerate(strong.clutter, len(strong.objects)):
            assert (np.abs(own.pose[:2]) <= np.abs(AREA).max(0)).all() and own.is_fixed
            apart = [np.hypot(*np.subtract(own.pose[:2], thing.pose[:2])) for thing in things]
            assert all(apart[n] > radii[n] + radii[first] for n in range(len(things)) if n != first)
        counts.append(len(strong.clutter))
    assert min(counts) >= 2


def test_clutter_in_the_way_is_found() -> None:
    scene = make_scene(CLOSE, TASK, 0, "clutter:1")
    robot = ROBOTS["piper"]
    moving = Recording(robot, stand_at_home(robot, 1))
    assert find_struck(scene.clutter, moving) is None
    thing = scene.clutter[0]
    under = replace(thing, pose=(-0.17, -0.24, 0.85, *thing.pose[3:]))
    assert find_struck((under,), moving) == "clutter 1 is in the way: something comes within 0 mm of it"


def test_clutter_would_not_change_the_physics() -> None:
    """Simulated as fixed objects, the same clutter gives the same motion."""
    scene = make_scene(CLOSE, TASK, 0, "clutter:3")
    robot = ROBOTS["piper"]
    action = stand_at_home(robot, 4)
    solid = replace(scene, objects=(*scene.objects, *(thing for thing in scene.clutter if thing.shape.hulls)), clutter=())
    assert len(solid.objects) > 1
    without, together = simulate([World(robot, scene, action), World(robot, solid, action)], "cpu")
    assert np.array_equal(without.joint_pos, together.joint_pos)
    assert np.allclose(without.object_pose, together.object_pose[:, :1], atol=1e-7)


def test_a_raised_plan_keeps_home_and_the_clock() -> None:
    name = "beat_block_hammer"
    task = TASKS[name]
    flat, raised = (make_plan(task, make_scene(task, name, 0, change)).path().pose for change in ("", "height:3"))
    assert flat.shape == raised.shape and np.array_equal(flat[0], raised[0])
    assert np.allclose(np.sort((raised - flat)[-1, :, 2]), [raised_by(Change("height", 3)), 0]), "the idle arm waits as before"


def test_rendering_from_states_agrees_with_making(data: Callable[[str], Path], tmp_path: Path, renderer: Renderer) -> None:
    for change in ("light:3", "clutter:3", "camera:3"):
        source = episode_folder(data(""), TASK, 0, "piper")
        written = render_changed(source, change, tmp_path / change, renderer)
        assert written == replace(read_record(episode_folder(data(change), TASK, 0, "piper")), files=written.files)


def test_inspect_writes_a_changed_data_set(
    data: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    source, out = shutil.copytree(data(""), tmp_path / "data"), tmp_path / "data_table_2"
    trusted = ("--trust", TASK.split(":")[0])

    def run(*flags: object) -> str:
        monkeypatch.setattr(sys, "argv", ["inspect", *map(str, flags), *trusted])
        try:
            inspect()
        except SystemExit as stop:
            assert stop.code == 2
        return "".join(capsys.readouterr())

    assert "2 of 2 episodes rendered with the change table:2" in run(source, "--render", "--change", "table:2", "--out", out)
    assert "changes: table:2 2" in run(out, "--verify")
    assert "1 episodes rendered again" in run(out, "--rerender", 1)
    assert "has the change table:2, expected the change table:3" in run(source, "--render", "--change", "table:3", "--out", out)
    assert "has the change table:2; expected an unchanged" in run(
        out, "--render", "--change", "light:1", "--out", tmp_path / "new"
    )
    for change in ("height:1", "random"):
        assert "needs physics" in run(source, "--render", "--change", change, "--out", tmp_path / "new")
    assert "--change needs --render and --out" in run(source, "--change", "height:1")


@pytest.mark.parametrize("change", ["dust:1", "light", "light:100", "light:-1", "light:1.5", "light:١", "Light:1"])
def test_what_is_no_change_is_refused_in_one_line(change: str, tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match=r"is no change, expected light, background.* from 0 to 99.*, or random\.$") as at:
        generate.generate(generate.Args((TASK,), out=tmp_path / "data", change=change))
    assert "\n" not in str(at.value) and not (tmp_path / "data").exists()


def test_a_header_names_a_change_in_one_way(data: Callable[[str], Path], tmp_path: Path) -> None:
    folder = episode_folder(Path(shutil.copytree(data("light:3"), tmp_path / "data")), TASK, 0, "piper")
    header = json.loads((folder / "episode.json").read_text())
    for change, problem in (("light:03", "its change is 'light:03', expected 'light:3'"), ("lamp:3", "'lamp:3' is no change")):
        (folder / "episode.json").write_text(json.dumps(header | {"change": change}))
        with pytest.raises(EpisodeError, match=problem):
            read_record(folder)


def test_changed_and_unchanged_scenes_are_not_mixed(data: Callable[[str], Path], tmp_path: Path) -> None:
    out = Path(shutil.copytree(data("light:3"), tmp_path / "data"))
    for change, expected in (("", "no change"), ("light:2", "the change light:2")):
        with pytest.raises(EpisodeError, match=f"panda has the change light:3, expected {expected}: .*choose another --out"):
            generate.generate(generate.Args((TASK,), ("piper",), 1, 0, out=out, change=change, device="cpu"))
    changed = Record(TASK, 0, "piper", True, change="light:3")
    assert demand_one_change(out, [changed]) == "light:3"
    assert demand_one_change(out, [changed, replace(changed, change="table:4")]) == "random"
    with pytest.raises(
        EpisodeError, match=r"has 1 unchanged episodes and 1 with a change \(light:3\), which cannot be compared"
    ):
        demand_one_change(out, [changed, replace(changed, change="")])


def test_random_changes_are_a_function_of_the_scene_and_never_graded() -> None:
    drawn = [parse_change(change_of("random", task, seed)) for task in ("lift_pot", "stamp_seal") for seed in range(200)]
    assert drawn == [
        parse_change(change_of("random", task, seed)) for task in ("lift_pot", "stamp_seal") for seed in range(200)
    ]
    assert {change.factor for change in drawn if change} == set(FACTORS)
    assert min(change.level for change in drawn if change) == 4
    assert {change.strength for change in drawn if change} == {1, 2, 3}
    record = Record("lift_pot", 7, "piper", True, change=str(change_of("random", "lift_pot", 7)))
    demand_change(Path("here"), record, "random")
    jobs = Family("lift_pot", 0, 3, NAMES, change="random").next_jobs()
    assert [job.change for job in jobs] == [str(change) for change in drawn[:3]]


@pytest.mark.parametrize("level", [1, 2, 3, 5])
def test_a_changed_camera_is_turned_and_moved_by_its_strength(level: int) -> None:
    change = Change("camera", level)
    camera = spec_camera(camera_of(change))
    offset = camera.extrinsics @ np.linalg.inv(HEAD_CAMERA.extrinsics)
    assert np.degrees(Rotation.from_matrix(offset[:3, :3]).magnitude()) == pytest.approx(1.5 * change.strength, abs=1e-3)
    assert np.linalg.norm(camera.position - HEAD_CAMERA.position) == pytest.approx(0.015 * change.strength, abs=1e-5)
    assert np.array_equal(camera.intrinsics, HEAD_CAMERA.intrinsics) and camera_of(change).problem == ""


def test_level_0_changes_nothing_and_names_say_the_change() -> None:
    assert parse_change("light:0") is parse_change("") is None and change_of("light:00", TASK, 0) == ""
    assert camera_of(None) is camera_of(Change("light", 1)) is HEAD_SPEC
    assert str(parse_change("light:04")) == "light:4"
    assert [split_key("data", SHARED_MOTION, change) for change in ("", "light:2", "random")] == [
        "data",
        "data_light_2",
        "data_random",
    ]
    assert generate.Args(change="light:2").folder == Path("data_light_2")


def test_patterns_are_periodic_and_the_same_on_every_machine() -> None:
    drawn = [
        draw(np.random.Generator(np.random.Philox(key=1)), ((250, 240, 200), (40, 30, 20)))
        for draw in (patterns.plain, patterns.plaster, patterns.wood, patterns.cloth, patterns.tiles, patterns.bricks)
    ]
    assert array_hash(*drawn)[:16] == "7b095d1ee043d0fe"
    rows = patterns.noise(np.random.Generator(np.random.Philox(key=1)), 8, 8)
    assert np.abs(np.diff(rows, axis=0, append=rows[:1])).max() < 0.1


@pytest.mark.parametrize(
    "step", [simulate, pytest.param(simulate_batch, marks=pytest.mark.lab)], ids=["one by one", "in a batch"]
)
def test_objects_stand_on_a_raised_table_in_both_engines(step: Callable[..., list[Motion]]) -> None:
    robot, scenes = ROBOTS["piper"], [make_scene(CLOSE, TASK, 0, change) for change in ("", "height:3")]
    flat, raised = step([World(robot, scene, stand_at_home(robot, 6)) for scene in scenes], "cpu")
    assert np.allclose(raised.object_pose[..., 2] - flat.object_pose[..., 2], raised_by(Change("height", 3)), atol=2e-4)
    assert raised.object_pose[-1, 0, 2] == pytest.approx(scenes[1].objects[0].pose[2], abs=1e-3)

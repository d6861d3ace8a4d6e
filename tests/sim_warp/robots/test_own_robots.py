"""Robots of users by their path: RoboTwin folders, bare URDFs, robot.yaml; kept beside data; and what is told of bad ones."""

import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml

from tests.sim_warp.robots.own_robot import STRIPES, robotwin_config, write_embodiment, write_urdf
from tests.sim_warp.small import TASK, work_inline
from xew.config import ConfigError
from xew.dataset import find_accepted
from xew.episode import array_hash
from xew.sim_warp import generate as command
from xew.sim_warp.embodiment import mesh_files
from xew.sim_warp.generate import Args, generate
from xew.sim_warp.kinematics.forward import tool_pose
from xew.sim_warp.plan import HOME
from xew.sim_warp.production.rerender import render_again
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import RobotSpec, adopt_robots, get_robot, load_robot, load_urdf
from xew.sim_warp.robots.user import own
from xew.sim_warp.robots.user.own import FOLDERS, keep_robot

PLACED: dict[str, Any] = {"root_pose": [0, -0.37, 0.75, 0, 0, 0.5**0.5, 0.5**0.5]}


@pytest.fixture(autouse=True)
def no_listed_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(FOLDERS, raising=False)


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A cache folder that knows no places yet: what an earlier session found proves nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def embodiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_embodiment(tmp_path_factory.mktemp("embodiments") / "my-arm")


def write_yaml(folder: Path, **content: Any) -> Path:
    write_urdf(folder)
    (folder / "robot.yaml").write_text(yaml.safe_dump({"urdf": "small.urdf"} | content))
    return folder


def at_home(robot: RobotSpec) -> np.ndarray:
    """[2] how far both tools are from home, in meters and radians together."""
    off = []
    for arm, home in enumerate(HOME):
        pose = tool_pose(robot, arm, np.array([robot.arms[arm].home]))[0]
        turned = 2 * np.arccos(min(1.0, abs(pose[3:] @ home.rotation.as_quat())))
        off.append(np.linalg.norm(pose[:3] - home.position) + turned)
    return np.array(off)


# --- What is taken from where.


def test_a_robotwin_folder_loads_whole(embodiment: Path) -> None:
    robot = load_robot(embodiment)
    assert robot.key == "my-arm" and robot.title == "small" and robot.urdf == (embodiment / "small.urdf").resolve()
    left, right = robot.arms
    assert left.joints == right.joints == tuple(f"arm{number}" for number in range(1, 7))
    assert left.root_pose == pytest.approx((-0.3, -0.35, 0.784, 0, 0, 0.5**0.5, 0.5**0.5)), "0.6 m apart, .707 made exact"
    assert right.root_pose[0] == pytest.approx(0.3)
    assert (left.tool_link, left.tool_pose) == ("link6", pytest.approx((0.13, 0, 0, 0, 0, 0, 1), abs=1e-6)), "at the tips"
    assert left.finger_closed == (0, 0) and left.finger_open == (0.04, 0.04), "the scale within the limits of the joints"
    assert robot.joint_lower[0] == -3.1 and set(robot.joint_velocity) == {4.0}
    assert at_home(robot).max() < 2e-3, "our home, not homestate: every plan begins there"


def test_the_tool_frame_is_turned_as_delta_matrix_says(tmp_path: Path) -> None:
    """The Panda's: approach along z, fingers opening along -y of the hand."""
    turned = write_embodiment(tmp_path / "turned", delta_matrix=[[0, 0, 1], [0, -1, 0], [1, 0, 0]])
    from xew.sim_warp.robots.user.draft import read_draft

    draft = read_draft(turned / "config.yml").arms[0]
    assert draft.tool_pose == pytest.approx((0, 0, 0.12, 0.5**0.5, 0, 0.5**0.5, 0))


def test_textures_color_the_triangles(embodiment: Path) -> None:
    mesh = load_urdf(embodiment / "small.urdf").links["link3"].visual
    assert mesh is not None
    height = mesh.vertices[mesh.triangles].mean(1)[:, 2]
    middle = (height.min() + height.max()) / 2
    assert (mesh.colors[height < middle - 0.005] == STRIPES[0]).all()
    assert (mesh.colors[height > middle + 0.005] == STRIPES[1]).all()
    plain = load_urdf(embodiment / "small.urdf").links["link1"].visual
    assert plain is not None and (plain.colors == [153, 153, 166]).all()


def test_a_bare_urdf_shows_its_hands_and_finds_its_place(tmp_path: Path) -> None:
    robot = load_robot(write_urdf(tmp_path / "bare"))
    left, right = robot.arms
    assert robot.key == "small" and left.fingers == ("grip_a", "grip_b") and len(left.joints) == 6
    assert left.tool_link == "link6" and left.tool_pose[:3] == pytest.approx((0.13, 0, 0), abs=1e-6), "15 mm behind the tips"
    assert left.finger_closed == (0, 0) and left.finger_open == (0.04, 0.04)
    assert left.root_pose[0] == -right.root_pose[0] < 0 and at_home(robot).max() < 2e-3


def test_a_place_is_searched_for_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process, here another copy of the same files, takes what was found; other files or drafts search again."""
    searched: list[str] = []
    find = own._find_place
    monkeypatch.setattr(own, "_find_place", lambda draft, robot, near: searched.append(robot.key) or find(draft, robot, near))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    first = load_robot(write_urdf(tmp_path / "one"))
    again = load_robot(write_urdf(tmp_path / "two"))
    assert searched == ["small"] and again.arms == first.arms and again.urdf.parent.name == "two"
    longer = write_urdf(tmp_path / "three", {'xyz="-0.264 0 0"': 'xyz="-0.274 0 0"'})
    assert load_robot(longer).arms != first.arms and len(searched) == 2


def test_a_robot_yaml_decides_what_it_names(tmp_path: Path) -> None:
    arms = [PLACED | {"finger_open": [0.03, 0.03], "rest": [0.1] * 6}, {}]
    limits = {"joint_velocity": [1.0] * 6, "joint_acceleration": [2.0] * 6}
    robot = load_robot(write_yaml(tmp_path / "some arm", title="Some arm", arms=arms, distance=0.5, **limits))
    assert (robot.key, robot.title) == ("some_arm", "Some arm")
    assert [arm.root_pose[0] for arm in robot.arms] == [-0.25, 0.25]
    assert robot.arms[1].finger_open == (0.03, 0.03) and robot.joint_velocity == (1.0,) * 6
    kept = keep_robot(robot, tmp_path / "data")
    for found in (robot, kept):
        assert [arm.rest for arm in found.arms] == [(0.1,) * 6, ()], "a rest is of one arm; the other begins at home"
        assert found.joint_acceleration == (2.0,) * 6


def test_a_name_of_the_project_s_robots_is_set_apart(tmp_path: Path) -> None:
    assert load_robot(write_embodiment(tmp_path / "piper")).key == "piper_own"


# --- What official files have and URDF allows.


def test_the_axis_of_a_fixed_joint_is_ignored(tmp_path: Path) -> None:
    mount = '<joint name="eye" type="fixed"><parent link="link6"/><child link="eye"/><axis xyz="0 0 0"/></joint>'
    urdf = load_urdf(write_urdf(tmp_path, {"</robot>": f'<link name="eye"/>{mount}</robot>'}))
    assert urdf.joints["eye"].kind == "fixed" and "eye" not in urdf.joint_names


def test_all_problems_of_a_urdf_are_told_at_once(tmp_path: Path) -> None:
    changes = {"meshes/skin.obj": "none.obj", 'type="revolute"': 'type="floating"', LINK4: LINK4.replace("0.3", "-1")}
    path = write_urdf(tmp_path, changes)
    with pytest.raises(ConfigError) as error:
        load_urdf(path)
    head, *lines = str(error.value).splitlines()
    assert head == f"{path.resolve()} has 3 problems:" and len(lines) == 3
    assert all(any(part in line for line in lines) for part in ("none.obj", "arm1 is floating", "a mass of -1 kg"))


@pytest.mark.parametrize("kind", ["glb", "gltf"])
def test_meshes_may_be_gltf(kind: str, tmp_path: Path) -> None:
    path = write_urdf(tmp_path, {"meshes/skin.obj": f"meshes/skin.{kind}"})
    path.write_text(path.read_text().replace("meshes/skin.obj", f"meshes/skin.{kind}"))
    shape = trimesh.creation.box((1, 1, 1))
    shape.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255]))
    exported = shape.export(file_type=kind)
    for name, content in (exported if kind == "gltf" else {"model.glb": exported}).items():
        (path.parent / "meshes" / name.replace("model", "skin")).write_bytes(content)
    visual = load_urdf(path).links["link3"].visual
    assert visual is not None and set(map(tuple, visual.colors)) == {(255, 0, 0)}
    assert np.isclose(np.ptp(visual.vertices[:, 0]), 0.25)


@pytest.mark.parametrize("start", ["file:///home/author/ws/arm/", "/home/author/ws/arm/"])
def test_files_of_another_machine_are_found_by_their_end(start: str, tmp_path: Path) -> None:
    path = write_urdf(tmp_path / "arm", {"meshes/skin.obj": f"{start}meshes/skin.obj"})
    urdf, found = load_urdf(path), path.parent / "meshes" / "skin.obj"
    assert urdf.meshes[f"{start}meshes/skin.obj"] == found
    assert urdf.notes == (f"{start}meshes/skin.obj is not on this machine: {found} is used instead",)


def test_textures_of_materials_color_the_triangles(tmp_path: Path) -> None:
    """By the mesh's coordinates in the picture; without any all of it has the picture's mean color."""
    old = '<material name="gray"><color rgba="0.6 0.6 0.65 1"/></material>'
    path = write_urdf(tmp_path, {old: '<material name="skin"><texture filename="textures/skin.png"/></material>'})
    urdf = load_urdf(path)
    base, other = (urdf.links[name].visual for name in ("base", "link1"))
    assert base is not None and other is not None and set(map(tuple, other.colors)) == {(153, 153, 166)}
    assert (base.colors == np.round(np.mean(STRIPES, axis=0))).all()
    assert path.parent / "textures" / "skin.png" in urdf.files


def test_without_collision_shapes_what_is_seen_collides(tmp_path: Path) -> None:
    path = write_urdf(tmp_path)
    path.write_text(re.sub(r"<collision>.*?</collision>", "", path.read_text(), flags=re.DOTALL))
    urdf = load_urdf(path)
    assert all(len(link.collisions) == 1 and len(link.collisions[0].points) == 8 for link in urdf.links.values())
    assert urdf.notes == ("it has no collision shapes: the convex hulls of its visuals collide instead",)


# --- Kept beside the data.


def test_data_keep_their_robot(embodiment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Made with a path, read elsewhere after the path has gone."""
    work_inline(monkeypatch)
    source, data = tmp_path / "my-arm", tmp_path / "data"
    shutil.copytree(embodiment, source)
    args = Args(tasks=(TASK,), robots=(str(source),), train_seeds=1, test_seeds=0, out=data, workers=1, device="cpu")
    assert [family.accepted for family in generate(args)] == [1, 0]
    assert [record.robot for _, record in find_accepted(data)] == ["my-arm"]
    assert [family.accepted for family in generate(args)] == [1, 0], "again, with what is kept"
    shutil.rmtree(source)
    moved = data.rename(tmp_path / "moved")
    with pytest.raises(ConfigError, match=r"unknown robot 'my-arm'.*For robots of a data set, list <data>/robots in"):
        get_robot("my-arm")
    folder, record = find_accepted(moved)[0]
    assert array_hash(render_again(folder, Renderer("cpu"))[0]) == record.hashes["rgb"]
    assert get_robot("my-arm", moved).urdf.is_relative_to(moved.resolve())
    assert FOLDERS not in os.environ, "folders are passed, the environment is the user's"


def test_what_is_kept_is_the_same_robot(embodiment: Path, tmp_path: Path) -> None:
    assert adopt_robots([str(embodiment), "piper"], tmp_path) == ("my-arm", "piper")
    ours, kept = load_robot(embodiment), get_robot("my-arm", tmp_path)
    assert kept.arms == ours.arms and (kept.joint_lower, kept.joint_upper) == (ours.joint_lower, ours.joint_upper)
    for name, link in load_urdf(ours.urdf).links.items():
        other = load_urdf(kept.urdf).links[name].visual
        assert link.visual is not None and other is not None
        assert (link.visual.vertices == other.vertices).all() and (link.visual.colors == other.colors).all()


def test_meshes_anywhere_are_kept(tmp_path: Path) -> None:
    """Named absolutely, and by a package above."""
    folder, far = tmp_path / "description" / "urdf", tmp_path / "far"
    path = write_urdf(folder)
    far.mkdir()
    shutil.move(folder / "meshes" / "box.stl", far / "box.stl")
    shutil.move(folder / "textures", tmp_path / "textures")
    for name in ("skin.obj", "skin.mtl"):
        shutil.move(folder / "meshes" / name, tmp_path / "description" / name)
    named = path.read_text().replace("meshes/box.stl", str(far / "box.stl"))
    path.write_text(named.replace("meshes/skin.obj", "package://description/skin.obj"))
    (folder / "robot.yaml").write_text(yaml.safe_dump({"urdf": "small.urdf", "arms": [PLACED, {}]}))
    (key,) = adopt_robots([f"{folder}/"], tmp_path / "data")
    for gone in (far, tmp_path / "description", tmp_path / "textures"):
        shutil.rmtree(gone)
    kept = load_urdf(get_robot(key, tmp_path / "data").urdf).links["link3"].visual
    assert kept is not None and set(map(tuple, kept.colors)) == set(STRIPES)


def test_another_robot_of_the_same_name_is_told(embodiment: Path, tmp_path: Path) -> None:
    adopt_robots([str(embodiment)], tmp_path / "data")
    other = write_embodiment(tmp_path / "my-arm", gripper_bias=0.11)
    with pytest.raises(ConfigError, match=r"my-arm holds another robot of that name.*rename the folder"):
        adopt_robots([str(other)], tmp_path / "data")


def test_robots_are_found_in_the_folders_of_the_environment(
    embodiment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    adopt_robots([str(embodiment)], tmp_path / "one")
    monkeypatch.setenv(FOLDERS, os.pathsep.join(str(tmp_path / name / "robots") for name in ("two", "one")))
    assert get_robot("my-arm").urdf.is_relative_to((tmp_path / "one").resolve())


def test_a_data_set_s_robot_goes_before_those_of_the_environment(
    embodiment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("one", "two"):
        adopt_robots([str(embodiment)], tmp_path / name)
    monkeypatch.setenv(FOLDERS, str(tmp_path / "one" / "robots"))
    assert get_robot("my-arm", tmp_path / "two").urdf.is_relative_to((tmp_path / "two").resolve())
    assert get_robot("my-arm", tmp_path / "none").urdf.is_relative_to((tmp_path / "one").resolve())
    assert get_robot(get_robot("my-arm")) == get_robot("my-arm"), "a robot itself is a name of it too"


# --- What is told of bad robots.


def refused(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> str:
    """What `generate --robot` says: one line and exit code 2, without a traceback, and nothing is made."""
    out = tmp_path / "data"
    flags = ["--robots", str(path), "--out", str(out), "--tasks", TASK, "--device", "cpu", "--workers", "1"]
    monkeypatch.setattr(sys, "argv", ["generate", *flags])
    with pytest.raises(SystemExit) as left:
        command.main()
    assert left.value.code == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert not list(out.glob("*/*/*")) and not list((out / "robots").glob("*"))
    return told[-1]


LINK4 = '<link name="link4"><inertial><mass value="0.3"/><inertia ixx="0.001"'
LIMIT = '<limit lower="-1.6" upper="1.55" velocity="4" effort="50"/>'
BAD_URDFS: list[tuple[dict[str, str], str]] = [
    ({"meshes/skin.obj": "meshes/none.obj"}, "link link3 names the mesh meshes/none.obj, which does not exist"),
    ({'<parent link="base"/>': '<parent link="link6"/>'}, "no way leads from base to"),
    ({'<parent link="link1"/>': '<parent link="link2"/>'}, "no way leads from base to finger_a, finger_b, link2"),
    ({LIMIT: ""}, "the arm's joint arm4 has no limits (from -inf to inf); give it <limit"),
    ({LIMIT: '<limit lower="1" upper="-1" effort="1" velocity="1"/>'}, "arm4 has no limits (from 1 to -1)"),
    ({LIMIT: '<limit lower="nan" upper="1" effort="1" velocity="1"/>'}, "the limit of joint arm4 has a number that is not"),
    ({LINK4: LINK4.replace("0.001", "nan")}, "the inertial of link link4 has a number that is not finite"),
    ({LINK4: LINK4.replace("0.3", "-1")}, "the inertial of link link4 has a mass of -1 kg"),
    ({'xyz="0 0 0.06"': 'xyz="0 0 inf"'}, "the origin of joint arm1 has a number that is not finite"),
    ({'scale="0.26 0.04 0.04"': 'scale="260 40 40"'}, "link link2 is 260 m large; is its mesh in millimeters?"),
    ({'<link name="link2">': '<link name="link1">'}, "more than one link is called link1; names must be unique"),
    ({'type="prismatic"': 'type="revolute"'}, "found 0 hands (a link with two prismatic finger joints)"),
    ({'name="arm1" type="revolute"': 'name="arm1" type="fixed"'}, "5 joints turn on the way to link6"),
    ({'upper="0.04"': 'upper="0.0"'}, "the finger grip_a is prismatic from 0 to 0; expected a prismatic joint with limits"),
    ({'type="revolute"': 'type="floating"'}, "joint arm1 is floating; expected fixed, revolute"),
    ({"</robot>": ""}, "is not a URDF that can be read"),
    ({'xyz="0 0 1"': 'xyz="0 0 0"'}, "joint arm1 has the axis 0 0 0; give it a direction"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "told"), BAD_URDFS, ids=[told[:40] for _, told in BAD_URDFS])
def test_a_bad_urdf_ends_in_one_line(
    changes: dict[str, str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    path = write_urdf(tmp_path / "bad", changes)
    line = refused(path, tmp_path, monkeypatch, capsys)
    assert line.startswith("error: ") and told in line and str(path) in line


def huge_file(path: Path) -> None:
    with path.open("r+b") as file:
        file.truncate(int(mesh_files.LARGEST_FILE) + 1)


def many_triangles(path: Path) -> None:
    sphere = trimesh.creation.icosphere(3)
    sphere.export(path)


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (huge_file, "box.stl has 200 MB, at most 200; simplify it"),
        (many_triangles, "box.stl has 1280 triangles, at most 1000; simplify it"),
        (lambda path: path.write_bytes(b""), "box.stl"),
        (lambda path: path.write_bytes(b"not a mesh" * 20), "box.stl"),
    ],
    ids=["huge file", "many triangles", "empty", "no mesh"],
)
def test_a_bad_mesh_ends_in_one_line(
    damage: Callable[[Path], None],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    monkeypatch.setattr(mesh_files, "MOST_TRIANGLES", 1000)
    path = write_urdf(tmp_path / "bad")
    damage(path.parent / "meshes" / "box.stl")
    assert told in refused(path, tmp_path, monkeypatch, capsys)


BAD_CONFIGS: list[tuple[dict[str, Any], str]] = [
    ({"delta_matrix": None}, "missing key 'delta_matrix'; expected the keys of a RoboTwin embodiment"),
    ({"delta_matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "expected a rotation matrix"),
    ({"delta_matrix": [[1, 0], [0, 1]]}, "expected finite numbers of shape (3, 3)"),
    ({"gripper_bias": "far"}, "gripper_bias is 'far'; expected numbers"),
    ({"gripper_scale": [0.04, 0.04]}, "move 0 and 0 mm from closed to open; expected equal strokes"),
    ({"gripper_name": [{"base": "grip_a", "mimic": []}]}, "expected a base joint and one mimic of"),
    ({"gripper_name": [{"base": "grip_c", "mimic": [["grip_b", 1, 0]]}]}, "small.urdf has no joint grip_c; it has arm1"),
    ({"robot_pose": [[0, 0, 0]]}, "robot_pose is [[0, 0, 0]]; expected lists of x y z and a quaternion w x y z"),
    ({"robot_pose": [[0, -3, 0.75, 0.707, 0, 0, 0.707]]}, "m, facing +y, both arms reach home."),
    ({"ee_joints": ["nowhere"]}, "has no link or joint nowhere; expected the tool's link"),
    ({"arm_joints_name": [["arm1", "arm2"]]}, "have 2 and 2 joints; expected equal arms of six or seven"),
    ({"homestate": [[0, 0]]}, "a home has 2 joints; expected 6"),
    ({"urdf_path": "./none.urdf"}, "none.urdf does not exist; expected a URDF file"),
    ({"dual_arm": "no"}, "dual_arm is 'no'; expected a bool"),
]


@pytest.mark.parametrize(("changes", "told"), BAD_CONFIGS, ids=[told[:40] for _, told in BAD_CONFIGS])
def test_a_bad_embodiment_ends_in_one_line(
    changes: dict[str, Any], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    assert set(changes) <= set(robotwin_config())
    assert told in refused(write_embodiment(tmp_path / "bad", **changes), tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({"urdff": "small.urdf"}, "unknown key 'urdff'; did you mean 'urdf'?"),
        ({"arms": [PLACED | {"tool_pose": [0, 0, 0, 0, 0, 0, 0]}, {}]}, "expected a position and a unit quaternion x y z w"),
        ({"arms": [PLACED | {"home": [0.0] * 5}, {}]}, "a home has 5 joints; expected 6"),
        ({"arms": [PLACED, PLACED | {"joints": ["arm1", "arm2"]}]}, "the arms have 6 and 2 joints; expected equal arms"),
        ({"arms": [PLACED, {}], "joint_upper": [1.0]}, "need 6 numbers each"),
        ({"arms": [PLACED, {}], "joint_acceleration": [1.0] * 5}, "expected 6 numbers above 0"),
        ({"arms": [PLACED | {"rest": [9.0] * 6}, {}]}, "the left arm's rest is [9.0, 9.0, 9.0"),
        ({"urdf": 3}, "urdf: expected str, found int 3"),
    ],
)
def test_a_bad_robot_yaml_ends_in_one_line(
    content: dict[str, Any], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    assert told in refused(write_yaml(tmp_path / "bad", **content), tmp_path, monkeypatch, capsys)


def test_what_is_no_robot_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.txt").write_text("")
    for path, told in (("none", "there is no robot at"), ("empty", "holds no URDF, no robot.yaml"), ("a.txt", "is no robot")):
        assert told in refused(tmp_path / path, tmp_path, monkeypatch, capsys)

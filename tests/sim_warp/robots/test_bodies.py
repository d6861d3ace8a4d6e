"""Procedural bodies as robots: named by number, placed by the catalog, kept in the cache folder, and mixed with any others."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.sim_warp.robots.own_robot import write_urdf
from tests.sim_warp.robots.test_own_robots import at_home
from tests.sim_warp.small import TASK, produce
from xew.analysis.distance import find_robots
from xew.config import ConfigError
from xew.dataset import read_dataset
from xew.episode import episode_folder, verify_episode
from xew.protocol import body_key, expand_robots
from xew.sim_warp.embodiment import prepared
from xew.sim_warp.kinematics.expert import joint_commands
from xew.sim_warp.production.cells import Job
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import adopt_robots, get_robot, load_robot, load_urdf
from xew.sim_warp.robots.procedural import design_body
from xew.sim_warp.robots.procedural.bodies import keep_files
from xew.sim_warp.robots.user.trials import trial_plans


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


# --- Names.


def test_a_body_is_named_by_its_number() -> None:
    robot = get_robot("body:3")
    assert robot is get_robot("body_3") and (robot.key, robot.title) == ("body_3", "Body 3") and ":" not in body_key(3)


def test_ranges_stand_for_bodies_in_a_row() -> None:
    assert expand_robots(["piper", "body:8-10", "body:2"]) == ("piper", "body_8", "body_9", "body_10", "body_2")
    assert expand_robots(["lab/body:1", "my:SPEC"]) == ("lab/body:1", "my:SPEC")
    assert adopt_robots(["body:0-1", "piper"], Path("none")) == ("body_0", "body_1", "piper")


@pytest.mark.parametrize(
    ("name", "told"), [("body:5000", "there is no body:5000; expected body:0 to body:"), ("body:3-1", "cannot import")]
)
def test_a_body_that_is_not_there_is_told(name: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        get_robot(expand_robots([name])[0])


def test_a_user_s_robot_of_a_body_s_name_is_set_apart(tmp_path: Path) -> None:
    path = write_urdf(tmp_path / "body_3")
    assert load_robot(path.rename(path.with_name("body_3.urdf"))).key == "body_3_own"


def test_distances_take_bodies() -> None:
    assert list(find_robots(["piper", "body:1-3", "body_5"])) == ["piper", "body_1", "body_2", "body_3", "body_5"]


@pytest.mark.parametrize("number", [0, 7, 31, 63, 95, 104, 140])
def test_a_body_stands_where_it_works(number: int) -> None:
    """Both tools are home, within the limits; and the experts follow plans of tasks."""
    robot = get_robot(f"body:{number}")
    assert at_home(robot).max() < 4e-3
    for arm in robot.arms:
        assert (np.array(robot.joint_lower) < arm.home).all() and (np.array(arm.home) < robot.joint_upper).all()
    few = list(trial_plans()[:4])
    assert [commands.problem for commands in joint_commands(robot, few)] == [None] * len(few)


def test_one_batch_mixes_bodies_with_other_robots(tmp_path: Path) -> None:
    """Folders have no colon, and the header finds its robot again."""
    robots = adopt_robots(["piper", "body:0-1", "body:2"], tmp_path)
    (records,) = produce(
        [Job(TASK, 0, robots)], tmp_path, Renderer("cpu"), videos=False, robots={name: get_robot(name) for name in robots}
    )
    assert {record.robot: record.success for record in records} == dict.fromkeys(("piper", "body_0", "body_1", "body_2"), True)
    folder = episode_folder(tmp_path, TASK, 0, "body_2")
    assert folder.name == "body_2" and verify_episode(folder).robot == "body_2"
    assert {record.robot for _, record in read_dataset(tmp_path).select(robots=expand_robots(["body:0-2"]))} == {
        "body_0",
        "body_1",
        "body_2",
    }


# --- Files.


def test_files_are_kept_once_and_read_as_the_meshes_say(empty_cache: Path, tmp_path: Path) -> None:
    design = design_body(5)
    path = keep_files(design)
    assert path.is_relative_to(empty_cache) and keep_files(design) == path
    bare = tmp_path / "bare"
    shutil.copytree(path.parent, bare)
    (bare / prepared.PREPARED).unlink()
    quick, slow = load_urdf(path), load_urdf(bare / path.name)
    assert {file.name for file in quick.files} == {file.name for file in slow.files} and set(quick.meshes) == set(slow.meshes)
    for name, link in slow.links.items():
        other = quick.links[name]
        assert link.visual is not None and other.visual is not None
        for field in ("vertices", "triangles", "colors", "normals"):
            a, b = getattr(link.visual, field), getattr(other.visual, field)
            assert a.dtype == b.dtype and np.array_equal(a, b), (name, field)
        assert [shape.name for shape in link.collisions] == [shape.name for shape in other.collisions]
        assert all(np.array_equal(a.points, b.points) for a, b in zip(link.collisions, other.collisions, strict=True))


def test_arrays_of_another_urdf_do_not_count(empty_cache: Path) -> None:
    path = keep_files(design_body(6))
    assert prepared.read_prepared(path) is not None
    path.write_bytes(path.read_bytes() + b"\n")
    assert prepared.read_prepared(path) is None and load_urdf(path).links


def test_a_cache_that_cannot_be_written_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(ConfigError, match="Set XDG_CACHE_HOME to another folder"):
        keep_files(design_body(0))

"""Procedural bodies as robots: named by number, placed by the catalog, kept in the cache folder, and mixed with any others."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from tests.sim_warp.robots.own_robot import write_urdf
from tests.sim_warp.robots.test_own_robots import at_home
from tests.sim_warp.small import TASK, InlineWorkers
from xew.analysis.distance import find_robots
from xew.config import ConfigError
from xew.dataset import read_dataset
from xew.episode import episode_folder, verify_episode
from xew.protocol import body_key, expand_robots
from xew.sim_warp import bodies
from xew.sim_warp.bodies import body_places, find_bodies, try_candidate
from xew.sim_warp.devices.workers import Workers
from xew.sim_warp.embodiment import prepared
from xew.sim_warp.kinematics.expert import joint_commands
from xew.sim_warp.production.cells import Job
from xew.sim_warp.production.produce import produce
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import adopt_robots, get_robot, load_robot, load_urdf
from xew.sim_warp.robots.procedural import design_body
from xew.sim_warp.robots.procedural.bodies import Entry, catalog_text, keep_files, read_catalog, unplaced_body
from xew.sim_warp.robots.procedural.design import WIDE
from xew.sim_warp.robots.user.trials import trial_plans

POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


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


# --- The catalog.


def test_the_catalog_holds_different_candidates_of_each_family() -> None:
    numbers = [entry.candidate for entry in read_catalog()]
    assert len(numbers) == bodies.BODY_COUNT == len(set(numbers))
    assert max(numbers[: bodies.FIRST_FAMILY]) < WIDE <= min(numbers[bodies.FIRST_FAMILY :])


@pytest.mark.parametrize("number", [0, 7, 31, 63, 95, 104, 140])
def test_a_body_stands_where_it_works(number: int) -> None:
    """Both tools are home, within the limits; and the experts follow plans of tasks."""
    robot = get_robot(f"body:{number}")
    assert at_home(robot).max() < 4e-3
    for arm in robot.arms:
        assert (np.array(robot.joint_lower) < arm.home).all() and (np.array(arm.home) < robot.joint_upper).all()
    few = list(trial_plans()[:4])
    assert [commands.problem for commands in joint_commands(robot, few)] == [None] * len(few)


def test_the_catalog_is_what_the_command_finds() -> None:
    known = read_catalog()[0]
    number, found = try_candidate(known.candidate)
    assert number == known.candidate and isinstance(found, Entry)
    assert np.allclose(found.root_pose, known.root_pose) and np.allclose(found.home, known.home, atol=2e-3)


def test_candidates_that_fail_are_skipped_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    def check(number: int) -> tuple[int, Entry | str]:
        return number, "too short" if number % 3 == 1 else Entry(number, (POSE, POSE), ((0.0,), (0.0,)))

    monkeypatch.setattr(bodies, "try_candidate", check)
    monkeypatch.setattr(bodies, "FIRST_FAMILY", 6)
    made = list(find_bodies((), 4, workers=1))
    assert [number for number, _ in made] == [0, 1, 2, 3, 4, 5] and made[1][1] == made[4][1] == "too short"
    known = tuple(entry for _, entry in made if isinstance(entry, Entry))
    longer = [number for number, entry in find_bodies(known, 6, workers=1) if isinstance(entry, Entry)]
    assert longer == [6, 8], "a longer catalog begins like a shorter one"
    known += tuple(Entry(number, (POSE, POSE), ((0.0,), (0.0,))) for number in longer)
    assert next(find_bodies(known, 7, workers=1))[0] == WIDE, "bodies after those of the first family are of the wide one"


def test_a_body_that_fails_in_physics_is_told() -> None:
    """The design that once was body:14 follows all plans, but stands 3 mm deep in the table's edge."""
    pose = (-0.225, -0.45, 0.6, 0.0618281, -0.0618281, 0.7043985, 0.7043985)
    homes = (-0.7539, -0.1228, 0.3966, 1.0381, 0.2359, -0.7231), (-0.2081, -0.1349, 0.3837, 0.9804, 0.0706, -0.1959)
    problem = bodies.find_failure(Entry(16, (pose, (-pose[0], *pose[1:])), homes))
    assert problem == "place_empty_cup, seed 2: an arm pressed 2.8 mm into the table"


def entry(number: int) -> Entry:
    return Entry(number, (POSE, POSE), ((0.0,), (0.0,)))


@pytest.fixture
def odd_numbers_are_too_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Families of three bodies, in which candidates 1 and 2 and the wide family's first fail in physics."""
    monkeypatch.setattr(Workers, "run", lambda self, function, jobs: map(function, reversed(jobs)))  # in any order
    monkeypatch.setattr(bodies, "FIRST_FAMILY", 3)
    monkeypatch.setattr(bodies, "find_failure", lambda known: "it falls" if known.candidate in (1, 2, WIDE) else None)
    monkeypatch.setattr(bodies, "try_candidate", lambda n: (n, "too short" if n % 2 else entry(n)))


@pytest.mark.usefixtures("odd_numbers_are_too_short")
def test_bodies_that_fail_are_replaced_and_all_others_stay() -> None:
    known = [entry(number) for number in (0, 1, 2, WIDE, WIDE + 1)]
    made = [(number, problem, entry.candidate) for number, problem, entry in bodies.replace_failing(known, 1)]
    assert made == [(1, "it falls", 4), (2, "it falls", 6), (3, "it falls", WIDE + 2)]


@pytest.mark.usefixtures("odd_numbers_are_too_short")
def test_a_catalog_that_was_checked_again_is_filled_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "catalog.json"
    path.write_text(catalog_text([entry(0), entry(1)]))
    bodies.fill_catalog(bodies.Args(count=4, recheck=True, workers=1, out=path))
    assert path.read_text() == catalog_text([entry(number) for number in (0, 2, 4, WIDE)])
    out = capsys.readouterr().out
    assert "body:1 is replaced by candidate 2: it falls" in out and "candidate 3 is skipped: too short" in out


def test_a_catalog_is_read_as_it_was_written(tmp_path: Path) -> None:
    entries = read_catalog()[:2]
    path = tmp_path / "catalog.json"
    path.write_text(catalog_text(entries))
    assert read_catalog(path) == entries
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(ConfigError, match="is no catalog of bodies"):
        read_catalog(tmp_path / "bad.json")


def test_a_base_that_leans_is_tried_leaning() -> None:
    design = next(design for number in range(40) if (design := design_body(number)).mount == "tilted")
    robot = body_places(design, unplaced_body(design, "a", "a"))[0]
    x, y, z, w = robot.arms[0].root_pose[3:]
    up = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    assert up[:2] == pytest.approx([0, np.sin(design.lean)], abs=1e-6), "towards the table, which lies at +y"


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
    with pytest.raises(ConfigError, match="Name another cache folder by XDG_CACHE_HOME"):
        keep_files(design_body(0))


def test_workers_begin_when_the_kernels_of_their_checks_are_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[str] = []
    begun: list[set[str]] = []

    class Inline(InlineWorkers):
        def run(self, function: Callable, jobs: Sequence[int]) -> Iterator[tuple[int, str]]:
            begun.append(set(compiled))
            return iter([(job, "skipped") for job in jobs])

    monkeypatch.setattr(bodies, "Workers", Inline)
    monkeypatch.setattr(bodies, "compile_on_devices", lambda pool, devices, batch: compiled.extend(devices))
    assert next(find_bodies((), 1, workers=2)) == (0, "skipped")
    assert begun == [{"physics", "kinematics"}]


def test_two_processes_write_the_same_bytes() -> None:
    """This one, and one with another locale, hash seed and number of threads."""
    environment = os.environ | {"PYTHONHASHSEED": "77", "OMP_NUM_THREADS": "2", "LC_ALL": "C"}
    command = [sys.executable, "-m", "xew.sim_warp.bodies", "--digest", "--count", "16"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert lines == list(bodies.digest_lines(bodies.read_catalog()[:16])) and len(set(lines)) == len(lines) == 17

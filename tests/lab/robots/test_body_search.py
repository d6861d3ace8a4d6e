"""The search for procedural bodies: candidates in order, replaced where they fail, and written as the catalog."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from lab.robots import bodies
from lab.robots.bodies import body_places, catalog_text, find_bodies, try_candidate
from tests.commands import run_command
from tests.sim_warp.small import InlineWorkers
from xew.config import ConfigError
from xew.sim_warp.devices.workers import Workers
from xew.sim_warp.robots.procedural import design_body
from xew.sim_warp.robots.procedural.bodies import Entry, read_catalog, unplaced_body
from xew.sim_warp.robots.procedural.design import WIDE

POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def test_the_catalog_holds_different_candidates_of_each_family() -> None:
    numbers = [entry.candidate for entry in read_catalog()]
    assert len(numbers) == bodies.BODY_COUNT == len(set(numbers))
    assert max(numbers[: bodies.FIRST_FAMILY]) < WIDE <= min(numbers[bodies.FIRST_FAMILY :])


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


def test_a_body_that_fails_in_physics_is_reported() -> None:
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
    with pytest.raises(ConfigError, match=r"bad\.json"):
        read_catalog(tmp_path / "bad.json")


def test_a_base_that_leans_is_tried_leaning() -> None:
    design = next(design for number in range(40) if (design := design_body(number)).mount == "tilted")
    robot = body_places(design, unplaced_body(design, "a", "a"))[0]
    x, y, z, w = robot.arms[0].root_pose[3:]
    up = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    assert up[:2] == pytest.approx([0, np.sin(design.lean)], abs=1e-6), "towards the table, which lies at +y"


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
    command = [sys.executable, "-m", "lab.robots.bodies", "--digest", "--count", "16"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert lines == list(bodies.digest_lines(bodies.read_catalog()[:16])) and len(set(lines)) == len(lines) == 17


def test_a_search_without_workers_ends_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AssertionError, match=r"ended with 2:\n.*--workers is 0") as refused:
        run_command("lab.robots.bodies", *["--count", "1", "--out", "bodies.json", "--workers", "0"])
    assert "Traceback" not in str(refused.value) and not list(tmp_path.iterdir())

"""The debug study from nothing to a report by its real commands, then a part of it from its data, killed again and again.

The task is the tests' own of twelve simulated frames, and of the 18 models five are made, something of every part.
"""

import filecmp
import json
import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import pytest
import yaml

from tests.metrics.quick import QUICK
from tests.sim_warp.small import TASK
from xew.protocol import BASELINES, PAPER_PARTS, PARTS, VARIANTS

ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "configs" / "study_debug.yaml"
MADE = (
    "fixed-optical_flow-none",
    "fixed-joints-none",
    "fixed-optical_flow-nine_views",
    "loeo_franka_panda-*",
    "few_shot-piper-1",
)
"""Something of each table."""
ADAPTED = "few_shot-piper-1"
"""An adaptation from one of the others."""
PART = (ADAPTED, "--parts", "few_shot", "forgetting")
"""What is killed: a training, an adaptation from it, and all that they need and lead to."""
KILLS = 3


@dataclass(frozen=True)
class Place:
    """Where a study of this file lies, and what it shares with others."""

    root: Path
    config: Path
    environment: dict[str, str]

    @property
    def study(self) -> Path:
        return self.root / "study"

    def command(self, *variants: str) -> list[str]:
        """Of a study of these variants (and of more choices after them)."""
        files = [str(self.config), "--experiment", str(ROOT / "configs" / "debug.yaml")]
        return [sys.executable, "-m", "xew.analysis.study", *files, "--out", "study", "--tasks", TASK, "--variants", *variants]

    def run(self, *variants: str) -> str:
        """What the study's command prints; it must end well."""
        done = subprocess.run(self.command(*variants), cwd=self.root, env=self.environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """A folder without data or weights; compiled programs are those of the session, which compiles many of them too."""
    root = tmp_path_factory.mktemp("debug")
    settings = yaml.safe_load(CONFIG.read_text())
    # XLA's options are those of the session, but not for grading, which computes for longer than it compiles.
    settings["step_environment"] = {"evaluate": {"XLA_FLAGS": ""}}
    settings["evaluate"] = ["--masks", QUICK]  # the masker that finds masks is at work in tests/metrics/test_evaluate.py
    (root / "config.yaml").write_text(yaml.safe_dump(settings))
    own = {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""}
    yield Place(root, root / "config.yaml", os.environ | own)
    shutil.rmtree(root)


@pytest.fixture(scope="module")
def printed(place: Place) -> str:
    """The whole study, from nothing."""
    return place.run(*MADE)


def rows_of(study: Path) -> pd.DataFrame:
    return pd.read_parquet(study / "scores.parquet")


def test_from_nothing_to_a_report(place: Place, printed: str) -> None:
    table = rows_of(place.study)
    planned = table.attrs["study"]
    assert set(table["variant"]) == {"", *planned["variants"]}
    assert len(planned["variants"]) == len(MADE) and planned["incomplete"] == [] and not planned["of_paper"]
    for part in PAPER_PARTS:
        assert {variant.name for variant in PARTS[part]} & set(planned["variants"]), f"nothing of {part}"
    for name, counts in planned["variants"].items():
        assert counts["found"] == dict.fromkeys(VARIANTS[name].graded_robots, 1)
    assert set(table.loc[table["variant"] == "", "model"]) == set(BASELINES)
    assert table["value"].notna().all()
    assert (place.study / "report" / "index.html").stat().st_size > 10_000
    assert f"report: {Path('study', 'report', 'index.html')}" in printed


def test_done_is_done(place: Place, printed: str) -> None:
    before = {path: path.stat().st_mtime_ns for path in place.study.rglob("*") if path.is_file() and "state" not in path.parts}
    again = place.run(*MADE)
    after = {path: path.stat().st_mtime_ns for path in before}
    changed = {path.name for path in before if before[path] != after[path]}
    assert changed <= {"study.yaml", "status.txt", ".lock"}
    assert "[0/" not in again.partition("about")[2], again


def test_an_adaptation_started_from_its_variant(place: Place, printed: str) -> None:
    start = json.loads((place.study / "runs" / ADAPTED / "start.json").read_text())
    assert Path(start["run"]).name == VARIANTS[ADAPTED].start.name  # type: ignore[union-attr]


def test_killed_anywhere_it_ends_in_the_same_videos_and_scores(place: Place, printed: str) -> None:
    """A part of the study again from nothing but data and compiled programs, killed as it goes: the same bytes at the end."""
    killed = Place(place.root / "killed", place.config, place.environment)
    shutil.copytree(place.study / "data", killed.study / "data")
    moments = random.Random(int(time.time()))
    for number in range(KILLS):
        seconds = moments.uniform(3, 10)
        print(f"kill {number} after {seconds:.2f} s")
        process = subprocess.Popen(killed.command(*PART), cwd=killed.root, env=killed.environment, stdout=subprocess.PIPE)
        try:
            process.communicate(timeout=seconds)
            break
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
    killed.run(*PART)
    found, expected = rows_of(killed.study), rows_of(place.study)
    made = [folder.name for folder in (killed.study / "rollouts").iterdir()]
    assert ADAPTED in made and len(made) > 1
    for variant in made:
        folders = (study / "rollouts" / variant for study in (place.study, killed.study))
        assert different_videos(*folders) == []
        rows = (table[table["variant"] == variant].reset_index(drop=True) for table in (expected, found))
        pd.testing.assert_frame_equal(*rows, check_categorical=False)


def different_videos(straight: Path, killed: Path) -> list[str]:
    """Names of videos that only one of two folders of rollouts holds, or whose bytes differ."""
    first, second = ({path.relative_to(top) for path in top.rglob("rgb.mkv")} for top in (straight, killed))
    assert first, f"{straight} is empty"
    shared = {file for file in first & second if not filecmp.cmp(straight / file, killed / file, shallow=False)}
    return sorted(map(str, (first ^ second) | shared))

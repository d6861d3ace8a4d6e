"""The debug study from nothing to a report by its real commands, then a part of it from its data, killed again and again.

The whole study runs in this process, what is redone and what is killed in processes of their own. The task is the tests' own of
twelve simulated frames, and of the 18 models four are made, something of every part; models that are given joints in place of
videos are trained and rolled out in tests/model/test_pipeline.py, other systems in test_systems.py beside it.
"""

import contextlib
import filecmp
import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import pandas as pd
import pytest
import yaml

from tests.analysis.inline import InlineMachines
from tests.metrics.quick import QUICK, QUICK_TRACKS
from tests.sim_warp.small import TASK, work_inline
from xew.analysis import study, study_analyse
from xew.config import read_yaml
from xew.protocol import BASELINES, PAPER_PARTS, PARTS, VARIANTS

ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "configs" / "study_debug.yaml"
MADE = (
    "fixed-optical_flow-none",
    "fixed-optical_flow-nine_views",
    "loeo_franka_panda-*",
    "few_shot-piper-1",
)
"""Something of each part of the paper."""
ADAPTED = "few_shot-piper-1"
"""An adaptation from one of the others."""
PART = (ADAPTED, "--parts", "few_shot", "forgetting")
"""What is killed: a training, an adaptation from it, and all that they need and lead to."""
KILLS = 2


@dataclass(frozen=True)
class Place:
    """Where a study of this file lies, and the config that it shares with others."""

    root: Path
    config: Path

    @property
    def study(self) -> Path:
        return self.root / "study"

    def arguments(self, *variants: str) -> list[str]:
        """Of a study of these variants (and of more choices after them)."""
        files = [str(self.config), "--experiment", str(ROOT / "configs" / "debug.yaml")]
        return [*files, "--out", "study", "--tasks", TASK, "--variants", *variants]

    def start(self, *variants: str) -> subprocess.Popen[str]:
        """The study's command, whose steps are processes of their own."""
        command = [sys.executable, "-m", "xew.analysis.study", *self.arguments(*variants)]
        own = {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": "", "PYTHONUNBUFFERED": "1"}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        return subprocess.Popen(command, cwd=self.root, env=os.environ | own, text=True, **pipes)

    def run(self, *variants: str) -> None:
        """The same study in this process, where its steps share programs, weights and imports; it must end well."""
        self.root.mkdir(exist_ok=True)
        # Optax raises floats to the power of its int32 count of steps.
        with pytest.MonkeyPatch.context() as patch, jax.numpy_dtype_promotion("standard"):
            patch.chdir(self.root)
            patch.setattr(study, "open_machines", lambda _: InlineMachines())
            work_inline(patch)
            study.main(self.arguments(*variants))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """A folder without data or weights; compiled programs are those of the session, which compiles many of them too."""
    root = tmp_path_factory.mktemp("debug")
    settings = read_yaml(CONFIG)
    del settings["step_environment"]  # XLA's options are those of the session
    # The estimators that find masks and points are at work in tests/metrics/grading/test_evaluate.py.
    settings["evaluate"] = ["--masks", QUICK, "--tracks", QUICK_TRACKS]
    (root / "config.yaml").write_text(yaml.safe_dump(settings))
    yield Place(root, root / "config.yaml")
    shutil.rmtree(root)


@pytest.fixture(scope="module")
def made(place: Place) -> Place:
    """The whole study, from nothing."""
    place.run(*MADE)
    return place


def rows_of(study: Path) -> pd.DataFrame:
    return pd.read_parquet(study / "scores.parquet")


def test_from_nothing_to_a_report(made: Place) -> None:
    table = rows_of(made.study)
    planned = table.attrs["study"]
    assert set(table["variant"]) == {"", *planned["variants"]}
    assert len(planned["variants"]) == len(MADE) and planned["incomplete"] == [] and not planned["of_paper"]
    for part in PAPER_PARTS:
        assert {variant.name for variant in PARTS[part]} & set(planned["variants"]), f"nothing of {part}"
    for name, counts in planned["variants"].items():
        assert counts["found"] == dict.fromkeys(VARIANTS[name].graded_robots, 1)
    assert set(table.loc[table["variant"] == "", "model"]) == set(BASELINES)
    assert table["value"].notna().all()
    assert (made.study / "report" / "index.html").stat().st_size > 10_000


def test_done_is_done_and_redone_is_the_same(made: Place) -> None:
    """By the real command, whose step is a process of its own."""
    before = {path: path.stat().st_mtime_ns for path in made.study.rglob("*") if path.is_file() and "state" not in path.parts}
    rows = rows_of(made.study)
    process = made.start(*MADE, "--redo", f"evaluate/{ADAPTED}")
    said, _ = process.communicate()
    assert process.returncode == 0, said
    assert f"report: {Path('study', 'report', 'index.html')}" in said
    assert re.findall(r"\] (\S+) done after", said) == [f"evaluate/{ADAPTED}"]
    pd.testing.assert_frame_equal(rows_of(made.study), rows)
    changed = {path.relative_to(made.study) for path in before if before[path] != path.stat().st_mtime_ns}
    assert {path.parts[0] for path in changed} <= {"study.yaml", "status.txt", ".lock", "logs", "scores"}, changed
    assert {path.parts[1].split(".")[0] for path in changed if path.parts[0] == "scores"} == {ADAPTED}, changed


def test_a_report_needs_no_rollouts_and_no_data(
    made: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where pieces of a study came without what is large; whatever is left of the rollouts is shown."""
    shutil.copytree(
        made.study, tmp_path / "study", ignore=shutil.ignore_patterns("runs", "latents", "data", "rollouts", "report")
    )
    monkeypatch.chdir(tmp_path)
    study_analyse.main(study_analyse.Args(Path("study"), distances=Path("study/distances")))
    shown, said = len(MADE), capsys.readouterr().out
    assert f"{shown} of {shown} variants are in no picture: their rollouts were not under study/rollouts" in said
    page, tables = Path("study/report/index.html"), Path("study/report/tables")
    assert page.stat().st_size > 10_000 and not list(tables.parent.rglob("*strip*"))
    for table in (made.study / "report" / "tables").rglob("*.csv"):
        assert (tables / table.name).read_bytes() == table.read_bytes()
    shutil.copytree(made.study / "rollouts" / ADAPTED, Path("study/rollouts") / ADAPTED)
    study_analyse.main(study_analyse.Args(Path("study"), data=made.study / "data"))
    assert f"{shown - 1} of {shown} variants are in no picture" in capsys.readouterr().out


def test_an_adaptation_started_from_its_variant(made: Place) -> None:
    start = json.loads((made.study / "runs" / ADAPTED / "start.json").read_text())
    assert Path(start["run"]).name == VARIANTS[ADAPTED].start.name  # type: ignore[union-attr]


def test_killed_anywhere_it_ends_in_the_same_videos_and_scores(made: Place) -> None:
    """A part of the study again from nothing but data, the baselines' scores and compiled programs, killed as it goes: the same
    bytes at the end."""
    killed = Place(made.root / "killed", made.config)
    for name in ("data", "data-baselines"):
        shutil.copytree(made.study / name, killed.study / name)
    moments = random.Random(int(time.time()))
    for number in range(KILLS):
        seconds = moments.uniform(0, 8)
        print(f"kill {number} after {seconds:.2f} s of its first step")
        process = killed.start(*PART)
        assert process.stdout is not None
        assert any("] latents" in line or "] train" in line or "] rollout" in line for line in process.stdout), "no step began"
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=seconds)
        process.kill()
        process.communicate()
    killed.run(*PART)
    found, expected = rows_of(killed.study), rows_of(made.study)
    folders = [folder.name for folder in (killed.study / "rollouts").iterdir()]
    assert ADAPTED in folders and len(folders) > 1
    for variant in folders:
        both = (study / "rollouts" / variant for study in (made.study, killed.study))
        assert different_videos(*both) == []
        rows = (table[table["variant"] == variant].reset_index(drop=True) for table in (expected, found))
        pd.testing.assert_frame_equal(*rows, check_categorical=False)


def different_videos(straight: Path, killed: Path) -> list[str]:
    """Names of videos that only one of two folders of rollouts holds, or whose bytes differ."""
    first, second = ({path.relative_to(top) for path in top.rglob("rgb.mkv")} for top in (straight, killed))
    assert first, f"{straight} is empty"
    shared = {file for file in first & second if not filecmp.cmp(straight / file, killed / file, shallow=False)}
    return sorted(map(str, (first ^ second) | shared))

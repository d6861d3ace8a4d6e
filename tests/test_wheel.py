"""What a user of pip gets: the wheel, installed beside the present libraries, works in an empty folder like the clone."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = ("xew", "configs", "docs", "examples", "benchmarks", "requirements", "tests")
FILES = ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "Makefile")
BUILD = "import setuptools.build_meta as build; build.build_sdist('dist'); build.build_wheel('dist')"
FIRST_STEPS = """
import sys
from pathlib import Path

import numpy as np

import xew
from xew.config import find_config
from xew.metrics import psnr
from xew.model import train
from xew.sim_warp.robots import ROBOTS, load_urdf

assert not Path(xew.__file__).is_relative_to(sys.argv[1]), xew.__file__
assert find_config("configs/fixed.yaml") == find_config("xew:fixed")
assert all(load_urdf(robot.urdf).links for robot in ROBOTS.values())
video = np.zeros((1, 8, 8, 3), np.uint8)
assert psnr(video, video).shape == (1,)
train.main(["xew:fixed", "--help"])
"""


def run(*command: str | Path, folder: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"COLUMNS": "120"}
    done = subprocess.run([*map(str, command)], cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist and the wheel of a copy of the repository."""
    pytest.importorskip("setuptools", minversion="77")
    copy = tmp_path_factory.mktemp("repository")
    for name in SOURCES:
        ignored = shutil.ignore_patterns("__pycache__", "*.pyc")
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=ignored)
    for name in FILES:
        shutil.copy(ROOT / name, copy)
    (copy / "dist").mkdir()
    run(sys.executable, "-c", BUILD, folder=copy)
    return copy / "dist"


def test_distributions_hold_what_they_need(distributions: Path) -> None:
    configs = {str(path.relative_to(ROOT)) for path in (ROOT / "configs").rglob("*.yaml")}
    (wheel,), (sdist,) = distributions.glob("*.whl"), distributions.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        assert {f"xew/{name}" for name in configs} <= set(archive.namelist())
    with tarfile.open(sdist) as archive:
        members = [member for member in archive.getmembers() if member.isfile()]
    held = {member.name.partition("/")[2] for member in members}
    helpers = {"tests/conftest.py", "tests/synthetic.py", "tests/metrics/small.py"}
    assert configs | helpers | {"docs/metrics.md", "docs/glossary.md", "examples/own_model.py", "CHANGELOG.md"} <= held


@pytest.fixture(scope="module")
def python(distributions: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel in an environment that has its own site-packages and, behind them, the libraries of this one."""
    home = tmp_path_factory.mktemp("environment")
    venv.create(home, symlinks=True)
    (wheel,) = distributions.glob("*.whl")
    install = ("install", "--no-deps", "--no-index", "-q", wheel)
    run(sys.executable, "-m", "pip", "--python", home / "bin" / "python", *install, folder=home)
    (site,) = home.glob("lib/python*/site-packages")
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return home / "bin" / "python"


def test_functions_and_configs_work_in_an_empty_folder(python: Path, tmp_path: Path) -> None:
    assert "--train.steps" in run(python, "-c", FIRST_STEPS, ROOT, folder=tmp_path)
    plan = run(python, "-m", "xew.analysis.study", "configs/study_debug.yaml", "--dry-run", "--out", "study", folder=tmp_path)
    assert "with 1 at once" in plan


def test_the_first_command_of_the_readme_makes_an_episode_in_an_empty_folder(python: Path, tmp_path: Path) -> None:
    few = ("--tasks", "press_stapler", "--robots", "piper", "--train-seeds", "1", "--test-seeds", "0")
    run(python, "-m", "xew.sim_warp.generate", *few, "--out", "data", folder=tmp_path)
    assert (tmp_path / "data" / "press_stapler" / "0000000" / "piper" / "episode.json").is_file()

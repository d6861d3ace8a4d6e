"""What a user of pip gets: the wheel, installed beside the present libraries, works in an empty folder like the clone."""

import os
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

import xew

ROOT = Path(__file__).parents[1]
SOURCES = ("xew", "configs", "docs", "examples", "benchmarks", "requirements", "lab", "tests")
FILES = ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff", "Makefile")
BUILD = "import setuptools.build_meta as build; build.build_sdist('dist'); build.build_wheel('dist')"


def run(*command: str | Path, folder: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"COLUMNS": "120"}
    done = subprocess.run([*map(str, command)], cwd=folder, env=environment, capture_output=True, text=True, timeout=1800)
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
        (metadata,) = (archive.read(name).decode() for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    assert f"\nVersion: {xew.__version__}\n" in metadata and "\nAuthor: " in metadata and "\nClassifier: " in metadata
    with tarfile.open(sdist) as archive:
        members = [member for member in archive.getmembers() if member.isfile()]
    held = {member.name.partition("/")[2] for member in members}
    helpers = {"tests/conftest.py", "tests/synthetic.py", "tests/metrics/small.py"}
    assert configs | helpers | {"docs/metrics.md", "docs/glossary.md", "examples/own_model.py", "CHANGELOG.md"} <= held
    linked = {link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", (ROOT / "README.md").read_text())}
    assert {link for link in linked if "://" not in link} <= held, "the README's links lead somewhere in the sdist"


def test_the_version_is_one_and_is_known_without_an_installation() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert project["version"] == xew.__version__ == str(citation["version"])
    asked = [path for path in (ROOT / "xew").rglob("*.py") if re.search(r"version\(\s*[\"']xew", path.read_text())]
    assert not asked, "a source tree that is not installed has no metadata"


@pytest.mark.lab
def test_the_quickstart_of_the_readme_passes_in_an_empty_environment(distributions: Path, tmp_path: Path) -> None:
    """The wheel and what it needs, at the versions that are tested; packages come from the index, or from pip's cache."""
    (wheel,) = distributions.glob("*.whl")
    script = ROOT / "benchmarks" / "fresh_environments.py"
    options = ("--pythons", sys.executable, "--wheel", wheel, "--constraints", ROOT / "requirements" / "test.txt")
    assert ": passed with jax " in run(sys.executable, script, *options, folder=tmp_path)


def test_a_quickstart_that_runs_nothing_is_told(tmp_path: Path) -> None:
    script = runpy.run_path(str(ROOT / "benchmarks" / "fresh_environments.py"))
    commands = script["quickstart"]((ROOT / "README.md").read_text())
    assert (
        len(commands) == 6
        and "xew.analysis.report" in commands[-1]
        and not any("pip install" in command for command in commands)
    )
    for readme in ("# xew\n", "## Quickstart\n```bash\npip install .\n```\n", "## Quickstart\n```bash\npython -m xew.x\n```\n"):
        with pytest.raises(RuntimeError, match="no section Quickstart"):
            script["quickstart"](readme)
    with pytest.raises(RuntimeError, match="false"):
        script["run"]("bash", "-c", "false", folder=tmp_path)

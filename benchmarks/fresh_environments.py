"""The wheel in fresh environments, by every Python of this machine that xew takes: the quickstart of the README.

    python -m benchmarks.fresh_environments [--pythons python3.11 python3.12 python3.13] [--constraints FILE]

For each Python: a new virtual environment, the wheel of this repository with what it needs from the package index (the newest
releases, or those of --constraints), and then, in an empty folder that is not in the clone, the commands of the README's
section "Quickstart" as they stand there, but for its `pip install`, which is that of the wheel; and what else the README shows
of the package: functions of the metrics, a config's --help, the plan of a study. Prints a line for each Python with the
versions that matter; exit status 1 where one fails. `make test-lab` does it by one Python at the versions of
requirements/test.txt, `make test-fresh` by all at the newest.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
PYTHONS = ("python3.11", "python3.12", "python3.13")
SHOWN = ("jax", "flax", "numpy", "pandas", "newton", "warp-lang", "mujoco", "av")
"""Packages whose versions are printed."""
QUICKSTART = re.compile(r"^## Quickstart\n.*?^```bash\n(.*?)^```", re.MULTILINE | re.DOTALL)
INSTALLS = "pip install "
REPORT = "report/index.html"
"""Page that the quickstart ends with."""
LEFT_OUT = ("PYTHONPATH", "PYTHONHOME", "PYTHONDONTWRITEBYTECODE", "VIRTUAL_ENV")
"""Variables that lead a Python elsewhere; and without compiled files each command would compile all that it imports anew."""
BEYOND = """
import sys
from pathlib import Path

import numpy as np

import xew
from xew.config import find_config
from xew.metrics import psnr
from xew.model import train
from xew.sim_warp.robots import ROBOTS, load_urdf

assert Path(xew.__file__).is_relative_to(sys.argv[1]), f"xew is imported from {xew.__file__}"
assert find_config("configs/fixed.yaml") == find_config("xew:fixed")
assert all(load_urdf(robot.urdf).links for robot in ROBOTS.values())
video = np.zeros((1, 8, 8, 3), np.uint8)
assert psnr(video, video).shape == (1,)
train.main(["xew:fixed", "--help"])
"""
PLAN = "python -m xew.analysis.study configs/study_debug.yaml --dry-run --out study"


def quickstart(readme: str) -> list[str]:
    """The commands of the README's quickstart, without those that install. Raises RuntimeError where there is none."""
    section = QUICKSTART.search(readme)
    lines = section[1].replace("\\\n", " ").splitlines() if section else []
    commands = [line for line in lines if line.strip() and not line.startswith(INSTALLS)]
    if not commands or len(commands) == len(lines):
        raise RuntimeError("README.md has no section Quickstart that installs and then runs something")
    return commands


def run(*command: str | Path, folder: Path, environment: Path | None = None) -> str:
    """Run a command in a folder, and return what it prints. Raises RuntimeError where it fails.

    Args:
        command: what to run.
        folder: to run it in.
        environment: virtual environment that is active meanwhile.
    """
    variables = {name: value for name, value in os.environ.items() if name not in LEFT_OUT}
    if environment is not None:
        variables |= {"VIRTUAL_ENV": str(environment), "PATH": f"{environment / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run([*map(str, command)], cwd=folder, env=variables, capture_output=True, encoding="utf-8")
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, command[1:]))[:160]}: {(done.stdout + done.stderr)[-1500:]}")
    return done.stdout


def try_python(python: str, wheel: Path, constraints: Path | None, folder: Path) -> str:
    """Install and run everything with one Python; a line about it. Raises RuntimeError where something fails."""
    environment, empty = folder / "environment", folder / "empty"
    run(python, "-m", "venv", environment, folder=folder)
    chosen = ("--upgrade",) if constraints is None else ("--constraint", constraints)
    pip = ("python", "-m", "pip", "--disable-pip-version-check")
    run(*pip, "install", "--no-compile", "-q", *chosen, wheel, folder=folder, environment=environment)
    empty.mkdir()
    for command in quickstart((ROOT / "README.md").read_text(encoding="utf-8")):
        run("bash", "-c", command, folder=empty, environment=environment)
    if not (empty / REPORT).is_file():
        raise RuntimeError(f"the quickstart leaves no {REPORT}")
    if "--train.steps" not in run("python", "-c", BEYOND, environment, folder=empty, environment=environment):
        raise RuntimeError("--help of a config lists no settings")
    run("bash", "-c", PLAN, folder=empty, environment=environment)
    listed = json.loads(run(*pip, "list", "--format", "json", folder=folder, environment=environment))
    versions = {package["name"]: package["version"] for package in listed}
    return ", ".join(f"{name} {versions.get(name, '?')}" for name in SHOWN)


def build_wheel(folder: Path) -> Path:
    """The wheel of this repository, built into a folder."""
    build = ("-m", "pip", "wheel", "--disable-pip-version-check", "--no-deps", "-q", "-w", folder, ROOT)
    run(sys.executable, *build, folder=folder)
    (wheel,) = folder.glob("xew-*.whl")
    return wheel


def try_all(pythons: Sequence[str], wheel: Path, constraints: Path | None, root: Path) -> int:
    """Try all Pythons, with a line each; returns how many failed."""
    failed = 0
    for python in pythons:
        if shutil.which(python) is None:
            print(f"{python}: not on this machine, not tried", flush=True)
            continue
        folder = root / Path(python).name
        folder.mkdir()
        try:
            print(f"{python}: passed with {try_python(python, wheel, constraints, folder)}", flush=True)
        except RuntimeError as error:
            failed += 1
            print(f"{python}: FAILED at {error}", flush=True)
    return failed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pythons", nargs="+", default=PYTHONS, help="commands; those that are not there are named")
    parser.add_argument("--constraints", type=Path, help="file of versions to install; the newest releases without")
    parser.add_argument("--wheel", type=Path, help="a wheel that is built already")
    parser.add_argument("--keep", type=Path, help="folder in which the environments are kept")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        root = (asked.keep or Path(temporary)).resolve()
        (root / "dist").mkdir(parents=True, exist_ok=True)
        wheel = asked.wheel.resolve() if asked.wheel else build_wheel(root / "dist")
        constraints = asked.constraints and asked.constraints.resolve()
        return int(try_all(asked.pythons, wheel, constraints, root) > 0)


if __name__ == "__main__":
    sys.exit(main())

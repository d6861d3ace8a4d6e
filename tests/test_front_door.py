"""The front door lists the commands and runs each as `python -m` does."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import xew
from xew.__main__ import COMMANDS

ROOT = Path(xew.__file__).parent
MOST_COMMANDS = 17
STARTED = (ROOT / "analysis" / "studies" / "processes.py",)
"""Modules that a command starts as a program, and nobody types."""


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "xew", *arguments], capture_output=True, text=True, timeout=120)


def is_command(path: Path) -> bool:
    """Whether a file has a block of `if __name__ == "__main__"` and is meant to be typed: it lies at the root of a package."""
    tests = (ast.unparse(node.test) for node in ast.parse(path.read_text()).body if isinstance(node, ast.If))
    return "__name__ == '__main__'" in tests


def test_the_list_has_every_command_of_the_package() -> None:
    files = [path for path in ROOT.rglob("*.py") if path.name != "__main__.py" and is_command(path) and path not in STARTED]
    modules = {".".join(path.relative_to(ROOT.parent).with_suffix("").parts) for path in files}
    assert modules == {module for module, _ in COMMANDS.values()}
    assert len(COMMANDS) <= MOST_COMMANDS


@pytest.mark.parametrize("arguments", [(), ("--help",)])
def test_commands_are_listed_with_a_line_each(arguments: tuple[str, ...]) -> None:
    listed = run(*arguments)
    assert listed.returncode == 0
    for name, (_, purpose) in COMMANDS.items():
        assert f"  {name} " in listed.stdout and purpose in listed.stdout


def test_a_command_takes_the_remaining_arguments(tmp_path: Path) -> None:
    listed = run("train", "--help")
    assert listed.returncode == 0 and "usage: python -m xew.model.train" in listed.stdout
    refused = run("train", str(tmp_path / "nowhere.yaml"))
    assert refused.returncode == 2 and "nowhere.yaml" in refused.stderr


def test_an_unknown_command_is_refused_with_a_suggestion() -> None:
    refused = run("trian")
    assert refused.returncode == 2 and "did you mean 'train'?" in refused.stderr
    assert run("--version").stdout == f"xew {xew.__version__}\n"

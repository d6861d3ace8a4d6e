"""Commands that are killed at any of their renames and run again end in the same as undisturbed ones, and nothing is left over.

A kill is the end of the process, before or after the rename (kills.py); the commands are a small study's (kill_stages.py).
"""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.faults import kills
from tests.faults.kill_stages import STAGES, begin, digests
from tests.faults.kills import Death, Server

ALL = bool(os.environ.get("XEW_ALL_FAULTS"))
"""Whether every kill is tried, as `make test-faults` does; else one of SHARE."""
SHARE = 9
TRIED = tuple(STAGES) if ALL else ("latents", *(pytest.param(stage, marks=pytest.mark.lab) for stage in ("lerobot", "study")))
"""Commands that are killed: without ALL those that take a second, and one in make test."""


@dataclass
class World:
    """Folders of the study before each command, and after it where nothing disturbed it."""

    root: Path
    server: Server
    renames: dict[str, int] = field(default_factory=dict)
    """Number of renames of each command that has run."""

    def before(self, stage: str) -> Path:
        """The folder as the command finds it, made by those before."""
        folder = self.root / "before" / stage
        if not folder.exists():
            if STAGES[stage].after:
                shutil.copytree(self.after(STAGES[stage].after), folder, symlinks=True)
            else:
                folder.mkdir(parents=True)
                begin(folder)
        return folder

    def after(self, stage: str) -> Path:
        """The folder as the command leaves it, undisturbed."""
        folder = self.root / "after" / stage
        if not folder.exists():
            shutil.copytree(self.before(stage), folder, symlinks=True)
            ended = self.server.run(stage, folder)
            assert ended.status == 0, ended.said
            self.renames[stage] = ended.renames
        return folder


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    server = Server()
    yield World(tmp_path_factory.mktemp("world"), server)
    server.stop()


def state(folder: Path, stage: str) -> dict[str, Any]:
    """What a command has made, as `contents` compares it, and all else that lies in its folder."""
    product = STAGES[stage].product
    others = {path: digest for path, digest in digests(folder).items() if Path(path).parts[0] != product}
    return {"made": STAGES[stage].contents(folder / product), "others": others}


@pytest.mark.parametrize("stage", TRIED)
def test_a_command_that_is_killed_at_a_rename_ends_in_the_same(
    stage: str, world: World, tmp_path: Path, record_property: Any
) -> None:
    expected = state(world.after(stage), stage)
    deaths = [Death(at, after) for at in range(1, world.renames[stage] + 1) for after in (False, True)]
    assert deaths and not kills.find_left_overs(world.after(stage))
    tried = deaths if ALL else deaths[len(stage) % SHARE % len(deaths) :: SHARE]
    failures = []
    for number, death in enumerate(tried):
        folder = tmp_path / str(number)
        shutil.copytree(world.before(stage), folder, symlinks=True)
        killed = world.server.run(stage, folder, death)
        assert killed.status == kills.KILLED and killed.renames == death.at, f"{death}: {killed.said}"
        kills.settle(folder)
        again = world.server.run(stage, folder)
        if again.status and not (again.status == 2 and STAGES[stage].once and (folder / STAGES[stage].product).exists()):
            failures.append(f"killed {death}, it ends with {again.status}: {again.said[-600:]}")
        elif left := kills.find_left_overs(folder):
            failures.append(f"killed {death}, it leaves {', '.join(left)}")
        elif (found := state(folder, stage)) != expected:
            failures.append(f"killed {death}, it makes other content: {differences(found, expected)}")
        shutil.rmtree(folder)
    record_property(f"tried kills of {stage}", len(tried))
    assert not failures, "\n".join(failures)


def differences(found: dict[str, Any], expected: dict[str, Any]) -> str:
    """Names of what two states do not have in common."""
    names = [
        f"{part}: {name}"
        for part in expected
        for name in sorted(found[part].keys() | expected[part].keys())
        if found[part].get(name) != expected[part].get(name)
    ]
    return ", ".join(names[:8])

"""Processes that die at a rename: commands run in forked children that end, as by SIGKILL, before or after the k-th one.

A server imports what the commands need and forks a child for each; in a child no `finally`, no handler and no thread goes on
after the kill. Nothing in the server may start a thread or a JAX backend, which no fork survives.
"""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
KILLED = 137
"""Exit status of a child that died at a rename, as a shell gives it for SIGKILL."""
PATIENCE_S = 240
"""Time after which a child is taken to hang [s]."""
MODULES = (
    "tests.faults.kill_stages",
    "xew.model.latents",
    "xew.model.train",
    "xew.model.rollout",
    "xew.metrics.evaluate",
    "xew.analysis.report",
)
"""Modules that the server imports before it forks."""
LEFT_OVER = re.compile(r"\.writing-.*|\..+\.\d+(-[0-9a-f]+)?|\..*\.lock|.*orbax-checkpoint-tmp.*")
"""Names of what only a killed process leaves; locks go with who held them."""


@dataclass(frozen=True)
class Death:
    """At which rename a child dies."""

    at: int = 0
    """Number of the rename, from 1; 0 lets it live."""
    after: bool = False
    """Whether the rename is made before it dies."""

    def __str__(self) -> str:
        return f"{'after' if self.after else 'before'} rename {self.at}"


@dataclass(frozen=True)
class Ended:
    """How a child ended."""

    status: int
    renames: int
    """Number of renames that it asked for."""
    said: str
    """What it printed."""


@dataclass
class Server:
    """A process that runs stages in children of its own."""

    process: "subprocess.Popen[str] | None" = None

    def run(self, stage: str, folder: Path, death: Death = Death()) -> Ended:
        """Run a stage (`kill_stages.STAGES`) in a folder, in a child that dies so."""
        if self.process is None:
            command = [sys.executable, "-m", "tests.faults.kills"]
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            own = {"PYTHONPATH": str(ROOT)}
            self.process = subprocess.Popen(command, cwd=ROOT, env=os.environ | own, **pipes)
        assert self.process.stdin is not None and self.process.stdout is not None
        job = {"stage": stage, "folder": str(folder), "at": death.at, "after": death.after}
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        return Ended(**json.loads(self.process.stdout.readline()))

    def stop(self) -> None:
        """End the server."""
        if self.process is not None:
            self.process.communicate(timeout=30)


def die_at_rename(death: Death, counter: int) -> None:
    """Let this process write a byte to the pipe `counter` at each rename, and end at the one that is named.

    Threads rename one after another: none gets to its rename while the process dies at that of another.
    """
    count, one_at_a_time = 0, threading.Lock()

    def watch(rename: Callable[..., None]) -> Callable[..., None]:
        def watched(*args: Any, **kwargs: Any) -> None:
            nonlocal count
            with one_at_a_time:
                count += 1
                os.write(counter, b".")
                if count == death.at and not death.after:
                    os._exit(KILLED)
                rename(*args, **kwargs)
                if count == death.at:
                    os._exit(KILLED)

        return watched

    os.rename, os.replace = watch(os.rename), watch(os.replace)


def find_left_overs(folder: Path) -> list[str]:
    """Paths below a folder that only a killed process leaves."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if LEFT_OVER.fullmatch(path.name))


def settle(folder: Path) -> None:
    """Make what was left look as old as it is when somebody comes back, for it is swept only then."""
    for path in sorted(folder.rglob(".*"), reverse=True):
        os.utime(path, (1, 1), follow_symlinks=False)


def _live(job: dict[str, Any], counter: int, log: Path) -> int:
    """Run a stage in this child; returns its exit status."""
    from tests.faults.kill_stages import STAGES

    os.setpgid(0, 0)
    signal.alarm(PATIENCE_S)
    os.chdir(job["folder"])
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(output, stream)
    die_at_rename(Death(job["at"], job["after"]), counter)
    try:
        STAGES[job["stage"]].run()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _serve(line: str, log: Path) -> Ended:
    """Fork a child for a job and wait until it has ended."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        status = _live(json.loads(line), writing, log)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(status)
    os.close(writing)
    renames = 0
    while noted := os.read(reading, 1 << 16):  # ends when the child and all that it started have ended
        renames += len(noted)
    os.close(reading)
    _, status = os.waitpid(child, 0)
    return Ended(os.waitstatus_to_exitcode(status), renames, log.read_text(errors="replace"))


def main(arguments: Sequence[str] = ()) -> None:
    """Serve jobs, a line of JSON each on stdin, and answer each in a line."""
    import importlib
    import tempfile

    for module in MODULES:
        importlib.import_module(module)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    with tempfile.TemporaryDirectory() as folder:
        for line in sys.stdin:
            print(json.dumps(_serve(line, Path(folder) / "log").__dict__), file=answers, flush=True)


if __name__ == "__main__":
    main()

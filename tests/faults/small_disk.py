"""Commands on a file system of a few hundred kilobytes that is full, read-only or another user's.

Command: unshare --mount python -m tests.faults.small_disk FOLDER

It prints JSON: of every disk and writer the exit status, what was said, whether what was there before is still there, and what
was left half-written.
"""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.faults.kills import find_left_overs
from tests.synthetic import write_synthetic_data
from xew.analysis import study
from xew.analysis.studies.config import load_study
from xew.config import user_errors
from xew.dataset import find_accepted
from xew.episode import read_states, read_video, write_episode
from xew.exchange import lerobot
from xew.files import write_bytes, write_text
from xew.model import outside
from xew.model.experiment import load_experiment
from xew.model.runs.folder import claim_run
from xew.model.runs.log import RunLog
from xew.rollout import write_rollout

KILOBYTES = 400
"""Size of the disk."""
PATIENCE_S = 60
"""Time after which a writer is taken to hang [s]."""
NOBODY = 65534
"""Number of a user who owns nothing."""
OLD = "what was there before"


def episode(data: Path, out: Path) -> None:
    """Write an episode anew, in place of an earlier one."""
    folder, record = find_accepted(data)[0]
    write_episode(out, replace(record, instruction="new"), read_states(folder), read_video(folder / "rgb.mkv"))


def rollout(data: Path, out: Path) -> None:
    folder, record = find_accepted(data)[0]
    write_rollout(out, record.task, record.seed, record.robot, read_video(folder / "rgb.mkv"), {"model": "m"})


def begin(data: Path, out: Path) -> None:
    experiment = load_experiment("xew:debug")
    claim_run(out / "run", experiment, load_experiment, resume=False, overwrite=False)
    log = RunLog(out / "run", 0)
    for step in range(3000):
        log.scalars(step, {"loss": 1.0})
    log.close()


def export(data: Path, out: Path) -> None:
    lerobot.export(lerobot.Args(data, out / "lerobot"))


def predict(data: Path, out: Path) -> None:
    outside.main(["examples.own_model:freeze", "--data", str(data), "--split", "train", "--out", str(out)])


def plan(data: Path, out: Path) -> None:
    study.prepare(load_study("xew:study_debug", ["--out", str(out / "study")]))


WRITERS: dict[str, Callable[[Path, Path], Any]] = {
    "a text": lambda data, out: write_text(out / "kept.txt", 100_000 * "new", within=out),
    "bytes": lambda data, out: write_bytes(out / "kept.txt", bytes(300_000), within=out),
    "an episode": episode,
    "a rollout": rollout,
    "a run": begin,
    "a LeRobot export": export,
    "rollouts of an outside model": predict,
    "a study": plan,
}
"""What is written, by name: functions of a data set and the folder to write to."""


@contextlib.contextmanager
def full(disk: Path) -> Iterator[None]:
    """No block is free."""
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))
    yield
    filler.unlink()


@contextlib.contextmanager
def read_only(disk: Path) -> Iterator[None]:
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    yield
    subprocess.run(["mount", "-o", "remount,rw", disk], check=True)


@contextlib.contextmanager
def another_users(disk: Path) -> Iterator[None]:
    """This process may no longer write there; it runs in a child, which has no way back."""
    if os.geteuid() == 0:
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)
    else:
        (disk / "out").chmod(0o555)
    yield


DISKS = {"full": full, "read-only": read_only, "another user's": another_users}


def attempt(disk: Path, state: str, name: str, data: Path) -> dict[str, Any]:
    """Write to a disk in a state; what came of it."""
    out, said = disk / "out", io.StringIO()
    out.mkdir()
    (out / "kept.txt").write_text(OLD)
    if name == "an episode":
        folder, record = find_accepted(data)[0]
        write_episode(out, record, read_states(folder))
    before = {path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    status: Any = 0
    with DISKS[state](disk):
        try:
            with redirect_stderr(said), redirect_stdout(io.StringIO()):
                user_errors(WRITERS[name])(data, out)
        except SystemExit as stop:
            status = stop.code
        except BaseException as error:
            status = f"{type(error).__name__}: {error}"
        kept = all((out / path).read_bytes() == content for path, content in before.items())
    bar = ("%|", "/s]", "?it/s")  # of progress, which is redrawn on one line
    lines = [line for line in said.getvalue().splitlines() if line and not any(part in line for part in bar)]
    return {"disk": state, "writer": name, "status": status, "said": lines, "kept": kept, "left": find_left_overs(disk)}


def in_a_child(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Do work in a fork, and return what it returns."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        signal.alarm(PATIENCE_S)
        try:
            with os.fdopen(writing, "w") as file:
                json.dump(work(), file)
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as file:
        text = file.read()
    os.waitpid(child, 0)
    return json.loads(text) if text else {"status": "the child died"}


def main(folder: Path) -> None:
    data, disk = folder / "data", folder / "disk"
    folder.chmod(0o755)
    write_synthetic_data(data, seeds=(0,), robots=("piper",), frames=3)
    disk.mkdir()
    for state in DISKS:
        for name in WRITERS:
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={KILOBYTES}k,mode=755", "tmpfs", disk], check=True)
            print(json.dumps(in_a_child(lambda s=state, n=name: attempt(disk, s, n, data))), flush=True)  # type: ignore[misc]
            subprocess.run(["umount", disk], check=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

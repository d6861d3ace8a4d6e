"""Kill `generate` at random moments, while somebody reads, and see that the data come out the same.

Command: python -m tests.sim_warp.kill --kills 20      # prints when it was killed and that the bytes agree
"""

import hashlib
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import tyro

from tests.sim_warp.reader import Reading, read_on
from tests.sim_warp.small import SLOW, TASK, work_inline
from xew.sim_warp.generate import Args as GenerateArgs
from xew.sim_warp.generate import generate

ROOT = Path(__file__).parents[2]
FLAGS = ("--tasks", TASK, "--robots", "franka_panda", SLOW, "--train-seeds", "2", "--test-seeds", "1", "--device", "cpu")
"""The slow robot fails on odd seeds: accepted, rejected and replaced cells all occur."""


def start(out: Path, workers: int = 2) -> subprocess.Popen[str]:
    """`generate` in a session of its own, as a user would start it."""
    return subprocess.Popen(
        [sys.executable, "-m", "xew.sim_warp.generate", *FLAGS, "--workers", str(workers), "--out", str(out)],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip


def finish(run: subprocess.Popen[str]) -> None:
    """Wait for the end of a run, which must be good."""
    told, _ = run.communicate(timeout=600)
    if run.returncode:
        raise AssertionError(f"generate ended with {run.returncode}:\n{told}")


def complete(out: Path) -> None:
    """Make what is missing as the command would, in this process, which has imported everything."""
    args = GenerateArgs(
        tasks=(TASK,), robots=("franka_panda", SLOW), train_seeds=2, test_seeds=1, device="cpu", workers=1, out=out
    )  # as FLAGS say
    with pytest.MonkeyPatch.context() as patch:
        work_inline(patch)
        generate(args)


def kill(run: subprocess.Popen[str], everybody: bool) -> None:
    """SIGKILL the command, or the command and its workers, and wait until all have gone."""
    if everybody:
        os.killpg(run.pid, signal.SIGKILL)
    else:
        run.send_signal(signal.SIGKILL)
    run.communicate()  # the pipe ends when the last worker has gone


def contents(out: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder."""
    files = (path for path in sorted(out.rglob("*")) if path.is_file())
    return {str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@contextmanager
def read_beside(out: Path) -> Iterator[Reading]:
    """A reader at work in another process; what it saw is filled in at the end."""
    context = multiprocessing.get_context("spawn")
    stop, result, seen = context.Event(), context.Queue(), Reading()
    process = context.Process(target=read_on, args=(out, stop, result))
    process.start()
    try:
        yield seen
    finally:
        stop.set()
        seen.__dict__.update(result.get(timeout=120).__dict__)
        process.join()


def count(out: Path) -> int:
    """Files that are there, half-written ones included."""
    return sum(len(names) for _, _, names in os.walk(out))


def kill_at_random(out: Path, files: int, rng: random.Random, workers: int = 2) -> str | None:
    """Start, and kill at a random moment of what is left to do; a line about it, or None if the run ended before.

    Args:
        files: how many there are in the end. The run is killed at most 0.05 s after a random one of those that are missing.
        workers: how many processes work for the command.
    """
    if count(out) >= files:
        return None
    target = rng.randint(count(out), files - 1)
    run = start(out, workers)
    while count(out) < target and run.poll() is None:
        time.sleep(0.002)
    try:
        run.wait(rng.uniform(0, 0.05))
    except subprocess.TimeoutExpired:
        everybody = rng.random() < 0.5
        kill(run, everybody)
        half = len(list(out.glob("*/*/.writing-*")))
        whom = "the command and its workers" if everybody else "the command alone"
        return f"killed {whom} at {count(out)} of {files} files, {half} folders half-written"
    finish(run)
    return None


def make_undisturbed(out: Path) -> dict[str, str]:
    """The files of a run without a kill."""
    complete(out)
    return contents(out)


@dataclass(frozen=True)
class Args:
    """How often."""

    kills: int = 20
    seed: int = 0


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    with tempfile.TemporaryDirectory() as folder:
        expected = make_undisturbed(Path(folder) / "undisturbed")
        print(f"undisturbed: {len(expected)} files", flush=True)
        rng, kills, sets, rounds, episodes = random.Random(args.seed), 0, 0, 0, 0
        while kills < args.kills:
            out, sets = Path(folder) / f"killed{sets}", sets + 1
            with read_beside(out) as reader:
                for _ in range(min(rng.randint(3, 6), args.kills - kills)):
                    if told := kill_at_random(out, len(expected), rng):
                        kills += 1
                        print(f"{kills}: data set {sets}: {told}", flush=True)
                complete(out)
            assert not reader.wrong, reader.wrong
            assert contents(out) == expected, f"data set {sets} has other bytes"
            rounds, episodes = rounds + reader.rounds, episodes + reader.episodes
        print(f"{kills} kills over {sets} data sets: every byte of each agrees with the undisturbed run")
        print(f"a reader beside them looked {rounds} times, read {episodes} episodes, and saw none that was not whole")


if __name__ == "__main__":
    main()

"""The process of one step of a study: a command of this package with its output in a log.

A process ends when the study is killed (training saves first), and waits while an older one works on the same step. On one
machine processes are forked from one that has imported JAX and the model, so a start takes a fraction of a second.
"""

import contextlib
import fcntl
import multiprocessing
import os
import resource
import runpy
import signal
import subprocess
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Literal

from xew.concurrency import leave_with_parent
from xew.files import open_own

PRELOADED = ("xew.model.train", "xew.model.rollout", "xew.metrics.evaluate")
"""Modules that the fork server imports. None of them may start a thread or a JAX backend at import, which no fork survives."""
ENDED = "exit status"

CONTEXTS: dict[str, ForkServerContext | SpawnContext] = {
    "forkserver": multiprocessing.get_context("forkserver"),
    "spawn": multiprocessing.get_context("spawn"),
}


def start_step(
    command: Sequence[str],
    log: Path,
    environment: Mapping[str, str],
    method: Literal["forkserver", "spawn"] = "forkserver",
    launcher: Sequence[str] = (),
    niceness: int = 0,
    cores: Sequence[int] = (),
) -> BaseProcess:
    """Start `python -m command...` in a new process; `.exitcode` is the command's.

    Args:
        command: module and arguments.
        log: file that its output is appended to, with a lock file next to it.
        environment: additional environment variables.
        method: forkserver is quick; spawn starts a fresh interpreter.
        launcher: program and arguments that start the command, such as srun.
        niceness: increment of the process's niceness.
        cores: numbers of the processor cores that it may use; all where left out.
    """
    if method == "forkserver":
        multiprocessing.set_forkserver_preload(list(PRELOADED))
    context = CONTEXTS[method]
    log.parent.mkdir(parents=True, exist_ok=True)
    given = (tuple(command), log, dict(environment), tuple(launcher), niceness, tuple(cores))
    process = context.Process(target=_run, args=given, name=log.stem)
    process.start()
    return process


def last_lines(log: Path, count: int = 3) -> str:
    """The end of a command's log, without progress bars."""
    try:
        text = log.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    lines = [line.rpartition("\r")[2].strip() for line in text.split("\n")]
    return "\n".join([line for line in lines if line and not line.startswith(ENDED)][-count:])


def _run(
    command: tuple[str, ...],
    log: Path,
    environment: dict[str, str],
    launcher: tuple[str, ...],
    niceness: int,
    cores: tuple[int, ...],
) -> None:
    """Run a module as `python -m` would, or the launcher's process; called in the new process."""
    os.environ.update(environment)
    os.nice(niceness)
    if cores:
        os.sched_setaffinity(0, cores)
    os.setpgrp()  # Ctrl-C reaches the study only, which asks its steps to stop
    leave_with_parent(lambda: os.kill(os.getpid(), signal.SIGTERM))
    with open_own(log, "a") as file, wait_for_lock(log.with_suffix(".lock")):
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        print("$", " ".join([*launcher, "python -m", *command]), flush=True)
        try:
            code = _launch([*launcher, sys.executable, "-m", *command]) if launcher else _run_module(*command)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
        print(f"{ENDED} {code}, {_cpu_seconds():.1f} s of CPU", flush=True)
    raise SystemExit(code)


def _run_module(module: str, *arguments: str) -> int:
    sys.argv[1:] = arguments
    sys.modules.pop(module, None)  # the fork server has imported it under its own name
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as stop:
        if isinstance(stop.code, str):
            print(stop.code, file=sys.stderr)
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _cpu_seconds() -> float:
    """CPU time of this process and of those that it has started and waited for [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def _launch(command: Sequence[str]) -> int:
    process = subprocess.Popen(command)
    signal.signal(signal.SIGTERM, lambda *_: process.terminate())
    return process.wait()


@contextlib.contextmanager
def wait_for_lock(path: Path) -> Iterator[None]:
    """Wait until no other process holds this file's lock, and hold it until the block or the process ends."""
    with open_own(path, "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield

"""Machines for the steps of a study: the GPUs (or cores) of this one, or a Ray cluster that sees the study's folder at the
same path.
"""

import logging
import multiprocessing.connection
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Protocol

from xew.analysis.studies.config import Study
from xew.analysis.studies.plan import Step, count_gpus
from xew.analysis.studies.processes import start_step
from xew.concurrency import visible_gpus
from xew.config import TRUST, ConfigError

GRADINGS = ("baselines", "evaluate")
"""Kinds of steps that keep processors busy, and let those go first that feed a GPU."""
GRADING_NICENESS = 10
SHARING = {"XLA_PYTHON_CLIENT_ALLOCATOR": "platform"}
"""Environment in which JAX gives a GPU's memory back after each use, for a training that begins later; a user's own wins."""
PATIENCE_S = 120.0
"""Time that steps have to end after they were asked to [s]; training saves in that time."""


class Machines(Protocol):
    """Machines that steps can run on, as the study's loop uses them."""

    slots: int
    """Number of steps of one GPU (or core) that can run at once; 0 where it is not known."""

    def has_room_for(self, step: Step) -> bool:
        """Whether a step can be started now."""
        ...

    def start(self, step: Step, command: tuple[str, ...], log: Path, among: int) -> int | None:
        """Start a step's command, its output appended to `log`; returns its number of GPUs, or None if that is not known.

        Free GPUs are divided among so many steps (`count_sharing`).
        """
        ...

    def wait(self) -> list[tuple[str, int]]:
        """Names and exit codes of steps that have ended, at least one."""
        ...

    def stop(self) -> None:
        """Ask all steps to end and wait for them."""
        ...


def open_machines(study: Study) -> Machines:
    """The machines that the config names. Raises ConfigError if they are not there or too small."""
    environment = study.environment | {TRUST: os.environ.get(TRUST, "")}
    if study.machine.ray:
        return RayCluster(study.machine.ray, environment)
    gpus = usable_gpus(study)
    needed = study.machine.gpus_per_training or 1
    if gpus and needed > len(gpus):
        raise ConfigError(f"machine.gpus_per_training is {needed}, there are {len(gpus)} GPUs ({', '.join(gpus)}); lower it.")
    if gpus and study.machine.steps_per_gpu > 1:
        environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"} | environment
    return ThisMachine(gpus, study.machine.workers, environment, study.machine.steps_per_gpu)


def usable_gpus(study: Study) -> tuple[str, ...]:
    """The GPUs of this machine that a study may use, as CUDA_VISIBLE_DEVICES names them."""
    return visible_gpus() if study.machine.gpus is None else tuple(map(str, study.machine.gpus))


@dataclass(frozen=True)
class _Running:
    process: BaseProcess
    step: Step
    slots: tuple[str, ...]


class ThisMachine:
    """This machine: one step per GPU, or a training and others; without a GPU as many steps as there are workers.

    A step with some of the GPUs has the same share of the processor cores.
    """

    def __init__(self, gpus: tuple[str, ...], workers: int, environment: Mapping[str, str], steps_per_gpu: int = 1) -> None:
        self.gpus, self.environment = gpus, dict(environment)
        self._others_per_gpu = steps_per_gpu - 1 if gpus else 0
        self._slots = gpus or tuple(map(str, range(workers)))
        self.slots = len(self._slots)
        self._running: dict[str, _Running] = {}
        os.environ.update(environment)  # the fork server imports JAX, which reads some of it then

    def has_room_for(self, step: Step) -> bool:
        return len(self._open_slots(step)) >= self._count_slots(step)

    def _count_slots(self, step: Step, free: int = 0, among: int = 0) -> int:
        return count_gpus(step, self.slots, free, among) if self.gpus else 1

    def _cores(self, slots: Sequence[str]) -> tuple[int, ...]:
        """Processor cores of some GPUs: their equal parts of those that this process may use."""
        cores, count = sorted(os.sched_getaffinity(0)), len(self._slots)
        parts = [cores[len(cores) * place // count : len(cores) * (place + 1) // count] for place in range(count)]
        return tuple(core for slot, part in zip(self._slots, parts, strict=True) if slot in slots for core in part)

    def _open_slots(self, step: Step) -> list[str]:
        """Slots that may take a step, the least busy first."""
        steps = {slot: [running.step for running in self._running.values() if slot in running.slots] for slot in self._slots}
        if not self._others_per_gpu:
            return [slot for slot, running in steps.items() if not running]
        most = 1 if step.is_training else self._others_per_gpu
        same = {slot: sum(other.is_training == step.is_training for other in steps[slot]) for slot in steps}
        return sorted((slot for slot in steps if same[slot] < most), key=lambda slot: len(steps[slot]))

    def start(self, step: Step, command: tuple[str, ...], log: Path, among: int = 0) -> int:
        free = self._open_slots(step)
        slots = tuple(free[: self._count_slots(step, len(free), among)])
        own = {"CUDA_VISIBLE_DEVICES": ",".join(slots)} if self.gpus else {}
        shares_gpu = bool(self._others_per_gpu) and step.kind in GRADINGS
        sharing = {name: os.environ.get(name, value) for name, value in SHARING.items()} if shares_gpu else {}
        environment = {**sharing, **self.environment, **step.environment, **own}
        niceness = GRADING_NICENESS if shares_gpu else 0
        cores = self._cores(slots) if self.gpus else ()
        process = start_step(command, log, environment, launcher=step.launcher, niceness=niceness, cores=cores)
        self._running[step.name] = _Running(process, step, slots)
        return len(slots) if self.gpus else 0

    def wait(self) -> list[tuple[str, int]]:
        multiprocessing.connection.wait([running.process.sentinel for running in self._running.values()])
        ended = [name for name, running in self._running.items() if running.process.exitcode is not None]
        return [(name, self._settle(name)) for name in ended]

    def _settle(self, name: str) -> int:
        running = self._running.pop(name)
        running.process.join()
        return running.process.exitcode or 0

    def stop(self) -> None:
        for running in self._running.values():
            running.process.terminate()
        until = time.monotonic() + PATIENCE_S
        for name, running in list(self._running.items()):
            running.process.join(max(0.0, until - time.monotonic()))
            running.process.kill()
            self._settle(name)


class RayCluster:
    """An existing Ray cluster, on which every step is a task; more machines may join while the study runs."""

    def __init__(self, address: str, environment: Mapping[str, str]) -> None:
        try:
            import ray
        except ImportError as error:
            raise ConfigError(f"machine.ray is {address!r}, but Ray is not installed: pip install 'xew[ray]'") from error
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise ConfigError(f"no Ray cluster answers at {address!r} ({error}); start one: ray start --head") from error
        self._ray, self.environment = ray, dict(environment)
        self._gpus = int(ray.cluster_resources().get("GPU", 0))
        self.slots = self._gpus or int(ray.cluster_resources().get("CPU", 1))
        self._running: dict[Any, str] = {}

    def has_room_for(self, step: Step) -> bool:
        """True always, since Ray itself lets tasks wait for room."""
        return True

    def start(self, step: Step, command: tuple[str, ...], log: Path, among: int = 0) -> None:
        # A machine that is lost is made up for elsewhere: the same command goes on from what is on disk.
        options: dict[str, Any] = {"num_cpus": 1, "num_gpus": step.gpus if self._gpus else 0, "max_retries": 2}
        task = self._ray.remote(_run_on_ray).options(**options)
        environment = {**self.environment, **step.environment}
        reference = task.remote(command, str(log.absolute()), environment, step.launcher, str(Path.cwd()))
        self._running[reference] = step.name

    def wait(self) -> list[tuple[str, int]]:
        ready, _ = self._ray.wait(list(self._running), num_returns=1)
        ended = []
        for reference in ready:
            name = self._running.pop(reference)
            try:
                ended.append((name, self._ray.get(reference)))
            except self._ray.exceptions.RayError as error:
                print(f"{name}: {error}", file=sys.stderr)
                ended.append((name, -1))
        return ended

    def stop(self) -> None:
        """Leave the cluster; the processes of its tasks notice that their parents have gone, and save."""
        self._ray.shutdown()


def _run_on_ray(command: tuple[str, ...], log: str, environment: dict[str, str], launcher: tuple[str, ...], folder: str) -> int:
    """Run a command in its own process from the study's working folder; called in a Ray worker."""
    os.chdir(folder)
    os.environ.update(environment)
    process = start_step(command, Path(log), environment, method="spawn", launcher=launcher)
    process.join()
    return process.exitcode if process.exitcode is not None else -signal.SIGKILL

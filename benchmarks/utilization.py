"""How busy processor cores and GPUs are while a command runs, sampled twice a second."""

import contextlib
import os
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

PERIOD_S = 0.5
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Use:
    """What a command took."""

    seconds: float
    cpu: float
    """Mean share of its cores that its processes kept busy."""
    gpu: float | None
    """Mean share of the time in which its GPUs had a kernel to run; None if it cannot be read."""
    gpu_source: str
    """How the share was read, or why not."""


def run_sampled(
    command: Sequence[str], log: Path, environment: Mapping[str, str], cores: Sequence[int], gpus: Sequence[str]
) -> Use:
    """Run a command on some cores and GPUs, its output appended to a log.

    Raises subprocess.CalledProcessError if it fails.
    """
    read_gpus, source = open_gpus(gpus)
    busy: dict[tuple[int, str], float] = {}
    samples: list[float] = []
    allowed = os.sched_getaffinity(0)
    with log.open("a", encoding="utf-8") as file:
        os.sched_setaffinity(0, cores)  # the command inherits it
        begin = time.perf_counter()
        process = subprocess.Popen(command, stdout=file, stderr=file, env=environment)
        os.sched_setaffinity(0, allowed)
        try:
            while process.poll() is None:
                busy |= cpu_seconds(process.pid)
                samples += read_gpus()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(PERIOD_S)
        finally:
            process.terminate()
            process.wait()
    seconds = time.perf_counter() - begin
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    gpu = sum(samples) / len(samples) if samples else None
    return Use(seconds, sum(busy.values()) / seconds / len(cores), gpu, source)


def cpu_seconds(root: int) -> dict[tuple[int, str], float]:
    """CPU time of a process and of its descendants by number and start, from /proc [s]."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            found[int(path.parent.name)] = path.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    family, added = set[int](), {root} & found.keys()
    while added:
        family |= added
        added = {number for number, fields in found.items() if int(fields[1]) in added}
    return {(number, found[number][19]): TICK_S * sum(map(int, found[number][11:13])) for number in family}


def open_gpus(gpus: Sequence[str]) -> tuple[Callable[[], list[float]], str]:
    """Function that reads the share of time in which each GPU was busy, and how: by nvidia-ml-py, else by nvidia-smi."""
    if not gpus:
        return list, "no GPU is used"
    reasons = []
    for name, opener in (("nvidia-ml-py", _open_nvml), ("nvidia-smi", _open_nvidia_smi)):
        try:
            read = opener(gpus)
            read()
            return read, name
        except Exception as error:  # of a driver, of a package that is not there, of a card that does not tell
            reasons.append(f"{name}: {str(error).splitlines()[0] if str(error) else type(error).__name__}")
    return list, "; ".join(reasons)


def _open_nvml(gpus: Sequence[str]) -> Callable[[], list[float]]:
    import pynvml

    pynvml.nvmlInit()
    by_index, by_uuid = pynvml.nvmlDeviceGetHandleByIndex, pynvml.nvmlDeviceGetHandleByUUID
    handles = [by_index(int(gpu)) if gpu.isdigit() else by_uuid(gpu) for gpu in gpus]
    return lambda: [pynvml.nvmlDeviceGetUtilizationRates(handle).gpu / 100 for handle in handles]


def _open_nvidia_smi(gpus: Sequence[str]) -> Callable[[], list[float]]:
    query = ("nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits", "-i", ",".join(gpus))

    def read() -> list[float]:
        output = subprocess.run(query, capture_output=True, encoding="utf-8", check=True).stdout
        return [float(percent) / 100 for percent in output.split()]

    return read

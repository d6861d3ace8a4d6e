"""The training loop: steps, log lines, checkpoints, samples, and a clean stop on signals."""

import contextlib
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from tqdm import tqdm

from xew.model.runs.checkpoint import TrainState, save_state
from xew.model.runs.session import Session
from xew.model.training.flops import peak_flops

STOPPED = 128 + signal.SIGTERM
"""Exit status of a run that was stopped and saved before its last step."""


@dataclass(frozen=True)
class Timetable:
    """Intervals of logging, saving and sampling, in steps."""

    steps: int
    log_every: int
    save_every: int
    sample_steps: Collection[int]
    """Steps after which samples are rolled out."""
    learning_rate: Callable[[int], Any]
    """Learning rate of the next step, by number of steps taken."""
    is_over: Callable[[int], bool] | None = None
    """Whether the run ends before `steps`, by number of steps taken, as with a time budget."""


@dataclass
class Meter:
    """The results and times of the steps since the last log line."""

    summarize: Callable[[Sequence[Any]], dict[str, float]]
    """Function that averages the results of some steps; each result has a field `finite`."""
    samples: int
    """Number of samples of one step."""
    flops: float = 0.0
    """Model FLOPs of one step; 0 if unknown."""
    results: list[Any] = field(default_factory=list)
    wait_s: float = 0.0
    """Time spent waiting for data [s]."""
    since: float = field(default_factory=time.perf_counter)

    def add(self, result: Any, wait_s: float) -> None:
        """Add the result of a step and its waiting time [s]."""
        self.results.append(result)
        self.wait_s += wait_s

    def check_finite(self) -> None:
        """End the program if any step since the last log line was not finite, before the state is saved."""
        steps = len(self.results)
        for number, result in enumerate(self.results):
            if not bool(result.finite):
                sys.exit(
                    f"error: loss, gradients or update were not finite {steps - number - 1} steps ago and were not saved. "
                    "Continue from the last checkpoint with --resume, or lower train.learning_rate."
                )

    def take(self) -> dict[str, float]:
        """Return the values of a log line, and reset the meter."""
        results, seconds = jax.device_get(self.results), time.perf_counter() - self.since
        values = self.summarize(results) | {
            "workload/step_s": seconds / len(results),
            "workload/data_wait_s": self.wait_s / len(results),
            "workload/samples_per_s": len(results) * self.samples / seconds,
        }
        peak = peak_flops(jax.devices()[0].device_kind)
        if peak and self.flops:
            values["workload/mfu"] = len(results) * self.flops / seconds / (peak * jax.device_count())
        if used := (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use"):
            values["workload/peak_memory_gb"] = used / 1e9
        self.results, self.wait_s, self.since = [], 0.0, time.perf_counter()
        return values

    @contextlib.contextmanager
    def pause(self) -> Iterator[None]:
        """Exclude the time of the block."""
        begin = time.perf_counter()
        yield
        self.since += time.perf_counter() - begin


class StopSignal:
    """Handler of SIGTERM and SIGINT, to save the run before it ends."""

    def __init__(self) -> None:
        self.received = False
        self.before = {number: signal.signal(number, self._note) for number in (signal.SIGTERM, signal.SIGINT)}

    def _note(self, number: int, frame: Any) -> None:
        self.received = True

    def is_agreed(self) -> bool:
        """Whether any process received a signal; all processes must call this at the same step."""
        if jax.process_count() == 1:
            return self.received
        return bool(np.any(multihost_utils.process_allgather(np.asarray(self.received))))

    def release(self) -> None:
        """Restore the previous handlers."""
        for number, handler in self.before.items():
            signal.signal(number, handler)


def run_steps(
    timetable: Timetable,
    session: Session,
    meter: Meter,
    take_step: Callable[[TrainState, Any], tuple[TrainState, Any]],
    state: TrainState,
    batches: Any,
    draw_samples: Callable[[TrainState, int], None],
) -> TrainState:
    """Train from the given state to the last step; after a signal, the current state is saved and returned.

    Args:
        timetable: intervals of logging and saving, and steps of samples.
        session: open files of the run.
        meter: of results and times.
        take_step: (state, batch) -> (next state, result).
        state: to start from.
        batches: an iterator of batches on the devices, with its position (get_state).
        draw_samples: called with the state and its step.
    """
    begin, stop, log = int(state.step), StopSignal(), session.log
    total = timetable.steps if timetable.is_over is None else None
    progress = tqdm(iter(range(begin, timetable.steps)), desc="train", initial=begin, total=total, file=sys.stderr)
    for step in (number + 1 for number in progress):
        requested = time.perf_counter()
        batch = next(batches)
        wait_s = time.perf_counter() - requested
        state, result = take_step(state, batch)
        meter.add(result, wait_s)
        last = step == timetable.steps or (timetable.is_over is not None and timetable.is_over(step))
        logs = step % timetable.log_every == 0 or last
        stops = (logs or jax.process_count() == 1) and stop.is_agreed()
        saves = step % timetable.save_every == 0 or last or stops
        if logs or saves:
            meter.check_finite()
        if logs:
            values = meter.take() | {"train/learning_rate": float(timetable.learning_rate(step - 1))}
            progress.set_postfix(loss=f"{values['loss/train']:.4f}")
            if log:
                log.scalars(step, values)
            stops = stops or stop.is_agreed()
        if saves or stops:
            save_state(session.checkpoints, state, batches.get_state())
        if stops and not last:  # the launcher will not wait for samples
            of = "" if total is None else f" of {total}"
            progress.write(f"stopped at step {step}{of} and saved; continue with --resume", file=sys.stderr)
            break
        if step in timetable.sample_steps or (last and timetable.sample_steps):
            with meter.pause():
                draw_samples(state, step)
        if last:
            break
    stop.release()
    return state

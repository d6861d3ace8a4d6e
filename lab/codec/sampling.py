"""Training samples in an order that depends only on the seed and the step, and the clock of a run with a time budget.

Clips are picked on the device if they fit there, otherwise ahead in threads.
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lab.codec.pictures import Pictures
from lab.codec.settings import CodecTrainSettings
from xew.concurrency import map_in_order

THREADS = 4
"""Number of threads that pick clips in the host's memory."""
PROBES = 16
"""Number of clips that are verified after copying them to a device."""


class Batch(NamedTuple):
    """Input of one step."""

    clips: Any
    """[b t h w 3] uint8."""
    regions: Any
    """[b k h w] uint8, one bit per frame, or None."""
    rate: Any
    """[] float32, the learning rate."""


class Clock:
    """Training time of a run, including the time `before` an interruption [s]."""

    def __init__(self, before: float = 0.0) -> None:
        self.before, self.begin = before, float("nan")

    def start(self) -> None:
        """Start the clock unless it runs."""
        if math.isnan(self.begin):
            self.begin = perf_counter()

    @property
    def elapsed(self) -> float:
        """Training time [s]."""
        return self.before + (0.0 if math.isnan(self.begin) else perf_counter() - self.begin)


@dataclass(frozen=True)
class Schedule:
    """Learning rate and end of a run, by steps or by time."""

    settings: CodecTrainSettings

    def rate(self, step: int, elapsed: float) -> float:
        """Learning rate of the step after `step` steps and `elapsed` seconds: warm-up in steps, then a cosine to the end."""
        train = self.settings
        progress = min(elapsed / train.seconds if train.seconds else step / train.steps, 1.0)
        cosine = train.decay_to + (1 - train.decay_to) * 0.5 * (1 + math.cos(math.pi * progress))
        warmup = min((step + 1) / train.warmup_steps, 1.0) if train.warmup_steps else 1.0
        return train.learning_rate * warmup * cosine

    def is_over(self, step: int, elapsed: float) -> bool:
        """Whether no step is left after `step` steps and `elapsed` seconds."""
        return elapsed >= self.settings.seconds if self.settings.seconds else step >= self.settings.steps


def place_pictures(pictures: Pictures, share: float) -> Pictures:
    """Copy the pictures to the device if they take at most a share of its memory; some are verified after copying."""
    device = jax.local_devices()[0]
    memory = (device.memory_stats() or {}).get("bytes_limit", 0) if device.platform != "cpu" else 0
    size = pictures.clips.nbytes + (0 if pictures.regions is None else pictures.regions.nbytes)
    if size > share * memory:
        return pictures
    regions = None if pictures.regions is None else jax.device_put(pictures.regions, device)
    placed = replace(pictures, clips=jax.device_put(pictures.clips, device), regions=regions)
    probes = np.unique(np.linspace(0, len(pictures.clips) - 1, PROBES).astype(np.int32))
    if not np.array_equal(np.asarray(pick_on_device(placed.clips, probes)), pictures.clips[probes]):
        return pictures
    return placed


@jax.jit
def pick_on_device(clips: jax.Array, numbers: jax.Array) -> jax.Array:
    """Select clips [b ...] of all [n ...] by index [b]."""
    return jnp.take(clips, numbers, axis=0, mode="clip")


class Batches(Iterator[Batch]):
    """Endless batches, with `get_state` and `set_state` of their position.

    Args:
        pictures: in the host's memory or on a device.
        shares: stream -> share of the samples; streams without pictures are ignored.
        settings: of the run.
    """

    def __init__(self, pictures: Pictures, shares: Mapping[str, float], settings: CodecTrainSettings) -> None:
        self.pictures, self.settings, self.schedule = pictures, settings, Schedule(settings)
        self.ranges = [pictures.streams[name] for name in shares if shares[name] and pictures.streams.get(name)]
        weights = np.array([shares[name] for name in shares if shares[name] and pictures.streams.get(name)])
        self.probabilities = weights / weights.sum()
        self.step, self.clock = 0, Clock()
        self.ahead: Iterator[tuple[Any, Any]] | None = None
        self.first = True

    @property
    def on_device(self) -> bool:
        """Whether the pictures are on a device."""
        return isinstance(self.pictures.clips, jax.Array)

    def numbers(self, step: int) -> np.ndarray:
        """Indices [b] int32 of the clips of a step: a stream by the shares, then a random clip of it."""
        rng = np.random.default_rng((self.settings.seed, step))
        streams = rng.choice(len(self.ranges), self.settings.batch, p=self.probabilities)
        fractions = rng.random(self.settings.batch)
        lengths, firsts = (np.array([pick(r) for r in self.ranges]) for pick in (len, lambda r: r.start))
        return (firsts[streams] + (fractions * lengths[streams]).astype(np.int64)).astype(np.int32)

    def __next__(self) -> Batch:
        if not self.first:
            self.clock.start()  # after the first step, which compiles
        self.first = False
        if self.on_device:
            clips, regions = self.pick(self.step)
        else:
            if self.ahead is None:
                self.ahead = map_in_order(self.pick, itertools.count(self.step), THREADS)
            clips, regions = next(self.ahead)
        rate = np.float32(self.rate(self.step))
        self.step += 1
        return Batch(clips, regions, rate)

    def pick(self, step: int) -> tuple[Any, Any]:
        """Clips [b t h w 3] uint8 of a step and their masks of the robot, [b k h w] uint8 or None."""
        clips, regions, numbers = self.pictures.clips, self.pictures.regions, self.numbers(step)
        if self.on_device:
            return pick_on_device(clips, numbers), None if regions is None else pick_on_device(regions, numbers)
        return clips[numbers], None if regions is None else regions[numbers]

    def rate(self, step: int) -> float:
        """Learning rate of the next step after `step` steps."""
        return self.schedule.rate(step, self.clock.elapsed)

    def is_over(self, step: int) -> bool:
        """Whether the run is complete after `step` steps."""
        return self.schedule.is_over(step, self.clock.elapsed)

    def get_state(self) -> dict[str, Any]:
        """The position: the next step, and the training time [s]."""
        return {"step": self.step, "seconds": self.clock.elapsed}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a position."""
        self.step, self.clock, self.ahead, self.first = int(state["step"]), Clock(float(state["seconds"])), None, True

"""Samples of a training in an order that depends on the seed and the step alone, and the clock of a training with a budget.

Reads  `Pictures`
Writes `Batch`, without decoding anything: clips are picked on the device where they fit there, else in threads ahead
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
"""Number of clips that are compared after they were put on a device."""


class Batch(NamedTuple):
    """What one step takes."""

    clips: Any
    """[b t h w 3] uint8."""
    regions: Any
    """[b k h w] uint8, one bit a frame, or None."""
    rate: Any
    """[] float32, the learning rate."""


class Clock:
    """Time that a training has taken, what it took before an interruption included.

    Args:
        before: time [s] that passed before.
    """

    def __init__(self, before: float = 0.0) -> None:
        self.before, self.begin = before, float("nan")

    def start(self) -> None:
        """Begin to count, unless that was done before."""
        if math.isnan(self.begin):
            self.begin = perf_counter()

    @property
    def elapsed(self) -> float:
        """Time [s] until now."""
        return self.before + (0.0 if math.isnan(self.begin) else perf_counter() - self.begin)


@dataclass(frozen=True)
class Schedule:
    """The learning rate, and when a training ends: by its steps, or by its time."""

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
    """Put the pictures into the device's memory where they take at most a share of it; else leave them where they are.

    What was put there is compared with what was sent, in a few places.
    """
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
    """Clips [b ...] of all [n ...] by their numbers [b]."""
    return jnp.take(clips, numbers, axis=0, mode="clip")


class Batches(Iterator[Batch]):
    """Endless batches; `get_state` and `set_state` carry their position, as the loop of training asks for.

    Args:
        pictures: in the host's memory or on a device.
        shares: stream -> share of the samples; streams without pictures have none.
        settings: of the training.
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
        """Whether the pictures lie on a device."""
        return isinstance(self.pictures.clips, jax.Array)

    def numbers(self, step: int) -> np.ndarray:
        """Numbers [b] int32 of the clips of a step: a stream by the shares, then any of its clips."""
        rng = np.random.default_rng((self.settings.seed, step))
        streams = rng.choice(len(self.ranges), self.settings.batch, p=self.probabilities)
        places = rng.random(self.settings.batch)
        lengths, firsts = (np.array([pick(r) for r in self.ranges]) for pick in (len, lambda r: r.start))
        return (firsts[streams] + (places * lengths[streams]).astype(np.int64)).astype(np.int32)

    def __next__(self) -> Batch:
        if not self.first:
            self.clock.start()  # the first step compiles, which is no training
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
        """Clips [b t h w 3] uint8 of a step and the robot's pixels in them, [b k h w] uint8 or None."""
        clips, regions, numbers = self.pictures.clips, self.pictures.regions, self.numbers(step)
        if self.on_device:
            return pick_on_device(clips, numbers), None if regions is None else pick_on_device(regions, numbers)
        return clips[numbers], None if regions is None else regions[numbers]

    def rate(self, step: int) -> float:
        """Learning rate of the step after `step` steps, now."""
        return self.schedule.rate(step, self.clock.elapsed)

    def is_over(self, step: int) -> bool:
        """Whether the training is at its end after `step` steps, now."""
        return self.schedule.is_over(step, self.clock.elapsed)

    def get_state(self) -> dict[str, Any]:
        """The position: the step that comes next, and the time [s] that has passed."""
        return {"step": self.step, "seconds": self.clock.elapsed}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on from a position."""
        self.step, self.clock, self.ahead, self.first = int(state["step"]), Clock(float(state["seconds"])), None, True

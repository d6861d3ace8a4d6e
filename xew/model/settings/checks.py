"""Checks of an experiment's settings, before any work starts."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

from xew.config import ConfigError, pick
from xew.model.codecs.codec import latent_size
from xew.model.conditions import Condition
from xew.model.diffusion.samplers import SAMPLERS, SCHEDULES
from xew.model.network.dit import STREAMS
from xew.model.network.mechanisms import MECHANISMS
from xew.model.settings.parts import pick_conditions
from xew.model.settings.settings import AdaptSettings, ModelSettings, count_replayed
from xew.model.video.frames import TEMPORAL_FACTOR

LEAST_OF_STEPS: dict[str, float] = {
    "train.batch": 1,
    "train.steps": 0,
    "train.learning_rate": 0,
    "train.warmup_steps": 0,
    "train.decay_to": 0,
    "train.seed": 0,
    "train.log_every": 1,
    "train.save_every": 1,
    "train.keep_checkpoints": 1,
}
"""Least values of the settings of a training run, of a world model or a codec."""
LEAST = LEAST_OF_STEPS | {
    "clip.height": 1,
    "clip.width": 1,
    "train.epochs": 0,
    "train.accumulate": 1,
    "train.history_noise": 0,
    "train.ema": 0,
    "train.motion_loss_weight": 0,
    "train.samples": 0,
    "adapt.lora_rank": 0,
    "rollout.steps": 1,
    "rollout.batch": 1,
    "rollout.max_frames": 0,
    "rollout.guidance": 0,
    "rollout.seed": 0,
}
"""Least values of an experiment's settings."""
LONGEST_AVERAGE = 0.25
"""Largest `train.ema`; a longer average would hold more than 2 % of the random start."""


def check_experiment(experiment: Any, source: str) -> None:
    """Raise ConfigError, naming the source, for a setting that does not exist or does not fit."""
    try:
        _check_choices(experiment, source)
    except ConfigError as error:
        if source in str(error):
            raise
        raise type(error)(f"{source}: {error}") from error


def _check_choices(experiment: Any, source: str) -> None:
    check_least(LEAST, experiment, source)
    pick(SAMPLERS, experiment.rollout.sampler, "sampler")
    pick(SCHEDULES, experiment.rollout.noise_schedule, "noise schedule")
    _ = experiment.size, experiment.robots
    conditions = pick_conditions(experiment.model)
    _check_conditions(conditions, source)
    _check_sizes(experiment, source)
    _check_training(experiment, source)
    _check_history(experiment.model, conditions, source)


def check_least(least: Mapping[str, float], settings: Any, source: str) -> None:
    """Raise ConfigError if a number of some settings, named as "train.batch", is below its least value."""
    for name, smallest in least.items():
        value = attrgetter(name)(settings)
        if not value >= smallest:
            raise ConfigError(f"{source}: {name} is {value:g}; it must be at least {smallest:g}.")


def check_steps(steps: int, length: float, unit: str, source: str) -> None:
    """Raise ConfigError unless a training run has one length, in steps or in another unit."""
    if (steps > 0) == (length > 0):
        raise ConfigError(f"{source}: train.steps is {steps}, train.{unit} {length:g}; set one of them, and the other to 0.")


def _check_conditions(conditions: Sequence[Condition], source: str) -> None:
    feeders: dict[str, str] = {}
    known = [name for name in STREAMS if name != "rgb"]
    known += [name for name, mechanism in MECHANISMS.items() if mechanism.source != "reference"]
    for condition in conditions:
        if condition.stream not in known:
            raise ConfigError(
                f"{source}: the condition {condition.name} feeds {condition.stream!r}; expected one of {', '.join(known)}."
            )
        if condition.stream in feeders:
            raise ConfigError(
                f"{source}: {feeders[condition.stream]} and {condition.name} both feed {condition.stream}; choose one of them "
                "(model.action, model.embodiment)."
            )
        feeders[condition.stream] = condition.name


def _check_sizes(experiment: Any, source: str) -> None:
    clip, factor = experiment.clip, latent_size(experiment.codec).spatial_factor * experiment.size.patch[1]
    if clip.frames < 5 or clip.frames % TEMPORAL_FACTOR != 1:
        near = max(5, clip.frames // TEMPORAL_FACTOR * TEMPORAL_FACTOR + 1)
        raise ConfigError(f"{source}: clip.frames is {clip.frames}; it must be 4 k + 1 and at least 5, for example {near}.")
    if clip.height % factor or clip.width % factor:
        size = f"{clip.width}x{clip.height}"
        raise ConfigError(f"{source}: clip is {size}; both sides must be multiples of {factor} (codec factor x patch).")


def _check_training(experiment: Any, source: str) -> None:
    train, adapt = experiment.train, experiment.adapt
    check_steps(train.steps, train.epochs, "epochs", source)
    if train.ema > LONGEST_AVERAGE:
        raise ConfigError(f"{source}: train.ema is {train.ema:g} of the run; it must be at most {LONGEST_AVERAGE:g}.")
    if not 0 <= adapt.replay < 1 or (adapt.replay and count_replayed(train.batch, adapt.replay) >= train.batch):
        raise ConfigError(
            f"{source}: adapt.replay is {adapt.replay:g} of a batch of {train.batch}; it must be a part below 1 that leaves at "
            "least one other sample."
        )
    if not train.shift > 0:
        raise ConfigError(f"{source}: train.shift is {train.shift:g}; it must be over 0 (1 leaves the levels as they are).")
    if adapt.start_from is None:
        if adapt != AdaptSettings():
            raise ConfigError(f"{source}: adapt is set without adapt.start_from; set it to the run to adapt, or remove adapt.")
        return
    if not adapt.robots or adapt.episodes < 1:
        raise ConfigError(f"{source}: adapt needs adapt.robots and at least one of adapt.episodes of each task and robot.")


def _check_history(settings: ModelSettings, conditions: Sequence[Condition], source: str) -> None:
    if any(frame >= 0 for frame in settings.history) or list(settings.history) != sorted(settings.history):
        history = list(settings.history)
        raise ConfigError(f"{source}: model.history is {history}; expected negative frames, the earliest first, as [-40, -20].")
    streams = [condition.stream for condition in conditions]
    framed = [name for name in streams if name in MECHANISMS and MECHANISMS[name].enters == "frame"]
    if settings.visibility == "one_way" and framed and settings.history:
        raise ConfigError(
            f"{source}: model.visibility one_way computes earlier frames without the poses of action {settings.action}; use "
            "joint, or set model.history to []."
        )

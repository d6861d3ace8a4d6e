"""Numbers of a common size: how conditions of numbers are scaled by those of the training episodes.

Reads  what conditions tell of the training episodes' commands
Writes `Scale`, kept with the latent cache and with the run, since a rollout needs the very same
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xew.config import ConfigError
from xew.files import replacing
from xew.model.conditions import Command, Condition
from xew.model.experiment import Experiment

PERCENTILES = (1, 99)
"""Ctrl-World and Boundless-World-Model map these to -1 and 1, and clip."""
SCALES = "scales.json"
"""In a run."""
STILL = 1e-3
"""A number that moves less over all training episodes is divided by this [m, rad or 1]: noise is not blown up."""


@dataclass(frozen=True)
class Scale:
    """(x - middle) / width, clipped where there is a limit."""

    middle: np.ndarray
    """[n] float32."""
    width: np.ndarray
    """[n] float32."""
    limit: float | None

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Values [... k*n], k rows of n numbers beside each other, in their shape: float32."""
        rows = (values.reshape(*values.shape[:-1], -1, len(self.middle)) - self.middle) / self.width
        rows = rows if self.limit is None else np.clip(rows, -self.limit, self.limit)
        return rows.reshape(values.shape).astype(np.float32)


def fit_scales(conditions: Iterable[Condition], commands: Iterable[Command]) -> dict[str, Scale]:
    """The scale of every condition that has one, by its name."""
    scaled = {condition.name: condition for condition in conditions if condition.scale != "none"}
    told: dict[str, list[np.ndarray]] = {name: [] for name in scaled}
    for command in commands if scaled else ():
        for name, condition in scaled.items():
            assert condition.make is not None
            told[name].append(condition.change(condition.make(command)))
    return {name: _fit(condition, np.concatenate(told[name])) for name, condition in scaled.items()}


def _fit(condition: Condition, values: np.ndarray) -> Scale:
    """Of values [m n]."""
    if condition.scale == "percentiles":
        low, high = np.percentile(values, PERCENTILES, axis=0)
        middle, width, limit = (low + high) / 2, (high - low) / 2, 1.0
    else:
        middle, width, limit = values.mean(axis=0), values.std(axis=0), None
    return Scale(middle.astype(np.float32), np.maximum(width, STILL).astype(np.float32), limit)


def apply_scales(
    scales: Mapping[str, Scale], conditions: Mapping[str, Condition], arrays: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Arrays by stream, with the numbers of conditions that have a scale in that scale."""
    names = {stream: condition.name for stream, condition in conditions.items() if condition.scale != "none"}
    return {stream: scales[names[stream]](array) if stream in names else array for stream, array in arrays.items()}


def save_scales(path: Path, scales: Mapping[str, Scale]) -> None:
    """Write scales as JSON, all or nothing."""
    content = {
        name: {"middle": scale.middle.tolist(), "width": scale.width.tolist(), "limit": scale.limit}
        for name, scale in scales.items()
    }
    with replacing(path) as unfinished:
        unfinished.write_text(json.dumps(content, indent=1) + "\n")


def read_scales(path: Path, conditions: Sequence[Condition], remedy: str) -> dict[str, Scale]:
    """The scales that the conditions need; nothing is read where none needs one.

    Raises:
        ConfigError: there is no such file, it is damaged, or lacks one; `remedy` says what to do.
    """
    names = {condition.name for condition in conditions if condition.scale != "none"}
    if not names:
        return {}
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        arrays = {name: (content[name]["middle"], content[name]["width"], content[name]["limit"]) for name in sorted(names)}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} does not hold the scales of {', '.join(sorted(names))} ({error}); {remedy}.") from error
    return {
        name: Scale(np.asarray(middle, np.float32), np.asarray(width, np.float32), limit)
        for name, (middle, width, limit) in arrays.items()
    }


def load_run_scales(experiment: Experiment, run: Path) -> dict[str, Scale]:
    """The scales that a run was trained with. Raises ConfigError if it needs some and has none."""
    return read_scales(run / SCALES, tuple(experiment.conditions.values()), "train it again with --overwrite")

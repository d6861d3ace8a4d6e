"""Normalization of numeric conditions by their spread over the training episodes.

Scales are stored with the latent cache and with the run, because rollouts must use the scales of training.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xew.config import ConfigError, parse
from xew.dataset import Episode
from xew.files import read_json, write_text
from xew.model.cache.keys import RUN_SCALES, scales_path
from xew.model.conditions import Command, Condition
from xew.model.episodes.commands import episode_command
from xew.model.settings.parts import Encoding

PERCENTILES = (1, 99)
"""Percentiles that map to -1 and 1, with clipping beyond, as in Ctrl-World and Boundless-World-Model."""
RUN_REMEDY = "train it again with --overwrite"
"""Remedy if a run's scales are damaged or lost."""
STILL = 1e-3
"""Least width [m, rad or 1], so the noise of a nearly constant number is not amplified."""


@dataclass(frozen=True)
class Scale:
    """The normalization (x - middle) / width, clipped at `limit` if there is one."""

    middle: np.ndarray
    """[n] float32."""
    width: np.ndarray
    """[n] float32."""
    limit: float | None

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Normalize values [... k*n], k groups of n numbers, to float32 [... k*n]."""
        scaled = (values.reshape(*values.shape[:-1], -1, len(self.middle)) - self.middle) / self.width
        scaled = scaled if self.limit is None else np.clip(scaled, -self.limit, self.limit)
        return scaled.reshape(values.shape).astype(np.float32)


def fit_scales(conditions: Iterable[Condition], commands: Iterable[Command]) -> dict[str, Scale]:
    """Fit the scale of every condition that needs one, by name, to the commands of episodes (actions [t 16])."""
    scaled = {condition.name: condition for condition in conditions if condition.scale != "none"}
    values: dict[str, list[np.ndarray]] = {name: [] for name in scaled}
    for command in commands if scaled else ():
        for name, condition in scaled.items():
            assert condition.make is not None
            values[name].append(condition.change(condition.make(command)))
    return {name: _fit(condition, np.concatenate(values[name])) for name, condition in scaled.items()}


def _fit(condition: Condition, values: np.ndarray) -> Scale:
    """Fit the scale of values [m n] float32."""
    if condition.scale == "percentiles":
        low, high = np.percentile(values, PERCENTILES, axis=0)
        middle, width, limit = (low + high) / 2, (high - low) / 2, 1.0
    else:
        middle, width, limit = values.mean(axis=0), values.std(axis=0), None
    return Scale(middle.astype(np.float32), np.maximum(width, STILL).astype(np.float32), limit)


def apply_scales(
    scales: Mapping[str, Scale], conditions: Mapping[str, Condition], arrays: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Normalize the arrays [... n], by stream, of conditions with a scale; other arrays are returned unchanged."""
    names = {stream: condition.name for stream, condition in conditions.items() if condition.scale != "none"}
    return {stream: scales[names[stream]](array) if stream in names else array for stream, array in arrays.items()}


def dump_scales(scales: Mapping[str, Scale]) -> str:
    """Serialize scales to the JSON that `read_scales` reads."""
    content = {
        name: {"middle": scale.middle.tolist(), "width": scale.width.tolist(), "limit": scale.limit}
        for name, scale in scales.items()
    }
    return json.dumps(content, indent=1) + "\n"


@dataclass(frozen=True)
class _StoredScale:
    """A `Scale` as stored in its file."""

    middle: tuple[float, ...]
    width: tuple[float, ...]
    limit: float | None

    def as_scale(self) -> Scale:
        numbers = [*self.middle, *self.width, *([] if self.limit is None else [self.limit])]
        if len(self.middle) != len(self.width) or not np.isfinite(numbers).all() or min((1.0, *self.width)) <= 0:
            raise ValueError("expected as many widths over 0 as middles, all finite")
        return Scale(np.asarray(self.middle, np.float32), np.asarray(self.width, np.float32), self.limit)


def read_scales(path: Path, conditions: Sequence[Condition], remedy: str) -> dict[str, Scale]:
    """The scales that the conditions need. Raises ConfigError with `remedy` if the file is missing, damaged or incomplete."""
    names = {condition.name for condition in conditions if condition.scale != "none"}
    if not names:
        return {}
    try:
        content = read_json(path)
        stored = {name: parse(_StoredScale, content[name], name) for name in sorted(names)}
        return {name: scale.as_scale() for name, scale in stored.items()}
    except (OSError, ValueError, KeyError, TypeError, ConfigError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path} does not hold the scales of {', '.join(sorted(names))} ({reason}); {remedy}.") from error


def load_run_scales(conditions: Mapping[str, Condition], run: Path) -> dict[str, Scale]:
    """The scales that a run was trained with. Raises ConfigError as `read_scales`."""
    return read_scales(run / RUN_SCALES, tuple(conditions.values()), RUN_REMEDY)


def load_scales(encoding: Encoding, episodes: Sequence[Episode]) -> dict[str, Scale]:
    """The scales of these episodes, or of the run that an adaptation starts from. Raises ConfigError as `read_scales`."""
    conditions = tuple(encoding.inputs.conditions.values())
    remedy = encoding.remedy if encoding.start_from is None else RUN_REMEDY
    return read_scales(scales_path(encoding, episodes), conditions, remedy)


def keep_scales(encoding: Encoding, episodes: Sequence[Episode]) -> None:
    """Fit and store the scales of these episodes, unless none is needed or they exist."""
    path, conditions = scales_path(encoding, episodes), encoding.inputs.conditions.values()
    if any(condition.scale != "none" for condition in conditions) and encoding.start_from is None and not path.exists():
        scales = fit_scales(conditions, (episode_command(folder, record) for folder, record in episodes))
        write_text(path, dump_scales(scales), within=encoding.folder)

"""A bundle: one JSON file by which others can check a score table.

It holds protocol, versions, estimators, the digest of the score table, and for every graded video its values and the digests of
prediction and truth. Alone it shows whether it is whole and consistent; with videos and data, whether it was made from them.
"""

import hashlib
import json
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xew.config import ConfigError, parse
from xew.files import digest_files, read_json, write_text
from xew.metrics.grading.scores import KEY, Cell

if TYPE_CHECKING:
    import pandas as pd

FORMAT = 1
DIGESTS = ("prediction", "rgb", "states")
CHOICES = ("protocol", "estimators", "frame_zero", "allowed")
MOST_NAMED = 5
AGREEMENT = 1e-3
"""Largest relative difference (of numbers below 1: absolute) of scores that are graded again on another machine."""

Bundle = dict[str, Any]


def write_bundle(path: Path, table: Path, rows: "pd.DataFrame", cells: Sequence[Cell]) -> None:
    """Write the bundle of a score table with these rows; graded cells without a row had no value."""
    values: dict[tuple[Any, ...], dict[str, float]] = defaultdict(dict)
    exact: dict[tuple[Any, ...], int] = {}
    for *key, metric, value, exact_frames in rows[[*KEY, "metric", "value", "exact_frames"]].itertuples(index=False, name=None):
        values[tuple(key)][metric] = value
        exact[tuple(key)] = exact_frames
    samples = [
        dict(zip(KEY, cell.key, strict=True))
        | {"frames": cell.frames, "exact_frames": exact[cell.key]}
        | {name: getattr(cell, name) for name in DIGESTS}
        | {"values": values[cell.key]}
        for cell in sorted(cells, key=lambda cell: cell.key)
        if cell.key in values
    ]
    bundle: Bundle = {"format": FORMAT, "table": table.name, "table_sha256": digest_files([table])}
    bundle |= {str(name): value for name, value in rows.attrs.items()} | {"samples": samples, "means": means(samples)}
    write_text(path, json.dumps(bundle | {"digest": digest(bundle)}, indent=1) + "\n", within=path.parent)


def read_bundle(path: Path) -> Bundle:
    """A bundle that is whole and consistent in itself and with the table next to it, where there is one.

    Raises:
        ConfigError: it is not; the message says what does not hold.
    """
    try:
        bundle = read_json(path)
        _check_types(path, bundle)
        given, samples = bundle.pop("digest"), bundle["samples"]
        wrong = []
        if bundle["format"] != FORMAT:
            wrong.append(f"its format is {bundle['format']}, this xew reads {FORMAT}")
        elif given != digest(bundle):
            wrong.append("its content does not have the digest that it names: it was changed after it was written")
        elif bundle["means"] != means(samples):
            wrong.append("its means are not those of its values")
        elif len({_key(sample) for sample in samples}) != len(samples):
            wrong.append("it holds a video twice")
        table = path.parent / bundle["table"]
        if not wrong and table.exists() and digest_files([table]) != bundle["table_sha256"]:
            wrong.append(f"{table} is another table than it was made from")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path} is no bundle of xew, or is damaged ({type(error).__name__}: {error}).") from error
    if wrong:
        raise ConfigError(f"{path} does not hold: {'; '.join(wrong)}.")
    return bundle


@dataclass(frozen=True)
class _Sample:
    """Types of what a bundle says of one video."""

    model: str
    condition: str
    task: str
    seed: int
    robot: str
    frames: int
    exact_frames: int
    prediction: str
    rgb: str
    states: str
    values: dict[str, float]


@dataclass(frozen=True)
class _Types:
    """Types of what is read of a bundle."""

    format: int
    table: str
    table_sha256: str
    protocol: int
    metrics: dict[str, Any]
    estimators: dict[str, Any]
    frame_zero: str
    allowed: tuple[str, ...]
    samples: tuple[_Sample, ...]
    means: tuple[dict[str, Any], ...]
    digest: str
    codecs: dict[str, tuple[str, ...]] = field(default_factory=dict)


def _check_types(path: Path, bundle: Any) -> None:
    """Raise ConfigError for what is missing or of another type than a bundle has; ValueError if its table lies elsewhere."""
    known = {entry.name for entry in fields(_Types)}
    known_values = {name: value for name, value in bundle.items() if name in known} if isinstance(bundle, dict) else bundle
    read = parse(_Types, known_values, f"{path} is no bundle of xew, or is damaged")
    if Path(read.table).name != read.table:
        raise ValueError(f"its table {read.table!r} does not lie next to it")


def differences(bundle: Bundle, choices: dict[str, Any], cells: Iterable[Cell]) -> list[str]:
    """Differences between a bundle and these videos and choices, one line each; empty if the bundle is made from them."""
    differing = [f"{name} is {bundle[name]!r}, here {choices[name]!r}" for name in CHOICES if bundle[name] != choices[name]]
    here = {cell.key: cell for cell in cells}
    there = {_key(sample): sample for sample in bundle["samples"]}
    differing += [f"{_text(key)} is in the bundle and not here" for key in there.keys() - here.keys()]
    differing += [f"{_text(key)} is here and not in the bundle" for key in here.keys() - there.keys()]
    for key in sorted(there.keys() & here.keys()):
        changed = [name for name in (*DIGESTS, "frames") if there[key][name] != getattr(here[key], name)]
        differing += [f"{_text(key)} has another {', '.join(changed)}"] if changed else []
    return differing


def disagreements(bundle: Bundle, key: tuple[Any, ...], values: dict[str, float]) -> list[str]:
    """Where values of a video that were graded again are not those of the bundle, one line each."""
    sample = next(sample for sample in bundle["samples"] if _key(sample) == key)
    disagreeing = []
    for metric in bundle["metrics"]:
        then, now = (some.get(metric, math.nan) for some in (sample["values"], values))
        if not np.isclose(now, then, rtol=AGREEMENT, atol=AGREEMENT, equal_nan=True):
            disagreeing.append(f"{_text(key)}: {metric} is {now:.6g}, the bundle says {then:.6g}")
    return disagreeing


def raise_if_any(path: Path, differences: Sequence[str]) -> None:
    """Raise ConfigError with the first few differences, if there are any."""
    if differences:
        more = [f"and {len(differences) - MOST_NAMED} more"] if len(differences) > MOST_NAMED else []
        raise ConfigError(f"{path} does not hold here:", *(f"  {text}" for text in [*differences[:MOST_NAMED], *more]))


def means(samples: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean values over samples, one for each robot, model, condition and metric; independent of the samples' order."""
    groups: dict[tuple[str, ...], list[float]] = defaultdict(list)
    for sample in samples:
        for metric, value in sample["values"].items():
            groups[sample["robot"], sample["model"], sample["condition"], metric].append(value)
    names = ("robot", "model", "condition", "metric")
    return [
        dict(zip(names, group, strict=True)) | {"mean": math.fsum(values) / len(values), "episodes": len(values)}
        for group, values in sorted(groups.items())
    ]


def digest(bundle: Bundle) -> str:
    """SHA-256 of a bundle's content, its own digest left out."""
    return hashlib.sha256(json.dumps(bundle, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _key(sample: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(sample[name] for name in KEY)


def _text(key: tuple[Any, ...]) -> str:
    return " ".join(str(part) for part in key if part != "")

"""Scores on disk: a tidy table that says itself what its metrics mean, and the per-frame curves beside it.

scores.parquet         model condition task seed robot metric value | frames exact_frames content
scores.curves.parquet  model condition task seed robot metric frame value
The table's attributes (pandas `attrs`) hold protocol, versions, and each metric's unit, direction, range and definition,
so that the analysis needs no import of this room.
"""

import hashlib
import math
import os
import time
from collections.abc import Hashable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

import xew
from xew.config import ConfigError
from xew.metrics import METRICS

KEY = ["model", "condition", "task", "seed", "robot"]
SAVE_EVERY_S = 30.0


@dataclass(frozen=True)
class Cell:
    """One graded video."""

    model: str
    condition: str
    task: str
    seed: int
    robot: str
    frames: int
    """Frames compared, the given one included."""
    content: str
    """Digest of all that the scores depend on: the video, the truth, the number of frames."""

    @property
    def identity(self) -> tuple[str | int, ...]:
        return (*(getattr(self, name) for name in KEY), self.content)

    def with_content(self, *parts: str) -> "Cell":
        digest = hashlib.sha256("\n".join((*parts, str(self.frames))).encode()).hexdigest()
        return replace(self, content=digest[:16])


class ScoreTable:
    """Scores and curves in memory, saved now and then, so that a killed run loses half a minute."""

    def __init__(self, path: Path, attributes: dict[Hashable, Any], rows: pd.DataFrame, curves: pd.DataFrame) -> None:
        self.path, self.attributes = path, attributes
        self._rows, self._curves = [rows], [curves]
        self._done = set(_identities(rows))
        self._saved_at = time.monotonic()

    @classmethod
    def open(cls, path: Path, protocol: int, metrics: tuple[str, ...], overwrite: bool = False) -> "ScoreTable":
        """The table at a path as far as it was graded for the same protocol and metrics, else an empty one.

        Raises:
            ConfigError: the path cannot be a score table, or holds a damaged one.
        """
        attributes = describe(protocol, metrics)
        if path.suffix != ".parquet":
            raise ConfigError(f"--out is {path}, expected a name that ends in .parquet.")
        empty = pd.DataFrame(columns=[*KEY, "metric", "value", "frames", "exact_frames", "content"])
        empty_curves = pd.DataFrame(columns=[*KEY, "metric", "frame", "value"])
        if overwrite or not path.exists():
            return cls(path, attributes, empty, empty_curves)
        try:
            rows, curves = pd.read_parquet(path), pd.read_parquet(_curves_path(path))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path} cannot be read ({error}); delete it, or grade anew: --overwrite.") from error
        same = all(rows.attrs.get(key) == attributes[key] for key in ("protocol", "metrics"))
        return cls(path, attributes, rows, curves) if same else cls(path, attributes, empty, empty_curves)

    @property
    def curves_path(self) -> Path:
        return _curves_path(self.path)

    def has(self, cell: Cell) -> bool:
        return cell.identity in self._done

    def add(self, cell: Cell, curves: dict[str, np.ndarray], exact_frames: int) -> None:
        """Enter per-frame scores (frame 1 on) of a cell; its score is their mean."""
        key = {name: getattr(cell, name) for name in KEY}
        for metric, curve in curves.items():
            score = {"metric": metric, "value": float(np.mean(curve, dtype=np.float64))}
            rest = {"frames": cell.frames, "exact_frames": exact_frames, "content": cell.content}
            self._rows.append(pd.DataFrame([key | score | rest]))
            frames = np.arange(1, len(curve) + 1)
            self._curves.append(pd.DataFrame(key | {"metric": metric, "frame": frames, "value": curve}))
        self._done.add(cell.identity)

    def keep_only(self, cells: list[Cell]) -> None:
        """Drop what is not among the cells, for example of rollouts that were made anew."""
        wanted = {cell.identity for cell in cells}
        rows, curves = _concat(self._rows), _concat(self._curves)
        rows = rows[[identity in wanted for identity in _identities(rows)]]
        kept = set(rows[KEY].itertuples(index=False, name=None))
        self._rows = [rows]
        self._curves = [curves[[key in kept for key in curves[KEY].itertuples(index=False, name=None)]]]

    def save_now_and_then(self) -> None:
        if time.monotonic() - self._saved_at > SAVE_EVERY_S:
            self.save()

    def save(self) -> None:
        """Write both files, sorted, so that the order of work leaves no trace. Raises ConfigError if that is impossible."""
        rows, curves = _concat(self._rows), _concat(self._curves)
        self._rows, self._curves = [rows], [curves]
        order = {name: i for i, name in enumerate(METRICS)}

        def rank(column: pd.Series) -> pd.Series:
            return column.map(order) if column.name == "metric" else column

        rows = rows.sort_values([*KEY, "metric"], key=rank, ignore_index=True)
        curves = curves.sort_values([*KEY, "metric", "frame"], key=rank, ignore_index=True)
        rows.attrs, curves.attrs = self.attributes, self.attributes
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # The curves first: a table that counts a cell as done always has its curves.
            for frame, path in ((curves, self.curves_path), (rows, self.path)):
                temporary = path.with_name(f".{path.name}.partial")
                frame.to_parquet(temporary, index=False)
                os.replace(temporary, path)
        except OSError as error:
            raise ConfigError(f"cannot write {self.path}: {error}. Free some space or choose another --out.") from error
        self._saved_at = time.monotonic()

    def summary(self, robots_apart: tuple[str, ...]) -> str:
        """Means as text, a line per robot and model, held-out robots first."""
        rows = _concat(self._rows)
        if rows.empty:
            return "no scores"
        table = rows.pivot_table(index=["robot", "model", "condition"], columns="metric", values="value", aggfunc="mean")
        names = [name for name in METRICS if name in table]
        order = sorted(table.index, key=lambda key: (key[0] not in robots_apart, *key))
        return table.loc[order, names].to_string(float_format=lambda value: f"{value:.4f}")


def describe(protocol: int, metrics: tuple[str, ...]) -> dict[Hashable, Any]:
    """The table's attributes: plain JSON."""
    described = {}
    for name in (name for name in METRICS if name in metrics):
        metric = METRICS[name]
        low, high = (bound if math.isfinite(bound) else None for bound in metric.range)
        fields = {key: getattr(metric, key) for key in ("dimension", "unit", "higher_is_better", "reference")}
        described[name] = fields | {"low": low, "high": high}
    return {"protocol": protocol, "metrics": described, "versions": {"xew": xew.__version__, "jax": jax.__version__}}


def _identities(rows: pd.DataFrame) -> list[tuple[str | int, ...]]:
    """Cell.identity of each row."""
    return list(rows[[*KEY, "content"]].itertuples(index=False, name=None))


def file_digest(paths: tuple[Path, ...]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _curves_path(path: Path) -> Path:
    return path.with_suffix(".curves.parquet")


def _concat(frames: list[pd.DataFrame]) -> pd.DataFrame:
    """All of them as one; empty ones are left out, whose columns have no type."""
    filled = [frame for frame in frames if len(frame)]
    return pd.concat(filled, ignore_index=True) if filled else frames[0]

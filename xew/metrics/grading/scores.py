"""Scores on disk: a tidy table with a description of its metrics in it, and the per-frame curves next to it.

scores.parquet         model condition task seed robot metric value | frames exact_frames content
scores.curves.parquet  model condition task seed robot metric frame value
scores.cells/          one small file for each graded video, from which the tables are put together
<data>-baselines/      the same for the baselines, next to the data set and for all tables
A metric that a video has no value of has no row. The tables' attributes (pandas `attrs`) hold protocol, versions,
estimators, what became of frame 0, and each metric's title, unit, direction, range and source, so the analysis needs no
import of this package. The tables are a function of what was graded alone: the same bytes whatever was done first, in how
many threads, and how often it was stopped on the way.
"""

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import xew
from xew.config import ConfigError
from xew.dataset import folder_beside
from xew.episode import place_episode
from xew.files import read_json, replacing, write_bytes
from xew.metrics import METRICS
from xew.metrics.grade import Grades
from xew.protocol import BASELINES

KEY = ["model", "condition", "task", "seed", "robot"]
ROW_GROUP = 64
"""Number of cells in a row group, the most that is in memory at once."""

_KEY_FIELDS = [(name, pa.int64() if name == "seed" else pa.string()) for name in KEY] + [("metric", pa.string())]
ROWS = pa.schema(
    [*_KEY_FIELDS, ("value", pa.float64()), ("frames", pa.int64()), ("exact_frames", pa.int64()), ("content", pa.string())]
)
CURVES = pa.schema([*_KEY_FIELDS, ("frame", pa.int64()), ("value", pa.float32())])


@dataclass(frozen=True)
class Cell:
    """One video to grade, and all that its scores depend on."""

    model: str
    condition: str
    task: str
    seed: int
    robot: str
    frames: int
    """Frames compared, the given one included."""
    prediction: str
    """SHA-256 of the video (`xew.files.digest_files`); '' for a baseline, which is made of the truth."""
    rgb: str
    states: str
    settings: str
    """The protocol, the estimators and what else was chosen, as text."""

    @property
    def key(self) -> tuple[str | int, ...]:
        return tuple(getattr(self, name) for name in KEY)

    @cached_property
    def content(self) -> str:
        """Digest of all that the scores depend on."""
        parts = (self.rgb, self.states, self.prediction, str(self.frames), self.settings)
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


class CellStore:
    """Graded videos, a file each, complete or not there: a grading that was stopped goes on from what is there.

    Args:
        folder: of the videos of models.
        baselines: folder of the baselines, which are the same for all models and are graded once a data set.
    """

    def __init__(self, folder: Path, baselines: Path) -> None:
        self.folder, self.baselines = folder, baselines

    def read(self, cell: Cell) -> Grades | None:
        """What a cell was graded with; None where it was not, or where anything that it depends on has changed."""
        try:
            stored = read_json(self._path(cell))
            if stored["content"] != cell.content:
                return None
            values = {name: math.nan if value is None else float(value) for name, value in stored["values"].items()}
            curves = {name: np.array(curve, np.float32) for name, curve in stored["curves"].items()}  # null becomes NaN
            exact_frames = int(stored["exact_frames"])
            whole = all(curve.ndim == 1 and len(curve) <= cell.frames for curve in curves.values())
            return Grades(values, curves, exact_frames) if whole and 0 <= exact_frames <= cell.frames else None
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError):
            return None

    def missing(self, cell: Cell, metrics: Iterable[str]) -> tuple[str, ...]:
        """Which of the metrics are still to be graded."""
        grades = self.read(cell)
        return tuple(name for name in metrics if grades is None or name not in grades.values)

    def write(self, cell: Cell, grades: Grades) -> None:
        """Add grades to those that a cell already has."""
        before = self.read(cell)
        values = (before.values if before else {}) | grades.values
        curves = (before.curves if before else {}) | grades.curves
        content = {name: getattr(cell, name) for name in KEY} | {
            "content": cell.content,
            "exact_frames": grades.exact_frames,
            "values": {name: _finite_or_none(value) for name, value in values.items()},
            "curves": {name: [_finite_or_none(value) for value in curve.tolist()] for name, curve in curves.items()},
        }
        root = self.baselines if cell.model in BASELINES else self.folder
        write_bytes(self._path(cell), json.dumps(content).encode(), within=root.parent)

    def _path(self, cell: Cell) -> Path:
        if cell.model in BASELINES:
            return place_episode(self.baselines, cell.task, cell.seed, cell.robot) / f"{cell.model}-{cell.content}.json"
        name = hashlib.sha256(f"{cell.model}\n{cell.condition}".encode()).hexdigest()[:16]
        return place_episode(self.folder, cell.task, cell.seed, cell.robot) / f"{name}.json"


def check_out(path: Path) -> None:
    """Raise ConfigError if a path cannot be that of a score table."""
    if path.suffix != ".parquet":
        raise ConfigError(f"--out is {path}, expected a name that ends in .parquet.")


def baselines_folder(data: Path, out: Path) -> Path:
    """Folder of the scores of baselines on a data set, see `folder_beside_data`."""
    return folder_beside_data(data, out, "baselines")


def surfaces_folder(data: Path, out: Path) -> Path:
    """Folder of the points on surfaces of a data set's episodes, see `folder_beside_data`."""
    return folder_beside_data(data, out, "surfaces")


def folder_beside_data(data: Path, out: Path, name: str) -> Path:
    """Folder for what is made of a data set once, for all score tables: next to the data, or next to the table where that
    cannot be written to or is a link."""
    folder = folder_beside(data.absolute(), name)
    there = next(path for path in (folder, *folder.parents) if path.exists())
    writable = not folder.is_symlink() and os.access(there, os.W_OK)
    return folder if writable else path_beside(out, name)


def path_beside(path: Path, ending: str) -> Path:
    """The name of a file next to a score table, such as scores.curves.parquet."""
    return path.with_suffix(f".{ending}")


def write_tables(path: Path, attributes: dict[str, Any], cells: Sequence[Cell], store: CellStore) -> None:
    """Write both tables of the cells that are graded, sorted, so the order of work leaves no trace."""
    metrics = list(attributes["metrics"])
    # The curves first: what is in the table always has its curves.
    _write_table(path_beside(path, "curves.parquet"), CURVES, _curve_table, attributes, metrics, cells, store)
    _write_table(path, ROWS, _row_table, attributes, metrics, cells, store)


def _write_table(
    path: Path,
    schema: pa.Schema,
    tabulate: Callable[[Cell, Grades, Sequence[str]], pa.Table],
    attributes: dict[str, Any],
    names: Sequence[str],
    cells: Sequence[Cell],
    store: CellStore,
) -> None:
    graded = ((cell, store.read(cell)) for cell in sorted(cells, key=lambda cell: cell.key))
    tables = (tabulate(cell, grades, names) for cell, grades in graded if grades and grades.values.keys() >= set(names))
    _write_parquet(path, schema.with_metadata({"PANDAS_ATTRS": json.dumps(attributes)}), tables)


def _row_table(cell: Cell, grades: Grades, metrics: Sequence[str]) -> pa.Table:
    names = [name for name in metrics if math.isfinite(grades.values[name])]
    count = len(names)
    columns = [*_repeat_key(cell, count), pa.array(names, pa.string()), pa.array([grades.values[name] for name in names])]
    columns += [pa.repeat(pa.scalar(number, pa.int64()), count) for number in (cell.frames, grades.exact_frames)]
    return pa.table([*columns, pa.repeat(cell.content, count)], names=ROWS.names).cast(ROWS)


def _curve_table(cell: Cell, grades: Grades, metrics: Sequence[str]) -> pa.Table:
    names = [name for name in metrics if name in grades.curves and math.isfinite(grades.values[name])]
    if not names:
        return CURVES.empty_table()
    curves = [grades.curves[name] for name in names]
    known = [np.flatnonzero(np.isfinite(curve)) for curve in curves]
    frames = np.concatenate([cell.frames - len(curve) + some for curve, some in zip(curves, known, strict=True)])
    values = np.concatenate([curve[some] for curve, some in zip(curves, known, strict=True)])
    of = pa.array(names, pa.string()).take(pa.array(np.repeat(np.arange(len(names)), list(map(len, known)))))
    columns = [*_repeat_key(cell, len(values)), of, pa.array(frames), pa.array(values)]
    return pa.table(columns, names=CURVES.names).cast(CURVES)


def _repeat_key(cell: Cell, count: int) -> list[pa.Array]:
    return [pa.repeat(pa.scalar(getattr(cell, name), kind), count) for name, kind in _KEY_FIELDS[: len(KEY)]]


def _write_parquet(path: Path, schema: pa.Schema, tables: Iterator[pa.Table]) -> None:
    with replacing(path, within=path.parent) as temporary, pq.ParquetWriter(temporary, schema) as writer:
        for group in _groups(tables, ROW_GROUP):
            writer.write_table(pa.concat_tables(group).replace_schema_metadata(schema.metadata))


def _groups(items: Iterator[pa.Table], size: int) -> Iterator[list[pa.Table]]:
    group: list[pa.Table] = []
    for item in items:
        group.append(item)
        if len(group) == size:
            yield group
            group = []
    if group:
        yield group


def describe(settings: dict[str, Any], metrics: tuple[str, ...]) -> dict[str, Any]:
    """The tables' attributes, plain JSON: the settings (protocol, estimators, frame_zero …), versions, and each metric."""
    described = {}
    for name in (name for name in METRICS if name in metrics):
        metric = METRICS[name]
        low, high = (bound if math.isfinite(bound) else None for bound in metric.range)
        fields = {key: getattr(metric, key) for key in ("dimension", "unit", "higher_is_better", "reference")}
        fields |= {"low": low, "high": high, "suites": list(metric.suites)}
        fields |= {"counterpart": metric.counterpart}
        described[name] = fields | {"title": metric.title or name, "estimated": metric.estimated, "reported": metric.reported}
    return settings | {"metrics": described, "versions": {"xew": xew.__version__, "jax": jax.__version__}}


def _finite_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None

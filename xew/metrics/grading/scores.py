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

import base64
import hashlib
import itertools
import json
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

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

Item = TypeVar("Item")

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
            curves = {name: _decode(curve) for name, curve in stored["curves"].items()}
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
            "curves": {name: _encode(curve) for name, curve in curves.items()},
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


Graded = Sequence[tuple[Cell, Grades]]
"""Cells and their scores."""


def write_tables(path: Path, attributes: dict[str, Any], cells: Sequence[Cell], store: CellStore) -> None:
    """Write both tables of the cells that are graded, sorted, so the order of work leaves no trace."""
    metrics = list(attributes["metrics"])
    graded = ((cell, store.read(cell)) for cell in sorted(cells, key=lambda cell: cell.key))
    complete = ((cell, grades) for cell, grades in graded if grades and grades.values.keys() >= set(metrics))
    # The curves are renamed first: what is in the table always has its curves.
    with (
        _open_table(path, ROWS, attributes) as rows,
        _open_table(path_beside(path, "curves.parquet"), CURVES, attributes) as curves,
    ):
        for group in _groups(complete, ROW_GROUP):
            rows.write_table(_row_table(group, metrics).replace_schema_metadata(rows.schema.metadata))
            curves.write_table(_curve_table(group, metrics).replace_schema_metadata(curves.schema.metadata))


@contextmanager
def _open_table(path: Path, schema: pa.Schema, attributes: dict[str, Any]) -> Iterator[pq.ParquetWriter]:
    schema = schema.with_metadata({"PANDAS_ATTRS": json.dumps(attributes)})
    with replacing(path, within=path.parent) as temporary, pq.ParquetWriter(temporary, schema) as writer:
        yield writer


def _row_table(graded: Graded, metrics: Sequence[str]) -> pa.Table:
    values = np.array([[grades.values[name] for name in metrics] for _, grades in graded])
    cell_index, metric_index = np.nonzero(np.isfinite(values))
    frames = [[cell.frames for cell, _ in graded], [grades.exact_frames for _, grades in graded]]
    columns = [*_repeat_keys(graded, cell_index), pa.array(metrics, pa.string()).take(pa.array(metric_index))]
    columns += [pa.array(values[cell_index, metric_index]), *(pa.array(np.array(some)[cell_index]) for some in frames)]
    content = pa.array([cell.content for cell, _ in graded]).take(pa.array(cell_index))
    return pa.table([*columns, content], names=ROWS.names).cast(ROWS)


def _curve_table(graded: Graded, metrics: Sequence[str]) -> pa.Table:
    curves = [np.empty(0, np.float32)]
    places = [(0, 0, 0)]  # cell, metric and first frame of each curve
    for i, (cell, grades) in enumerate(graded):
        for j, name in enumerate(metrics):
            if name in grades.curves and math.isfinite(grades.values[name]):
                curves.append(grades.curves[name])
                places.append((i, j, cell.frames - len(curves[-1])))
    lengths = list(map(len, curves))
    values, frame = np.concatenate(curves), np.concatenate([*map(np.arange, lengths)])
    known = np.isfinite(values)
    cell_index, metric_index, first = np.repeat(places, lengths, axis=0)[known].T
    columns = [*_repeat_keys(graded, cell_index), pa.array(metrics, pa.string()).take(pa.array(metric_index))]
    return pa.table([*columns, pa.array(first + frame[known]), pa.array(values[known])], names=CURVES.names).cast(CURVES)


def _repeat_keys(graded: Graded, cell_index: np.ndarray) -> list[pa.Array]:
    """Columns of the keys of rows, by the index [r] of each row's cell."""
    index = pa.array(cell_index)
    return [pa.array([getattr(cell, name) for cell, _ in graded], kind).take(index) for name, kind in _KEY_FIELDS[: len(KEY)]]


def _groups(items: Iterator[Item], size: int) -> Iterator[list[Item]]:
    while group := list(itertools.islice(items, size)):
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


def _encode(curve: np.ndarray) -> str:
    """A curve [t] float32 as text, of which 12,500 videos are read in seconds. What is not finite becomes NaN."""
    return base64.b64encode(np.where(np.isfinite(curve), curve, np.nan).astype("<f4").tobytes()).decode()


def _decode(curve: str | list[float | None]) -> np.ndarray:
    """The curve [t] float32 of `_encode`, or of a list as earlier versions wrote it."""
    if isinstance(curve, str):
        return np.frombuffer(base64.b64decode(curve, validate=True), "<f4")
    return np.array(curve, np.float32)  # null becomes NaN

"""Score tables: reading, checking and merging them. Errors name the wrong rows.

A study's table merges several runs' tables. Its column `variant` names the trained model of each row (xew.protocol.Variant) and
is empty for baselines. The column `training` holds the seed of the training run, 0 for baselines; it is absent if every variant
was trained once.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet

from xew.config import IMPORT_PATH, ConfigError, parse
from xew.files import demand_regular, parse_json, replacing
from xew.names import MOST_LETTERS, EpisodeError, check_label, check_name
from xew.protocol import BASELINES, BODY_NAME, COPY_FIRST_FRAME, GROUND_TRUTH, OUTCOME, ROBOT_NAMES, SHARED_MOTION

VARIANT = "variant"
TRAINING = "training"
"""Column of the seed of the training that a row's model is of; tables in which each variant has one training may lack it."""
EPISODE = ["task", "seed", "robot"]
KEY = ["model", "condition", *EPISODE]
NAMES = [VARIANT, "model", "condition", "task", "robot", "metric"]
COLUMNS = [*KEY, "metric", "value", "frames", "exact_frames"]
CURVE_COLUMNS = [*KEY, "metric", "frame", "value"]
TYPES: dict[str, tuple[str, Callable[[pa.DataType], bool]]] = {
    **dict.fromkeys((*NAMES, "content"), ("text", lambda kind: pa.types.is_string(kind) or pa.types.is_large_string(kind))),
    **dict.fromkeys(("seed", "frames", "exact_frames", "frame", TRAINING), ("whole numbers", pa.types.is_integer)),
    "value": ("numbers", lambda kind: pa.types.is_integer(kind) or pa.types.is_floating(kind)),
}
"""Content of the columns, in words and as a test of their type; other columns are not read."""
SMALL_TABLE = 2**20
"""Number of rows, and of bytes of content, that a file of any size may declare."""
MOST_ROWS, MOST_BYTES = 10, 100
"""Largest number of rows, and of bytes of content, that a file may declare per byte of its size."""
COPY, TRUTH = COPY_FIRST_FRAME, GROUND_TRUTH
"""Baselines that others are measured by: the frozen first frame, and the true video, which is the ceiling."""
COMPARABLE = ("protocol", "metrics", "estimators", "frame_zero", "motion", "change")
"""Attributes that say how a table was graded, and on what scenes; tables that differ in one cannot be compared."""
REQUIRED = ("dimension", "unit", "higher_is_better", "low", "high", "reference", "estimated")
LISTED = 20
"""Largest number of rows of each kind that an error names; it counts the others."""

EVALUATE = "python -m xew.metrics.evaluate ROLLOUTS --data DATA --out {path}"


@dataclass(frozen=True)
class MetricInfo:
    """A metric as the score table describes it."""

    name: str
    dimension: str
    unit: str
    higher_is_better: bool
    low: float | None
    high: float | None
    reference: str
    title: str = ""
    """Title in tables and charts; its name where the table gives none."""
    estimated: bool = False
    """Whether it needs an estimator, so even the true video does not get the best score."""
    suites: tuple[str, ...] = ()
    counterpart: str = ""
    """Name of the metric of the suite paper in whose place it stands in the suite strict, and decides."""
    reported: bool = False
    """Whether a study's full tables show it beside the metrics of the paper."""

    def __post_init__(self) -> None:
        if not self.title:
            object.__setattr__(self, "title", self.name)

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest score that is possible; infinite where there is none."""
        return -np.inf if self.low is None else self.low, np.inf if self.high is None else self.high

    @property
    def leaves_tasks(self) -> bool:
        """Do tasks without power leave its mean (`xew.statistics.find_power`)?"""
        return self.estimated and "strict" in self.suites and self.dimension != OUTCOME

    @property
    def best(self) -> float | None:
        """The best score; None where there is none, as of PSNR."""
        return self.high if self.higher_is_better else self.low


@dataclass(frozen=True)
class Scores:
    """A checked score table."""

    rows: pd.DataFrame
    """Table with one row per model, condition, task, seed, robot and metric; of a study also per variant."""
    curves: pd.DataFrame
    """Table of the same scores by frame; empty where its file is not there."""
    metrics: tuple[MetricInfo, ...]
    attributes: Mapping[Hashable, Any]
    """Attributes of the table: protocol, metrics, versions, estimators, frame_zero."""

    @property
    def protocol(self) -> int:
        return self.attributes["protocol"]

    @property
    def versions(self) -> dict[str, str]:
        return self.attributes.get("versions", {})

    @property
    def frame_zero(self) -> str:
        """Treatment of frame 0: given (and not scored), absent from the videos, or predicted."""
        return self.attributes.get("frame_zero", "given")

    @property
    def motion(self) -> str:
        """Kind of motion of the graded episodes (`xew.protocol.MOTIONS`)."""
        return self.attributes.get("motion", SHARED_MOTION)

    @property
    def change(self) -> str:
        """Change of the graded scenes, as FACTOR:LEVEL (`xew.protocol.parse_change`) or random; empty if there is none."""
        return self.attributes.get("change", "")

    @property
    def codecs(self) -> dict[str, list[str]]:
        """By model (of a study by variant): conditions of the truth through its codec, of which its noise floor is."""
        return dict(self.attributes.get("codecs", {}))

    @property
    def measured_by(self) -> dict[str, str]:
        """How the table was graded, as names and texts."""
        estimators = {f"estimator of {name}": str(used) for name, used in self.attributes.get("estimators", {}).items()}
        allowed = ", ".join(self.attributes.get("allowed", ())) or "nothing"
        return {
            "protocol": str(self.protocol),
            **estimators,
            "frame 0": self.frame_zero,
            "changed to fit": allowed,
            "motion": self.motion,
            **({"change": self.change} if self.change else {}),
        }

    @property
    def of_study(self) -> bool:
        """Whether the table is a study's, with several variants, and not of one run."""
        return VARIANT in self.rows

    @property
    def models(self) -> list[tuple[str, str]]:
        """Model and condition of all rows that are no baseline, each pair once, in order."""
        pairs = self.rows[["model", "condition"]].drop_duplicates().itertuples(index=False, name=None)
        return [pair for pair in pairs if pair[0] not in BASELINES]


def read_scores(path: Path, own_robots: Sequence[str] = ()) -> Scores:
    """Read and check a score table, and its curves if they exist.

    Args:
        path: file that `xew.metrics.evaluate` or `write_scores` wrote.
        own_robots: robots that are neither the paper's, nor in the attribute `robots`, nor bodies, nor `module:NAME`.

    Raises:
        ConfigError: a file is missing or damaged, or rows cannot be averaged over; the message names them.
    """
    command = EVALUATE.format(path=path)
    rows, by_frame = _read(path, COLUMNS, command), path.with_suffix(".curves.parquet")
    curves = _read(by_frame, CURVE_COLUMNS, command) if by_frame.exists() else rows.iloc[:0].assign(frame=0)
    if missing := [key for key in ("protocol", "metrics") if key not in rows.attrs]:
        raise ConfigError(f"{path} has no {', '.join(missing)}; it is no score table of xew. Make one: {command}")
    if rows.empty:
        raise ConfigError(f"{path} holds no row. Grade some rollouts: {command}")
    _check_attributes(path, rows.attrs)
    _check_texts(path, rows)
    metrics = _read_metric_infos(path, rows.attrs["metrics"])
    names = rows["robot"].unique()
    known = {*ROBOT_NAMES, *rows.attrs.get("robots", ()), *own_robots}
    known |= {robot for robot in names if IMPORT_PATH.fullmatch(str(robot)) or BODY_NAME.fullmatch(str(robot))}
    wrong = _find_wrong_rows(rows, metrics, known)
    if wrong:
        raise ConfigError(f"{path} cannot be averaged over:", *_list_wrong_rows(wrong), f"Grade again: {command} --overwrite")
    return Scores(rows, curves, metrics, rows.attrs)


def merge_scores(tables: Sequence[tuple[str, Path]], trainings: Sequence[int] = ()) -> Scores:
    """The score tables of a study's variants as one, with the column `variant` in front; shared baselines are kept once.

    Args:
        tables: variant and path of each score table.
        trainings: seed of each table's training run, for the column `training`; empty for no such column.

    Raises:
        ConfigError: a table cannot be read, tables were graded differently, or cells are duplicate or differ in frames.
    """
    if not tables:
        raise ConfigError("there is no score table to merge; grade at least one variant's rollouts first.")
    attributes, rows, curves = [], [], []
    metrics: tuple[MetricInfo, ...] = ()
    graded: set[tuple[object, ...]] = set()
    seeds: Sequence[int | None] = trainings or [None] * len(tables)
    for (variant, path), seed in zip(tables, seeds, strict=True):
        scores = read_scores(path)
        if not variant or scores.of_study:
            found = f"is a merged table of {scores.rows[VARIANT].nunique()} variants" if variant else "has no variant's name"
            raise ConfigError(f"{path} {found}; expected the score table of one variant, and its name.")
        new = _drop_known_baselines(scores.rows, graded)
        rows.append(_add_variant_column(variant, seed, new))
        curves.append(_compact_names(_add_variant_column(variant, seed, _select_curves(scores.curves, new))))
        attributes.append((path, scores.attributes))
        metrics = metrics or scores.metrics
    common = _merge_attributes(attributes)
    if codecs := _merge_codecs([variant for variant, _ in tables], [attributes for _, attributes in attributes]):
        common["codecs"] = codecs
    merged = pd.concat(rows, ignore_index=True)
    wrong = _find_wrong_rows(merged, metrics, set(merged["robot"]))
    if wrong:
        paths = ", ".join(str(path) for _, path in tables)
        again = "Grade them again from one data set."
        raise ConfigError(f"the score tables {paths} do not match:", *_list_wrong_rows(wrong), again)
    return Scores(merged, _stack_compact_tables(curves), metrics, common)


def write_scores(scores: Scores, path: Path) -> None:
    """Write a table and its curves, each file whole or not at all, so `read_scores` reads them back.

    Raises:
        ConfigError: they cannot be written there.
    """
    try:
        for frame, file in ((scores.curves, path.with_suffix(".curves.parquet")), (scores.rows, path)):
            frame = frame.copy(deep=False)
            frame.attrs = dict(scores.attributes)
            with replacing(file, within=file.parent) as temporary:
                frame.to_parquet(temporary, index=False)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error}. Free some space or choose another place.") from error


def find_missing_scores(rows: pd.DataFrame) -> pd.DataFrame:
    """Scores that some models have and others lack: columns [variant] [training] model condition task seed robot metric.

    A model with a score on a robot is expected to have all scores that any other model has on this robot.
    """
    who = [column for column in (VARIANT, TRAINING, "model", "condition") if column in rows]
    asked = rows[[*who, "robot"]].drop_duplicates()
    expected = asked.merge(rows[[*EPISODE, "metric"]].drop_duplicates(), on="robot")[[*who, *EPISODE, "metric"]]
    found = expected.merge(rows[[*who, *EPISODE, "metric"]].drop_duplicates(), how="left", indicator=True)
    missing = found[found["_merge"] == "left_only"].drop(columns="_merge")
    return missing.sort_values(list(missing.columns), ignore_index=True)


def describe_scores(cells: pd.DataFrame, most: int = LISTED) -> str:
    """Text such as 'reference flow open_laptop 1000003 piper lpips; …', with the number of those left out."""
    columns = [column for column in (VARIANT, TRAINING, *KEY, "metric") if column in cells]
    shown = "; ".join(" ".join(str(part) for part in cell if part != "") for cell in cells[columns].head(most).to_numpy())
    return shown + (f"; and {len(cells) - most} more" if len(cells) > most else "")


def _read(path: Path, columns: Sequence[str], command: str) -> pd.DataFrame:
    """The known columns of a table. Raises ConfigError if one of `columns` is missing, or as `read_scores`."""
    if path.is_dir():
        raise ConfigError(f"{path} is a folder; name a score table, or make one: {EVALUATE.format(path='scores.parquet')}")
    try:
        schema = parquet.read_schema(demand_regular(path))
        if missing := [column for column in columns if column not in schema.names]:
            raise ConfigError(f"{path} has no {', '.join(missing)}; it is no score table of xew. Make one: {command}")
        return _read_columns(path, schema)
    except FileNotFoundError as error:
        raise ConfigError(f"{path} does not exist; make it: {command}") from error
    except (OSError, ValueError, TypeError, KeyError, RecursionError, pa.ArrowException) as error:
        raise ConfigError(f"{path} cannot be read ({error}); delete it and make it again: {command}") from error


def _read_columns(path: Path, schema: pa.Schema) -> pd.DataFrame:
    """The columns of TYPES. Raises ValueError if one is of another type or larger than its file can hold."""
    known = pa.schema([_check_type(field) for field in schema if field.name in TYPES])
    # Read as dictionaries, a long text that many rows repeat takes memory once.
    with parquet.ParquetFile(path, read_dictionary=[name for name in known.names if TYPES[name][0] == "text"]) as file:
        _check_size(file.metadata, path.stat().st_size)
        table = file.read(columns=known.names)
    for name, column in zip(table.column_names, table.columns, strict=True):
        _check_cells(name, column)
    frame: pd.DataFrame = table.cast(known).to_pandas()
    frame.attrs = parse_json((schema.metadata or {}).get(b"PANDAS_ATTRS", b"{}"))
    return frame


def _check_type(column: pa.Field) -> pa.Field:
    """The same column. Raises ValueError if it is of another type than TYPES says; in a table without rows it has none."""
    kind, (what, fits) = column.type, TYPES[column.name]
    value = kind.value_type if pa.types.is_dictionary(kind) else kind
    if not (fits(value) or pa.types.is_null(value)):
        raise ValueError(f"its column {column.name} is of type {kind}, expected {what}")
    return column


def _check_size(declared: parquet.FileMetaData, size: int) -> None:
    """Raise ValueError if a file of `size` bytes declares too many rows or too much content."""
    content = sum(declared.row_group(group).total_byte_size for group in range(declared.num_row_groups))
    if declared.num_rows > max(SMALL_TABLE, MOST_ROWS * size) or content > max(SMALL_TABLE, MOST_BYTES * size):
        raise ValueError(f"it declares {declared.num_rows} rows and {content} bytes, too many for a file of {size} bytes")


def _check_cells(name: str, column: pa.ChunkedArray) -> None:
    """Raise ValueError if a column has empty cells, except of values, or a text that is too long for a name."""
    if column.null_count and name != "value":
        raise ValueError(f"its column {name} has empty cells")
    if pa.types.is_dictionary(column.type):
        longest = max((pc.max(pc.binary_length(chunk.dictionary)).as_py() or 0 for chunk in column.chunks), default=0)
        if longest > 4 * MOST_LETTERS:  # bytes of a letter
            raise ValueError(f"its column {name} has a text of {longest} bytes, expected at most {MOST_LETTERS} letters")


def _check_texts(path: Path, rows: pd.DataFrame) -> None:
    """Raise ConfigError for names that could lead elsewhere: files of reports are named after them."""
    try:
        for column, check in (("task", check_name), ("robot", check_name), ("model", check_label), ("condition", check_label)):
            for name in rows[column].unique():
                check(name, column)
        for name in rows[VARIANT].unique() if VARIANT in rows else ():
            check_label(name, VARIANT)
        if not pd.api.types.is_integer_dtype(rows["seed"]) or (rows["seed"] < 0).any():
            raise EpisodeError("the seeds are no whole numbers from 0 on.")
    except EpisodeError as error:
        raise ConfigError(f"{path} is no score table of xew: {error}") from error


def _read_metric_infos(path: Path, described: Mapping[str, Mapping[str, Any]]) -> tuple[MetricInfo, ...]:
    known = {field.name for field in fields(MetricInfo)} - {"name"}
    for metric, info in described.items():
        if missing := [name for name in REQUIRED if name not in info]:
            raise ConfigError(f"{path} does not say the {', '.join(missing)} of {metric}; it is no score table of this xew.")
    infos = []
    for metric, info in described.items():
        content = {"name": metric} | {key: value for key, value in info.items() if key in known}
        parsed = parse(MetricInfo, content, f"{path}: the metric {metric}")
        if parsed.low is not None and parsed.high is not None and parsed.low >= parsed.high:
            raise ConfigError(f"{path}: the metric {metric} ranges from {parsed.low} to {parsed.high}; make the table again.")
        infos.append(parsed)
    return tuple(infos)


@dataclass(frozen=True)
class _Attributes:
    """Types of the attributes that are read of a score table; further ones are somebody else's."""

    protocol: int
    metrics: dict[str, dict[str, Any]]
    versions: dict[str, str] = field(default_factory=dict)
    estimators: dict[str, Any] = field(default_factory=dict)
    frame_zero: Literal["given", "absent", "predicted"] = "given"
    allowed: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()
    study: dict[str, Any] = field(default_factory=dict)
    codecs: dict[str, tuple[str, ...]] = field(default_factory=dict)
    motion: Literal["shared", "own"] = "shared"
    change: str = ""


def _check_attributes(path: Path, attributes: Mapping[Hashable, Any]) -> None:
    known = {entry.name for entry in fields(_Attributes)}
    parse(_Attributes, {name: value for name, value in attributes.items() if name in known}, f"{path}, its attributes")


def _find_wrong_rows(rows: pd.DataFrame, metrics: Sequence[MetricInfo], robots: set[str]) -> dict[str, pd.DataFrame]:
    """Rows that cannot be averaged over, by what is wrong with them."""
    # Of a variant, model and condition are no more than names; two of them would be two scores of one cell.
    named = rows.assign(**{VARIANT: name_graded(rows)}) if VARIANT in rows else rows
    key = [*([VARIANT, *EPISODE] if VARIANT in rows else KEY), "metric", *([TRAINING] if TRAINING in rows else [])]
    value = pd.to_numeric(rows["value"], errors="coerce")
    low, high = (rows["metric"].map({metric.name: metric.range[end] for metric in metrics}) for end in (0, 1))
    # Sums of float32 may pass an end of the range by their rounding.
    out = (value < low - 1e-6) | (value > high + 1e-6)
    found = {
        "the robot is unknown": ~rows["robot"].isin(robots),
        "the metric is not described": ~rows["metric"].isin([metric.name for metric in metrics]),
        "the value is NaN": value.isna(),
        "the value is outside of the metric's range": out | np.isinf(value),
        "a cell occurs more than once": named.duplicated(key, keep=False),
        "an episode is graded over different numbers of frames": rows.groupby(EPISODE)["frames"].transform("nunique") > 1,
    }
    return {reason: rows[mask] for reason, mask in found.items() if mask.any()}


def _list_wrong_rows(wrong: Mapping[str, pd.DataFrame]) -> list[str]:
    return [f"  {reason}, {len(cells)} rows: {describe_scores(cells)}" for reason, cells in wrong.items()]


def _merge_attributes(tables: Sequence[tuple[Path, Mapping[Hashable, Any]]]) -> dict[Hashable, Any]:
    """Attributes that all tables share; versions of packages may differ and are all named."""
    first = tables[0][1]
    for key in COMPARABLE:
        values = [attributes.get(key) for _, attributes in tables]
        if any(value != values[0] for value in values):
            raise ConfigError(
                f"the score tables differ in {key}, so their numbers do not compare:",
                *(f"  {path}: {value}" for (path, _), value in zip(tables, values, strict=True)),
                f"Grade all by the same version and options: {EVALUATE.format(path='SCORES')} --overwrite",
            )
    packages = dict.fromkeys(name for _, attributes in tables for name in attributes.get("versions", {}))
    used = {name: {attributes.get("versions", {}).get(name, "none") for _, attributes in tables} for name in packages}
    robots = sorted({robot for _, attributes in tables for robot in attributes.get("robots", ())})
    merged = {**first, "versions": {name: ", ".join(sorted(versions)) for name, versions in used.items()}}
    return merged | ({"robots": robots} if robots else {})


def _merge_codecs(variants: Sequence[str], tables: Sequence[Mapping[Hashable, Any]]) -> dict[str, list[str]]:
    """The attribute `codecs` by variant, of tables by model."""
    found: dict[str, list[str]] = {}
    for variant, attributes in zip(variants, tables, strict=True):
        keys = [key for own in attributes.get("codecs", {}).values() for key in own]
        if keys:
            found[variant] = list(dict.fromkeys([*found.get(variant, []), *keys]))
    return found


def name_graded(rows: pd.DataFrame) -> pd.Series:
    """The name of what each row of a study's table grades: its variant; of a baseline its model, and its condition if any."""
    condition = rows["condition"] if "condition" in rows else pd.Series("", rows.index)
    baseline = rows["model"].where((condition == "") | ~rows["model"].isin(BASELINES), rows["model"] + " " + condition)
    return rows["variant"].where(rows["variant"] != "", baseline)


def _drop_known_baselines(rows: pd.DataFrame, graded: set[tuple[object, ...]]) -> pd.DataFrame:
    """Rows but those of baselines that are in `graded`, to which the others' are added."""
    columns = [*KEY, "metric", "content" if "content" in rows else "value"]
    identities = list(rows[columns].itertuples(index=False, name=None))
    is_baseline = rows["model"].isin(BASELINES)
    new = [not (baseline and identity in graded) for baseline, identity in zip(is_baseline, identities, strict=True)]
    graded |= {identity for baseline, identity in zip(is_baseline, identities, strict=True) if baseline}
    return rows[new]


def _select_curves(curves: pd.DataFrame, rows: pd.DataFrame) -> pd.DataFrame:
    """The curves of baselines that are in a table's rows, and all others."""
    is_baseline = curves["model"].isin(BASELINES)
    kept = rows.loc[rows["model"].isin(BASELINES), [*KEY, "metric"]]
    own = curves[~is_baseline]
    return own if kept.empty else pd.concat([own, curves[is_baseline].merge(kept, on=[*KEY, "metric"])])


def _add_variant_column(variant: str, seed: int | None, table: pd.DataFrame) -> pd.DataFrame:
    baseline = table["model"].isin(BASELINES)
    named = table.assign(**{VARIANT: np.where(baseline, "", variant)})[[VARIANT, *table.columns]]
    if seed is not None:
        named.insert(1, TRAINING, np.where(baseline, 0, seed))
    named.attrs = {}  # concat compares them
    return named


def _compact_names(curves: pd.DataFrame) -> pd.DataFrame:
    """Names as numbers: a study of the paper's size has a hundred million frames."""
    return curves.astype(dict.fromkeys(NAMES, "category"))


def _stack_compact_tables(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    known = {name: sorted(set().union(*(table[name].cat.categories for table in tables))) for name in NAMES}
    alike = [table.astype({name: pd.CategoricalDtype(known[name]) for name in NAMES}) for table in tables]
    return pd.concat(alike, ignore_index=True)

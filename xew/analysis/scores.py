"""Stage 11 of 11, its input: the score table, read and checked. Cells that are wrong are named, never averaged over."""

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from xew.config import ConfigError
from xew.protocol import ROBOT_NAMES

KEY = ["model", "condition", "task", "seed", "robot"]
COLUMNS = [*KEY, "metric", "value", "frames", "exact_frames"]
COPY, TRUTH = "copy_first_frame", "ground_truth"
"""The two models that every other is read against: a score of nothing, and the ceiling."""

EVALUATE = "python -m xew.metrics.evaluate ROLLOUTS --data DATA --baselines --out {path}"


@dataclass(frozen=True)
class MetricInfo:
    """What the score table says of a metric."""

    name: str
    dimension: str
    unit: str
    higher_is_better: bool
    low: float | None
    high: float | None
    reference: str


@dataclass(frozen=True)
class Scores:
    """A checked score table."""

    rows: pd.DataFrame
    """One row per model, condition, task, seed, robot and metric."""
    curves: pd.DataFrame
    """The same by frame."""
    metrics: tuple[MetricInfo, ...]
    protocol: int
    versions: dict[str, str]

    @property
    def models(self) -> list[tuple[str, str]]:
        """(model, condition) of all that is not a baseline, in order."""
        pairs = self.rows[["model", "condition"]].drop_duplicates().itertuples(index=False, name=None)
        return [pair for pair in pairs if pair[0] not in (COPY, TRUTH)]


def read_scores(path: Path) -> Scores:
    """Read and check a score table and its curves.

    Raises:
        ConfigError: a file is missing or damaged; rows are duplicate, NaN, of unknown robots, or of other metrics than said.
    """
    rows = _read(path, EVALUATE.format(path=path))
    curves = _read(path.with_suffix(".curves.parquet"), EVALUATE.format(path=path))
    missing = [column for column in COLUMNS if column not in rows] + [
        key for key in ("protocol", "metrics") if key not in rows.attrs
    ]
    if missing:
        raise ConfigError(
            f"{path} has no {', '.join(missing)}; it is no score table of xew. Make one: {EVALUATE.format(path=path)}"
        )
    _check_rows(path, rows)
    metrics = tuple(MetricInfo(name=name, **info) for name, info in rows.attrs["metrics"].items())
    return Scores(rows, curves, metrics, rows.attrs["protocol"], rows.attrs.get("versions", {}))


def _read(path: Path, command: str) -> pd.DataFrame:
    try:
        return pd.read_parquet(path)
    except FileNotFoundError as error:
        raise ConfigError(f"{path} does not exist; make it: {command}") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read ({error}); delete it and make it anew: {command}") from error


def _check_rows(path: Path, rows: pd.DataFrame) -> None:
    if rows.empty:
        raise ConfigError(f"{path} holds no row. Grade some rollouts: {EVALUATE.format(path=path)}")
    wrong = {
        "the robot is unknown": rows[~rows["robot"].isin(ROBOT_NAMES)],
        "the value is NaN": rows[rows["value"].isna()],
        "a cell occurs more than once": rows[rows.duplicated([*KEY, "metric"], keep=False)],
        "the metric is not described": rows[~rows["metric"].isin(list(rows.attrs["metrics"]))],
    }
    for reason, found in wrong.items():
        if len(found):
            shown = "; ".join(" ".join(map(str, cell)) for cell in found.reindex(columns=[*KEY, "metric"]).head(5).to_numpy())
            raise ConfigError(
                f"{path}: {reason} in {len(found)} rows ({shown}). Grade anew: {EVALUATE.format(path=path)} --overwrite"
            )

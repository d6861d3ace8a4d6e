"""Tables of measured distances: tidy frames with the paper's values, and text."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from xew.analysis.distances.workspaces import Features
from xew.analysis.paper import Paper, read_paper
from xew.protocol import ROBOT_NAMES

DIGITS = 3
"""Number of decimals of distances and sizes in the printed tables."""


@dataclass(frozen=True)
class Axis:
    """One kind of distance between robots."""

    robots: tuple[str, ...]
    value: np.ndarray
    """[n n] distances."""
    draws: np.ndarray
    """[s n n] distances, a matrix for each seed, or one without each view."""
    scale: float = 1.0
    """Factor from the standard deviation of the draws to the spread."""


def jackknifed(robots: tuple[str, ...], value: np.ndarray, without_one: np.ndarray) -> Axis:
    """Distances [n n] and those without each of p parts [p n n], such as views, whose jackknife gives the spread."""
    count = len(without_one)
    return Axis(robots, value, without_one, (count - 1) / np.sqrt(count))


def mean_axis(robots: tuple[str, ...], parts: np.ndarray) -> Axis:
    """The mean of the distances [p n n] of several parts."""
    return jackknifed(robots, parts.mean(axis=0), (parts.sum(axis=0) - parts) / (len(parts) - 1))


def distance_frame(axes: Mapping[str, Axis]) -> pd.DataFrame:
    """All pairs as a tidy frame: axis robot other value spread published."""
    paper = read_paper()
    return pd.DataFrame(
        {"axis": name, "robot": axis.robots[a], "other": axis.robots[b]}
        | {"value": float(axis.value[a, b]), "spread": axis.scale * _standard_deviation(axis.draws[:, a, b])}
        | {"published": _published_pair(paper, name, axis.robots[a], axis.robots[b])}
        for name, axis in axes.items()
        for a, b in combinations(range(len(axis.robots)), 2)
    )


def robot_frame(features: Features, axes: Mapping[str, Axis], floor: np.ndarray) -> pd.DataFrame:
    """All features as a tidy frame: robot feature value spread published.

    Distances are means over the paper's robots other than the robot itself; `floor` [s n] comes from `chamfer_floor` [m].
    """
    counts = {"dof": features.dof, "links": features.links}
    columns = [(name, features.robots, count, np.zeros(len(count))) for name, count in counts.items()]
    drawn = {"reach": features.reach, "volume": features.volume, "floor": floor}
    columns += [(name, features.robots, draws.mean(axis=0), _standard_deviation(draws)) for name, draws in drawn.items()]
    for name, axis in axes.items():
        mean, draws = (_mean_to_paper_robots(axis.robots, matrix) for matrix in (axis.value, axis.draws))
        columns.append((name, axis.robots, mean, axis.scale * _standard_deviation(draws)))
    published = read_paper().robots
    return pd.DataFrame(
        {"robot": robot, "feature": name, "value": float(value), "spread": float(spread)}
        | {"published": float(getattr(published.get(robot), name, np.nan))}
        for name, robots, values, spreads in columns
        for robot, value, spread in zip(robots, values, spreads, strict=True)
    )


def matrix_text(pairs: pd.DataFrame, robots: Sequence[str]) -> str:
    """The matrix of one axis as text: value ± spread (the paper's value)."""
    cells = {(row["robot"], row["other"]): _format_value(row) for row in pairs.to_dict("records")}
    rows = [[cells.get((a, b)) or cells.get((b, a)) or ("–" if a != b else "0") for b in robots] for a in robots]
    return pd.DataFrame(rows, index=list(robots), columns=list(robots)).to_string()


def robot_text(singles: pd.DataFrame) -> str:
    """The features as text, one row per robot."""
    texts = singles.assign(text=[_format_value(row) for row in singles.to_dict("records")])
    table = texts.pivot(index="robot", columns="feature", values="text").fillna("–")
    heads = dict.fromkeys(singles["feature"])
    return table.loc[list(dict.fromkeys(singles["robot"])), list(heads)].rename_axis(None).rename_axis(None, axis=1).to_string()


def _format_value(row: Mapping[Hashable, Any]) -> str:
    """Text such as '0.201 ±0.005 (0.195)'."""
    digits = 0 if row.get("feature") in ("dof", "links") else DIGITS
    text = f"{row['value']:.{digits}f}" + (f" ±{row['spread']:.{DIGITS}f}" if row["spread"] > 0 else "")
    return text if np.isnan(row["published"]) else f"{text} ({row['published']:.{digits}f})"


def _standard_deviation(draws: np.ndarray) -> np.ndarray:
    """Standard deviation of draws [s ...] over the first axis [...]; 0 for a single draw."""
    return draws.std(axis=0, ddof=1) if len(draws) > 1 else np.zeros(draws.shape[1:])


def _published_pair(paper: Paper, axis: str, robot: str, other: str) -> float:
    names = list(paper.robots)
    if axis not in paper.distances or robot not in names or other not in names:
        return np.nan
    return paper.distances[axis][names.index(robot)][names.index(other)]


def _mean_to_paper_robots(robots: Sequence[str], matrices: np.ndarray) -> np.ndarray:
    """Mean distance [... n] of each robot to the paper's other than itself, from matrices [... n n]."""
    counted = np.array([[other in ROBOT_NAMES and other != robot for other in robots] for robot in robots])
    return (matrices * counted).sum(axis=-1) / counted.sum(axis=-1)

"""The command `python -m xew.analysis.distance`: both matrices of distance, the paper's figures beside, written and printed.

Writes <out>/distances.csv, one row per axis and pair of robots, and <out>/robots.csv, one row per robot and feature: value,
spread (of kinematic figures the standard deviation of one draw of configurations, over seeds; of appearance the jackknife's
standard error over views) and the figure that the paper prints.
"""

import importlib
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tyro

from xew.analysis.distance import Features, Frame, ImageDistance, appearance_matrix, chamfer_floor, measure, perceptual_matrices
from xew.analysis.paper import Paper, read_paper
from xew.config import ConfigError, user_errors
from xew.files import replacing
from xew.protocol import ROBOT_NAMES
from xew.sim_warp.robots import RobotSpec, Urdf, get_robot, load_urdf

TITLES = {
    "kinematic": "Kinematic distance [m]: workspace Chamfer",
    "arm_base": "The same in the frame of the arm's base [m] (ours)",
    "arm_alone": "The same of the arm alone [m] (ours)",
    "appearance": "Appearance distance: cosine of hue-saturation histogram and Hu moments of nine views",
    "perceptual": "Perceptual distance of the nine views, mean of {} (ours)",
}
OTHER_FRAMES: tuple[Frame, ...] = ("arm_base", "arm_alone")
DIGITS = 3
FLOOR_SEEDS = 20
"""Draws that the floor is a mean of, at most."""


@dataclass(frozen=True)
class Args:
    """Distances between robots, by what they can reach and what they look like."""

    robot: tuple[str, ...] = ()
    """Robots of one's own beside the five: a path (.urdf, folder with robot.yaml), or module:NAME."""
    out: Path = Path("distances")
    """Folder for distances.csv and robots.csv."""
    seeds: int = 100
    """Draws of configurations, from seed 0 on; they give the spread."""
    looks: bool = True
    """Render the robots, for the distances of appearance."""
    perceptual: str = "xew.metrics:lpips"
    """module:NAME of a distance of two videos [t h w 3] uint8, frame by frame; empty for none."""
    workers: int = -1
    """Threads of the nearest-neighbor search; -1 for all cores."""


@dataclass(frozen=True)
class Axis:
    """One kind of distance between robots."""

    robots: tuple[str, ...]
    value: np.ndarray
    """[n n]."""
    draws: np.ndarray
    """[s n n], a matrix for each seed, or without each view."""
    scale: float = 1.0
    """Of the spread, by the standard deviation of the draws."""


@user_errors
def main(args: Args) -> None:
    """Measure, write and print."""
    if args.seeds < 1:
        raise ConfigError(f"--seeds is {args.seeds}; expected 1 or more.")
    distance = _image_distance(args.perceptual) if args.looks and args.perceptual else None
    names = (*ROBOT_NAMES, *args.robot)
    robots = find_robots(names)
    features = measure(robots, range(args.seeds), workers=args.workers)
    axes = {"kinematic": Axis(features.robots, features.kinematic.mean(axis=0), features.kinematic)}
    for other in OTHER_FRAMES:
        draws = measure(robots, range(args.seeds), other, args.workers).kinematic
        axes[other] = Axis(features.robots, draws.mean(axis=0), draws)
    if args.looks:
        whole = {key: name for (key, robot), name in zip(robots.items(), names, strict=True) if isinstance(robot, RobotSpec)}
        axes |= _looks(whole, distance)
    floor = chamfer_floor(robots, range(min(args.seeds, FLOOR_SEEDS)))
    pairs, singles = distance_frame(axes), robot_frame(features, axes, floor)
    for title, axis in axes.items():
        print(f"\n{TITLES[title].format(args.perceptual)}\n{matrix_text(pairs[pairs['axis'] == title], axis.robots)}")
    print(f"\nRobots\n{robot_text(singles)}\n\n{_legend(args.seeds, args.looks)}")
    for name, frame in (("robots", singles), ("distances", pairs)):  # where the second stands, both do
        path = args.out / f"{name}.csv"
        _write(frame, path)
        print(path)


def find_robots(names: Iterable[str]) -> dict[str, RobotSpec | Urdf]:
    """Robots by key, path or module:NAME, under their own keys.

    A URDF that is no complete robot of ours, for example for want of a gripper, has a workspace all the same.

    Raises:
        ConfigError: there is no such robot, or two have the same name.
    """
    found: dict[str, RobotSpec | Urdf] = {}
    for name in names:
        robot = _find_robot(name)
        key = robot.key if isinstance(robot, RobotSpec) else robot.path.stem
        if key in found:
            raise ConfigError(f"{name} is named {key}, as another robot of this table; rename its file or folder.")
        found[key] = robot
    return found


def distance_frame(axes: Mapping[str, Axis]) -> pd.DataFrame:
    """All pairs as a tidy frame: axis robot other value spread published."""
    paper = read_paper()
    return pd.DataFrame(
        {"axis": name, "robot": axis.robots[a], "other": axis.robots[b]}
        | {"value": float(axis.value[a, b]), "spread": axis.scale * _deviation(axis.draws[:, a, b])}
        | {"published": _published_pair(paper, name, axis.robots[a], axis.robots[b])}
        for name, axis in axes.items()
        for a, b in combinations(range(len(axis.robots)), 2)
    )


def robot_frame(features: Features, axes: Mapping[str, Axis], floor: np.ndarray) -> pd.DataFrame:
    """All features as a tidy frame: robot feature value spread published.

    Distances are means to the paper's robots other than itself; `floor` [s n] is of `chamfer_floor`.
    """
    counts = {"dof": features.dof, "links": features.links}
    columns = [(name, features.robots, count, np.zeros(len(count))) for name, count in counts.items()]
    drawn = {"reach": features.reach, "volume": features.volume, "floor": floor}
    columns += [(name, features.robots, draws.mean(axis=0), _deviation(draws)) for name, draws in drawn.items()]
    for name, axis in axes.items():
        mean, draws = (_mean_to_the_fleet(axis.robots, matrix) for matrix in (axis.value, axis.draws))
        columns.append((name, axis.robots, mean, axis.scale * _deviation(draws)))
    published = read_paper().robots
    return pd.DataFrame(
        {"robot": robot, "feature": name, "value": float(value), "spread": float(spread)}
        | {"published": float(getattr(published.get(robot), name, np.nan))}
        for name, robots, values, spreads in columns
        for robot, value, spread in zip(robots, values, spreads, strict=True)
    )


def matrix_text(pairs: pd.DataFrame, robots: Sequence[str]) -> str:
    """One axis as a square: value ± spread (the paper's)."""
    cells = {(row["robot"], row["other"]): _text(row) for row in pairs.to_dict("records")}
    rows = [[cells.get((a, b)) or cells.get((b, a)) or ("–" if a != b else "0") for b in robots] for a in robots]
    return pd.DataFrame(rows, index=list(robots), columns=list(robots)).to_string()


def robot_text(singles: pd.DataFrame) -> str:
    """Features as a table, a robot a row."""
    texts = singles.assign(text=[_text(row) for row in singles.to_dict("records")])
    table = texts.pivot(index="robot", columns="feature", values="text").fillna("–")
    heads = dict.fromkeys(singles["feature"])
    return table.loc[list(dict.fromkeys(singles["robot"])), list(heads)].rename_axis(None).rename_axis(None, axis=1).to_string()


def _text(row: Mapping[Hashable, Any]) -> str:
    """Such as '0.201 ±0.005 (0.195)'."""
    digits = 0 if row.get("feature") in ("dof", "links") else DIGITS
    text = f"{row['value']:.{digits}f}" + (f" ±{row['spread']:.{DIGITS}f}" if row["spread"] > 0 else "")
    return text if np.isnan(row["published"]) else f"{text} ({row['published']:.{digits}f})"


def _legend(seeds: int, looks: bool) -> str:
    spreads = [f"the standard deviation of one draw over {seeds} seeds (kinematic)"] * (seeds > 1)
    spreads += ["the jackknife's standard error over nine views (appearance, perceptual)"] * looks
    said = f"± is {' and '.join(spreads)}. " if spreads else ""
    return (
        f"{said}floor: kinematic distance of two draws of the same robot. "
        "In brackets: the paper's, from its own models of the robots and its own renders."
    )


def _deviation(draws: np.ndarray) -> np.ndarray:
    """Standard deviation over the first axis; 0 for a single draw."""
    return draws.std(axis=0, ddof=1) if len(draws) > 1 else np.zeros(draws.shape[1:])


def _published_pair(paper: Paper, axis: str, robot: str, other: str) -> float:
    names = list(paper.robots)
    if axis not in paper.distances or robot not in names or other not in names:
        return np.nan
    return paper.distances[axis][names.index(robot)][names.index(other)]


def _mean_to_the_fleet(robots: Sequence[str], matrices: np.ndarray) -> np.ndarray:
    """[... n] mean distance of each robot to the paper's, itself left out, from matrices [... n n]."""
    fleet = np.array([[other in ROBOT_NAMES and other != robot for other in robots] for robot in robots])
    return (matrices * fleet).sum(axis=-1) / fleet.sum(axis=-1)


def _looks(names: Mapping[str, str], distance: ImageDistance | None) -> dict[str, Axis]:
    """Distances of appearance between robots, which are given by the names that find them, under their keys."""
    from xew.sim_warp.rendering.streams import VIEW_COUNT, nine_views  # loads Warp, which no other part of the analysis needs

    renders, robots = [nine_views(name) for name in names.values()], tuple(names)
    without_one = [appearance_matrix([np.delete(views, i, axis=0) for views in renders]) for i in range(VIEW_COUNT)]
    jackknife = (VIEW_COUNT - 1) / np.sqrt(VIEW_COUNT)
    axes = {"appearance": Axis(robots, appearance_matrix(renders), np.array(without_one), jackknife)}
    if distance is not None:
        by_view = _perceptual(renders, distance)
        without_one = (by_view.sum(axis=0) - by_view) / (VIEW_COUNT - 1)
        axes["perceptual"] = Axis(robots, by_view.mean(axis=0), without_one, jackknife)
    return axes


def _perceptual(renders: Sequence[np.ndarray], distance: ImageDistance) -> np.ndarray:
    try:
        return perceptual_matrices(renders, distance)
    except FileNotFoundError as error:  # the weights
        raise ConfigError(f'{error} Or leave it out: --perceptual "".') from error


def _find_robot(name: str) -> RobotSpec | Urdf:
    try:
        return get_robot(name)
    except ConfigError as error:
        if not name.endswith(".urdf") or not Path(name).is_file():
            raise
        urdf = load_urdf(name)
        print(f"{name}: its workspace is compared, its looks are not, for it is no complete robot: {error}")
        return urdf


def _image_distance(name: str) -> ImageDistance:
    module, _, attribute = name.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"--perceptual {name!r} cannot be imported: {error}; expected module:NAME, or nothing.") from error


def _write(frame: pd.DataFrame, path: Path) -> None:
    try:
        with replacing(path) as temporary:
            frame.to_csv(temporary, index=False)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error}. Choose another --out.") from error


def run() -> None:
    """Read the command line."""
    main(tyro.cli(Args, prog="python -m xew.analysis.distance"))

"""Distances between robots by reach and appearance: the command.

    python -m xew.analysis.distance --out distances                    # the five robots, with the paper's values
    python -m xew.analysis.distance --robot lab/my_arm.urdf --out out  # and a custom robot
    python -m xew.analysis.distance --robot body:0-3 --out out         # and four procedural bodies

Writes <out>/distances.csv (axis and pair of robots) and <out>/robots.csv (robot and feature), each with value, spread and the
paper's value. The spread is the standard deviation over draws of configurations, of appearance the jackknife's over views.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import tyro

from xew.analysis.distances.appearance import (
    ImageEmbedding,
    appearance_descriptor,
    appearance_matrix,
    cosine_distance,
    describe_views,
    descriptor_matrix,
    perceptual_matrices,
)
from xew.analysis.distances.frames import Axis, distance_frame, jackknifed, matrix_text, mean_axis, robot_frame, robot_text
from xew.analysis.distances.motion import SCENES, motion_matrices
from xew.analysis.distances.workspaces import (
    Features,
    Frame,
    Workspace,
    chamfer,
    chamfer_floor,
    chamfer_matrix,
    measure,
    workspace,
    workspace_cloud,
)
from xew.config import ConfigError, import_named, user_errors
from xew.files import hold_lock, write_text
from xew.names import csv_text
from xew.protocol import ROBOT_NAMES, expand_robots
from xew.sim_warp.robots import RobotSpec, Urdf, get_robot, load_urdf

__all__ = [
    "Features",
    "Frame",
    "ImageEmbedding",
    "Workspace",
    "appearance_descriptor",
    "appearance_matrix",
    "chamfer",
    "chamfer_floor",
    "chamfer_matrix",
    "cosine_distance",
    "measure",
    "perceptual_matrices",
    "workspace",
    "workspace_cloud",
]

TITLES = {
    "kinematic": "Kinematic distance [m]: workspace Chamfer",
    "arm_base": "The same in the frame of the arm's base [m] (ours)",
    "arm_alone": "The same of the arm alone [m] (ours)",
    "appearance": "Appearance distance: cosine of hue-saturation histogram and Hu moments of nine views",
    "perceptual": "Perceptual distance of the nine views, mean of squared distances of {} (ours)",
    "motion": "Motion distance [px]: endpoint error of the commanded optical flow on the same tool paths (ours)",
}
OTHER_FRAMES: tuple[Frame, ...] = ("arm_base", "arm_alone")
FLOOR_SEEDS = 20
"""Largest number of draws that the floor is the mean of."""


@dataclass(frozen=True)
class Args:
    """Distances between robots, by what they can reach and what they look like."""

    robot: tuple[str, ...] = ()
    """Robots to add to the five: body:17 or a range as body:0-3, a path (.urdf, folder with robot.yaml), or module:NAME."""
    out: Path = Path("distances")
    """Folder for distances.csv and robots.csv."""
    seeds: int = 100
    """Number of draws of configurations, from seed 0 on; they give the spread."""
    looks: bool = True
    """Render the robots, for the distances of appearance and motion."""
    perceptual: str = "xew.metrics:lpips_embedding"
    """module:NAME of a function from images [n h w 3] uint8 to vectors [n d], whose squared distances are measured; empty for
    none. The default's are LPIPS."""


@user_errors
def main(args: Args) -> None:
    """Measure the distances, write both tables and print them."""
    if args.seeds < 1:
        raise ConfigError(f"--seeds is {args.seeds}; expected 1 or more.")
    embed = _import_embedding(args.perceptual) if args.looks and args.perceptual else None
    robots = find_robots((*ROBOT_NAMES, *args.robot))
    with hold_lock(args.out):
        write_distances(args, robots, embed)


def write_distances(args: Args, robots: dict[str, RobotSpec | Urdf], embed: ImageEmbedding | None) -> None:
    """Measure the distances between robots, by name, and write and print both tables."""
    features = measure(robots, range(args.seeds))
    axes = {"kinematic": Axis(features.robots, features.kinematic.mean(axis=0), features.kinematic)}
    for other in OTHER_FRAMES:
        draws = measure(robots, range(args.seeds), other).kinematic
        axes[other] = Axis(features.robots, draws.mean(axis=0), draws)
    if args.looks:
        specs = [robot for robot in robots.values() if isinstance(robot, RobotSpec)]
        axes |= _measure_looks(specs, embed) | _measure_motion(specs)
    floor = chamfer_floor(robots, range(min(args.seeds, FLOOR_SEEDS)))
    pairs, singles = distance_frame(axes), robot_frame(features, axes, floor)
    for title, axis in axes.items():
        print(f"\n{TITLES[title].format(args.perceptual)}\n{matrix_text(pairs[pairs['axis'] == title], axis.robots)}")
    print(f"\nRobots\n{robot_text(singles)}\n\n{_format_legend(args.seeds, args.looks)}")
    for name, frame in (("robots", singles), ("distances", pairs)):  # where the second stands, both do
        path = args.out / f"{name}.csv"
        _write(frame, path)
        print(path)


def find_robots(names: Iterable[str]) -> dict[str, RobotSpec | Urdf]:
    """Robots by key, range of bodies, path or module:NAME; a URDF without a gripper is enough for a workspace.

    Raises:
        ConfigError: there is no such robot, or two have the same name.
    """
    found: dict[str, RobotSpec | Urdf] = {}
    for name in expand_robots(names):
        robot = _find_robot(name)
        key = robot.key if isinstance(robot, RobotSpec) else robot.path.stem
        if key in found:
            raise ConfigError(f"{name} is named {key}, as another robot of this table; rename its file or folder.")
        found[key] = robot
    return found


def _measure_looks(specs: Sequence[RobotSpec], embed: ImageEmbedding | None) -> dict[str, Axis]:
    from xew.sim_warp.rendering.streams import VIEW_COUNT, nine_views  # loads Warp, which no other part of the analysis needs

    renders, robots = [nine_views(robot) for robot in specs], tuple(robot.key for robot in specs)
    described = np.stack([describe_views(views) for views in renders])
    without_one = [descriptor_matrix(np.delete(described, i, axis=1)) for i in range(VIEW_COUNT)]
    axes = {"appearance": jackknifed(robots, descriptor_matrix(described), np.array(without_one))}
    if embed is not None:
        axes["perceptual"] = mean_axis(robots, _measure_perceptual(renders, embed))
    return axes


def _measure_motion(specs: Sequence[RobotSpec]) -> dict[str, Axis]:
    moved = motion_matrices(specs)
    if missing := [task for task in SCENES if task not in moved]:
        print(f"motion is not compared in {', '.join(missing)}, whose path one of the robots cannot follow")
    parts = np.array(list(moved.values()))
    return {"motion": mean_axis(tuple(robot.key for robot in specs), parts)} if len(parts) > 1 else {}


def _measure_perceptual(renders: Sequence[np.ndarray], embed: ImageEmbedding) -> np.ndarray:
    try:
        return perceptual_matrices(renders, embed)
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


def _import_embedding(name: str) -> ImageEmbedding:
    try:
        return import_named(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"--perceptual {name!r} cannot be imported: {error}; expected module:NAME, or nothing.") from error


def _write(frame: pd.DataFrame, path: Path) -> None:
    try:
        write_text(path, csv_text(frame), within=path.parent)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error}. Choose another --out.") from error


def _format_legend(seeds: int, looks: bool) -> str:
    spreads = [f"the standard deviation of one draw over {seeds} seeds (kinematic)"] * (seeds > 1)
    spreads += ["the jackknife's standard error over nine views (appearance, perceptual) or tasks (motion)"] * looks
    said = f"± is {' and '.join(spreads)}. " if spreads else ""
    return (
        f"{said}floor: kinematic distance of two draws of the same robot; the robots of a draw share its random numbers. "
        "In brackets: the paper's, from its own models of the robots and its own renders."
    )


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m xew.analysis.distance"))

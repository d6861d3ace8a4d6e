"""Which tool poses the robots reach: `python -m lab.robots.reach` prints the study as Markdown.

Base poses, homes and the experts' grasp tilt rest on it. A pose counts as reached when the arm gets there from home
along a straight path of its tool, inside the limits that experts keep, to 2 mm and 0.02 rad.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
import tyro

from xew.config import user_errors
from xew.protocol import expand_robots
from xew.sim_warp.devices.workers import quiet_warp
from xew.sim_warp.kinematics.inverse import ArmSolver
from xew.sim_warp.kinematics.reachability import reaches, work_reach
from xew.sim_warp.robots import ROBOTS, RobotSpec, get_robot

X, Y, Z = np.linspace(-0.32, 0.10, 6), np.linspace(-0.25, 0.15, 5), np.array([0.76, 0.85, 0.95])
"""Grid over the work volume of the left arm [m]; the right arm's is its mirror image."""
TILTS, YAWS = (0, 15, 30, 45, 60), (-90, -60, -30, 0, 30, 60, 90)
"""Leans and turns of the left hand [deg]; a negative yaw turns it inward. The right arm is given the mirrored yaw."""


def reach_table(robot: RobotSpec) -> np.ndarray:
    """Share of the work volume that the worse of the two arms reaches, [tilts yaws] in 0 to 1."""
    solver = ArmSolver(robot)
    cells = list(product(TILTS, YAWS, product(X, Y, Z)))
    tilts, yaws, positions = (np.array(column, float) for column in zip(*cells, strict=True))
    both = [reaches(solver, arm, positions, tilts, yaws).reshape(len(TILTS), len(YAWS), -1).mean(-1) for arm in (0, 1)]
    return np.minimum(*both)


def format_tables(robots: list[RobotSpec]) -> str:
    """Both tables."""
    lines = ["| robot | left arm | right arm |", "|---|---|---|"]
    for robot in robots:
        shares = " | ".join(f"{100 * work_reach(robot, arm).mean():.1f} %" for arm in (0, 1))
        lines.append(f"| {robot.title} | {shares} |")
    lines += ["", "| robot | tilt | " + " | ".join(f"yaw {yaw}" for yaw in YAWS) + " |", "|---|---|" + "---|" * len(YAWS)]
    for robot in robots:
        for tilt, row in zip(TILTS, reach_table(robot), strict=True):
            lines.append(f"| {robot.title} | {tilt} | " + " | ".join(f"{100 * share:.0f}" for share in row) + " |")
    return "\n".join(lines)


@dataclass(frozen=True)
class Args:
    """Print which tool poses robots reach, as Markdown."""

    robots: tuple[str, ...] = tuple(ROBOTS)
    """Registry keys, bodies (body:17, body:0-63), import paths module:NAME or paths."""


@user_errors
def main() -> None:
    quiet_warp()
    args = tyro.cli(Args)
    print(format_tables([get_robot(name) for name in expand_robots(args.robots)]))


if __name__ == "__main__":
    main()

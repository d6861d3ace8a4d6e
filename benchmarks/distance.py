"""Kinematic distances of the five robots over 100 seeds: the time they take, and how far they are from the paper's.

    python benchmarks/distance.py [--seeds 100] [--workers 2] [--limit 20]

Exits with 1 where it takes longer than the limit in seconds, or where one of the ten distances lies more than two standard
deviations of one draw from the published one.
"""

import sys
import time
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import tyro

from xew.analysis.distance import measure
from xew.analysis.paper import read_paper
from xew.sim_warp.robots import ROBOTS, load_urdf


@dataclass(frozen=True)
class Args:
    seeds: int = 100
    workers: int = 2
    """Threads of the nearest-neighbor search."""
    limit: float = 20.0
    """Seconds."""


def main(args: Args) -> int:
    for robot in ROBOTS.values():
        load_urdf(robot.urdf)  # is read once, whatever is measured
    start, cpu = time.perf_counter(), time.process_time()
    features = measure(ROBOTS, range(args.seeds), workers=args.workers)
    taken, worked = time.perf_counter() - start, time.process_time() - cpu
    print(f"{args.seeds} seeds of {len(ROBOTS)} robots: {taken:.1f} s ({worked:.1f} s of CPU), limit {args.limit:.0f} s")
    paper = read_paper()
    mean, deviation = features.kinematic.mean(axis=0), features.kinematic.std(axis=0, ddof=1)
    z = (np.array(paper.distances["kinematic"]) - mean) / np.where(deviation > 0, deviation, 1)
    for a, b in combinations(range(len(features.robots)), 2):
        names = f"{features.robots[a]} - {features.robots[b]}"
        printed = paper.distances["kinematic"][a][b]
        print(f"  {names:28} {mean[a, b]:.4f} ±{deviation[a, b]:.4f} m, paper {printed:.3f} ({z[a, b]:+.1f} deviations)")
    return int(taken > args.limit or bool((np.abs(z) > 2).any()))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))

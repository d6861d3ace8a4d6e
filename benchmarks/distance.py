"""Kinematic distances of the five robots over 100 seeds: the time they take, and how far they are from the paper's.

    python -m benchmarks.distance [--seeds 100] [--workers 2] [--limit 20] [--bodies 24]

Exits with 1 where it takes longer than the limit in seconds, or where one of the ten distances lies more than two standard
deviations of one draw from the published one. Then, of some procedural bodies, how much sooner threads measure workspaces than
one, and embeddings LPIPS than pairs of videos; both ways give the same numbers, or it ends with an error.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import tyro

from xew.analysis.distance import measure, perceptual_matrices
from xew.analysis.paper import read_paper
from xew.metrics import lpips, lpips_embedding
from xew.sim_warp.rendering.streams import nine_views
from xew.sim_warp.robots import ROBOTS, get_robot, load_urdf


@dataclass(frozen=True)
class Args:
    seeds: int = 100
    workers: int = 2
    """Threads that compare workspaces."""
    limit: float = 20.0
    """Seconds."""
    bodies: int = 24
    """Number of procedural bodies; 0 for none."""


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
    if args.bodies:
        compare_ways(args)
    return int(taken > args.limit or bool((np.abs(z) > 2).any()))


def compare_ways(args: Args) -> None:
    """Print the ratios of one thread to several, and of LPIPS of each pair to that of embeddings, by turns."""
    bodies = {f"body_{number}": get_robot(f"body:{number}") for number in range(args.bodies)}
    renders = [nine_views(body) for body in bodies.values()]
    pairs = list(combinations(range(args.bodies), 2))

    def measure_by(workers: int) -> np.ndarray:
        return measure(bodies, range(2), workers=workers).kinematic

    def compare_pairs() -> np.ndarray:
        return np.stack([np.asarray(lpips(renders[a], renders[b])) for a, b in pairs], axis=1)

    def compare_embeddings() -> np.ndarray:
        rows, columns = zip(*pairs, strict=True)
        return perceptual_matrices(renders, lpips_embedding)[:, rows, columns]

    for name, before, after in (
        (f"workspaces, {args.workers} threads", lambda: measure_by(1), lambda: measure_by(args.workers)),
        ("LPIPS by embeddings", compare_pairs, compare_embeddings),
    ):
        seconds, found = zip(*(time_one(way) for way in (before, after, before, after)), strict=True)
        np.testing.assert_allclose(found[2], found[3], rtol=1e-5)
        one, other = seconds[2:]
        print(f"{name}, {len(pairs)} pairs: {other:.1f} s in place of {one:.1f}, {one / other:.1f} times as fast")


def time_one(way: Callable[[], np.ndarray]) -> tuple[float, np.ndarray]:
    begin = time.perf_counter()
    found = way()
    return time.perf_counter() - begin, found


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))

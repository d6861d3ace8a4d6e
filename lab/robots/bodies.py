"""Search for procedural bodies that work and for their places: the catalog behind `body:17`.

Reads  the designs of candidates, in numeric order
Writes the catalog: for every body the number of its candidate, base poses and homes, so that loading one searches for nothing

A candidate is skipped unless it passes three checks. From some place both of its arms follow the plans of eight tasks and two
seeds each (`trials.trial_plans`) within the limits and speeds of its joints; at home each arm stays on its side; and it
succeeds in physics on two further seeds of each task. A seed of paired data counts only where all robots succeed, so that one
body that never does would cost all others theirs.

Known bodies keep their numbers, so a longer catalog begins like a shorter one. Each body is written when it is accepted, and
the command resumes from the file unless --anew is given. With --recheck known bodies are checked in physics again, and those
that fail are replaced by further candidates.

With --digest it prints SHA-256 digests of the URDF and meshes of each body of the catalog, and of all: two machines that print
the same make the same bodies.

Command: python -m lab.robots.bodies [--count 104 --anew --recheck --workers 2 --out FILE | --count 104 --digest]
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import count as count_from
from itertools import islice, product
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from xew.concurrency import usable_cores
from xew.config import ConfigError, user_errors
from xew.files import hold_lock, write_bytes
from xew.protocol import body_key
from xew.sim_warp.devices.workers import Workers, find_device, quiet_warp
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.geometry.poses import Pose, matrix_from_pose
from xew.sim_warp.kinematics.forward import link_poses
from xew.sim_warp.production.cells import Job, plan_cells, simulate_cells
from xew.sim_warp.production.warm_up import compile_on_devices
from xew.sim_warp.rendering.streams import home_action
from xew.sim_warp.robots.procedural.bodies import CATALOG, Entry, placed_body, read_catalog, unplaced_body
from xew.sim_warp.robots.procedural.design import WIDE, BodyDesign, design_body
from xew.sim_warp.robots.procedural.urdf_files import body_files
from xew.sim_warp.robots.user.placement import YAW_90, move_apart, move_to, place
from xew.sim_warp.robots.user.trials import PLAN_TASKS

BODY_COUNT = 168
"""Number of bodies in the packaged catalog."""
FIRST_FAMILY = 104
"""Number of bodies of the first family of designs; those after them are of the wide family."""
LEAST_SHARE = 1.0
"""Least share of the trial plans that a body follows."""
PHYSICS_SEEDS = (2, 3)
"""Seeds of each task of the trial plans on which a body has to succeed in physics; its place is chosen by those before."""
LEAST_GAP = 0.002
"""Least distance of an arm at home from the plane between both [m]."""
GAPS, BASE_Y = (0.6, 0.45, 0.75), (-0.45, -0.55, -0.65)
BASE_Z = {
    "upright": (0.75, 0.55),
    "tilted": (0.75, 0.6),
    "frame": (0.75, 0.95),
    "pedestal": (0.35, 0.55),
    "stand": (0.0,),
}
"""Places that are tried [m]: distances between the bases, and where their roots stand, by the kind of mount."""


def body_places(design: BodyDesign, robot: RobotSpec) -> list[RobotSpec]:
    """A body at every place that is tried."""
    rotation = (Rotation.from_quat(YAW_90) * Rotation.from_euler("y", design.lean)).as_quat(canonical=True)
    turn = np.round(rotation, 7).tolist()
    places = product(GAPS, BASE_Y, BASE_Z[design.mount])
    return [move_apart(move_to(robot, (0.0, y, z, *turn)), gap) for gap, y, z in places]


def try_candidate(number: int) -> tuple[int, Entry | str]:
    """Look for a place for a candidate; what the catalog holds of it, or why it is skipped."""
    design = design_body(number)
    robot = unplaced_body(design, f"candidate_{number}", f"Candidate {number}")
    try:
        placed = place(body_places(design, robot))
    except ConfigError as error:
        return number, str(error).partition(": ")[2]
    if placed.share < LEAST_SHARE:
        problem = next(problem for problem in placed.problems if problem is not None)
        return number, f"follows {placed.share:.0%} of the plans ({problem})"
    if (gap := gap_between_arms(placed.robot)) < LEAST_GAP:
        return number, f"its arms come within {1000 * gap:.0f} mm of the middle between them at home"
    left, right = placed.robot.arms
    entry = Entry(number, (_rounded(left.root_pose), _rounded(right.root_pose)), (left.home, right.home))
    return number, find_failure(entry) or entry


def find_failure(entry: Entry) -> str | None:
    """Why the body of an entry fails in physics on one of the trial tasks; None if it succeeds on all of PHYSICS_SEEDS."""
    key = f"candidate_{entry.candidate}"
    robots = {key: placed_body(entry, key, key)}
    for task in PLAN_TASKS:
        planned = plan_cells([Job(task, seed, (key,)) for seed in PHYSICS_SEEDS], robots)
        for (cell,) in simulate_cells(planned, "cpu"):
            if cell.failure:
                return f"{task}, seed {cell.scene.seed}: {cell.failure[1]}"
    return None


def compile_for_checks(workers: Workers) -> None:
    """Compile the kernels that checks launch, where there are none yet; else each worker would compile them all."""
    compile_on_devices(workers, {"physics": "cpu", "kinematics": find_device(None).alias}, 1)


def gap_between_arms(robot: RobotSpec) -> float:
    """Least distance of a link from the plane between the two arms, at home [m]; negative where one is on the other's side."""
    urdf, row = load_urdf(robot.urdf), home_action(robot)[None]
    gaps = []
    for side, frames in zip((-1, 1), link_poses(robot, row), strict=True):
        for name, link in urdf.links.items():
            pose = matrix_from_pose(frames[name])[0]
            gaps += [] if link.visual is None else [side * (link.visual.vertices @ pose[0, :3] + pose[0, 3])]
    return float(min(gap.min() for gap in gaps))


def find_bodies(known: tuple[Entry, ...], count: int, workers: int) -> Iterator[tuple[int, Entry | str]]:
    """Candidates after the known ones in numeric order, until `count` bodies are known; skipped ones with the reason.

    The first `FIRST_FAMILY` bodies are of the first family of designs, all others of the wide one.
    """
    body_count = len(known)
    for first, end in ((0, min(FIRST_FAMILY, count)), (WIDE, count)):
        if body_count >= end:
            continue
        begin = max([first, *(entry.candidate + 1 for entry in known)])
        for result in _try_in_order(count_from(begin), workers):
            yield result
            body_count += isinstance(result[1], Entry)
            if body_count == end:
                break


def replace_failing(known: Sequence[Entry], workers: int) -> Iterator[tuple[int, str, Entry]]:
    """Further candidates for those known bodies that fail in physics: the number of each body, why it fails, and its successor.

    Successors are of the same family of designs. All other bodies keep their numbers.
    """
    with Workers(workers) as pool:
        compile_for_checks(pool)
        checked = pool.run(_check_entry, known)
        problems = dict(tqdm(checked, total=len(known), desc="check", unit="body"))
    numbered = list(enumerate(known))
    for first, family in ((0, numbered[:FIRST_FAMILY]), (WIDE, numbered[FIRST_FAMILY:])):
        failing = [(number, problem) for number, entry in family if (problem := problems[entry.candidate])]
        begin = max([first, *(entry.candidate + 1 for _, entry in family)])
        successors = (entry for _, entry in _try_in_order(count_from(begin), workers) if isinstance(entry, Entry))
        for (number, problem), entry in zip(failing, successors, strict=False):  # successors have no end
            yield number, problem, entry


def _check_entry(entry: Entry) -> tuple[int, str | None]:
    return entry.candidate, find_failure(entry)


def _try_in_order(numbers: Iterator[int], workers: int) -> Iterator[tuple[int, Entry | str]]:
    """What becomes of candidates, in their order and without end."""
    if workers == 1:
        yield from map(try_candidate, numbers)
        return
    with Workers(workers) as pool:
        compile_for_checks(pool)
        while True:
            yield from sorted(pool.run(try_candidate, list(islice(numbers, 2 * workers))), key=lambda result: result[0])


def catalog_text(entries: Sequence[Entry]) -> str:
    """The content of a catalog, a line an entry."""
    lines = ",\n".join(json.dumps(asdict(entry)) for entry in entries)
    return f'{{"bodies": [\n{lines}\n]}}\n'


def digest_lines(entries: Sequence[Entry]) -> Iterator[str]:
    """One line per body with the digest of its files, then a line with the digest of all."""
    together = hashlib.sha256()
    for number, entry in enumerate(entries):
        digest = hashlib.sha256()
        for name, content in sorted(body_files(design_body(entry.candidate)).items()):
            digest.update(name.encode() + b"\0" + hashlib.sha256(content).digest())
        together.update(digest.digest())
        yield f"{body_key(number)} {digest.hexdigest()}"
    yield f"all {together.hexdigest()}"


def _rounded(pose: Pose) -> Pose:
    x, y, z, qx, qy, qz, qw = (round(float(value), 7) for value in pose)
    return x, y, z, qx, qy, qz, qw


@dataclass(frozen=True)
class Args:
    """Find procedural bodies that work."""

    count: int = BODY_COUNT
    """Number of bodies in the catalog, or of those whose digests are printed."""
    anew: bool = False
    """Forget the bodies that the file knows."""
    recheck: bool = False
    """Replace the bodies that the file knows and that fail in physics; all others keep their numbers."""
    workers: int = usable_cores()
    out: Path = CATALOG
    """File of the catalog."""
    digest: bool = False
    """Print digests of the bodies of the file instead."""


@user_errors
def main() -> None:
    quiet_warp()
    args = tyro.cli(Args, description=__doc__)
    if args.digest:
        for line in digest_lines(read_catalog(args.out)[: args.count]):
            print(line)
        return
    if args.workers < 1:
        raise ConfigError(f"--workers is {args.workers}; expected at least 1.")
    with hold_lock(args.out):
        fill_catalog(args)


def fill_catalog(args: Args) -> None:
    """Find bodies until the catalog has as many as are asked for; it is written at each."""
    entries = list(read_catalog(args.out)) if args.out.is_file() and not args.anew else []
    skipped = 0
    if args.recheck:
        for number, problem, entry in replace_failing(entries, args.workers):
            print(f"body:{number} is replaced by candidate {entry.candidate}: {problem}")
            entries[number] = entry
            write_bytes(args.out, catalog_text(entries).encode(), within=args.out.parent)
    with tqdm(total=args.count, initial=len(entries), desc="bodies", unit="body") as bar:
        for number, result in find_bodies(tuple(entries), args.count, args.workers):
            if isinstance(result, str):
                skipped += 1
                bar.write(f"candidate {number} is skipped: {result}")
                continue
            entries.append(result)
            write_bytes(args.out, catalog_text(entries).encode(), within=args.out.parent)
            bar.update()
    print(f"{args.out}: {len(entries)} bodies; {skipped} candidates were skipped")


if __name__ == "__main__":
    main()

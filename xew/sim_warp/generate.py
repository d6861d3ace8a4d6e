"""The command that makes the paired data set: episodes of every task, seed and robot.

Reads  the registries of tasks and robots
Writes <out>/<task>/<seed>/<robot>/, see xew/episode.py; one line per task and robot at the end

Seeds are tried in order until enough are accepted: a seed is accepted if all robots succeed on it. Seeds that fail according to
the manifest (manifest.py) are skipped. Episodes on disk are not made again: an interrupted command can be run again.
--faults 8 adds seven faulty episodes to each accepted scene, with commands that may fail, and keeps failures too.

Command: python -m xew.sim_warp.generate --batch 256 [--tasks … --robots … --train-seeds 50 --test-seeds 20
    --validation-seeds 4 --motion shared --out data]
"""

import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from xew.config import user_errors
from xew.dataset import find_records, read_dataset, remove_left_overs
from xew.episode import EpisodeError, Record
from xew.files import hold_lock
from xew.protocol import (
    HEAD,
    SEED_STARTS,
    TEST_SEEDS_PER_TASK,
    TRAIN_SEEDS_PER_TASK,
    expand_robots,
    split_key,
)
from xew.sim_warp.cameras import demand_sight, get_views
from xew.sim_warp.changes.scenes import check_change, demand_change
from xew.sim_warp.devices.workers import Workers, choose_physics, find_devices, quiet_warp, worker_count
from xew.sim_warp.faults import FAULTS
from xew.sim_warp.inspection.checks import render_views
from xew.sim_warp.manifest import PACKAGED, Manifest, read_manifest
from xew.sim_warp.production.cells import Job
from xew.sim_warp.production.produce import Production, make_scenes
from xew.sim_warp.production.seeds import (
    MOST_UNPAIRED,
    Family,
    FamilyKey,
    FaultFamily,
    demand_enough,
    family_key,
    plan_families,
    plan_faults,
)
from xew.sim_warp.production.summary import yield_table
from xew.sim_warp.production.warm_up import compile_on_devices
from xew.sim_warp.robots import ROBOTS, RobotSpec, adopt_robots, get_robot, is_path
from xew.sim_warp.tasks import TASKS, get_task

Timed = tuple[list[Record], float]
"""Headers of one job's cells, and the workers' time for them [s]."""
Make = Callable[[Sequence[Job]], Iterator[Timed]]
"""Function that makes the scenes of jobs."""


@dataclass(frozen=True)
class Args:
    """What to generate."""

    tasks: tuple[str, ...] = tuple(TASKS)
    """Keys of the registry, or module:NAME."""
    robots: tuple[str, ...] = tuple(ROBOTS)
    """Keys of the registry, bodies (body:17, body:0-63), module:NAME, or paths (docs/add_a_robot.md)."""
    train_seeds: int = TRAIN_SEEDS_PER_TASK
    """Number of accepted training seeds per task, or with --unpaired per task and robot."""
    test_seeds: int = TEST_SEEDS_PER_TASK
    """Number of accepted test seeds per task; they never overlap with training seeds."""
    validation_seeds: int = 0
    """Number of accepted validation seeds per task: for samples during training, calibration and tuning."""
    final_seeds: int = 0
    """Number of accepted seeds per task of the block reserved for the final study."""
    test_robots: tuple[str, ...] = ()
    """Robots of the test seeds; default: --robots."""
    change: str = ""
    """One change of all scenes, as FACTOR:LEVEL: light, background, table, clutter, height or camera, with levels 1, 2, 3 of
    growing strength (docs/cameras.md). random: a change is drawn for each scene, for training."""
    out: Path | None = None
    """Folder of the data set; default: data, with a change such as light:2 data_light_2."""
    batch: int = 256
    """Number of worlds that a GPU steps together. On a CPU each worker steps one world at a time."""
    workers: int | None = None
    """Number of processes; default: one per core, on GPUs one per two cores within their memory."""
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda:0")] = None
    """Device; default: all GPUs of the first one's kind, shared by the workers, else the CPU."""
    physics: Literal["cpu", "cuda"] | None = None
    """Device for planning and physics; default: the CPU, or the GPU if there are less than 8 cores for each GPU. CPU physics is
    bit-repeatable, GPU physics is not: equal processors make equal data sets (docs/performance.md)."""
    unpaired: bool = False
    """Use different seeds for each robot. Gives more scenes for codec training, but no paired comparison of robots."""
    motion: Literal["shared", "own"] = "shared"
    """Kind of motion. shared: all robots follow one tool path on one clock; only the body differs. own: each robot moves
    between the task's waypoints on its own path, in its own time and from its own rest posture."""
    states_only: bool = False
    """Store states and all hashes without videos; `python -m xew.sim_warp.inspect DATA --render` makes videos on demand."""
    cameras: tuple[str, ...] = (HEAD,)
    """Cameras with a view of each accepted episode: head, wrist_left, wrist_right, front, side, or YAML files
    (docs/cameras.md). The head camera at 320x240 is always there."""
    size: str | None = None
    """Size of these views, such as 640x480; default: the camera's."""
    manifest: Path = PACKAGED
    """File with the seeds that are known to fail."""
    faults: int = 0
    """Number of commands of each accepted scene: the expert's, and others with drawn faults (docs/tasks.md). Their episodes are
    kept whether the task is solved or not, with the seed fault * 10000000 + seed."""
    search: bool = False
    """Try every seed, ignoring the manifest."""

    @property
    def folder(self) -> Path:
        """Folder of the data set."""
        return self.out or Path(split_key("data", self.motion, self.change))


@contextmanager
def start_workers(args: Args, robots: Mapping[str, RobotSpec]) -> Iterator[tuple[Workers, Make]]:
    """Start worker processes with compiled kernels; yields them and the function that makes the scenes of jobs."""
    devices = find_devices(args.device)
    physics = choose_physics(args.physics, devices)
    production = Production(args.folder, robots, physics.is_cuda, args.batch, not args.states_only, len(devices))
    with Workers(args.workers or worker_count(devices, physics), devices) as workers:
        parts = {"physics": physics.alias, "kinematics": physics.alias, "rendering": devices[0].alias}
        wait_for_renderer = compile_on_devices(workers, parts, args.batch, later="rendering")
        yield workers, lambda jobs: make_scenes(workers, jobs, production, wait_for_renderer)


def generate(args: Args) -> list[Family]:
    """Make missing episodes; returns all families with their records."""
    _check(args)
    robots = _find_robots(args.robots, args.folder)
    tested = _find_robots(args.test_robots, args.folder) or robots
    manifest = Manifest() if args.search else read_manifest(args.manifest)
    teams = dict.fromkeys(SEED_STARTS, tuple(robots)) | dict.fromkeys(("test", "final"), tuple(tested))
    families = plan_seeds(args, teams, manifest)
    speed = _Speed()
    with start_workers(args, {**robots, **tested}) as (workers, make):
        _complete(families, args, make, speed)
        faulty = plan_faults(families, args.faults, workers) if args.faults > 1 else []
        if faulty:
            _complete(faulty, args, make, speed)
    speed.print()
    return [*families, *faulty]


def _complete(families: Sequence[Family], args: Args, make: Make, speed: "_Speed") -> None:
    """Make the missing episodes of some families, and add all records to them."""
    _read_existing(families, args)
    total = sum(family.wanted for family in families)
    with tqdm(total=total, initial=sum(f.accepted for f in families), desc="accepted seeds", unit="seed") as bar:
        while jobs := {(family.task, job.seed): (family, job) for family in families for job in family.next_jobs()}:
            for records, seconds in make([job for _, job in jobs.values()]):
                family, _ = jobs[records[0].task, records[0].seed]
                before = family.accepted
                for record in records:
                    family.add(record)
                speed.add(records, seconds)
                bar.n += family.accepted - before
                bar.set_postfix_str(f"{records[0].task} {records[0].seed}", refresh=True)


def plan_seeds(args: Args, robots: Mapping[str, Sequence[str]], manifest: Manifest) -> list[Family]:
    """The requested families of seeds; arguments as of `plan_families`."""
    wanted = {
        "train": args.train_seeds,
        "validation": args.validation_seeds,
        "test": args.test_seeds,
        "final": args.final_seeds,
    }
    return plan_families(args.tasks, wanted, robots, manifest, motion=args.motion, change=args.change, unpaired=args.unpaired)


def _check(args: Args) -> None:
    """Check tasks, the change and numbers before any work. Raises ConfigError or EpisodeError."""
    check_change(args.change)
    for task in args.tasks:
        get_task(task)
    if args.workers is not None and args.workers < 1:
        raise EpisodeError(f"--workers is {args.workers}; expected at least 1; omit it for the default.")
    if not 0 <= args.faults <= len(FAULTS) + 1:
        raise EpisodeError(
            f"--faults is {args.faults}; expected 2 to {len(FAULTS) + 1} commands a scene, or 0 for the expert's."
        )
    if not args.tasks or not args.robots or min(args.train_seeds, args.test_seeds) < 0 or args.batch < 1:
        raise EpisodeError(
            f"found {len(args.tasks)} tasks, {len(args.robots)} robots, {args.train_seeds} training and {args.test_seeds} test "
            f"seeds and --batch {args.batch}; expected at least one task and robot, seeds from 0 and a batch from 1."
        )
    if args.unpaired and max(args.train_seeds, args.test_seeds) > MOST_UNPAIRED:
        raise EpisodeError(
            f"--unpaired with {max(args.train_seeds, args.test_seeds)} seeds per robot; expected at most {MOST_UNPAIRED}: ask "
            "for fewer, or name more robots."
        )


def _find_robots(asked: Sequence[str], out: Path) -> dict[str, RobotSpec]:
    """Robots by their names in episodes; robots at paths are copied into the data set.

    Raises:
        ConfigError: there is no such robot, or it cannot be used; nothing has been written.
        EpisodeError: the folder cannot be written.
    """
    names = expand_robots(asked)
    known = {name: get_robot(name, out) for name in names if not is_path(name)}
    _prepare_folder(out)
    return {key: known.get(name) or get_robot(key, out) for name, key in zip(names, adopt_robots(names, out), strict=True)}


def _prepare_folder(out: Path) -> None:
    """Make the folder and remove incomplete episodes. Raises EpisodeError if it cannot be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        remove_left_overs(out)
        tempfile.TemporaryFile(dir=out).close()  # whether it can be written
    except OSError as error:
        raise EpisodeError(f"cannot write to {out}: {error.strerror}. Choose another folder with --out.") from error


def _read_existing(families: Sequence[Family], args: Args) -> None:
    """Add the cells on disk to the families.

    Raises:
        EpisodeError: a header is damaged or in a wrong folder, an episode of these tasks was imported, or the data set has
            no videos, another kind of motion or another change.
    """
    out = args.folder
    by_key: dict[FamilyKey, list[Family]] = {}
    for family in families:
        by_key.setdefault(family.key, []).append(family)
    for folder, record in find_records(out):
        if not record.videos and not args.states_only:
            raise EpisodeError(
                f"{out} was made with --states-only; pass it again, make the videos by `python -m xew.sim_warp.inspect {out} "
                "--render`, or choose another --out."
            )
        if record.motion != args.motion:
            raise EpisodeError(
                f"{out} holds episodes of {record.motion} motion, expected {args.motion} motion; choose another --out."
            )
        demand_change(folder, record, args.change)
        for family in by_key.get(family_key(record), ()):
            if args.unpaired and record.robot not in family.robots:
                continue
            if record.source:
                raise EpisodeError(
                    f"{folder} was imported ({record.source}): its seed is not the scene of {record.task} here. "
                    "Choose another --out."
                )
            family.add(record)


@dataclass
class _Speed:
    """Frames made, and the workers' time for them, by task."""

    frames: Counter[str] = field(default_factory=Counter)
    spent: dict[str, float] = field(default_factory=lambda: defaultdict(float))

    def add(self, records: Sequence[Record], seconds: float) -> None:
        """Add the headers of one scene and the time for it [s]."""
        self.spent[records[0].task] += seconds
        self.frames[records[0].task] += sum(record.frame_count for record in records if record.hashes)

    def print(self) -> None:
        for task, seconds in self.spent.items():
            count = self.frames[task]
            print(f"{task}: {count} frames in {seconds:.1f} process-seconds, {count / seconds:.1f} frames/s per process")


@user_errors
def main() -> None:
    quiet_warp()
    args = tyro.cli(Args, description=__doc__)
    print(f"device: {', '.join(device.name for device in find_devices(args.device))}")
    views = get_views(args.cameras, args.size)
    if views and args.states_only:
        raise EpisodeError("--cameras makes videos, and --states-only stores none; add views by inspect --render --cameras.")
    if views:
        demand_sight(views, [get_robot(name, args.folder) for name in expand_robots(args.robots)])
    with hold_lock(args.folder):
        families = generate(args)
        if views:
            render_views(read_dataset(args.folder).accepted, views)
    print(yield_table([record for family in families for seed in family.done.values() for record in seed.values()]))
    demand_enough([family for family in families if not isinstance(family, FaultFamily)])  # a set may be smaller


if __name__ == "__main__":
    main()

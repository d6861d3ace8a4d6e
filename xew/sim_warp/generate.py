"""The command that makes the paired data set: episodes of every task, seed and robot.

Reads  the registries of tasks and robots
Writes <out>/<task>/<seed>/<robot>/, see xew/episode.py; one line per task and robot at the end

Seeds are tried in order until enough of them are accepted, that is, until all robots have succeeded on them; those that
the manifest (manifest.py) knows to fail are left out. What is on disk is not made again: stop the command at any time, give
it again, and the result is the same.

Command: python -m xew.sim_warp.generate --batch 256 [--tasks … --robots … --train-seeds 50 --test-seeds 20
    --validation-seeds 4 --motion shared --out data]
"""

import itertools
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from xew.config import user_errors
from xew.dataset import count_motions, find_records, read_dataset
from xew.episode import EpisodeError, Record, episode_folder, remove_left_overs
from xew.files import hold_lock
from xew.protocol import (
    SEED_STARTS,
    SHARED_MOTION,
    TEST_SEEDS_PER_TASK,
    TRAIN_SEEDS_PER_TASK,
    expand_robots,
    painted_key,
    seed_split,
)
from xew.sim_warp.devices.workers import FRAMES_OF_A_PAINTER, Workers, find_device, find_devices, quiet_warp, worker_count
from xew.sim_warp.manifest import PACKAGED, Manifest, read_manifest
from xew.sim_warp.production.by_robot import Timed, make_by_robot
from xew.sim_warp.production.cells import Cell, Job
from xew.sim_warp.production.produce import produce, simulate_jobs, write_seeds
from xew.sim_warp.production.rerender import paint_again
from xew.sim_warp.production.warm_up import compile_on_devices
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import ROBOTS, RobotSpec, adopt_robots, get_robot, is_path
from xew.sim_warp.tasks import TASKS, get_task

TRIES_PER_SEED = 3
SPARE_TRIES = 20
"""Numbers of seeds after which a task gives up: 3 n + 20 have been tried and fewer than n accepted."""
SEEDS_OF_ROBOT = 1000
"""Number of seeds from the first of one robot to the first of the next where robots share no scenes."""
MOST_UNPAIRED = (SEEDS_OF_ROBOT - SPARE_TRIES) // TRIES_PER_SEED
"""Largest number of accepted seeds that fit between them."""


@dataclass(frozen=True)
class Args:
    """What to generate."""

    tasks: tuple[str, ...] = tuple(TASKS)
    """Keys of the registry, or module:NAME."""
    robots: tuple[str, ...] = tuple(ROBOTS)
    """Keys of the registry, bodies (body:17, body:0-63), module:NAME, or paths of your own (docs/add_a_robot.md)."""
    robot: Path | None = None
    """Path of a robot of your own, then the only one: a URDF, a folder with a robot.yaml, or a RoboTwin embodiment folder."""
    train_seeds: int = TRAIN_SEEDS_PER_TASK
    """Number of accepted training seeds a task, or with --unpaired a task and robot."""
    test_seeds: int = TEST_SEEDS_PER_TASK
    """Number of accepted test seeds, likewise; they count from where no training seed comes."""
    validation_seeds: int = 0
    """Number of accepted validation seeds, likewise: for samples while models train, for calibration and whatever is tuned."""
    test_robots: tuple[str, ...] = ()
    """Robots of the test seeds, where they are others than --robots, which then are those of all other seeds."""
    out: Path = Path("data")
    batch: int = 256
    """Number of worlds that a GPU steps together. A CPU steps each by itself, as many at a time as there are workers."""
    workers: int | None = None
    """Number of processes; by default one a core, on GPUs one for two cores, as far as their memory has room."""
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda:0")] = None
    """Default: all GPUs of the kind of the first, which workers share, else the CPU."""
    physics: Literal["cpu"] | None = None
    """Plan and step physics on the CPU, which repeats to the bit where a GPU does not, and use the GPU for pictures alone, so
    that machines of a kind make the same data set (docs/performance.md). Takes about a second of a core an episode."""
    unpaired: bool = False
    """Each robot gets seeds of its own, and no scene waits for another robot to succeed: more scenes for a codec to learn
    from, nothing to compare robots by."""
    motion: Literal["shared", "own"] = "shared"
    """shared: all robots follow one tool path on one clock, so that the body alone differs. own: each robot goes between the
    task's waypoints by a path, in a time and from a rest posture of its own."""
    mixed_motion: bool = False
    """Let a data set have episodes of both kinds, each cell of one."""
    states_only: bool = False
    """Store no videos, only states and all hashes; `python -m xew.sim_warp.inspect DATA --render` makes them on demand."""
    paints: int = 0
    """Number of paints: each training episode is also written with its robot in other colors, as robot NAME_paint_N, where N
    follows from the seed. Shapes, motion and scene stay the same, and nothing is simulated for it."""
    manifest: Path = PACKAGED
    """File that says which seeds are known to fail."""
    search: bool = False
    """Try every seed, whatever the manifest says."""


@dataclass
class Family:
    """The seeds of one task and family (`xew.protocol.seed_split`), and how far they are."""

    task: str
    first_seed: int
    wanted: int
    robots: tuple[str, ...]
    failing: frozenset[int] = frozenset()
    """Seeds on which one of the robots is known to fail."""
    motion: str = SHARED_MOTION
    """Kind of motion of what is missing."""
    done: dict[int, dict[str, Record]] = field(default_factory=lambda: defaultdict(dict))

    def add(self, record: Record) -> None:
        """Take a cell into account."""
        self.done[record.seed][record.robot] = record

    @property
    def tries(self) -> list[int]:
        """The seeds that may be tried."""
        candidates = (seed for seed in itertools.count(self.first_seed) if seed not in self.failing)
        return list(itertools.islice(candidates, TRIES_PER_SEED * self.wanted + SPARE_TRIES))

    @property
    def accepted(self) -> int:
        """Number of complete seeds on which no robot failed, at most as many as are wanted."""
        return min(self.wanted, sum(not self._missing_robots(seed) and self._is_hopeful(seed) for seed in list(self.done)))

    def next_jobs(self) -> list[Job]:
        """What is missing of the first seeds: as many as it takes if from now on no robot fails.

        Seeds on which a robot has failed are completed too, so that a run that was stopped ends like one that was not.
        """
        jobs: list[Job] = []
        hopeful = 0
        for seed in self.tries:
            if hopeful == self.wanted:
                break
            if missing := self._missing_robots(seed):
                jobs.append(Job(self.task, seed, missing, not self._is_hopeful(seed), self.motion))
            hopeful += self._is_hopeful(seed)
        return jobs

    def _missing_robots(self, seed: int) -> tuple[str, ...]:
        """Robots without a record or, where all have succeeded, without an episode."""
        done = self.done[seed]
        return tuple(r for r in self.robots if r not in done or (self._is_hopeful(seed) and not done[r].hashes))

    def _is_hopeful(self, seed: int) -> bool:
        """Whether no robot has failed so far."""
        return all(record.success for record in self.done[seed].values())


def plan_families(args: Args, robots: Mapping[str, Sequence[str]], manifest: Manifest) -> list[Family]:
    """The families of all tasks: one of all robots together, or one a robot, each with seeds that no other has.

    Args:
        args: what is asked for.
        robots: keys of the robots by family of seeds, a key of SEED_STARTS.
        manifest: seeds that are known to fail.
    """
    families = []
    for task in dict.fromkeys(args.tasks):
        wanted_seeds = {"train": args.train_seeds, "validation": args.validation_seeds, "test": args.test_seeds}
        for name, wanted in wanted_seeds.items():
            if name == "validation" and not wanted:
                continue
            teams = [(robot,) for robot in robots[name]] if args.unpaired else [tuple(robots[name])]
            for number, team in enumerate(teams):
                first_seed = SEED_STARTS[name] + number * SEEDS_OF_ROBOT
                families.append(Family(task, first_seed, wanted, team, manifest.failing(task, team), args.motion))
    return families


Made = tuple[list[Record], float]
"""Headers of one job's cells, and the seconds spent on it."""


@contextmanager
def start_workers(args: Args, robots: Mapping[str, RobotSpec]) -> Iterator[Callable[[Sequence[Job]], Iterator[Made]]]:
    """Start worker processes; what is given runs jobs in them: on a GPU in large batches, on a CPU robot by robot."""
    devices = find_devices(args.device)
    physics = find_device(args.physics) if args.physics else devices[0]
    with Workers(args.workers or worker_count(devices, physics), devices) as workers:
        parts = {"physics": physics.alias, "kinematics": physics.alias, "rendering": devices[0].alias}
        compile_on_devices(workers, parts, args.batch)

        def run(jobs: Sequence[Job]) -> Iterator[Made]:
            videos = not args.states_only
            if not physics.is_cuda:
                simulate = partial(_simulate, physics=physics.alias)
                write = partial(_write, out=args.out, videos=videos, painter=devices[0].is_cuda)
                yield from make_by_robot(workers, jobs, robots, simulate, write)
                return
            size = max(1, args.batch // (1 if args.unpaired else len(robots)))
            batches = [jobs[start : start + size] for start in range(0, len(jobs), size)]
            make = partial(_make, robots=robots, out=args.out, batch=args.batch, videos=videos)
            for made in workers.run(make, batches):
                yield from made

        yield run


@cache
def _renderer(painter: bool) -> Renderer:
    """The renderer of a worker process on its own device, made once."""
    return Renderer(frames_per_chunk=FRAMES_OF_A_PAINTER if painter else None)


def _make(jobs: Sequence[Job], robots: Mapping[str, RobotSpec], out: Path, batch: int, videos: bool) -> list[Made]:
    """Make some jobs in a worker process, on its own device."""
    begin = time.perf_counter()
    seeds = produce(jobs, out, _renderer(painter=False), batch, videos, robots)
    seconds = (time.perf_counter() - begin) / len(jobs)
    return [(records, seconds) for records in seeds]


def _simulate(job: Job, robot: RobotSpec, physics: str) -> Timed:
    """The cell of a job of one robot with its motion, and the seconds it took, in a worker process."""
    begin = time.perf_counter()
    ((cell,),) = simulate_jobs([job], physics, robots=dict.fromkeys(job.robots, robot))
    _ = cell.failure  # found here once, it travels with the cell
    return cell, time.perf_counter() - begin


def _write(cell: Cell, rejected: bool, out: Path, videos: bool, painter: bool) -> Timed:
    """Write a cell in a worker process, rendered on its own device unless its scene is rejected; its header, and seconds."""
    begin = time.perf_counter()
    places = {(cell.task_name, cell.scene.seed)} if rejected else set()
    ((record,),) = write_seeds([[cell]], places, out, _renderer(painter), videos)
    return record, time.perf_counter() - begin


def generate(args: Args) -> list[Family]:
    """Make what is missing; returns all families with their records."""
    if args.robot:
        args = replace(args, robots=(str(args.robot.absolute()),))
    _check(args)
    robots = _find_robots(args.robots, args.out)
    tested = _find_robots(args.test_robots, args.out) or robots
    manifest = Manifest() if args.search else read_manifest(args.manifest)
    teams = dict.fromkeys(SEED_STARTS, tuple(robots)) | {"test": tuple(tested)}
    families = plan_families(args, teams, manifest)
    _read_existing(families, args)
    spent: dict[str, float] = defaultdict(float)
    frames: Counter[str] = Counter()
    total = sum(family.wanted for family in families)
    bar = tqdm(total=total, initial=sum(f.accepted for f in families), desc="accepted seeds", unit="seed")
    with bar, start_workers(args, {**robots, **tested}) as make:
        while jobs := {(family.task, job.seed): (family, job) for family in families for job in family.next_jobs()}:
            for records, seconds in make([job for _, job in jobs.values()]):
                family, _ = jobs[records[0].task, records[0].seed]
                for record in records:
                    family.add(record)
                spent[family.task] += seconds
                frames[family.task] += sum(record.frame_count for record in records if record.hashes)
                bar.n = sum(f.accepted for f in families)
                bar.set_postfix_str(f"{records[0].task} {records[0].seed}", refresh=True)
    _print_speed(frames, spent)
    if args.paints:
        paint_episodes(args, tuple(robots))
    return families


def paint_episodes(args: Args, robots: Sequence[str]) -> None:
    """Write what is missing of the accepted training episodes of some robots in other colors; see `Args.paints`."""
    episodes = read_dataset(args.out).select(robots=robots, tasks=args.tasks, split="train")
    asked = [(folder, 1 + record.seed % args.paints) for folder, record in episodes]
    todo = [(folder, paint) for folder, paint in asked if not folder.with_name(painted_key(folder.name, paint)).is_dir()]
    if not todo:
        return
    devices = find_devices(args.device)
    with Workers(args.workers or worker_count(devices, find_device("cpu")), devices) as workers:
        compile_on_devices(workers, {"rendering": devices[0].alias}, 1)
        painted = workers.run(partial(_paint, painter=devices[0].is_cuda), todo)
        for _ in tqdm(painted, desc="painted episodes", total=len(todo), unit="episode"):
            pass


def _paint(episode: tuple[Path, int], painter: bool) -> None:
    """Write an episode with its robot in the colors of a paint, in a worker process, rendered on its own device."""
    paint_again(*episode, _renderer(painter))


def _check(args: Args) -> None:
    """Check tasks and numbers before any work. Raises ConfigError or EpisodeError."""
    for task in args.tasks:
        get_task(task)
    if args.workers is not None and args.workers < 1:
        raise EpisodeError(f"--workers is {args.workers}; expected at least 1, or none for as many as there are cores.")
    if args.paints < 0:
        raise EpisodeError(f"--paints is {args.paints}; expected a number of paints, or 0 for none.")
    if not args.tasks or not args.robots or min(args.train_seeds, args.test_seeds) < 0 or args.batch < 1:
        raise EpisodeError(
            f"nothing to make of {len(args.tasks)} tasks, {len(args.robots)} robots, {args.train_seeds} training and "
            f"{args.test_seeds} test seeds in batches of {args.batch}; name tasks and robots, seeds from 0 and batches from 1."
        )
    if args.unpaired and max(args.train_seeds, args.test_seeds) > MOST_UNPAIRED:
        raise EpisodeError(
            f"{max(args.train_seeds, args.test_seeds)} seeds a robot are asked for by --unpaired, which has room for"
            f" {MOST_UNPAIRED}; ask for fewer, or name more robots."
        )


def _find_robots(asked: Sequence[str], out: Path) -> dict[str, RobotSpec]:
    """Robots by the names under which episodes know them, each found once; those at paths are kept beside the data.

    Raises:
        ConfigError: there is no such robot, or it cannot be used; then nothing has been written.
        EpisodeError: the folder cannot be written to.
    """
    names = expand_robots(asked)
    known = {name: get_robot(name, out) for name in names if not is_path(name)}
    _prepare_folder(out)
    return {key: known.get(name) or get_robot(key, out) for name, key in zip(names, adopt_robots(names, out), strict=True)}


def _prepare_folder(out: Path) -> None:
    """Make the folder, without what a stopped run left half-written. Raises EpisodeError where it cannot be written to."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        remove_left_overs(out)
        (out / ".writable").touch()
        (out / ".writable").unlink()
    except OSError as error:
        raise EpisodeError(f"cannot write to {out}: {error.strerror}. Choose another folder with --out.") from error


def _read_existing(families: list[Family], args: Args) -> None:
    """Add what is on disk to the families.

    Raises:
        EpisodeError: a header is damaged or in another's place, an episode of these tasks was imported, videos are wanted
            that were left out, or episodes are of the other kind of motion.
    """
    out = args.out
    for folder, record in find_records(out):
        if not record.videos and not args.states_only:
            raise EpisodeError(
                f"{out} was made with --states-only; go on so, make its videos by `python -m xew.sim_warp.inspect {out} "
                "--render`, or choose another --out."
            )
        if record.motion != args.motion and not args.mixed_motion:
            raise EpisodeError(
                f"{out} holds episodes of {record.motion} motion, and {args.motion} motion is asked for; choose another --out,"
                " or mix them on purpose by --mixed-motion."
            )
        for family in families:
            if args.unpaired and record.robot not in family.robots:
                continue
            same_family = seed_split(record.seed) == seed_split(family.first_seed)
            if record.task == family.task and same_family:
                if folder != episode_folder(out, record.task, record.seed, record.robot):
                    raise EpisodeError(f"{folder} holds {record.task}/{record.seed}/{record.robot}; move or delete it.")
                if record.source:
                    raise EpisodeError(
                        f"{folder} was imported ({record.source}): its seed is another scene than that of {record.task} here. "
                        "Choose another --out."
                    )
                family.add(record)


def _print_speed(frames: Counter[str], spent: dict[str, float]) -> None:
    for task, seconds in spent.items():
        print(
            f"{task}: {frames[task]} frames in {seconds:.1f} process-seconds, {frames[task] / seconds:.1f} frames/s a process"
        )


def yield_table(records: Sequence[Record]) -> str:
    """A line per task and robot: cells tried, succeeded, why not, and frames; a line per task of accepted seeds; the motion."""
    cells: dict[tuple[str, str], list[Record]] = defaultdict(list)
    seeds: dict[str, dict[int, bool]] = defaultdict(dict)
    for record in records:
        cells[record.task, record.robot].append(record)
        seeds[record.task][record.seed] = seeds[record.task].get(record.seed, True) and record.success
    wide, room = max(map(len, ("task", *seeds))), max(len(robot) for robot in ("robot", *(robot for _, robot in cells)))
    lines = [f"{'task':<{wide}} {'robot':<{room}} {'tried':>6}{'succeeded':>11}{'frames':>8}  reasons"]
    for (task, robot), tried in sorted(cells.items()):
        good = [record for record in tried if record.success]
        frames = sum(record.frame_count for record in good) // max(1, len(good))
        reasons = Counter(record.failure for record in tried if not record.success)
        listed = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
        share = f"{len(good)} ({100 * len(good) / len(tried):.0f} %)"
        lines.append(f"{task:<{wide}} {robot:<{room}} {len(tried):>6}{share:>11}{frames:>8}  {listed}")
    for task, accepted in sorted(seeds.items()):
        lines.append(f"{task:<{wide}} all robots together: {sum(accepted.values())} of {len(accepted)} seeds accepted")
    lines.append("motion: " + ", ".join(f"{motion} {count}" for motion, count in count_motions(records).items()))
    return "\n".join(lines)


def _demand_enough(families: Sequence[Family]) -> None:
    """Raise EpisodeError where the tries of a task are used up."""
    short = [
        f"{family.task} with {', '.join(family.robots)}: only {family.accepted} of {family.wanted} seeds were accepted in"
        f" {len(family.tries)} tries."
        for family in families
        if family.accepted < family.wanted
    ]
    if short:
        raise EpisodeError("\n".join([*short, "The table shows why; make the task easier or leave out a robot."]))


@user_errors
def main() -> None:
    quiet_warp()
    args = tyro.cli(Args, description=__doc__)
    print(f"device: {', '.join(device.name for device in find_devices(args.device))}")
    with hold_lock(args.out):
        families = generate(args)
    print(yield_table([record for family in families for seed in family.done.values() for record in seed.values()]))
    _demand_enough(families)


if __name__ == "__main__":
    main()

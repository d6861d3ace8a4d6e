"""Scheduling of seeds: they are tried in order until enough are accepted. A seed is accepted if all robots succeed on it.

The faults of an accepted scene are tried in the same way, in a drawn order: a fault is accepted if no robot is refused.
"""

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from xew.episode import EpisodeError, Record
from xew.protocol import SEED_STARTS, SHARED_MOTION, join_fault, seed_split, split_fault
from xew.sim_warp.changes.scenes import change_of, make_scene
from xew.sim_warp.devices.workers import Workers
from xew.sim_warp.faults import draw_faults
from xew.sim_warp.manifest import Manifest
from xew.sim_warp.production.cells import Job
from xew.sim_warp.tasks import get_task

TRIES_PER_SEED = 3
SPARE_TRIES = 20
"""A task fails if 3 n + 20 seeds have been tried and fewer than n accepted."""
SEEDS_OF_ROBOT = 1000
"""Distance between the first seeds of two robots that share no scenes."""
MOST_UNPAIRED = (SEEDS_OF_ROBOT - SPARE_TRIES) // TRIES_PER_SEED
"""Largest number of accepted seeds per robot that share no scenes."""


FamilyKey = tuple[str, str | int]
"""A task and a family of seeds, or of faulty cells their base seed."""


def family_key(record: Record) -> FamilyKey:
    """The key of the families that a cell is of (`Family.key`)."""
    fault, base = split_fault(record.seed)
    return record.task, base if fault else seed_split(base)


@dataclass
class Family:
    """The seeds of one task and family (`xew.protocol.seed_split`), with their records."""

    task: str
    first_seed: int
    wanted: int
    robots: tuple[str, ...]
    failing: frozenset[int] = frozenset()
    """Seeds on which one of the robots is known to fail."""
    motion: str = SHARED_MOTION
    """Kind of motion of new episodes."""
    change: str = ""
    """Change of new episodes, or RANDOM_CHANGE."""
    done: dict[int, dict[str, Record]] = field(default_factory=lambda: defaultdict(dict))

    @property
    def key(self) -> FamilyKey:
        """The key of its cells, which another robot's family may share."""
        return self.task, seed_split(self.first_seed)

    def add(self, record: Record) -> None:
        """Add the record of a cell."""
        self.done[record.seed][record.robot] = record

    @property
    def tries(self) -> list[int]:
        """The seeds that may be tried."""
        candidates = (seed for seed in itertools.count(self.first_seed) if seed not in self.failing)
        return list(itertools.islice(candidates, TRIES_PER_SEED * self.wanted + SPARE_TRIES))

    @property
    def accepted_seeds(self) -> list[int]:
        """The first complete seeds on which no robot failed, at most `wanted`."""
        good = (seed for seed in sorted(self.done) if not self._missing_robots(seed) and self._is_hopeful(seed))
        return list(itertools.islice(good, self.wanted))

    @property
    def accepted(self) -> int:
        """Number of accepted seeds."""
        return len(self.accepted_seeds)

    def next_jobs(self) -> list[Job]:
        """Missing cells of the first seeds, enough if no further robot fails.

        Failed seeds are completed too: an interrupted run ends like an uninterrupted one.
        """
        jobs: list[Job] = []
        hopeful = 0
        for seed in self.tries:
            if hopeful == self.wanted:
                break
            if missing := self._missing_robots(seed):
                change = change_of(self.change, self.task, seed)
                jobs.append(Job(self.task, seed, missing, not self._is_hopeful(seed), self.motion, change))
            hopeful += self._is_hopeful(seed)
        return jobs

    def _missing_robots(self, seed: int) -> tuple[str, ...]:
        """Robots without a record or, if none has failed, without an episode."""
        done = self.done[seed]
        return tuple(r for r in self.robots if r not in done or (self._is_hopeful(seed) and not done[r].hashes))

    def _is_hopeful(self, seed: int) -> bool:
        """Whether no robot has failed so far."""
        return all(record.is_kept for record in self.done[seed].values())


@dataclass
class FaultFamily(Family):
    """The faulty seeds of one scene, whose base seed is `first_seed`."""

    faults: tuple[int, ...] = ()
    """Numbers of faults in the order in which they are tried."""

    @property
    def key(self) -> FamilyKey:
        return self.task, self.first_seed

    @property
    def tries(self) -> list[int]:
        """The seeds that may be tried."""
        return [join_fault(fault, self.first_seed) for fault in self.faults]


def plan_faults(families: Sequence[Family], variants: int, workers: Workers) -> list[FaultFamily]:
    """The faulty seeds of all accepted scenes; with the expert, each scene is to have `variants` commands."""
    accepted = [(family, seed) for family in families for seed in family.accepted_seeds]
    drawn = dict(workers.run(_draw_faults, [(family.task, seed) for family, seed in accepted]))
    return [_fault_family(family, seed, drawn[family.task, seed], variants - 1) for family, seed in accepted]


def _draw_faults(scene: tuple[str, int]) -> tuple[tuple[str, int], tuple[int, ...]]:
    """A task and seed, and the faults of this scene, drawn in a worker process."""
    name, seed = scene
    task = get_task(name)
    return scene, draw_faults(task.plan, make_scene(task, name, seed))


def _fault_family(family: Family, seed: int, faults: tuple[int, ...], most: int) -> FaultFamily:
    wanted = min(most, len(faults))
    return FaultFamily(family.task, seed, wanted, family.robots, motion=family.motion, change=family.change, faults=faults)


def plan_families(
    tasks: Sequence[str],
    wanted_seeds: Mapping[str, int],
    robots: Mapping[str, Sequence[str]],
    manifest: Manifest,
    *,
    motion: str = SHARED_MOTION,
    change: str = "",
    unpaired: bool = False,
) -> list[Family]:
    """The families of all tasks: one for all robots, or with `unpaired` one per robot with different seeds.

    `wanted_seeds` (numbers of accepted seeds) and `robots` (their keys) are by family of seeds, the keys of SEED_STARTS.
    """
    families = []
    for task in dict.fromkeys(tasks):
        for name, wanted in wanted_seeds.items():
            if name in ("validation", "final") and not wanted:
                continue
            teams = [(robot,) for robot in robots[name]] if unpaired else [tuple(robots[name])]
            for number, team in enumerate(teams):
                first_seed = SEED_STARTS[name] + number * SEEDS_OF_ROBOT
                families.append(Family(task, first_seed, wanted, team, manifest.failing(task, team), motion, change))
    return families


def demand_enough(families: Sequence[Family]) -> None:
    """Raise EpisodeError if a family has too few accepted seeds."""
    short = [
        f"{family.task} with {', '.join(family.robots)}: only {family.accepted} of {family.wanted} seeds were accepted in"
        f" {len(family.tries)} tries."
        for family in families
        if family.accepted < family.wanted
    ]
    if short:
        raise EpisodeError(*short, "The table shows why; make the task easier or exclude a robot.")

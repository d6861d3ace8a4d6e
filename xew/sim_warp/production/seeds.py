"""Scheduling of seeds: which seeds of a task are tried, what is missing of them, and when there are enough.

Reads  headers of what is on disk, and the manifest of seeds that are known to fail
Writes `Job`s

Seeds are tried in order until enough are accepted, that is, until all robots have succeeded on them.
"""

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from xew.episode import EpisodeError, Record
from xew.protocol import SEED_STARTS, SHARED_MOTION
from xew.sim_warp.manifest import Manifest
from xew.sim_warp.production.cells import Job

TRIES_PER_SEED = 3
SPARE_TRIES = 20
"""Numbers of seeds after which a task gives up: 3 n + 20 have been tried and fewer than n accepted."""
SEEDS_OF_ROBOT = 1000
"""Number of seeds from the first of one robot to the first of the next where robots share no scenes."""
MOST_UNPAIRED = (SEEDS_OF_ROBOT - SPARE_TRIES) // TRIES_PER_SEED
"""Largest number of accepted seeds that fit between them."""


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


def plan_families(
    tasks: Sequence[str],
    wanted_seeds: Mapping[str, int],
    robots: Mapping[str, Sequence[str]],
    manifest: Manifest,
    *,
    motion: str = SHARED_MOTION,
    unpaired: bool = False,
) -> list[Family]:
    """The families of all tasks: one of all robots together, or one a robot, each with seeds that no other has.

    Args:
        tasks: keys of the tasks.
        wanted_seeds: numbers of accepted seeds by family of seeds, a key of SEED_STARTS.
        robots: keys of the robots by family of seeds.
        manifest: seeds that are known to fail.
        motion: kind of motion of what is missing.
        unpaired: whether each robot has seeds of its own.
    """
    families = []
    for task in dict.fromkeys(tasks):
        for name, wanted in wanted_seeds.items():
            if name == "validation" and not wanted:
                continue
            teams = [(robot,) for robot in robots[name]] if unpaired else [tuple(robots[name])]
            for number, team in enumerate(teams):
                first_seed = SEED_STARTS[name] + number * SEEDS_OF_ROBOT
                families.append(Family(task, first_seed, wanted, team, manifest.failing(task, team), motion))
    return families


def demand_enough(families: Sequence[Family]) -> None:
    """Raise EpisodeError where the tries of a task are used up."""
    short = [
        f"{family.task} with {', '.join(family.robots)}: only {family.accepted} of {family.wanted} seeds were accepted in"
        f" {len(family.tries)} tries."
        for family in families
        if family.accepted < family.wanted
    ]
    if short:
        raise EpisodeError("\n".join([*short, "The table shows why; make the task easier or leave out a robot."]))

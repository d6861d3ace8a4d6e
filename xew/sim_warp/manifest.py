"""The manifest: seeds that are known to fail, which `generate` skips.

lab/seeds/manifest.py makes seeds.json. On another GPU an accepted seed may fail; generate then continues with further seeds.
"""

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from xew.config import ConfigError, parse
from xew.episode import EpisodeError
from xew.files import read_json
from xew.names import check_name
from xew.protocol import TEST_SEED_START

PACKAGED = Path(__file__).with_name("seeds.json")


@dataclass(frozen=True)
class TaskSeeds:
    """Known seeds of one task."""

    train: tuple[int, ...]
    """Training seeds on which every robot of the manifest succeeded, ascending."""
    test: tuple[int, ...]
    """Test seeds on which every robot of the manifest succeeded, ascending."""
    rejected: dict[str, dict[str, str]] = field(default_factory=dict)
    """Reasons of failure, each one of `xew.episode.FAILURES`, by seed and robot."""


@dataclass(frozen=True)
class Manifest:
    """Seeds by task, with the robots, device and versions of the search."""

    robots: tuple[str, ...] = ()
    device: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    tasks: dict[str, TaskSeeds] = field(default_factory=dict)

    def failing(self, task: str, robots: Collection[str]) -> frozenset[int]:
        """Seeds of a task on which at least one of these robots is known to fail."""
        rejected = self.tasks[task].rejected if task in self.tasks else {}
        return frozenset(int(seed) for seed, failed in rejected.items() if not failed.keys().isdisjoint(robots))


def read_manifest(path: Path = PACKAGED) -> Manifest:
    """Read a manifest. Raises EpisodeError if the file is missing or invalid."""
    try:
        return _check(parse(Manifest, read_json(Path(path)), "its content"))
    except (OSError, ValueError, ConfigError) as error:
        reason = "; ".join(str(error).splitlines())
        raise EpisodeError(
            f"{path} is no manifest of seeds ({reason}); pass another file with --manifest, or omit it."
        ) from error


def _check(manifest: Manifest) -> Manifest:
    """The same manifest. Raises ValueError for invalid names and seeds."""
    for task, seeds in manifest.tasks.items():
        try:
            for name, what in [(task, "task"), *((robot, "robot") for failed in seeds.rejected.values() for robot in failed)]:
                check_name(name, what)
        except EpisodeError as error:
            raise ValueError(str(error)) from error
        for family, low, high in ((seeds.train, 0, TEST_SEED_START), (seeds.test, TEST_SEED_START, 2 * TEST_SEED_START)):
            if any(not low <= seed < high for seed in family) or sorted(set(family)) != list(family):
                raise ValueError(f"{task}: seeds must be whole, ascending and from {low} to {high - 1}, found {family[:5]}…")
        if wrong := [seed for seed in seeds.rejected if not (seed.isascii() and seed.isdecimal())]:
            raise ValueError(f"{task}: rejected seeds must be whole numbers, found {wrong[0]!r}")
        if both := {str(seed) for seed in (*seeds.train, *seeds.test)} & set(seeds.rejected):
            raise ValueError(f"{task}: seeds {sorted(both)} are accepted and rejected")
    return manifest

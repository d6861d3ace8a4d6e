"""The manifest: seeds that are known to fail, found once in physics, so `generate` does not try them.

Reads  seeds.json in this folder, or a file of the same form (lab/seeds/manifest.py makes one)

A seed in the manifest is not a promise: where physics differs a little (another GPU) one may fail, and generate goes on
to seeds that have not been tried.
"""

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cattrs

from xew.episode import EpisodeError
from xew.files import read_json
from xew.names import check_name
from xew.protocol import TEST_SEED_START

PACKAGED = Path(__file__).with_name("seeds.json")


@dataclass(frozen=True)
class TaskSeeds:
    """What is known of one task's seeds."""

    train: tuple[int, ...]
    """Training seeds on which every robot of the manifest succeeded, ascending."""
    test: tuple[int, ...]
    """Test seeds on which every robot of the manifest succeeded, ascending."""
    rejected: dict[str, dict[str, str]] = field(default_factory=dict)
    """Reasons of failure, each one of `xew.episode.FAILURES`, by seed and robot."""


@dataclass(frozen=True)
class Manifest:
    """Seeds by task, and what they were found with."""

    robots: tuple[str, ...] = ()
    device: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    tasks: dict[str, TaskSeeds] = field(default_factory=dict)

    def failing(self, task: str, robots: Collection[str]) -> frozenset[int]:
        """Seeds of a task on which at least one of these robots is known to fail."""
        rejected = self.tasks[task].rejected if task in self.tasks else {}
        return frozenset(int(seed) for seed, failed in rejected.items() if not failed.keys().isdisjoint(robots))


def read_manifest(path: Path = PACKAGED) -> Manifest:
    """A manifest from its file.

    Raises:
        EpisodeError: it is not there or not of this form; the message says where.
    """
    try:
        return _check(_converter().structure(_demand_object(read_json(Path(path))), Manifest))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError, cattrs.BaseValidationError) as error:
        raise EpisodeError(
            f"{path} is no manifest of seeds ({error}); name another file by --manifest, or leave it out"
        ) from error
    except cattrs.ForbiddenExtraKeysError as error:
        raise EpisodeError(f"{path} is no manifest of seeds: unknown keys {sorted(error.extra_fields)}") from error


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(forbid_extra_keys=True, detailed_validation=False)
    converter.register_structure_hook(int, lambda value, _: _demand_whole(value))
    return converter


def _demand_whole(value: Any) -> int:
    if type(value) is not int:
        raise ValueError(f"found {value!r}, expected a whole number")
    return value


def _demand_object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"found {type(value).__name__}, expected an object with tasks")
    return value


def _check(manifest: Manifest) -> Manifest:
    """The same manifest. Raises ValueError for names that could lead out of a folder and for seeds that are none."""
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

"""The manifest: which seeds make the data set, found once in physics so that no user has to search again.

Reads  seeds.json in this folder, or a file of the same form; headers of a data set
Writes a manifest from the headers of a data set: accepted training and test seeds of each task and, of the others, which
       robots failed and why

A seed in the manifest is not a promise: where physics differs a little (another GPU) one may fail, and generate goes on
to seeds that have not been tried.

Command: python -m xew.sim_warp.manifest data --out seeds.json
"""

import json
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import cattrs
import tyro

from xew.config import user_errors
from xew.dataset import explain_missing, find_records
from xew.episode import EpisodeError, Record
from xew.files import hold_lock, read_json, replacing
from xew.names import check_name
from xew.protocol import TEST_SEED_START, seed_split

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
            f"{path} is no manifest of seeds ({error}); make one: python -m xew.sim_warp.manifest DATA --out {path}"
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


def manifest_of(records: Collection[Record]) -> Manifest:
    """What the headers of a data set know of its seeds; seeds that some robot has not tried are left out."""
    robots = sorted({record.robot for record in records})
    cells: dict[str, dict[int, dict[str, Record]]] = defaultdict(lambda: defaultdict(dict))
    for record in records:
        cells[record.task][record.seed][record.robot] = record
    return Manifest(
        tuple(robots),
        next((record.device for record in records), ""),
        next((record.versions for record in records), {}),
        {task: _task_seeds(of_task, set(robots)) for task, of_task in sorted(cells.items())},
    )


def _task_seeds(seeds: dict[int, dict[str, Record]], robots: set[str]) -> TaskSeeds:
    tried = {seed: cells for seed, cells in sorted(seeds.items()) if set(cells) == robots}
    accepted = [seed for seed, cells in tried.items() if all(record.success for record in cells.values())]
    rejected = {
        str(seed): {robot: record.failure or "" for robot, record in sorted(cells.items()) if not record.success}
        for seed, cells in tried.items()
        if seed not in accepted
    }
    return TaskSeeds(
        tuple(seed for seed in accepted if seed_split(seed) == "train"),
        tuple(seed for seed in accepted if seed_split(seed) == "test"),
        rejected,
    )


def to_json(manifest: Manifest) -> str:
    """The text of a manifest's file, a line a task and list, so that a change of one seed is a change of one line."""
    plain = cattrs.unstructure(manifest)
    head = {name: plain[name] for name in ("robots", "device", "versions")}
    tasks = [f"  {json.dumps(task)}: {{\n   {_lines(seeds, '   ')}\n  }}" for task, seeds in plain["tasks"].items()]
    body = ",\n".join(tasks)
    return f'{{\n {_lines(head, " ")},\n "tasks": {{\n{body}\n }}\n}}\n'


def _lines(values: dict[str, Any], indent: str) -> str:
    return f",\n{indent}".join(f"{json.dumps(name)}: {json.dumps(value)}" for name, value in values.items())


@dataclass(frozen=True)
class Args:
    """Which data to read and which file to write."""

    data: Annotated[Path, tyro.conf.Positional]
    out: Path
    """JSON file to write; name the packaged one only to replace what is known of all tasks."""


@user_errors
def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    manifest = manifest_of([record for _, record in find_records(args.data)])
    if not manifest.tasks:
        raise explain_missing(args.data)
    try:
        with hold_lock(args.out), replacing(args.out) as file:
            file.write_text(to_json(manifest))
    except OSError as error:
        raise EpisodeError(f"cannot write {args.out}: {error.strerror}. Choose another file with --out.") from error
    for task, seeds in manifest.tasks.items():
        print(f"{task}: {len(seeds.train)} training and {len(seeds.test)} test seeds, {len(seeds.rejected)} rejected")


if __name__ == "__main__":
    main()

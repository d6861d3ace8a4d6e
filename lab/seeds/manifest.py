"""Build the manifest of seeds (xew/sim_warp/seeds.json) from the headers of a data set.

    python -m lab.seeds.manifest data --out seeds.json

It holds accepted training and test seeds of each task and, of the others, which robots failed and why.
"""

import json
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cattrs
import tyro

from xew.config import user_errors
from xew.dataset import explain_missing, find_records
from xew.episode import EpisodeError, Record
from xew.files import hold_lock, write_text
from xew.protocol import seed_split
from xew.sim_warp.manifest import Manifest, TaskSeeds


def manifest_of(records: Collection[Record]) -> Manifest:
    """What the headers of a data set know of its seeds; seeds that some robot has not tried are left out."""
    robots = sorted({record.robot for record in records})
    cells: dict[str, dict[int, dict[str, Record]]] = defaultdict(lambda: defaultdict(dict))
    for record in (record for record in records if not record.fault):
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
    """The text of a manifest's file, one line per task and list: a change of one seed changes one line."""
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
        with hold_lock(args.out):
            write_text(args.out, to_json(manifest), within=args.out.parent)
    except OSError as error:
        raise EpisodeError(f"cannot write {args.out}: {error.strerror}. Choose another file with --out.") from error
    for task, seeds in manifest.tasks.items():
        print(f"{task}: {len(seeds.train)} training and {len(seeds.test)} test seeds, {len(seeds.rejected)} rejected")


if __name__ == "__main__":
    main()

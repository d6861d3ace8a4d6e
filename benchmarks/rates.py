"""Measured rates from a study that has run, for the estimates of `study --dry-run`.

    python benchmarks/rates.py configs/study_small.yaml --machine "one H100 and 16 cores" [--out studies/small]

Writes the entry of the size of the study's network in xew/analysis/studies/rates.json: times come from the study's ledger,
sizes stay as they were. A kind of step that the study has not done keeps its time.
"""

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from xew.analysis.studies.config import load_study
from xew.analysis.studies.cost import RATES, estimate, find_rates, find_size
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.plan import plan

FIELDS = {
    "generate": "episode_s", "latents": "encode_s", "train": "step_s", "rollout": "rollout_s", "evaluate": "grade_s",
    "distances": "pair_s",
}  # fmt: skip
"""Rate that each kind of step measures."""


@dataclass(frozen=True)
class Args:
    study: Annotated[Path, tyro.conf.Positional]
    """Config of the study."""
    machine: str
    """Machine that it ran on, in words."""
    out: Path | None = None
    """Folder of the study; the config's where left out."""


def main(args: Args) -> None:
    study = load_study(args.study, ["--out", str(args.out)] if args.out else [])
    steps, rates, ledger = plan(study), find_rates(study), Ledger(study.out)
    costs = estimate(study, steps)
    measured = {}
    for kind, field in FIELDS.items():
        done = {n: ledger.record(step) for n, step in steps.items() if step.kind == kind}
        done = {n: record for n, record in done.items() if record.get("status") == "done" and costs[n].amount}
        if done:
            seconds = sum(max(0.0, record["seconds"] - rates.start_s) for record in done.values())
            measured[field] = round(seconds / sum(costs[name].amount for name in done), 3)
    when = f"{args.study.name}, {time.strftime('%Y-%m')}"
    entry = asdict(replace(rates, machine=args.machine, measured=when, **measured))
    rates = json.loads(RATES.read_text(encoding="utf-8")) | {find_size(study): entry}
    RATES.write_text(json.dumps(rates, indent=1) + "\n", encoding="utf-8")
    print(f"{RATES}: {', '.join(f'{name} {value}' for name, value in measured.items()) or 'nothing was measured'}")


if __name__ == "__main__":
    main(tyro.cli(Args))

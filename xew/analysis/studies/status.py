"""Text about a study: what of it is done, what the rest takes, and what failed."""

import sys
from collections.abc import Mapping
from typing import NoReturn

from xew.analysis.studies.config import Study
from xew.analysis.studies.cost import correct_by_ledger, estimate, format_costs, format_duration
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.plan import Step
from xew.analysis.studies.processes import last_lines
from xew.protocol import SEED_STARTS

COLUMNS = ("latents", "train", "rollout", "evaluate")
"""Kinds of steps that the table has a column for; an adaptation stands in the column of training."""


def format_status(study: Study, steps: Mapping[str, Step], ledger: Ledger, failed: Mapping[str, str] | None = None) -> str:
    """A row per variant and a column per kind of step: the time of what is done, FAILED, blocked, begun, or '-'."""
    ledger.find_all_done(steps)
    width = max(map(len, [*(variant.name for variant in study.planned_runs), *study.shifted_runs])) + 2
    lines = [f"{'variant':<{width}}" + "".join(f"{kind:>12}" for kind in COLUMNS)]
    for variant in study.planned_runs:
        training = "adapt" if variant.target else "train"
        names = [f"{training if kind == 'train' else kind}/{variant.name}" for kind in COLUMNS]
        states = (_format_state(steps[name], ledger, failed or {}) for name in names)
        lines.append(f"{variant.name:<{width}}" + "".join(f"{state:>12}" for state in states))
    for name in study.shifted_runs:
        states = (_format_state(steps[f"{kind}/{name}"], ledger, failed or {}) for kind in ("rollout", "evaluate"))
        lines.append(f"{name:<{width}}" + " " * 24 + "".join(f"{state:>12}" for state in states))
    lines += [f"{name:<{width}}{_format_state(steps[name], ledger, failed or {}):>12}" for name in steps if "/" not in name]
    lines += [f"test scenes: seeds from {SEED_STARTS[study.test_family]:,} (family {study.test_family})"]
    return "\n".join(lines)


def _format_state(step: Step, ledger: Ledger, failed: Mapping[str, str]) -> str:
    record = ledger.record(step)
    if step.name in failed:
        return "blocked" if failed[step.name].startswith("needs ") else "FAILED"
    if ledger.outcome(step.name):
        return format_duration(record.get("seconds", 0.0))
    return "begun" if record.get("status") == "begun" else "-"


def format_cost(study: Study, steps: Mapping[str, Step], ledger: Ledger, slots: int) -> str:
    """The estimate of what is left."""
    costs = estimate(study, steps)
    return format_costs(study, steps, costs, correct_by_ledger(costs, steps, ledger, slots), ledger, slots)


def exit_with_failures(failed: Mapping[str, str], ledger: Ledger, steps: Mapping[str, Step]) -> NoReturn:
    """Name what failed with its log and its last lines, and exit with status 1."""
    printed = ""
    for name, reason in failed.items():
        if not reason.startswith("needs "):
            log = ledger.log(steps[name])
            lines = "  " + last_lines(log).replace("\n", "\n  ")
            print(f"FAILED {name}: {reason}; log: {log}", *([lines] if lines != printed else []), sep="\n", file=sys.stderr)
            printed = lines
    blocked = sum(reason.startswith("needs ") for reason in failed.values())
    print(f"{len(failed) - blocked} steps failed, {blocked} could not be made for it; the others are done.", file=sys.stderr)
    raise SystemExit(1)

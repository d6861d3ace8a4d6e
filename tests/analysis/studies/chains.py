"""Studies whose steps cost nothing: a chain of commands that write a file each, and one pass over it."""

from pathlib import Path

from xew.analysis.studies.config import Study
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.machines import Machines, ThisMachine
from xew.analysis.studies.plan import Step
from xew.analysis.studies.runner import StudyRunner

ROOT = Path(__file__).parents[3]
STEPS = "tests.analysis.steps"
CHAIN = (("data", ""), ("left", "data"), ("right", "data"), ("end", "left right"))
"""Steps and what each needs."""


def chain(out: Path, **changes: tuple[str, ...]) -> dict[str, Step]:
    """The steps of CHAIN; `changes` are more arguments of single ones."""
    steps = [
        Step("train", name, (STEPS, str(out / name), name, *changes.get(name, ())), tuple(f"train/{n}" for n in needs.split()),
             list(changes.get(name, ())), out / name)
        for name, needs in CHAIN
    ]  # fmt: skip
    return {step.name: step for step in steps}


def begun(out: Path) -> dict[str, int]:
    """How often each step was started."""
    return {path.stem: len(path.read_text().splitlines()) for path in out.glob("*.begun")}


def run(study: Study, steps: dict[str, Step], machines: Machines | None = None) -> dict[str, str]:
    """One pass over the steps; what failed."""
    machines = machines or ThisMachine((), 2, {})
    return StudyRunner(study, steps, Ledger(study.out), machines, dict.fromkeys(steps, 1.0)).run()

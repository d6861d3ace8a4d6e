"""The loop of a study: skips what is done, starts what can be started, and notes what ended."""

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from graphlib import TopologicalSorter
from pathlib import Path

from xew.analysis.studies.config import Study
from xew.analysis.studies.cost import correct_by_ledger, critical_paths, estimate, format_duration
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.machines import Machines
from xew.analysis.studies.plan import Step, count_sharing
from xew.dataset import find_accepted
from xew.protocol import seed_split

FINISHING = ("rollout", "evaluate")
"""Kinds of steps that make scores of what is trained: where time is short they come before those that only begin something."""


@dataclass
class StudyRunner:
    """One pass over a study's graph of steps, in which the step on the longest critical path starts first."""

    study: Study
    steps: Mapping[str, Step]
    ledger: Ledger
    machines: Machines
    critical_paths: Mapping[str, float]
    budget: "Budget | None" = None
    """Time after which nothing may run, if there is such a time."""
    only: Collection[str] = ()
    started: dict[str, tuple[float, int | None]] = field(default_factory=dict)
    """Start times of the steps that run [s], and their numbers of GPUs."""
    settled: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    """Steps that failed, and steps that could not be made because of them, with the reason."""

    def run(self) -> dict[str, str]:
        """Run every step that can be run, is wanted and fits the time; returns those that failed, with the reason."""
        order = TopologicalSorter({name: step.predecessors for name, step in self.steps.items()})
        order.prepare()
        self.ledger.find_all_done(self.steps)
        waiting: set[str] = set()
        try:
            while order.is_active():
                waiting |= set(order.get_ready())
                ended = self._settle_or_start(waiting)
                if not ended and not self.started:
                    break  # none of those that are left is wanted, or there is no time for any
                if not ended:
                    ended = [self._finish(name, code) for name, code in self.machines.wait()]
                order.done(*ended)
                self.settled += len(ended)
        except BaseException:
            self.machines.stop()
            raise
        return self.failed

    def _settle_or_start(self, waiting: set[str]) -> list[str]:
        """Start what there is room for; returns steps that need no work or cannot be made."""
        ended = []
        for name in sorted(waiting, key=self.budget.rank if self.budget else lambda name: -self.critical_paths[name]):
            step = self.steps[name]
            reason = self._find_blocker(step)
            if reason:
                self.failed[name] = reason
            elif not self.ledger.find_done(step):
                if self._is_wanted(step) and self.machines.has_room_for(step):
                    self._start(step, waiting)
                    waiting.discard(name)
                continue
            waiting.discard(name)
            ended.append(name)
        return ended

    def _is_wanted(self, step: Step) -> bool:
        return (not self.only or step.kind in self.only) and (self.budget is None or self.budget.fits(step.name))

    def _find_blocker(self, step: Step) -> str:
        """Why a step cannot be made, or ''. The analysis needs no particular step."""
        missing = [name for name in step.needs if name in self.failed]
        if not missing or (step.kind == "analyse" and list_graded_variants(step, self.failed)):
            return ""
        return f"needs {missing[0]}"

    def _start(self, step: Step, waiting: Collection[str]) -> None:
        goes_on = self.ledger.begin(step)
        command, begin = complete_command(step, goes_on, self.failed), time.monotonic()
        gpus = self.machines.start(step, command, self.ledger.log(step), self._count_sharing(step, waiting))
        self.started[step.name] = begin, gpus
        self._print_progress(f"{step.name}{f' on {gpus} GPUs' if (gpus or 0) > 1 else ''}{', goes on' if goes_on else ''}")

    def _count_sharing(self, step: Step, waiting: Collection[str]) -> int:
        """Number of steps that the free GPUs are divided among."""
        ended = {name for name in self.steps if self.ledger.outcome(name)}
        begun = ended | self.failed.keys() | self.started.keys()
        left = {name for name, other in self.steps.items() if name not in begun and self._is_wanted(other)}
        return count_sharing(step, self.steps, left, left.intersection(waiting), ended)

    def _finish(self, name: str, code: int) -> str:
        begin, gpus = self.started.pop(name)
        step, seconds = self.steps[name], time.monotonic() - begin
        error = self.ledger.finish(step, code, seconds, gpus)
        if self.budget is not None and not error:
            self.budget.learn(self.ledger)
        if not error and step.kind == "generate":
            error = self._check_data(step.product)
        if error:
            self.failed[name] = error
        self._print_progress(f"{name} {'FAILED: ' + error if error else 'done'} after {format_duration(seconds)}")
        return name

    def _check_data(self, data: Path) -> str:
        """What a data set holds beyond the study, or '': its models would be trained and graded on that, too."""
        study, accepted = self.study, [record for _, record in find_accepted(data)]
        tasks, robots = ({getattr(record, name) for record in accepted} for name in ("task", "robot"))
        beyond = sorted(tasks - set(study.tasks or tasks)) + sorted(robots - set(study.robot_keys))
        experts = [record for record in accepted if not record.fault]  # a model learns from others only by train.faults
        for family, wanted in (("train", study.train_seeds), (study.test_family, study.test_seeds)):
            seeds = {(record.task, record.seed) for record in experts if seed_split(record.seed) == family}
            more = max((len([1 for task, _ in seeds if task == name]) for name in tasks), default=0) - wanted
            beyond += [f"{more} more {family} seeds a task"] if more > 0 else []
        if any(record.fault and seed_split(record.seed) == study.test_family for record in accepted):
            beyond.append(f"faulty {study.test_family} episodes")
        found = ", ".join(beyond)
        return f"{data} also holds {found}; name them in the study, or give it its own data" if found else ""

    def _print_progress(self, text: str) -> None:
        print(f"{time.strftime('%H:%M:%S')} [{self.settled}/{len(self.steps)}] {text}", flush=True)


class Budget:
    """Time limit of a study: trained models are graded first, and no run starts that could not be graded in time.

    Training runs come in the order of the plan, adaptations directly after the run that they start from.
    """

    def __init__(self, study: Study, steps: Mapping[str, Step], ledger: Ledger, seconds: float, slots: int = 1) -> None:
        self._steps, self._costs, self._slots = steps, estimate(study, steps), slots
        self._end = time.monotonic() + seconds
        self._order = {name: place for place, name in enumerate(steps)}
        self.learn(ledger)

    def learn(self, ledger: Ledger) -> None:
        """Estimate again, by how long steps of each kind have taken."""
        seconds = correct_by_ledger(self._costs, self._steps, ledger, self._slots)
        paths = critical_paths({name: step for name, step in self._steps.items() if step.kind != "analyse"}, seconds, own=True)
        self._seconds = seconds | paths

    def rank(self, name: str) -> tuple[int, int]:
        """Sort key: what every table has and what was trained comes first, then adaptations, then the plan's order."""
        kind, _, variant = name.partition("/")
        finishing, adapting = kind in ("baselines", *FINISHING), f"adapt/{variant}" in self._order
        return 0 if finishing else 1 if adapting else 2, self._order[name]

    def fits(self, name: str) -> bool:
        """Whether a step and its followers up to the variant's grades would end in time; trained models are always finished."""
        seconds = 0.0 if name.partition("/")[0] in FINISHING else self._seconds[name]
        return time.monotonic() + seconds <= self._end


def complete_command(step: Step, goes_on: bool, failed: Mapping[str, str]) -> tuple[str, ...]:
    """A step's command with what is known at its start only: whether a training goes on, what the analysis has."""
    if step.kind in ("train", "adapt") and goes_on:
        return (*step.command, "--resume")
    if step.kind == "analyse":
        measured = "distances" in step.needs and "distances" not in failed
        folder = ("--distances", str(Path(step.command[1], "distances"))) if measured else ()
        return (*step.command, *list_graded_variants(step, failed), *folder)
    return step.command


def list_graded_variants(analyse: Step, failed: Mapping[str, str]) -> list[str]:
    """Names of the variants that an analysis has scores of."""
    return [name.partition("/")[2] for name in analyse.needs if name.startswith("evaluate/") and name not in failed]

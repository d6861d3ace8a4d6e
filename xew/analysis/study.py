"""A whole study by one command: generate, encode, train, adapt, roll out, grade and report every cell of it; resumable.

Reads  a study's config (configs/study_*.yaml)
Writes <out>/: data, latents, configs, runs, rollouts, scores; scores.parquet, report/; state/ and logs/ of every cell

    python -m xew.analysis.study configs/study_debug.yaml [--dry-run] [--redo 'train/loeo_*'] [--out DIR and other overrides]

Stop it at any time, also by kill -9, and give it again: what is done is skipped, what was begun goes on. A cell that fails is
named with its log; the others go on, and the exit status is 1.
"""

import argparse
import contextlib
import fcntl
import fnmatch
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any, NoReturn

from xew.analysis.studies.cell import last_lines
from xew.analysis.studies.config import Study, load_study
from xew.analysis.studies.cost import corrected, cost_table, duration, estimate, longest_ways
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.machines import Machines, gpus_of, open_machines
from xew.analysis.studies.plan import STAGES, Cell, in_order, plan, write_configs
from xew.config import ConfigError, save, user_errors
from xew.dataset import find_accepted
from xew.protocol import seed_split

CHECK_CONFIGS = """
import sys
from xew.config import user_errors
from xew.model.experiment import load_experiment
user_errors(lambda: [load_experiment(path) for path in sys.argv[1:]])()
"""
"""Run in a process of its own, for the analysis does not import the model."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Plan, estimate, run, report."""
    parser = argparse.ArgumentParser(prog="python -m xew.analysis.study", description=__doc__.splitlines()[0])
    parser.add_argument("config", type=Path, help="a YAML file; every field may be overridden, as in --machine.workers 2")
    parser.add_argument("--dry-run", action="store_true", help="show what is done, what is to do and what it takes; do nothing")
    parser.add_argument("--redo", nargs="+", default=[], metavar="CELL", help="cells to make anew, such as 'train/loeo_*'")
    args, overrides = parser.parse_known_args(arguments)
    study = load_study(args.config, overrides)
    cells, ledger = plan(study), Ledger(study.out)
    if args.dry_run:
        check_configs([study.experiment])
        print(
            status(study, cells, ledger), cost(study, cells, ledger, len(gpus_of(study)) or study.machine.workers), sep="\n\n"
        )
        return
    with alone(study.out), stoppable():
        prepare(study)
        for cell in chosen(cells, args.redo):
            ledger.forget(cell)
        machines = open_machines(study)
        print(status(study, cells, ledger), cost(study, cells, ledger, machines.slots), sep="\n\n", flush=True)
        seconds = corrected(estimate(study, cells), cells, ledger)
        failed = Run(study, cells, ledger, machines, longest_ways(cells, seconds)).to_the_end()
        table = status(study, cells, ledger, failed)
        (study.out / "status.txt").write_text(table + "\n")
    print(table)
    if failed:
        tell_failures(failed, ledger, cells)
    print(f"report: {study.out / 'report' / 'index.html'}")


def prepare(study: Study) -> None:
    """Write the configs of the study and of all variants, and have the model check those that are new."""
    try:
        changed = write_configs(study)
        save(study, study.out / "study.yaml")
    except OSError as error:
        raise ConfigError(f"cannot write the study {study.out}: {error}; choose another --out.") from error
    if changed:
        try:
            check_configs(list(changed.values()))
        except ConfigError:
            for path in changed.values():
                path.unlink()
            raise


def check_configs(paths: Sequence[Path]) -> None:
    """Raises ConfigError with what the model says if it does not accept one of these experiments."""
    told = subprocess.run([sys.executable, "-c", CHECK_CONFIGS, *map(str, paths)], capture_output=True, text=True)
    if told.returncode:
        raise ConfigError(f"the model does not accept the study's experiments.\n{told.stderr.strip().removeprefix('error: ')}")


def chosen(cells: Mapping[str, Cell], patterns: Sequence[str]) -> list[Cell]:
    """Cells whose names match. Raises ConfigError for a pattern that none matches."""
    for pattern in patterns:
        if not fnmatch.filter(cells, pattern):
            raise ConfigError(f"--redo {pattern} matches no cell; there are {', '.join(cells)}.")
    return [cell for name, cell in cells.items() if any(fnmatch.fnmatch(name, pattern) for pattern in patterns)]


@contextlib.contextmanager
def alone(out: Path) -> Iterator[None]:
    """Raises ConfigError while another process runs a study in the same folder."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = (out / ".lock").open("w")
    except OSError as error:
        raise ConfigError(f"cannot write the study {out}: {error}; choose another --out.") from error
    with lock as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ConfigError(
                f"another process runs the study {out}; wait for it, stop it, or choose another --out."
            ) from error
        yield


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """SIGTERM, as Slurm sends it before it kills, stops a study as Ctrl-C does."""

    def stop(number: int, frame: Any) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@dataclass
class Run:
    """One pass over the graph: what is done is skipped, what can start is started, the longest way to the end first."""

    study: Study
    cells: Mapping[str, Cell]
    ledger: Ledger
    machines: Machines
    ways: Mapping[str, float]
    """Seconds from the start of each cell to the end of the study."""
    started: dict[str, float] = field(default_factory=dict)
    settled: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    """Cells that failed, and cells that could not be made for it, with the reason."""

    def to_the_end(self) -> dict[str, str]:
        """Run all that can be run; returns what failed."""
        order = TopologicalSorter({name: cell.needs for name, cell in self.cells.items()})
        order.prepare()
        waiting: set[str] = set()
        try:
            while order.is_active():
                waiting |= set(order.get_ready())
                ended = self._settle_or_start(waiting)
                if not ended:
                    ended = [self._finish(name, code) for name, code in self.machines.wait()]
                order.done(*ended)
                self.settled += len(ended)
        except BaseException:
            self.machines.stop()
            raise
        return self.failed

    def _settle_or_start(self, waiting: set[str]) -> list[str]:
        """Start what there is room for; returns cells that need no work or cannot be made."""
        ended = []
        for name in sorted(waiting, key=lambda name: -self.ways[name]):
            cell = self.cells[name]
            reason = self._blocked(cell)
            if reason:
                self.failed[name] = reason
            elif not self.ledger.find_done(cell):
                if self.machines.room_for(cell):
                    waiting.discard(name)
                    self._start(cell)
                continue
            waiting.discard(name)
            ended.append(name)
        return ended

    def _blocked(self, cell: Cell) -> str:
        """Why a cell cannot be made, or ''. The analysis is of whatever was graded."""
        wrong = [name for name in cell.needs if name in self.failed]
        if not wrong or (cell.stage == "analyse" and graded(cell, self.failed)):
            return ""
        return f"needs {wrong[0]}"

    def _start(self, cell: Cell) -> None:
        goes_on = self.ledger.begin(cell)
        self.started[cell.name] = time.monotonic()
        self._tell(f"{cell.name}{', goes on' if goes_on else ''}")
        self.machines.start(cell, command_of(cell, goes_on, self.failed), self.ledger.log(cell))

    def _finish(self, name: str, code: int) -> str:
        cell, seconds = self.cells[name], time.monotonic() - self.started.pop(name)
        error = self.ledger.finish(cell, code, seconds)
        if not error and cell.stage == "generate":
            error = self._check_data()
        if error:
            self.failed[name] = error
        self._tell(f"{name} {'FAILED: ' + error if error else 'done'} after {duration(seconds)}")
        return name

    def _check_data(self) -> str:
        """Nothing, or what the data set holds beyond the study: its models would be trained and graded on that, too."""
        study, accepted = self.study, [record for _, record in find_accepted(self.study.data_folder)]
        tasks, robots = ({getattr(record, name) for record in accepted} for name in ("task", "robot"))
        beyond = sorted(tasks - set(study.tasks or tasks)) + sorted(robots - set(study.robots))
        for family, wanted in (("train", study.train_seeds), ("test", study.test_seeds)):
            seeds = {(record.task, record.seed) for record in accepted if seed_split(record.seed) == family}
            more = max((len([1 for task, _ in seeds if task == name]) for name in tasks), default=0) - wanted
            beyond += [f"{more} more {family} seeds a task"] if more > 0 else []
        found = ", ".join(beyond)
        return f"{study.data_folder} also holds {found}; name them in the study, or give it its own data" if found else ""

    def _tell(self, text: str) -> None:
        print(f"{time.strftime('%H:%M:%S')} [{self.settled}/{len(self.cells)}] {text}", flush=True)


def command_of(cell: Cell, goes_on: bool, failed: Mapping[str, str]) -> tuple[str, ...]:
    """A cell's command, with what only its start tells: whether a training goes on, what the analysis has."""
    if cell.stage in ("train", "adapt") and goes_on:
        return (*cell.command, "--resume")
    if cell.stage == "analyse":
        distances = "distances" in cell.needs and "distances" not in failed
        folder = ("--distances", str(Path(cell.command[1], "distances"))) if distances else ()
        return (*cell.command, *graded(cell, failed), *folder)
    return cell.command


def graded(analyse: Cell, failed: Mapping[str, str]) -> list[str]:
    """Names of the variants that an analysis has scores of."""
    return [name.partition("/")[2] for name in analyse.needs if name.startswith("evaluate/") and name not in failed]


def find_done(cells: Mapping[str, Cell], ledger: Ledger) -> None:
    """Ask every cell in order whether it is done."""
    for cell in in_order(cells):
        if all(ledger.outcome(name) for name in cell.needs):
            ledger.find_done(cell)


def cost(study: Study, cells: Mapping[str, Cell], ledger: Ledger, slots: int) -> str:
    """The estimate of what is left."""
    costs = estimate(study, cells)
    return cost_table(study, cells, costs, corrected(costs, cells, ledger), ledger, slots)


def status(study: Study, cells: Mapping[str, Cell], ledger: Ledger, failed: Mapping[str, str] | None = None) -> str:
    """A row per variant and a column per stage: the time of what is done, FAILED, blocked, begun, or nothing yet."""
    find_done(cells, ledger)
    columns = [stage for stage in STAGES if stage in ("latents", "train", "rollout", "evaluate")]
    width = max(len(variant.name) for variant in study.planned) + 2
    lines = [f"{'variant':<{width}}" + "".join(f"{stage:>12}" for stage in columns)]
    for variant in study.planned:
        training = "adapt" if variant.target else "train"
        names = [f"{training if stage == 'train' else stage}/{variant.name}" for stage in columns]
        lines.append(f"{variant.name:<{width}}" + "".join(f"{_state(cells[name], ledger, failed or {}):>12}" for name in names))
    lines += [f"{name:<{width}}{_state(cells[name], ledger, failed or {}):>12}" for name in cells if "/" not in name]
    return "\n".join(lines)


def _state(cell: Cell, ledger: Ledger, failed: Mapping[str, str]) -> str:
    record = ledger.record(cell)
    if cell.name in failed:
        return "blocked" if failed[cell.name].startswith("needs ") else "FAILED"
    if ledger.outcome(cell.name):
        return duration(record.get("seconds", 0.0))
    return "begun" if record.get("status") == "begun" else "-"


def tell_failures(failed: Mapping[str, str], ledger: Ledger, cells: Mapping[str, Cell]) -> NoReturn:
    """Name what failed with its log and its last words, and end with status 1."""
    told = ""
    for name, reason in failed.items():
        if not reason.startswith("needs "):
            log = ledger.log(cells[name])
            words = "  " + last_lines(log).replace("\n", "\n  ")
            print(f"FAILED {name}: {reason}; log: {log}", *([words] if words != told else []), sep="\n", file=sys.stderr)
            told = words
    blocked = sum(reason.startswith("needs ") for reason in failed.values())
    print(f"{len(failed) - blocked} cells failed, {blocked} could not be made for it; the others are done.", file=sys.stderr)
    raise SystemExit(1)


if __name__ == "__main__":
    main()

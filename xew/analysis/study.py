"""A whole study by one command: generate, encode, train, adapt, roll out, grade and report; resumable.

Reads  a study's config (configs/study_*.yaml)
Writes <out>/: data, latents, configs, runs, rollouts, scores; scores.parquet, report/; state/ and logs/ of every step

    python -m xew.analysis.study configs/study_debug.yaml [--dry-run] [--redo 'train/loeo_*'] [--out DIR and other overrides]

Stop it at any time and run it again: it skips what is done and resumes the rest. A failed step is named with its log; other
steps continue, and the exit status is 1.
"""

import contextlib
import fnmatch
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

import tyro

from xew.analysis.studies.config import KINDS, Study, check_study
from xew.analysis.studies.cost import correct_by_ledger, critical_paths, estimate
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.machines import open_machines, usable_gpus
from xew.analysis.studies.merge import merge_piece
from xew.analysis.studies.plan import Step, plan, write_configs
from xew.analysis.studies.power import format_power
from xew.analysis.studies.runner import Budget, StudyRunner
from xew.analysis.studies.status import exit_with_failures, format_cost, format_status
from xew.config import ConfigError, admit_named, load, read_yaml, save, suggestion, user_errors
from xew.files import hold_lock, write_text

CHECK_CONFIGS = """
import sys
from xew.config import user_errors
from xew.metrics.grading.settings import check_weights
from xew.model.experiment import load_experiment
user_errors(lambda: [check_weights(), *map(load_experiment, sys.argv[1:])])()
"""
"""Program that checks experiments, and that what metrics need is installed, in its own process, since the analysis does
not import the model."""


@dataclass(frozen=True)
class Args:
    """Run a whole study: generate, encode, train, adapt, roll out, grade and report; resumable.

    Every field of the study's config may be overridden, as in --machine.workers 2.
    """

    config: Annotated[Path, tyro.conf.Positional]
    """YAML file of the study."""
    study: Annotated[Study, tyro.conf.arg(name="")]
    """The study that the file describes, with overrides."""
    dry_run: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show what is done, what is left and its cost, and run nothing."""
    scores: Annotated[Path | None, tyro.conf.arg(metavar="{None}|PATH")] = None
    """Score table of an earlier study: --dry-run also estimates how many runs, scenes and bodies each claim needs. Default: the
    study's own, if it exists."""
    redo: Annotated[tuple[str, ...], tyro.conf.arg(metavar="STEP [STEP ...]")] = ()
    """Run these steps again, such as 'train/loeo_*'."""
    minutes: Annotated[float | None, tyro.conf.arg(metavar="{None}|FLOAT")] = None
    """Time limit: start no step that would not be graded by then, as estimated."""
    only: tuple[str, ...] = ()
    """Kinds of steps to run, such as 'generate latents train rollout'; default: all."""
    merge: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PIECE [PIECE ...]")] = ()
    """Merge these folders of the same study from other machines, and run nothing."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Plan, estimate, run and report."""
    args = read_arguments(sys.argv[1:] if arguments is None else arguments)
    study = args.study
    admit_named([study, read_yaml(study.experiment)])  # their steps then know these names in data and runs
    steps, ledger = plan(study), Ledger(study.out)
    if args.dry_run:
        check_configs([study.experiment])
        slots = len(usable_gpus(study)) or study.machine.workers
        print(format_status(study, steps, ledger), format_cost(study, steps, ledger, slots), sep="\n\n")
        print(describe_power(args))
        return
    with lock_study(study.out), stop_on_sigterm():
        prepare(study)
        for step in select_steps(steps, args.redo):
            ledger.forget(step)
        failed = merge_pieces(steps, ledger, args.merge) if args.merge else run_steps(args, steps, ledger)
        table = format_status(study, steps, ledger, failed)
        write_text(study.out / "status.txt", table + "\n", within=study.out)
    print(table)
    if failed:
        exit_with_failures(failed, ledger, steps)
    left = [name for name in steps if not ledger.outcome(name)]
    print(f"{len(left)} steps are left" if left else f"report: {study.out / 'report' / 'index.html'}")


def describe_power(args: Args) -> str:
    """Text on the power of an earlier study's scores, or of the study's own. Raises ConfigError for scores that are named."""
    own = args.study.out / "scores.parquet"
    if args.scores is None and not own.exists():
        return ""
    try:
        return f"\n{format_power(args.scores or own)}"
    except ConfigError as error:
        if args.scores is not None:
            raise
        return f"\n{error}"


def run_steps(args: Args, steps: Mapping[str, Step], ledger: Ledger) -> dict[str, str]:
    """Run what is left and wanted, within a time if there is one; returns the steps that failed, with the reason."""
    study, machines = args.study, open_machines(args.study)
    print(format_status(study, steps, ledger), format_cost(study, steps, ledger, machines.slots), sep="\n\n", flush=True)
    slots = max(1, machines.slots)
    seconds = correct_by_ledger(estimate(study, steps), steps, ledger, slots)
    budget = None if args.minutes is None else Budget(study, steps, ledger, 60 * args.minutes, slots)
    return StudyRunner(study, steps, ledger, machines, critical_paths(steps, seconds), budget, args.only).run()


def merge_pieces(steps: Mapping[str, Step], ledger: Ledger, pieces: Sequence[Path]) -> dict[str, str]:
    """Take over what pieces of the study have done and say how much; returns no failed steps. Raises ConfigError."""
    for piece in pieces:
        print(f"{piece}: {len(merge_piece(steps, ledger, piece))} steps taken over")
    return {}


def read_arguments(arguments: Sequence[str]) -> Args:
    """The command line with the study of its config and overrides.

    Raises:
        ConfigError: the config cannot be read, or the study names something that does not exist.
        SystemExit: an option is unknown or malformed (code 2), or --help was asked for (code 0).
    """
    prog = "python -m xew.analysis.study"
    path = next((Path(argument) for argument in arguments if not argument.startswith("-")), None)
    if path is None:
        return tyro.cli(Args, args=arguments, prog=prog)
    args = tyro.cli(Args, args=arguments, prog=prog, default=Args(path, load(Study, path)))
    check_study(args.study, path)
    check_kinds(args.only)
    return args


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
    """Raises ConfigError if the model does not accept one of these experiments, or metrics lack their weights."""
    command = [sys.executable, "-c", CHECK_CONFIGS, *map(str, paths)]
    checked = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace")
    if checked.returncode:
        message = checked.stderr.strip().removeprefix("error: ")
        raise ConfigError("the study's experiments cannot be run here.", *message.splitlines())


def check_kinds(names: Sequence[str]) -> None:
    """Raise ConfigError for a name that is no kind of step."""
    for name in names:
        if name not in KINDS:
            raise ConfigError(f"--only {name} is no kind of step;{suggestion(name, KINDS)} there are {', '.join(KINDS)}.")


def select_steps(steps: Mapping[str, Step], patterns: Sequence[str]) -> list[Step]:
    """Steps whose names match one of the patterns. Raises ConfigError for a pattern that matches none."""
    for pattern in patterns:
        if not fnmatch.filter(steps, pattern):
            raise ConfigError(f"--redo {pattern} matches no step; there are {', '.join(steps)}.")
    return [step for name, step in steps.items() if any(fnmatch.fnmatch(name, pattern) for pattern in patterns)]


@contextlib.contextmanager
def lock_study(out: Path) -> Iterator[None]:
    """Make a study's folder and hold its lock. Raises ConfigError or, if another process runs it, EpisodeError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot write the study {out}: {error}; choose another --out.") from error
    with hold_lock(out):
        yield


@contextlib.contextmanager
def stop_on_sigterm() -> Iterator[None]:
    """Let SIGTERM, as Slurm sends it before it kills, stop a study as Ctrl-C does."""

    def stop(number: int, frame: Any) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


if __name__ == "__main__":
    main()

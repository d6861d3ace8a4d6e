"""The command that grades rollouts against the episodes that they predict: list the videos, open graders, grade, write.

Reads  <rollouts>/<task>/<seed>/<robot>/ (xew.rollout) and the same folders of the data set
Writes scores.parquet, one row per model, condition, task, seed, robot and metric; next to it
       scores.curves.parquet (the same by frame), scores.summary.md and .csv (means, intervals, noise), scores.pairs.csv
       (differences between models), scores.power.csv (on which tasks a metric distinguishes a frozen frame from the truth),
       scores.bundle.json (what others need to check all this), scores.cells/ (to go on from);
       <data>-baselines/, the baselines' scores, for every table on the same data

    python -m xew.metrics.evaluate demo/rollouts --data demo/data --out demo/scores.parquet
    python -m xew.metrics.evaluate demo/rollouts --data demo/data --check demo/scores.bundle.json --regrade 5
    python -m xew.metrics.evaluate --data demo/data --baselines-of test --out demo/baselines.parquet
"""

import gc
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from xew.config import ConfigError, user_errors
from xew.episode import EpisodeError, verify_episode
from xew.files import hold_lock
from xew.metrics import METRICS
from xew.metrics.grading.baselines import BASELINES
from xew.metrics.grading.bundle import Bundle, differences, disagreements, raise_if_any, read_bundle
from xew.metrics.grading.grade_episodes import describe_results, group_jobs
from xew.metrics.grading.list_jobs import list_jobs
from xew.metrics.grading.open_graders import grade_groups, open_grader, prepare_graders, prepare_process
from xew.metrics.grading.scores import check_out
from xew.metrics.grading.settings import Args, resolve
from xew.metrics.grading.write_scores import write_scores

SECONDS_IN_LOGS = 10.0
"""Shortest time between two lines of progress that are not on a terminal."""


@user_errors
def main(args: Args) -> None:
    """Grade, write, and print what came out; or check a bundle."""
    prepare_process(args.trust)
    if args.check is not None:
        check(args, args.check)
        return
    check_out(args.out)
    with hold_lock(args.out):
        grade_tables(args)


def grade_tables(args: Args) -> None:
    """Grade, write the tables and print the summary. Raises EpisodeError where a rollout could not be graded."""
    settings = resolve(args)
    prepare_graders()
    listing = list_jobs(settings)
    groups, total = group_jobs(settings, listing.jobs), len(listing.jobs)
    interval = 0.1 if sys.stderr.isatty() else SECONDS_IN_LOGS
    before = total - sum(map(len, groups))
    with tqdm(total=total, initial=before, desc="evaluate", unit="video", mininterval=interval) as bar:
        results = list(grade_groups(settings, listing.codecs, groups, bar.update))
    errors = [*listing.errors, *(error for result in results for error in result.errors)]
    print(*filter(None, [describe_results(results, total)]), write_scores(settings, listing), sep="\n")
    if errors:
        total = len(listing.jobs) + len(listing.errors)
        raise EpisodeError(f"{len(errors)} of {total} could not be graded:", *(f"  {error}" for error in errors))


def check(args: Args, path: Path) -> None:
    """Check a bundle against itself, and against rollouts, data and new grading if they are named. Raises ConfigError."""
    bundle = read_bundle(path)
    print(f"{path}: {len(bundle['samples'])} videos, whole, and its means are those of its values")
    if not args.rollouts:
        return
    _demand_codecs(path, bundle, args)
    settings = replace(resolve(args), metrics=tuple(name for name in bundle["metrics"] if name in METRICS))
    graded_models = {sample["model"] for sample in bundle["samples"]}
    listing = list_jobs(settings, [name for name in BASELINES if name in graded_models])
    raise_if_any(path, differences(bundle, settings.choices, [job.cell for job in listing.jobs]))
    print("made from these rollouts and this data, by their digests")
    grader = open_grader(settings, listing.codecs, threading.Event())
    picked = [listing.jobs[i] for i in np.unique(np.linspace(0, len(listing.jobs) - 1, args.regrade).astype(int))]
    changes: list[str] = []
    for job in tqdm(picked, desc="grade again", unit="video", disable=None):
        verify_episode(job.episode)
        episode = grader.read_episode([(job, settings.metrics)])
        changes += disagreements(bundle, job.cell.key, grader.grade(job, episode, settings.metrics).values)
    raise_if_any(path, changes)
    if picked:
        print(f"{len(picked)} videos graded again: the same scores")


def _demand_codecs(path: Path, bundle: Bundle, args: Args) -> None:
    if bundle.get("codecs") and not args.codec:
        raise ConfigError(
            f"{path} has the truth through the codecs of {', '.join(sorted(bundle['codecs']))}; name these runs: --codec RUN."
        )


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m xew.metrics.evaluate"))
    gc.freeze()  # Python would go through all that is imported once more at its end, for nothing

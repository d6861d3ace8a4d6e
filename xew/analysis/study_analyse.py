"""The end of a study: its merged score table, with the plan in its attribute `study`, and the report.

Reads  <study>/study.yaml, scores/<variant>.parquet, data, rollouts
Writes <study>/scores.parquet with the column `variant`, its curves, and report/

    python -m xew.analysis.study_analyse STUDY [VARIANT ...]
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from xew.analysis import report
from xew.analysis.scores import TRAINING, VARIANT, Scores, merge_scores, write_scores
from xew.analysis.studies.config import Study, load_study
from xew.config import ConfigError, admit, demand_admitted, load, user_errors
from xew.dataset import view_folder
from xew.files import check_place, hold_lock, remove_written
from xew.protocol import TASK_COUNT, TEST_SEEDS_PER_TASK, TRAIN_SEEDS_PER_TASK, expected_counts


@dataclass(frozen=True)
class Args:
    """Merge the scores of a study's variants and write its report."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    variants: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Training runs to report; default: all that have scores."""
    rollouts: Path | None = None
    """Folder of rollouts by variant, for pictures; default: <study>/rollouts. Some scenes of some variants suffice."""
    data: Path | None = None
    """Data set that holds these scenes; the study's where left out."""
    distances: Path | None = None
    """Folder of python -m xew.analysis.distance; without it the report has the paper's distances."""
    trust: tuple[str, ...] = ()
    """Modules with custom tasks, such as my_lab.tasks, that the study may name."""


@user_errors
def main(args: Args) -> None:
    """Merge the tables, write the merged one and its report."""
    admit(args.trust)
    path = args.study / "study.yaml"
    demand_admitted(load(Study, path), str(path))
    study = load_study(path)
    with hold_lock(args.study / "scores.parquet"):  # a study that runs this as its last step holds the folder's
        merge_and_report(args, replace(study, out=args.study))


def merge_and_report(args: Args, study: Study) -> None:
    """Write the merged table of what is graded, and its report. Raises ConfigError where nothing is."""
    planned = {run.name: run for run in study.planned_runs}
    asked = args.variants or tuple(name for name in (*planned, *study.shifted_runs) if study.scores_path(name).exists())
    shifted = tuple(study.scores_path(name) for name in asked if name in study.shifted_runs)
    graded = tuple(name for name in asked if name not in study.shifted_runs)
    if not graded:
        raise ConfigError(f"{args.study} has no graded variant yet; run python -m xew.analysis.study {args.study}/study.yaml")
    tables = [(planned[name].of if name in planned else name, study.scores_path(name)) for name in graded]
    seeds = [(planned[name].seed or 0) if name in planned else 0 for name in graded]
    if study.baselines_path.exists():
        tables, seeds = [("baselines", study.baselines_path), *tables], [0, *seeds]
    merged = merge_scores(tables, trainings=seeds if study.training_seeds else ())
    scores = replace(merged, attributes={**merged.attributes, "study": describe(study, merged)})
    write_scores(scores, args.study / "scores.parquet")
    print(format_coverage(scores.attributes["study"]))
    # Strips show the first training of each variant.
    shown = [name for name in graded if name not in planned or planned[name].of == name]
    root = args.rollouts or args.study / "rollouts"
    rollouts = tuple(root / name for name in shown if (root / name).is_dir())
    if args.rollouts and not rollouts:
        raise ConfigError(f"{root} has no folder of a graded variant, such as {shown[0]}; name the folder that holds them.")
    if len(rollouts) < len(shown):
        print(f"{len(shown) - len(rollouts)} of {len(shown)} variants are in no picture: their rollouts were not under {root}")
    data = args.data or (view_folder(study.data_folder, study.view) if rollouts else None)
    table, out = args.study / "scores.parquet", args.study / "report"
    check_place(out / "index.html", within=args.study)
    remove_written(out, report.FILES)  # a larger study's figures would stay
    other = study.other_scores
    report.main(report.Args(table, data, rollouts, out, distances=args.distances, other_motion=other, shifted=shifted))


def describe(study: Study, scores: Scores) -> dict[str, Any]:
    """The merged table's description of its study, as plain JSON.

    `variants` has `expected` and `found` scored episodes of each robot; `incomplete` names variants that lack any; `of_paper`
    says whether the extent is the paper's.
    """
    cell = [VARIANT, "task", "seed", "robot"]
    graded = scores.rows[[*cell, *([TRAINING] if TRAINING in scores.rows else [])]].drop_duplicates().groupby(cell).size()
    # An episode counts where all trainings of the variant were graded on it.
    trainings = {variant.name: study.count_trainings(variant) for variant in study.planned_variants}
    wanted = graded.index.get_level_values(VARIANT).map(lambda name: trainings.get(name, 1))
    episodes = graded[graded.to_numpy() >= wanted.to_numpy()].reset_index()
    found = episodes.groupby([VARIANT, "robot"]).size().to_dict()
    variants = {
        variant.name: {
            "expected": study.graded_counts(variant),
            "found": {robot: int(found.get((variant.name, robot), 0)) for robot in study.graded_counts(variant)},
        }
        for variant in study.planned_variants
    }
    return {
        "parts": list(study.parts),
        "tasks": study.task_count,
        "robots": list(study.robot_keys),
        "train_seeds": study.train_seeds,
        "test_seeds": study.test_seeds,
        "shots": list(study.shots),
        "training_seeds": list(study.training_seeds),
        "of_paper": is_of_paper(study),
        "variants": variants,
        "incomplete": [name for name, counts in variants.items() if counts["expected"] != counts["found"]],
    }


def is_of_paper(study: Study) -> bool:
    """Whether every variant is trained and graded on as many episodes as in the paper."""
    seeds = (study.train_seeds, study.test_seeds) == (TRAIN_SEEDS_PER_TASK, TEST_SEEDS_PER_TASK)
    counts = all(study.graded_counts(variant) == expected_counts(variant) for variant in study.planned_variants)
    return seeds and counts and study.task_count == TASK_COUNT


def format_coverage(described: dict[str, Any]) -> str:
    """Text that says whether the table is complete, with a line for each variant that is not."""
    lines = [
        f"{name}: " + ", ".join(f"{robot} {counts['found'][robot]} of {count}" for robot, count in counts["expected"].items())
        for name, counts in described["variants"].items()
        if name in described["incomplete"]
    ]
    count = len(described["variants"])
    if not lines:
        return f"all {count} variants are complete" if count > 1 else "the one variant is complete"
    lacking = f"{len(lines)} of {count} variants lack" if count > 1 else "the one variant lacks"
    return "\n".join([f"INCOMPLETE, {lacking} scored episodes:", *(f"  {line}" for line in lines)])


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m xew.analysis.study_analyse"))

"""The graph of a study: every command that it takes, what each needs first, and what each depends on.

generate -> latents -> train -> rollout -> evaluate -> analyse
                         |__ latents -> adapt -> rollout -> evaluate __|
distances _____________________________________________________________|
"""

import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import yaml

import xew
from xew.analysis.studies.config import Settings, Study, experiment_of, run_folder
from xew.episode import SCHEMA_VERSION
from xew.protocol import Variant

STAGES = ("generate", "latents", "train", "adapt", "rollout", "evaluate", "distances", "analyse")


@dataclass(frozen=True)
class Cell:
    """One command of a study."""

    stage: str
    """One of STAGES."""
    variant: str
    """Name of a variant; empty where it is for all."""
    command: tuple[str, ...]
    """Module and arguments."""
    needs: tuple[str, ...]
    """Names of the cells before it."""
    inputs: Any
    """What its result depends on beside theirs, as plain JSON."""
    product: Path
    """File or folder that it makes."""
    gpus: int = 1
    launcher: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return f"{self.stage}/{self.variant}" if self.variant else self.stage


def plan(study: Study) -> dict[str, Cell]:
    """All cells of a study by name, each after those that it needs."""
    experiments = {variant.name: experiment_of(study, variant) for variant in study.planned}
    cells = [_generate(study)]
    firsts: dict[str, str] = {}
    for number, variant in enumerate(study.planned):
        experiment = experiments[variant.name]
        first = firsts.setdefault(variant.split, f"latents/{variant.name}")
        cells += [
            _latents(study, variant, experiment, first),
            _train(study, variant, experiment),
            _rollout(study, variant, experiment),
            _evaluate(study, variant, baselines=number == 0),
        ]
    if "loeo" in study.parts:
        cells.append(_distances(study))
    cells.append(_analyse(study, tuple(cell.name for cell in cells if cell.stage in ("evaluate", "distances"))))
    return {cell.name: cell for cell in cells}


def in_order(cells: Mapping[str, Cell]) -> list[Cell]:
    """Cells, each after those that it needs."""
    return [cells[name] for name in TopologicalSorter({name: cell.needs for name, cell in cells.items()}).static_order()]


def write_configs(study: Study) -> dict[str, Path]:
    """Write every variant's config where its commands read it; returns those that are new or changed."""
    changed = {}
    for variant in study.planned:
        path, text = _config(study, variant), yaml.safe_dump(experiment_of(study, variant), sort_keys=False)
        if not path.exists() or path.read_text() != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
            changed[variant.name] = path
    return changed


def _config(study: Study, variant: Variant) -> Path:
    return study.out / "configs" / f"{variant.name}.yaml"


def _rollouts(study: Study, variant: str) -> Path:
    return study.out / "rollouts" / variant


def _scores(study: Study, variant: str) -> Path:
    return study.out / "scores" / f"{variant}.parquet"


def _generate(study: Study) -> Cell:
    tasks = ("--tasks", *study.tasks) if study.tasks else ()
    seeds = ("--train-seeds", str(study.train_seeds), "--test-seeds", str(study.test_seeds))
    return Cell(
        "generate",
        "",
        ("xew.sim_warp.generate", "--out", str(study.data_folder), *tasks, "--robots", *study.robots, *seeds, *study.generate),
        needs=(),
        inputs=[SCHEMA_VERSION, study.tasks, study.robots, study.train_seeds, study.test_seeds],
        product=study.data_folder,
    )


def _latents(study: Study, variant: Variant, experiment: Settings, first: str) -> Cell:
    name = f"latents/{variant.name}"
    # Streams that variants of a split share are encoded by the first of them; an adaptation has its start's codec.
    before = (_training(variant.start),) if variant.start is not None else () if first == name else (first,)
    return Cell(
        "latents",
        variant.name,
        ("xew.model.latents", str(_config(study, variant))),
        needs=("generate", *before),
        inputs=_of_training(experiment),
        product=study.out / "latents",
    )


def _training(variant: Variant) -> str:
    return f"{'train' if variant.target is None else 'adapt'}/{variant.name}"


def _train(study: Study, variant: Variant, experiment: Settings) -> Cell:
    joins = ("--distributed",) if study.machine.train_launcher else ()
    before = (_training(variant.start),) if variant.start is not None else ()
    return Cell(
        _training(variant).partition("/")[0],
        variant.name,
        ("xew.model.train", str(_config(study, variant)), *joins),
        needs=(f"latents/{variant.name}", *before),
        inputs=_of_training(experiment),
        product=run_folder(study, variant),
        gpus=study.machine.gpus_per_training,
        launcher=tuple(shlex.split(study.machine.train_launcher)),
    )


def _rollout(study: Study, variant: Variant, experiment: Settings) -> Cell:
    run, out, robots = run_folder(study, variant), _rollouts(study, variant.name), tuple(study.graded(variant))
    settings = {key: value for key, value in experiment.get("rollout", {}).items() if value is not None}
    flags = tuple(text for key, value in settings.items() for text in (f"--rollout.{key.replace('_', '-')}", str(value)))
    return Cell(
        "rollout",
        variant.name,
        ("xew.model.rollout", str(run), "--data", str(study.data_folder), "--robots", *robots, "--out", str(out), *flags),
        needs=("generate", _training(variant)),
        inputs=[settings, robots],
        product=out,
    )


def _evaluate(study: Study, variant: Variant, baselines: bool) -> Cell:
    """The first variant is of all robots, so the baselines stand beside its rows and not again beside the others'."""
    out = _scores(study, variant.name)
    given = ("--data", str(study.data_folder), "--out", str(out))
    asked = ("--baselines" if baselines else "--no-baselines", *study.evaluate)
    return Cell(
        "evaluate",
        variant.name,
        ("xew.metrics.evaluate", str(_rollouts(study, variant.name)), *given, *asked),
        needs=("generate", f"rollout/{variant.name}"),
        inputs=[asked, source_digest("metrics")],
        product=out,
    )


def _distances(study: Study) -> Cell:
    """Of the robots as they are drawn here, which the errors of the LOEO folds are held against."""
    folder = study.out / "distances"
    return Cell(
        "distances",
        "",
        ("xew.analysis.distance", "--out", str(folder), *study.distances),
        needs=(),
        inputs=[study.distances, source_digest("analysis")],
        product=folder / "distances.csv",
    )


def _analyse(study: Study, needs: tuple[str, ...]) -> Cell:
    """The names of the variants that have been graded are added to its command when it starts."""
    return Cell(
        "analyse",
        "",
        ("xew.analysis.study_analyse", str(study.out)),
        needs=needs,
        inputs=[[asdict(variant) for variant in study.planned], source_digest("analysis")],
        product=study.out / "report" / "index.html",
        gpus=0,
    )


def _of_training(experiment: Settings) -> Settings:
    """What a trained network depends on: not where things lie, nor how it is rolled out."""
    kept = {key: value for key, value in experiment.items() if key not in ("data", "out", "cache", "mesh", "rollout")}
    adapt = {key: value for key, value in experiment.get("adapt", {}).items() if key != "start_from"}
    return kept | {"adapt": adapt, "xew": xew.__version__}


@cache
def source_digest(room: str) -> str:
    """Of a room's source: what is quickly done again is done again when its code changes, as grading and the report."""
    folders = sorted(Path(path, room) for path in xew.__path__)
    content = [file.read_bytes() for folder in folders for file in sorted(folder.glob("*")) if file.is_file()]
    return hashlib.sha256(b"\0".join(content)).hexdigest()[:16]


def key_of(cell: Cell, outcomes: Sequence[str | None]) -> str:
    """Digest of all that a cell's result depends on: its own inputs and the outcomes of what it needs."""
    content = json.dumps([cell.name, cell.inputs, list(outcomes)], sort_keys=True, default=str)
    return hashlib.sha256(content.encode()).hexdigest()[:16]

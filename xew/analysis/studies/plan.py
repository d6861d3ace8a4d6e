"""The graph of a study: every step that it takes, what each needs first, and what each depends on.

generate -> latents -> train -> rollout -> evaluate -> analyse
               |         |__ latents -> adapt -> rollout -> evaluate __|
               |__ baselines _____________________________________ |
distances _____________________________________________________________|
"""

import hashlib
import json
import math
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import yaml

import xew
from xew.analysis.studies.config import RECIPE, Run, Settings, Study, build_experiment, run_folder
from xew.config import merge_settings
from xew.episode import SCHEMA_VERSION
from xew.files import file_digest, read_text, write_text
from xew.protocol import CROSSED_BODIES, DISTANCE_BODIES, GRADING_PROTOCOL, HEAD, RANDOM_CHANGE, SHARED_MOTION, Variant

TRAININGS = ("train", "adapt")
"""Kinds of steps that keep a GPU busy all the time."""


@dataclass(frozen=True)
class Step:
    """One command of a study, with what it needs and what it makes."""

    kind: str
    variant: str
    """Name of a variant's training (`Run`), or of a folder of changed scenes; empty for a step that serves all."""
    command: tuple[str, ...]
    needs: tuple[str, ...]
    inputs: Any
    """Inputs of its result besides those steps, as plain JSON."""
    product: Path
    gpus: int = 1
    every_gpu: bool = False
    """Whether it takes all GPUs of its machine instead of a number."""
    may_spread: bool = False
    """Whether it takes more than `gpus` if others leave them free (`count_gpus`)."""
    batch: int = 0
    """Number that a larger number of GPUs must divide; 0 for none."""
    launcher: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    after: tuple[str, ...] = ()
    """Names of steps that it lets end first, such as one that makes part of the same; its result does not depend on theirs."""

    @property
    def predecessors(self) -> tuple[str, ...]:
        """Names of all steps that it comes after."""
        return (*self.needs, *self.after)

    @property
    def name(self) -> str:
        return f"{self.kind}/{self.variant}" if self.variant else self.kind

    @property
    def is_training(self) -> bool:
        return self.kind in TRAININGS

    def gpus_of(self, count: int) -> int:
        """Number of GPUs that it is planned with on a machine that has `count`."""
        return count if self.every_gpu else self.gpus


def count_sharing(
    step: Step, steps: Mapping[str, Step], left: Collection[str], ready: Collection[str], ended: Collection[str]
) -> int:
    """Number of steps that a machine's free GPUs are divided among when a step starts; 0: it gets what it is planned with.

    A training run shares them with all others that are left and wait for no other run. Other steps leave free GPUs to
    training runs until the last one has started, and then share them with all steps that are ready.

    Args:
        step: the step that starts.
        steps: all steps of the study.
        left: names of steps that have not started, this one included.
        ready: those that could start now.
        ended: names of steps that are done.
    """
    trainings = [steps[name] for name in left if steps[name].is_training]
    if not step.is_training:
        return 0 if trainings else len(ready)
    return sum(all(need in ended for need in other.needs if steps[need].is_training) for other in trainings)


def count_gpus(step: Step, total: int, free: int, among: int) -> int:
    """Number of GPUs that a step takes of a machine: as planned, or a multiple within its share of the free ones.

    Args:
        step: the step that starts.
        total: number of the machine's GPUs.
        free: number of those that are free.
        among: `count_sharing`.
    """
    planned = min(max(1, step.gpus_of(total)), total)
    if not step.may_spread or among == 0:
        return planned
    fitting = (count for count in range(free // among, planned, -1) if count % planned == 0 and step.batch % count == 0)
    return next(fitting, planned)


def plan(study: Study) -> dict[str, Step]:
    """All steps of a study by name, each after those that it needs."""
    experiments = {run.name: build_experiment(study, run) for run in study.planned_runs}
    steps = [_plan_generate(study)]
    firsts: dict[str, str] = {}
    for variant in study.planned_runs:
        experiment = experiments[variant.name]
        first = firsts.setdefault(variant.change, f"latents/{variant.name}")
        steps += [
            _plan_latents(study, variant, experiment, first),
            _plan_train(study, variant, experiment),
            _plan_rollout(study, variant, experiment),
            _plan_evaluate(study, variant),
        ]
    steps += [_plan_changed_scenes(study, change, counts) for change, counts in study.planned_changes.items()]
    for name, (run, change) in study.shifted_runs.items():
        steps += _plan_shift(study, name, run, change, experiments[run.name])
    steps.insert(2, _plan_baselines(study, study.planned_runs[0], experiments[study.planned_runs[0].name]))
    if {"loeo", "bodies", "halves"}.intersection(study.parts):
        steps.append(_plan_distances(study))
    steps.append(
        _plan_analyse(study, tuple(step.name for step in steps if step.kind in ("baselines", "evaluate", "distances")))
    )
    return {step.name: replace(step, environment=study.step_environment.get(step.kind, {})) for step in steps}


def sort_steps(steps: Mapping[str, Step]) -> list[Step]:
    """The steps in an order in which each comes after those that it needs."""
    return [steps[name] for name in TopologicalSorter({name: step.predecessors for name, step in steps.items()}).static_order()]


def write_configs(study: Study) -> dict[str, Path]:
    """Write every variant's config where its commands read it; returns those that are new or changed."""
    changed = {}
    for variant in study.planned_runs:
        path, text = _config_path(study, variant), yaml.safe_dump(build_experiment(study, variant), sort_keys=False)
        if not path.exists() or read_text(path) != text:
            write_text(path, text, within=study.out)
            changed[variant.name] = path
    return changed


def _config_path(study: Study, variant: Variant) -> Path:
    return study.out / "configs" / f"{variant.name}.yaml"


def _rollouts_path(study: Study, variant: str) -> Path:
    return study.out / "rollouts" / variant


def _plan_generate(study: Study) -> Step:
    counts = {"train": study.train_seeds, study.test_family: study.test_seeds}
    motion = () if study.motion == SHARED_MOTION else ("--motion", study.motion)
    robots = dict.fromkeys((study.trained_robots, study.graded_robots))  # once where all are both trained on and graded
    named = tuple(text for option, keys in zip(("--robots", "--test-robots"), robots, strict=False) for text in (option, *keys))
    return Step(
        "generate",
        "",
        ("xew.sim_warp.generate", "--out", str(study.data_folder), *_generate_options(study, named, counts)),
        needs=(),
        inputs=[
            SCHEMA_VERSION,
            study.tasks,
            *robots,
            study.train_seeds,
            study.test_seeds,
            *motion,
            *_other_family(study),
            *_view_options(study, "--cameras"),
        ],
        product=study.data_folder,
        every_gpu=True,
    )


def _generate_options(study: Study, robots: Sequence[str], counts: Mapping[str, int]) -> tuple[str, ...]:
    """Options of `generate` for a study's tasks and motion, with these options for robots and numbers of seeds by family."""
    tasks = ("--tasks", *study.tasks) if study.tasks else ()
    asked = {"train": 0, "test": 0} | dict(counts)
    seeds = (text for family, count in asked.items() for text in (f"--{family}-seeds", str(count)))
    motion = () if study.motion == SHARED_MOTION else ("--motion", study.motion)
    return (*tasks, *robots, *seeds, *motion, *_view_options(study, "--cameras"), *study.generate)


def _view_options(study: Study, option: str) -> tuple[str, ...]:
    """The option that names the study's view; none for the head camera, so steps of other studies keep their digests."""
    return () if study.view == HEAD else (option, study.view)


def generate_name(study: Study, change: str) -> str:
    """Name of the step that makes the scenes with a change, or those without one."""
    return f"generate/{study.folder_of('data', change).name}" if change else "generate"


def _plan_changed_scenes(study: Study, change: str, counts: Mapping[str, int]) -> Step:
    """Making of scenes with a change, with these numbers of seeds by family, for the training robots.

    Changes of the table's height, which random ones include, need physics; others are rendered from the states of test scenes.
    """
    data, robots = study.folder_of("data", change), study.shifted_robots
    with_physics = change == RANDOM_CHANGE or change.startswith("height")
    if with_physics:
        command = ("xew.sim_warp.generate", *_generate_options(study, ("--robots", *robots), counts))
    else:
        options = ("--render", "--split", study.test_family, *_view_options(study, "--cameras"))
        command = ("xew.sim_warp.inspect", str(study.data_folder), *options)
    return Step(
        "generate",
        data.name,
        (*command, "--change", change, "--out", str(data)),
        needs=() if with_physics else ("generate",),
        inputs=[SCHEMA_VERSION, study.tasks, robots, counts, study.motion, study.view],
        product=data,
        every_gpu=with_physics,
    )


def _other_family(study: Study) -> tuple[str, ...]:
    """The family of the test seeds where it is not the usual one; steps of other studies keep their digests."""
    return () if study.test_family == "test" else (study.test_family,)


def _plan_latents(study: Study, variant: Variant, experiment: Settings, first: str) -> Step:
    name = f"latents/{variant.name}"
    # An adaptation has its start's codec.
    started = (_training_name(variant.start),) if variant.start is not None else ()
    return Step(
        "latents",
        variant.name,
        ("xew.model.latents", str(_config_path(study, variant))),
        needs=(generate_name(study, variant.change), *started),
        inputs=_training_inputs(experiment),
        product=study.folder_of("latents", variant.change),
        # Streams that variants share are encoded by the first of them that is run.
        after=() if started or first == name else (first,),
        every_gpu=first == name and not started,  # all others wait for it
        may_spread=True,
    )


def _training_name(variant: Variant) -> str:
    return f"{'train' if variant.target is None else 'adapt'}/{variant.name}"


def _plan_train(study: Study, variant: Variant, experiment: Settings) -> Step:
    joins = ("--distributed",) if study.machine.train_launcher else ()
    before = (_training_name(variant.start),) if variant.start is not None else ()
    settings = merge_settings(RECIPE, experiment)
    mesh = settings["mesh"].values()
    return Step(
        _training_name(variant).partition("/")[0],
        variant.name,
        ("xew.model.train", str(_config_path(study, variant)), *joins),
        needs=(f"latents/{variant.name}", *before),
        inputs=_training_inputs(experiment),
        product=run_folder(study, variant),
        gpus=study.machine.gpus_per_training or math.prod(size for size in mesh if size > 0),
        may_spread=study.machine.gpus_per_training is None and -1 in mesh and not study.machine.train_launcher,
        batch=settings["train"]["batch"] // settings["train"]["accumulate"],
        launcher=tuple(shlex.split(study.machine.train_launcher)),
    )


def _plan_rollout(study: Study, variant: Variant, experiment: Settings) -> Step:
    run, out, robots = run_folder(study, variant), _rollouts_path(study, variant.name), tuple(study.graded_counts(variant))
    settings = {key: value for key, value in experiment.get("rollout", {}).items() if value is not None}
    flags = tuple(text for key, value in settings.items() for text in (f"--rollout.{key.replace('_', '-')}", str(value)))
    given = ("--data", str(study.data_folder), "--split", study.test_family)
    return Step(
        "rollout",
        variant.name,
        ("xew.model.rollout", str(run), *given, "--robots", *robots, "--out", str(out), *flags),
        needs=("generate", _training_name(variant)),
        inputs=[settings, robots],
        product=out,
        may_spread=True,
    )


def _plan_shift(study: Study, name: str, run: Run, change: str, experiment: Settings) -> list[Step]:
    """Rollouts of a run on test scenes with a change, and their grading."""
    data, made = study.folder_of("data", change), generate_name(study, change)
    rollout = _plan_rollout(study, run, experiment)
    out = _rollouts_path(study, name)
    moved = {str(study.data_folder): str(data), str(rollout.product): str(out)}
    asked = rollout.command[: rollout.command.index("--robots") + 1], rollout.command[rollout.command.index("--out") :]
    rolled = replace(
        rollout,
        variant=name,
        command=tuple(moved.get(text, text) for text in (*asked[0], *study.shifted_robots, *asked[1])),
        needs=(made, _training_name(run)),
        inputs=[*rollout.inputs, change],
        product=out,
    )
    scores = study.scores_path(name)
    options = ("--no-baselines", *_view_options(study, "--view"), *study.evaluate)
    graded = Step(
        "evaluate",
        name,
        ("xew.metrics.evaluate", str(out), "--data", str(data), "--out", str(scores), *options),
        needs=(made, rolled.name),
        inputs=[study.evaluate, GRADING_PROTOCOL, change],
        product=scores,
        may_spread=True,
    )
    return [rolled, graded]


def _plan_baselines(study: Study, variant: Variant, experiment: Settings) -> Step:
    """Grading of the baselines, and of the truth through the codec of most variants, on all test episodes.

    It uses processors while the first models train; nothing waits for it.
    """
    out, frames = study.baselines_path, experiment.get("rollout", {}).get("max_frames", 0)
    given = ("--data", str(study.data_folder), "--out", str(out), "--codec", str(_config_path(study, variant)))
    view = _view_options(study, "--view")
    asked = ("--baselines-of", study.test_family, "--max-frames", str(frames), *view, *study.evaluate)
    return Step(
        "baselines",
        "",
        ("xew.metrics.evaluate", *given, *asked),
        needs=("generate", f"latents/{variant.name}"),
        inputs=[frames, study.evaluate, GRADING_PROTOCOL, *view],
        product=out,
        every_gpu=study.machine.steps_per_gpu > 1,  # alone it would wait for all GPUs to be free, or trainings for it
        may_spread=True,
    )


def _plan_evaluate(study: Study, variant: Variant) -> Step:
    """Grading of a variant. The truth through a codec is graded once for all variants that share it."""
    out = study.scores_path(variant.name)
    given = ("--data", str(study.data_folder), "--out", str(out))
    asked = ("--no-baselines", "--codec", str(run_folder(study, variant)), *_view_options(study, "--view"), *study.evaluate)
    return Step(
        "evaluate",
        variant.name,
        ("xew.metrics.evaluate", str(_rollouts_path(study, variant.name)), *given, *asked),
        needs=("generate", _training_name(variant), f"rollout/{variant.name}"),
        inputs=[study.evaluate, GRADING_PROTOCOL],
        product=out,
        may_spread=True,
    )


def measured_bodies(study: Study) -> list[str]:
    """Keys of the bodies whose distances are measured in addition to the five robots."""
    asked = {"bodies": DISTANCE_BODIES, "halves": CROSSED_BODIES}
    wanted = {body for part, bodies in asked.items() if part in study.parts for body in bodies}
    return [robot for robot in study.graded_robots if robot in wanted]


def _plan_distances(study: Study) -> Step:
    """Distances of the robots as they are rendered here, with which the errors of folds and bodies are correlated."""
    folder, bodies = study.out / "distances", measured_bodies(study)
    asked = (*(("--robot", *bodies) if bodies else ()), *study.distances)
    return Step(
        "distances",
        "",
        ("xew.analysis.distance", "--out", str(folder), *asked),
        needs=(),
        inputs=[asked, source_digest("analysis", "statistics")],
        product=folder / "distances.csv",
    )


def _plan_analyse(study: Study, needs: tuple[str, ...]) -> Step:
    """The analysis; the names of the variants that have been graded are added to its command when it starts."""
    return Step(
        "analyse",
        "",
        ("xew.analysis.study_analyse", str(study.out)),
        needs=needs,
        inputs=[
            [asdict(variant) for variant in study.planned_variants],
            *study.training_seeds,
            *([file_digest(study.other_scores)] if study.other_scores else []),
            source_digest("analysis", "statistics"),
        ],
        product=study.out / "report" / "index.html",
        gpus=0,
    )


def _training_inputs(experiment: Settings) -> Settings:
    """Settings that a trained network depends on: not where things lie, nor how it is rolled out."""
    kept = {key: value for key, value in experiment.items() if key not in ("data", "out", "cache", "mesh", "rollout")}
    adapt = {key: value for key, value in experiment.get("adapt", {}).items() if key != "start_from"}
    return kept | {"adapt": adapt, "xew": xew.__version__}


@cache
def source_digest(*rooms: str) -> str:
    """Digest of all files of some packages: steps that are quick to repeat, such as the report, depend on the code."""
    content = hashlib.sha256()
    for root in map(Path, xew.__path__):
        for path in sorted(path for room in rooms for path in Path(root, room).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                content.update(f"{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return content.hexdigest()[:16]


def step_key(step: Step, outcomes: Sequence[str | None]) -> str:
    """Digest of all that a step's result depends on: its own inputs and the outcomes of what it needs."""
    content = json.dumps([step.name, step.inputs, list(outcomes)], sort_keys=True, default=str)
    return hashlib.sha256(content.encode()).hexdigest()[:16]

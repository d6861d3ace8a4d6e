"""The config of a study: what configs/study_*.yaml hold, and the experiment that each of its variants becomes.

A study names one experiment (a config of xew.model) and says only what differs: between all its variants and that file
(`settings`), for what is adapted (`adaptation`, `remedies`) and for other systems (`systems`). Data, folders, split, action
and conditioning of each variant follow from the protocol.
"""

import fnmatch
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from xew.config import ConfigError, load, read_yaml, suggestion
from xew.protocol import (
    PAPER_PARTS,
    PARTS,
    ROBOT_NAMES,
    SHOTS,
    SPLITS,
    TASK_COUNT,
    TEST_SEEDS_PER_TASK,
    TRAIN_SEEDS_PER_TASK,
    Variant,
    expected_counts,
    training_counts,
)
from xew.sim_warp.tasks import get_task

Settings = dict[str, Any]
"""A part of an experiment's config, nested as in its file."""


@dataclass(frozen=True)
class Rates:
    """Measured speeds and sizes, from which the cost of a study is estimated before it starts."""

    measured_on: str
    """The machine, and where the figures stand."""
    episode_s: float
    """Making one episode."""
    encode_s: float
    """Encoding one stream of one episode."""
    step_s: float
    """One optimizer step of the experiment, on the GPUs that a training has."""
    rollout_s: float
    """Predicting one episode."""
    grade_s: float
    """Grading one predicted episode."""
    start_s: float
    """From the start of a command to its first real work, compiling included."""
    episode_mb: float
    stream_mb: float
    """One encoded stream of one episode."""
    run_mb: float
    """All checkpoints that a run keeps."""
    rollout_mb: float
    episode_frames: int = 178
    """On average; 178 over all tasks."""


@dataclass(frozen=True)
class Machine:
    """What the cells of a study may use."""

    gpus: tuple[int, ...] | None = None
    """Numbers of the GPUs, one cell on each; those that can be seen where left out; [] is none."""
    workers: int = 1
    """Cells at once where there is no GPU."""
    gpus_per_training: int = 1
    """A training takes as many at once."""
    train_launcher: str = ""
    """Put before a training's command, which then joins the processes that it starts (jax.distributed): srun --nodes=2."""
    ray: str | None = None
    """Address of a Ray cluster whose machines share this folder: auto, or host:port. Its resources are used instead."""


@dataclass(frozen=True)
class Study:
    out: Path
    """Everything of the study lies here."""
    experiment: Path
    """The config of xew.model that all variants are made from."""
    rates: Rates
    parts: tuple[str, ...] = PAPER_PARTS
    """Keys of protocol.PARTS: which tables."""
    variants: tuple[str, ...] = ()
    """Only variants whose name matches one of these patterns (as `loeo_*`), and what they start from; all where left out."""
    tasks: tuple[str, ...] = ()
    """All where left out."""
    robots: tuple[str, ...] = ROBOT_NAMES
    shots: tuple[int, ...] = SHOTS
    """M of the adaptations."""
    train_seeds: int = TRAIN_SEEDS_PER_TASK
    test_seeds: int = TEST_SEEDS_PER_TASK
    settings: Settings = field(default_factory=dict)
    """Laid over the experiment for every variant."""
    adaptation: Settings = field(default_factory=dict)
    """Laid over it for what is adapted."""
    remedies: dict[str, Settings] = field(
        default_factory=lambda: {"replay": {"adapt": {"replay": 0.25}}, "lora": {"adapt": {"lora_rank": 16}}}
    )
    """Laid over it for an adaptation with replay or LoRA."""
    systems: dict[str, Settings] = field(default_factory=dict)
    """Laid over it for another project's system."""
    generate: tuple[str, ...] = ()
    """More arguments of `xew.sim_warp.generate`."""
    evaluate: tuple[str, ...] = ()
    """More arguments of `xew.metrics.evaluate`, such as --masks sam2."""
    distances: tuple[str, ...] = ()
    """More arguments of `xew.analysis.distance`, which runs where the part loeo is planned."""
    environment: dict[str, str] = field(default_factory=dict)
    """Variables set for every cell."""
    data: Path | None = None
    """Episodes; <out>/data where left out. What is missing in it is made."""
    machine: Machine = Machine()

    @property
    def data_folder(self) -> Path:
        return self.data or self.out / "data"

    @property
    def task_count(self) -> int:
        return len(self.tasks) or TASK_COUNT

    @property
    def planned(self) -> tuple[Variant, ...]:
        """The variants of the study in the order of the tables, each once, and what they start from before them."""
        chosen: dict[str, Variant] = {}
        for variant in (variant for part in self.parts for variant in PARTS[part] if self._has(variant)):
            if variant.start is not None:
                chosen.setdefault(variant.start.name, variant.start)
            chosen.setdefault(variant.name, variant)
        return tuple(sorted(chosen.values(), key=lambda variant: variant.target is not None))

    def _has(self, variant: Variant) -> bool:
        named = not self.variants or any(fnmatch.fnmatch(variant.name, pattern) for pattern in self.variants)
        if variant.target is not None:
            return named and variant.target in self.robots and variant.shots in self.shots
        return named and any(robot in self.robots for robot in SPLITS[variant.split].held_out_robots)

    def graded(self, variant: Variant) -> dict[str, int]:
        """Episodes of each robot that a variant is graded on."""
        return expected_counts(variant, self.task_count, self.test_seeds, self.robots)

    def trained(self, variant: Variant) -> int:
        """Episodes that a variant learns from."""
        return sum(training_counts(variant, self.task_count, self.train_seeds, self.robots).values())


def load_study(path: Path, overrides: Iterable[str] = ()) -> Study:
    """Read and check a study's config. Raises ConfigError with every choice that does not exist or does not fit."""
    study = load(Study, path, list(overrides))
    _check_names(study, path)
    if not study.planned:
        raise ConfigError(f"{path}: no variant of the parts {', '.join(study.parts)} is left; widen variants, robots or shots.")
    shots = max((variant.shots for variant in study.planned), default=0)
    if study.train_seeds < max(shots, 1) or study.test_seeds < 1:
        raise ConfigError(
            f"{path}: {study.train_seeds} training and {study.test_seeds} test seeds; expected at least {max(shots, 1)} and 1."
        )
    if study.machine.workers < 1 or study.machine.gpus_per_training < 1:
        raise ConfigError(f"{path}: machine.workers and machine.gpus_per_training must be at least 1.")
    return study


def _check_names(study: Study, path: Path) -> None:
    """Raises ConfigError with the first name that does not exist, or that stands twice."""
    for task in study.tasks:
        get_task(task)
    shots, known_shots = tuple(map(str, study.shots)), tuple(map(str, SHOTS))
    for kind, names, known in (
        ("part", study.parts, tuple(PARTS)),
        ("robot", study.robots, ROBOT_NAMES),
        ("number of shots", shots, known_shots),
        ("task", study.tasks, study.tasks),  # known: asked above, and may be of one's own
    ):
        for name in names:
            if name not in known:
                raise ConfigError(f"{path}: unknown {kind} {name!r};{suggestion(name, known)} known: {', '.join(known)}.")
        if len(set(names)) < len(names):
            raise ConfigError(f"{path}: a {kind} stands twice in {', '.join(names)}; name each once.")
    variants = list(dict.fromkeys(variant.name for part in study.parts for variant in PARTS[part]))
    for pattern in study.variants:
        if not fnmatch.filter(variants, pattern):
            raise ConfigError(
                f"{path}: variants {pattern!r} matches none of the parts {', '.join(study.parts)};"
                f"{suggestion(pattern, variants)} there are {', '.join(variants)}."
            )


def experiment_of(study: Study, variant: Variant) -> Settings:
    """The experiment's config of one variant, plain as in a file."""
    settings = merged(read_yaml(study.experiment), study.settings)
    settings = merged(settings, study.systems.get(variant.system, {}))
    if variant.start is not None:
        settings = merged(settings, study.adaptation)
        settings = merged(settings, study.remedies.get(variant.remedy, {}))
        start = {"start_from": str(run_folder(study, variant.start)), "robots": [variant.target], "episodes": variant.shots}
        settings = merged(settings, {"adapt": start})
    given = {
        "data": str(study.data_folder),
        "out": str(run_folder(study, variant)),
        "cache": str(study.out / "latents"),
        "split": variant.split,
        "model": {"action": variant.action, "embodiment": variant.embodiment},
    }
    return merged(settings, given)


def run_folder(study: Study, variant: Variant) -> Path:
    return study.out / "runs" / variant.name


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> Settings:
    """Nested settings, those above before those below."""
    result = dict(below)
    for key, value in above.items():
        both = isinstance(value, Mapping) and isinstance(result.get(key), Mapping)
        result[key] = merged(result[key], value) if both else value
    return result

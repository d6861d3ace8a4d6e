"""The config of a study, and the experiment of each of its variants.

A study names one experiment (a config of xew.model) and the differences of all variants (`settings`), of adaptations
(`adaptation`, `remedies`) and of other systems (`systems`). The rest of each variant follows from the protocol.
"""

import fnmatch
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from xew.config import ConfigError, check_finite, load, merge_settings, read_yaml, suggestion
from xew.model.conditions import ACTIONS, CONDITIONS, list_conditions, shows_carried
from xew.protocol import (
    HEAD,
    MOTIONS,
    PAPER_PARTS,
    PARTS,
    ROBOT_NAMES,
    SHARED_MOTION,
    SHIFTS,
    SHOTS,
    SPLITS,
    TASK_COUNT,
    TEST_SEEDS_PER_TASK,
    TRAIN_SEEDS_PER_TASK,
    Variant,
    expand_robots,
    expected_counts,
    split_key,
    training_counts,
)
from xew.sim_warp.tasks import get_task

KINDS = ("generate", "latents", "baselines", "train", "adapt", "rollout", "evaluate", "distances", "analyse")

_KNOWN_ROBOTS = tuple(
    dict.fromkeys(robot for split in SPLITS.values() for robot in (*split.train_robots, *split.held_out_robots))
)

Settings = dict[str, Any]
"""A part of an experiment's config, nested as in its file."""

RECIPE: Settings = {
    "clip": {"frames": 33},
    "model": {
        "size": "small",
        "action": "mask_and_flow_channels",
        "embodiment": "carried_render_and_shadows",
        "visibility": "one_way",
    },
    "train": {"batch": 16, "steps": 3000, "accumulate": 1},
    "mesh": {"data": -1, "fsdp": 1},
}
"""Defaults of xew.model's experiments, which the analysis does not import, as far as costs and devices depend on them."""


@dataclass(frozen=True)
class Machine:
    """Devices that the steps of a study may use."""

    gpus: tuple[int, ...] | None = None
    """Numbers of the GPUs; all visible ones where left out; [] is none."""
    workers: int = 1
    """Number of steps at once where there is no GPU."""
    gpus_per_training: int | None = None
    """Number of GPUs of a training run; where left out, the free GPUs are divided evenly among the training runs that are left
    and wait for no other run, at least one for each."""
    steps_per_gpu: int = 1
    """Number of steps that share a GPU: at most one training run, and others, which leave it idle while they read and write.
    Above 1 memory is allocated as it is needed."""
    train_launcher: str = ""
    """Launcher of training commands, such as srun --nodes=2; its processes join by jax.distributed."""
    ray: str | None = None
    """Address of a Ray cluster whose machines share this folder: auto, or host:port. Its resources are used instead."""
    rates: Path | None = None
    """File of measured rates for estimates, which `benchmarks/node.py` writes; default: that of this machine, if it exists."""


@dataclass(frozen=True)
class Run(Variant):
    """One training of a variant; its name is the variant's, with an ending from the second training on."""

    of: str = ""
    seed: int | None = None
    """Seed of the training; that of the experiment where the study names none."""

    @property
    def start(self) -> "Run | None":
        """The training of the same seed that an adapted one starts from."""
        base = super().start
        return None if base is None else make_run(base, self.seed, self.name.removeprefix(self.of))


def make_run(variant: Variant, seed: int | None, ending: str) -> Run:
    """One training of a variant."""
    return Run(**{**asdict(variant), "name": variant.name + ending}, of=variant.name, seed=seed)


@dataclass(frozen=True)
class Study:
    """A study: the variants that it compares, and their settings."""

    out: Path
    """Folder for everything of the study."""
    experiment: Path
    """Config of xew.model that all variants are made from."""
    parts: tuple[str, ...] = PAPER_PARTS
    """Keys of protocol.PARTS: which tables."""
    variants: tuple[str, ...] = ()
    """Patterns: only variants whose name matches one of them (as `loeo_*`), and what they start from; all where left out."""
    tasks: tuple[str, ...] = ()
    """Keys of tasks; all where left out."""
    robots: tuple[str, ...] = ()
    """Robots, bodies as body:0-15; all that the parts name where left out. Variants that train on other bodies are left out."""
    shots: tuple[int, ...] = SHOTS
    """Numbers of episodes of each task that models are adapted with (M)."""
    train_seeds: int = TRAIN_SEEDS_PER_TASK
    """Number of training seeds of each task."""
    test_seeds: int = TEST_SEEDS_PER_TASK
    """Number of test seeds of each task."""
    test_family: str = "test"
    """Family of the test seeds; validation: for trials; final: the block of the final study, which nobody has looked at."""
    training_seeds: tuple[int, ...] = ()
    """Seeds of every variant's training runs; one run with the experiment's seed where left out."""
    repeated: tuple[str, ...] = ("*",)
    """Patterns: variants whose names match one of them are trained with every one of these seeds, others with the first."""
    settings: Settings = field(default_factory=dict)
    """Settings laid over the experiment for every variant."""
    dense_channels: bool = False
    """Whether mask, optical flow, ray map and per-frame render are channels of the video instead of tokens of their own."""
    adaptation: Settings = field(default_factory=dict)
    """Settings laid over it for adaptations."""
    remedies: dict[str, Settings] = field(
        default_factory=lambda: {"replay": {"adapt": {"replay": 0.25}}, "lora": {"adapt": {"lora_rank": 16}}}
    )
    """Settings laid over it for adaptations with replay or LoRA."""
    systems: dict[str, Settings] = field(default_factory=dict)
    """Settings laid over it for another project's system."""
    motion: str = SHARED_MOTION
    """Kind of motion of all episodes, one of protocol.MOTIONS."""
    changes: tuple[str, ...] = ()
    """Changes of the test scenes, such as light:2, on which the models of the part `shifts` are graded; all where left out."""
    view: str = HEAD
    """View that all models predict and are graded on: the name of a camera, such as wrist_left."""
    other_motion: Path | None = None
    """Folder of the same study in the other kind of motion; the report compares action representations of both."""
    generate: tuple[str, ...] = ()
    """Further arguments of `xew.sim_warp.generate`."""
    evaluate: tuple[str, ...] = ()
    """Further arguments of `xew.metrics.evaluate`, such as --masks sam2."""
    distances: tuple[str, ...] = ()
    """Further arguments of `xew.analysis.distance`, which runs where the part loeo or bodies is planned."""
    environment: dict[str, str] = field(default_factory=dict)
    """Environment variables set for every step."""
    step_environment: dict[str, dict[str, str]] = field(default_factory=dict)
    """Further environment variables for the steps of one kind, such as XLA_FLAGS for `train`."""
    machine: Machine = Machine()
    """Devices to run on."""

    @property
    def data_folder(self) -> Path:
        return self.out / "data"

    def folder_of(self, name: str, change: str) -> Path:
        """Folder of the data or latents of scenes with a change or without one: data, data_light_2, latents_random."""
        return self.out / split_key(name, SHARED_MOTION, change)

    @property
    def baselines_path(self) -> Path:
        """Score table of the baselines, which no variant has a name like."""
        return self.scores_path("baselines")

    @property
    def other_scores(self) -> Path | None:
        """Score table of the study in the other kind of motion; None where there is none yet."""
        path = self.other_motion / "scores.parquet" if self.other_motion else None
        return path if path and path.is_file() else None

    def scores_path(self, variant: str) -> Path:
        """Score table of a variant's training."""
        return self.out / "scores" / f"{variant}.parquet"

    @property
    def robot_keys(self) -> tuple[str, ...]:
        """Keys of the robots of the study: those that it names, else all of its parts, the five first."""
        splits = [SPLITS[variant.split] for part in self.parts for variant in PARTS[part]]
        named = expand_robots(self.robots) or [robot for s in splits for robot in (*s.train_robots, *s.held_out_robots)]
        of_paper = tuple(robot for robot in ROBOT_NAMES if robot in named)
        return (*of_paper, *dict.fromkeys(robot for robot in named if robot not in ROBOT_NAMES))

    @property
    def trained_robots(self) -> tuple[str, ...]:
        """Robots that have training episodes: of the five all, so parts may be added; bodies that a variant trains on."""
        asked = {robot for variant in self.planned_variants for robot in SPLITS[variant.split].train_robots}
        if self.test_family == "validation":  # whose scenes `generate` makes with the robots of training scenes
            asked |= set(self.graded_robots)
        return tuple(robot for robot in self.robot_keys if robot in ROBOT_NAMES or robot in asked)

    @property
    def graded_robots(self) -> tuple[str, ...]:
        """Robots that have test episodes: of the five all; bodies that a variant is graded on."""
        asked = {robot for variant in self.planned_variants for robot in self.graded_counts(variant)}
        return tuple(robot for robot in self.robot_keys if robot in ROBOT_NAMES or robot in asked)

    @property
    def task_count(self) -> int:
        return len(self.tasks) or TASK_COUNT

    @property
    def planned_variants(self) -> tuple[Variant, ...]:
        """The variants of the study in the order of the tables, each once, and what they start from before them."""
        found: dict[str, Variant] = {}
        for variant in (variant for part in self.parts for variant in PARTS[part] if self._includes(variant)):
            if variant.start is not None:
                found.setdefault(variant.start.name, variant.start)
            found.setdefault(variant.name, variant)
        return tuple(sorted(found.values(), key=lambda variant: variant.target is not None))

    @property
    def planned_runs(self) -> tuple[Run, ...]:
        """The trainings of the study's variants: all of the first seed, then those of the next."""
        endings = ["", *(f"-seed_{seed}" for seed in self.training_seeds[1:])]
        seeds = self.training_seeds or (None,)
        return tuple(
            make_run(variant, seed, ending)
            for seed, ending in zip(seeds, endings, strict=True)
            for variant in self.planned_variants
            if not ending or self._is_repeated(variant)
        )

    @property
    def shifted_runs(self) -> dict[str, tuple[Run, str]]:
        """Runs that are graded on changed scenes, each with one change, by names such as `fixed-…@light_2`."""
        asked = (self.changes or SHIFTS) if "shifts" in self.parts else ()
        runs = [run for run in self.planned_runs if run.name in (variant.name for variant in PARTS["shifts"])]
        return {f"{run.name}@{change.replace(':', '_')}": (run, change) for run in runs for change in asked}

    @property
    def planned_changes(self) -> dict[str, dict[str, int]]:
        """The changes that scenes are made with, and the numbers of their seeds by family: training scenes, or test scenes."""
        trained = {variant.change: {"train": self.train_seeds} for variant in self.planned_variants if variant.change}
        return trained | {change: {self.test_family: self.test_seeds} for _, change in self.shifted_runs.values()}

    @property
    def shifted_robots(self) -> tuple[str, ...]:
        """Robots in changed scenes: those that the models of the part `shifts` train on."""
        return tuple(robot for robot in PARTS["shifts"][0].seen_robots if robot in self.robot_keys)

    def count_trainings(self, variant: Variant) -> int:
        """Number of trainings of a variant."""
        return max(len(self.training_seeds), 1) if self._is_repeated(variant) else 1

    def _is_repeated(self, variant: Variant) -> bool:
        """Whether a variant is trained with every seed: it is named, and so is what it starts from."""
        named = any(fnmatch.fnmatch(variant.name, pattern) for pattern in self.repeated)
        return named and (variant.start is None or self._is_repeated(variant.start))

    def _includes(self, variant: Variant) -> bool:
        named = not self.variants or any(fnmatch.fnmatch(variant.name, pattern) for pattern in self.variants)
        robots, split = self.robot_keys, SPLITS[variant.split]
        if variant.target is not None:
            return named and variant.target in robots and variant.shots in self.shots
        bodies = {robot for robot in split.train_robots if robot not in ROBOT_NAMES}
        return named and bodies <= set(robots) and any(robot in robots for robot in split.held_out_robots)

    def graded_counts(self, variant: Variant) -> dict[str, int]:
        """Number of episodes of each robot that a variant is graded on."""
        return expected_counts(variant, self.task_count, self.test_seeds, self.robot_keys)

    def training_count(self, variant: Variant) -> int:
        """Number of episodes that a variant learns from."""
        return sum(training_counts(variant, self.task_count, self.train_seeds, self.robot_keys).values())


def load_study(path: Path, overrides: Iterable[str] = ()) -> Study:
    """Read a study's config, apply overrides and check it. Raises ConfigError as `check_study` does."""
    study = load(Study, path, list(overrides))
    check_study(study, path)
    return study


def check_study(study: Study, path: Path) -> None:
    """Raises ConfigError for a choice that does not exist or does not fit; `path` names the study's config."""
    check_finite(study, str(path))
    _check_names(study, path)
    if not study.planned_variants:
        raise ConfigError(f"{path}: no variant of the parts {', '.join(study.parts)} is left; widen variants, robots or shots.")
    _check_view(study, path)
    shots = max((variant.shots for variant in study.planned_variants), default=0)
    if study.train_seeds < max(shots, 1) or study.test_seeds < 1:
        raise ConfigError(
            f"{path}: {study.train_seeds} training and {study.test_seeds} test seeds; expected at least {max(shots, 1)} and 1."
        )
    try:
        shlex.split(study.machine.train_launcher)
    except ValueError as error:
        raise ConfigError(f"{path}: machine.train_launcher is {study.machine.train_launcher!r}: {error}.") from error
    for name in ("workers", "gpus_per_training", "steps_per_gpu"):
        if (count := getattr(study.machine, name)) is not None and count < 1:
            raise ConfigError(f"{path}: machine.{name} is {count}; expected at least 1.")


def _check_names(study: Study, path: Path) -> None:
    for task in study.tasks:
        get_task(task)
    shots, known_shots = tuple(map(str, study.shots)), tuple(map(str, SHOTS))
    for kind, names, known in (
        ("part", study.parts, tuple(PARTS)),
        ("robot", expand_robots(study.robots), _KNOWN_ROBOTS),
        ("number of shots", shots, known_shots),
        ("kind of motion", (study.motion,), MOTIONS),
        ("change of scenes", study.changes, SHIFTS),
        ("family of test seeds", (study.test_family,), ("test", "validation", "final")),
        ("task", study.tasks, study.tasks),  # known: checked above, and may be outside tasks
        ("training seed", tuple(map(str, study.training_seeds)), tuple(map(str, study.training_seeds))),
        ("kind of step in step_environment", tuple(study.step_environment), KINDS),
    ):
        for name in names:
            if name not in known:
                raise ConfigError(f"{path}: unknown {kind} {name!r};{suggestion(name, known)} known: {', '.join(known)}.")
        if len(set(names)) < len(names):
            raise ConfigError(f"{path}: a {kind} is named twice in {', '.join(names)}; name each once.")
    variants = list(dict.fromkeys(variant.name for part in study.parts for variant in PARTS[part]))
    for field_name, patterns in (("variants", study.variants), ("repeated", study.repeated)):
        for pattern in patterns:
            if not fnmatch.filter(variants, pattern):
                raise ConfigError(
                    f"{path}: {field_name} {pattern!r} matches none of the parts {', '.join(study.parts)};"
                    f"{suggestion(pattern, variants)} there are {', '.join(variants)}."
                )


def _check_view(study: Study, path: Path) -> None:
    """Raises ConfigError for a view of no built-in camera, or of one that moves where a variant needs one that stands still."""
    if study.view == HEAD:
        return
    from xew.sim_warp.cameras import CAMERAS  # loads Warp

    if study.view not in CAMERAS:
        raise ConfigError(f"{path}: unknown view {study.view!r};{suggestion(study.view, CAMERAS)} known: {', '.join(CAMERAS)}.")
    carried = {name for name, entry in CONDITIONS.items() if shows_carried(list_conditions(entry))}
    still = [variant.name for variant in study.planned_variants if variant.embodiment in carried]
    if CAMERAS[study.view].moves and still:
        cameras = ", ".join(name for name, camera in CAMERAS.items() if not camera.moves)
        raise ConfigError(
            f"{path}: the camera {study.view} moves with the robot, and {', '.join(still)} needs one that stands still "
            f"({cameras}); choose one of them, or other parts or variants."
        )


def build_experiment(study: Study, variant: Variant) -> Settings:
    """The config of one variant's experiment, plain as in a file."""
    settings = merge_settings(read_yaml(study.experiment), study.settings)
    settings = merge_settings(settings, study.systems.get(variant.system, {}))
    if variant.start is not None:
        settings = merge_settings(settings, study.adaptation)
        settings = merge_settings(settings, study.remedies.get(variant.remedy, {}))
        start = {"start_from": str(run_folder(study, variant.start)), "robots": [variant.target], "episodes": variant.shots}
        settings = merge_settings(settings, {"adapt": start})
    if isinstance(variant, Run) and variant.seed is not None:
        settings = merge_settings(settings, {"train": {"seed": variant.seed}})
    given = {
        "data": str(study.folder_of("data", variant.change)),
        "out": str(run_folder(study, variant)),
        "cache": str(study.folder_of("latents", variant.change)),
        "split": split_key(variant.split, study.motion),
        "model": {
            "action": _place_condition(study, variant.action, ACTIONS),
            "embodiment": _place_condition(study, variant.embodiment, CONDITIONS),
        },
    }
    given |= {"view": study.view} if study.view != settings.get("view", HEAD) else {}
    return merge_settings(settings, given)


def _place_condition(study: Study, name: str, known: Mapping[str, Any]) -> str:
    """The condition of this name, or the same picture as channels if the study asks for it and there is such an entry."""
    joined = f"{name}_channels"
    return joined if study.dense_channels and joined in known else name


def run_folder(study: Study, variant: Variant) -> Path:
    """Folder that the training of a variant writes."""
    return study.out / "runs" / variant.name

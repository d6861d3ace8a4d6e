"""Each variant of a study differs from its experiment in what it must, and in nothing else."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.analysis.studies.chains import ROOT
from xew.analysis.studies.config import build_experiment, load_study
from xew.analysis.studies.cost import RECIPE, read_model, work_of_sample
from xew.config import CONVERTER, merge_settings, parse, read_yaml
from xew.model.experiment import Experiment, load_experiment
from xew.model.training.flops import flops_of_step
from xew.protocol import Variant

PLACES = {"data", "out", "cache"}
"""Settings that say where files lie."""
CHOSEN = {"split", "model.action", "model.embodiment"}
"""Settings that a variant chooses."""
DENSE = ("optical_flow", "mask", "ray_map", "robot_render")
"""Conditions that are channels in every study but the paper's."""
STUDIES = {
    "small": {"train.steps", "train.keep_checkpoints", "train.samples"},
    "paper": {"train.keep_checkpoints", "train.samples"},
    "final": {"train.steps", "train.keep_checkpoints", "train.samples"},
    "bodies": {"train.steps", "train.keep_checkpoints", "train.samples"},
    "halves": {"train.steps", "train.keep_checkpoints", "train.samples"},
    "debug": {
        *("clip.frames", "clip.height", "clip.width", "model.size", "train.steps", "train.batch", "train.save_every"),
        *("train.keep_checkpoints", "rollout.steps", "rollout.batch", "rollout.max_frames"),
    },
}
"""Settings that all variants of a study change."""
SYSTEMS = {"ctrl_world": {"model.history", "model.visibility", "train.history_noise"}}
"""Settings that the conditioning of another project's system changes too."""
ADAPTED = {f"adapt.{name}" for name in ("start_from", "robots", "episodes")} | {
    f"train.{name}"
    for name in (
        "batch",
        "optimizer",
        "steps",
        "epochs",
        "learning_rate",
        "warmup_steps",
        "decay_to",
        "ema",
        "log_every",
        "save_every",
    )
}
"""Settings that an adaptation changes too."""


def flatten(settings: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def resolve(path: Path) -> dict[str, Any]:
    """All settings of an experiment with their values, by their dotted names."""
    return dict(flatten(CONVERTER.unstructure(load_experiment(path))))


def allowed(study: str, variant: Variant) -> set[str]:
    return PLACES | CHOSEN | STUDIES[study] | SYSTEMS.get(variant.system, set()) | (ADAPTED if variant.target else set())


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


@pytest.mark.parametrize("name", STUDIES)
def test_variants_change_what_they_must(name: str, tmp_path: Path) -> None:
    study = load_study(ROOT / "configs" / f"study_{name}.yaml")
    experiment, changed = resolve(study.experiment), set()
    for variant in study.planned_variants:
        path = tmp_path / f"{variant.name}.yaml"
        path.write_text(yaml.safe_dump(build_experiment(study, variant)))
        settings = resolve(path)
        different = {key for key in settings if settings[key] != experiment.get(key)}
        assert different <= allowed(name, variant), variant.name
        named = (variant.action, variant.embodiment)
        expected = named if name == "paper" else tuple(f"{key}_channels" if key in DENSE else key for key in named)
        assert (settings["model.action"], settings["model.embodiment"]) == expected
        changed |= different
    assert changed >= STUDIES[name], "the table names what no variant changes"


def test_systems_and_adaptations_are_those_of_their_configs() -> None:
    study = load_study(ROOT / "configs" / "study_small.yaml")
    own = read_yaml("configs/baselines/ctrl_world.yaml")
    assert study.systems["ctrl_world"]["train"] == own["train"]
    assert study.systems["ctrl_world"]["model"].items() <= own["model"].items()
    assert read_yaml("configs/fewshot/full.yaml")["train"].items() <= study.adaptation["train"].items()


def test_costs_know_the_defaults_of_experiments() -> None:
    recipe = load_experiment(ROOT / "configs" / "fixed.yaml")
    assert isinstance(recipe, Experiment)
    settings = CONVERTER.unstructure(recipe)
    for section, values in RECIPE.items():
        assert values.items() <= settings[section].items()


@pytest.mark.parametrize("name", ["small", "paper"])
def test_the_cost_of_training_knows_the_tokens_of_variants(name: str) -> None:
    def work(settings: Mapping[str, Any]) -> float:
        spec = parse(Experiment, {"data": "data", "out": "out", **settings}, "variant").spec
        return flops_of_step(spec) / spec.settings.batch

    study = load_study(ROOT / "configs" / f"study_{name}.yaml", ["--parts", "actions", "ladder", "loeo"])
    experiment = read_yaml(study.experiment)
    assert len(study.planned_runs) > 10
    for run in study.planned_runs:
        settings = build_experiment(study, run)
        estimated = work_of_sample(merge_settings(RECIPE, settings)["model"]) / work_of_sample(read_model(study))
        assert estimated == pytest.approx(work(settings) / work(experiment), rel=0.2)

"""The recommended recipe: every shipped config differs from configs/fixed.yaml only in what its header says.

And the benchmark of it: its changes are settings that exist, and its table says what was measured.
"""

import dataclasses
import runpy
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from tests.synthetic import write_synthetic_data
from xew.model.experiment import Experiment, load_experiment, parse_experiment
from xew.model.latents import Flags
from xew.protocol import VALIDATION_SEED_START

ROOT = Path(__file__).parents[2]
SYSTEM = {"out", "model.action", "model.embodiment"}
FEWSHOT = {"out", "adapt.start_from", "adapt.robots", "train.steps", "train.epochs", "train.optimizer", "train.learning_rate"}
FEWSHOT |= {"train.batch", "train.warmup_steps", "train.decay_to", "train.ema"}
WAN5B = {
    *("out", "cache", "clip.frames", "codec.name", "codec.weights", "codec.dtype", "mesh.data", "mesh.fsdp"),
    *("model.size", "model.action", "model.embodiment", "model.reference", "model.history", "model.visibility"),
    *("model.prediction", "model.weights", "model.text", "model.text_weights", "model.text_tokenizer", "model.remat"),
    *("train.batch", "train.steps", "train.epochs", "train.chunks", "train.optimizer", "train.learning_rate"),
    *("train.warmup_steps", "train.decay_to", "train.ema", "train.motion_loss_weight", "train.log_every", "train.save_every"),
    *("rollout.sampler", "rollout.steps", "rollout.batch", "train.mu_dtype"),
}
DEBUG = {
    *("out", "clip.frames", "model.size", "model.action", "model.embodiment", "model.history", "model.dtype"),
    *("train.batch", "train.steps", "train.optimizer", "train.mu_dtype", "train.warmup_steps", "train.ema"),
    *("train.motion_loss_weight", "train.log_every", "train.save_every", "train.samples"),
    *("rollout.sampler", "rollout.batch", "rollout.max_frames"),
}
DIFFERS: dict[str, set[str]] = {
    "debug": DEBUG,
    "baselines/bwm": SYSTEM,
    "baselines/ctrl_world": SYSTEM | {"model.history", "model.visibility", "train.history_noise"},
    "baselines/enerverse_ac": SYSTEM,
    "baselines/irasim": SYSTEM,
    "fewshot/full": FEWSHOT,
    "fewshot/lora": FEWSHOT | {"adapt.lora_rank"},
    "fewshot/replay": FEWSHOT | {"adapt.replay"},
    "three_views": {"out", "view", "model.embodiment", "clip.height", "clip.width"},
    "wan5b/fixed": WAN5B,
    "wan5b/fewshot": WAN5B - {"model.weights"} | {"adapt.start_from", "adapt.robots", "train.samples"},
}
"""Settings in which each variant differs from configs/fixed.yaml."""


def flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for field in dataclasses.fields(settings):
        value, name = getattr(settings, field.name), f"{prefix}{field.name}"
        yield from flatten(value, f"{name}.") if dataclasses.is_dataclass(value) else [(name, value)]


def differences(first: Experiment, second: Experiment) -> set[str]:
    """Names of the settings in which two experiments differ."""
    values = dict(flatten(second))
    return {name for name, value in flatten(first) if value != values[name]}


def shipped() -> dict[str, Path]:
    """The shipped configs of experiments, by their names."""
    folders = (ROOT / "configs", *(path for path in (ROOT / "configs").iterdir() if path.is_dir()))
    paths = [path for folder in folders for path in folder.glob("*.yaml")]
    names = {path.relative_to(ROOT / "configs").with_suffix("").as_posix(): path for path in paths}
    return {name: path for name, path in sorted(names.items()) if not name.startswith(("study_", "codec", "vae_", "fixed"))}


def test_the_defaults_are_the_recommended_recipe() -> None:
    recipe = load_experiment(ROOT / "configs/fixed.yaml")
    assert differences(recipe, Experiment(data=Path("data"), out=Path("runs/fixed"))) == set()


def test_every_shipped_config_is_compared() -> None:
    assert set(shipped()) == set(DIFFERS)


@pytest.mark.parametrize("name", DIFFERS)
def test_variants_change_only_what_they_must(name: str) -> None:
    assert differences(load_experiment(shipped()[name]), load_experiment(ROOT / "configs/fixed.yaml")) == DIFFERS[name]


@pytest.fixture(scope="module")
def recipe() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "benchmarks" / "recipe.py"), run_name="recipe")


def test_every_change_is_another_experiment_that_can_be_trained(recipe: dict[str, Any]) -> None:
    found = {}
    for name, overrides in recipe["CHANGES"].items():
        _, found[name] = parse_experiment(Flags, [str(ROOT / "configs/fixed.yaml"), *overrides], "recipe", "")
    plain = found.pop("none")
    assert found and all(experiment != plain for experiment in found.values())
    assert len({repr(experiment) for experiment in found.values()}) == len(found)
    assert all(experiment.split == plain.split and experiment.codec == plain.codec for experiment in found.values())


def test_the_table_has_a_line_for_each_sampler_and_for_what_failed(recipe: dict[str, Any]) -> None:
    rollout = {"sampler": "euler:20", "seconds": 30.4, "seen": [0.0612, 28.04, 0.041, 0.08], "unseen": [0.1, 26, 0.06, 0.12]}
    done = {"change": "none", "loss": 0.7004, "train_s": 81.2, "rollouts": [rollout, rollout | {"sampler": "unipc:8"}]}
    lines = recipe["table"]([done, {"change": "shift 3", "failed": "train, see the log"}]).splitlines()
    scores = "0.061 / 0.100 | 28.0 / 26.0 | 0.041 / 0.060 | 0.080 / 0.120 | 30 |"
    assert lines[2] == f"| none | 0.700 | 81 | euler:20 | {scores}"
    assert lines[3] == f"|  |  |  | unipc:8 | {scores}"
    assert lines[4].startswith("| shift 3 | failed: train, see the log |")
    assert {line.count("|") for line in lines} == {10}


@pytest.mark.parametrize(
    ("seeds", "robots", "said"),
    [
        ((VALIDATION_SEED_START,), ("ur5_wsg", "piper"), "has no training episodes"),
        ((0,), ("ur5_wsg", "piper"), r"validation seeds are of \[\] alone"),
        ((0, VALIDATION_SEED_START), ("ur5_wsg",), r"validation seeds are of \['ur5_wsg'\] alone"),
        ((0, VALIDATION_SEED_START), ("ur5_wsg", "piper"), ""),
    ],
)
def test_data_that_cannot_answer_are_refused(
    seeds: tuple[int, ...], robots: tuple[str, ...], said: str, recipe: dict[str, Any], tmp_path: Path
) -> None:
    write_synthetic_data(tmp_path, seeds=seeds, robots=robots, frames=3)
    with pytest.raises(AssertionError, match=said) if said else nullcontext():
        recipe["assert_workload"](tmp_path)

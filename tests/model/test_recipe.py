"""The benchmark of the small size's recipe: its changes are settings that exist, and its table says what was found."""

import runpy
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from tests.synthetic import write_synthetic_data
from xew.model.experiment import parse_experiment
from xew.model.latents import Flags
from xew.protocol import VALIDATION_SEED_START

ROOT = Path(__file__).parents[2]


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
    ("seeds", "robots", "told"),
    [
        ((VALIDATION_SEED_START,), ("ur5_wsg", "piper"), "has no training episodes"),
        ((0,), ("ur5_wsg", "piper"), r"validation seeds are of \[\] alone"),
        ((0, VALIDATION_SEED_START), ("ur5_wsg",), r"validation seeds are of \['ur5_wsg'\] alone"),
        ((0, VALIDATION_SEED_START), ("ur5_wsg", "piper"), ""),
    ],
)
def test_data_that_cannot_answer_are_refused(
    seeds: tuple[int, ...], robots: tuple[str, ...], told: str, recipe: dict[str, Any], tmp_path: Path
) -> None:
    write_synthetic_data(tmp_path, seeds=seeds, robots=robots, frames=3)
    with pytest.raises(AssertionError, match=told) if told else nullcontext():
        recipe["assert_workload"](tmp_path)

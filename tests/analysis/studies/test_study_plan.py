"""Studies before they start: configs, variants, the graph, keys, costs."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from xew.analysis.studies.config import Study, experiment_of, load_study, merged
from xew.analysis.studies.cost import corrected, cost_table, duration, estimate, longest_ways, steps_of, wall_seconds
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.plan import Cell, in_order, key_of, plan
from xew.config import ConfigError
from xew.protocol import PAPER_PARTS, PARTS, VARIANTS

CONFIGS = Path(__file__).parents[3] / "configs"
DEBUG = CONFIGS / "study_debug.yaml"


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """Studies name their experiments from the repository's root."""
    monkeypatch.chdir(CONFIGS.parent)


@pytest.fixture
def study() -> Study:
    return load_study(DEBUG)


@pytest.mark.parametrize("name", ["debug", "small", "paper"])
def test_the_configs_plan_every_variant_of_their_parts(name: str) -> None:
    study = load_study(CONFIGS / f"study_{name}.yaml")
    wanted = {
        variant.name for part in PAPER_PARTS for variant in PARTS[part] if not variant.target or variant.shots in study.shots
    }
    assert wanted <= {variant.name for variant in study.planned}
    cells = plan(study)
    assert len(cells) == 3 + 4 * len(study.planned)
    assert set(study.parts) >= set(PAPER_PARTS)


def test_the_paper_is_planned_at_its_size() -> None:
    study = load_study(CONFIGS / "study_paper.yaml")
    assert sum(study.graded(VARIANTS["fixed-optical_flow-none"]).values()) == 2500
    adapted = VARIANTS["few_shot-piper-3"]
    assert (study.trained(adapted), study.graded(adapted)) == (75, {"ur5_wsg": 500, "piper": 500})
    settings = experiment_of(study, adapted)
    assert settings["adapt"] == {
        "start_from": "studies/paper/runs/fixed-optical_flow-nine_views",
        "robots": ["piper"],
        "episodes": 3,
    }
    assert (settings["train"]["epochs"], float(settings["train"]["learning_rate"])) == (20, 2e-5)
    assert settings["model"]["embodiment"] == "nine_views"


def test_an_adaptation_waits_for_what_it_starts_from(study: Study) -> None:
    cells = plan(study)
    order = [cell.name for cell in in_order(cells)]
    for cell in cells.values():
        assert all(order.index(need) < order.index(cell.name) for need in cell.needs)
    assert "train/fixed-optical_flow-nine_views" in cells["latents/few_shot-piper-1"].needs
    assert "train/fixed-optical_flow-nine_views" in cells["adapt/few_shot-piper-1"].needs
    assert order[0] == "generate" and order[-1] == "analyse"


def test_baselines_are_graded_once_and_over_all_robots(study: Study) -> None:
    graded = [cell for cell in plan(study).values() if "--baselines" in cell.command]
    assert [cell.name for cell in graded] == ["evaluate/fixed-optical_flow-none"]


def test_a_subset_keeps_what_it_starts_from(study: Study) -> None:
    names = [variant.name for variant in replace(study, variants=("few_shot-piper-*",)).planned]
    assert names == ["fixed-optical_flow-nine_views", "few_shot-piper-1"]
    without_panda = replace(study, robots=("aloha_agilex", "arx_x5", "ur5_wsg", "piper")).planned
    assert not any("franka" in variant.name for variant in without_panda)
    assert replace(study, robots=("ur5_wsg", "piper")).graded(VARIANTS["fixed-irasim"]) == {"ur5_wsg": 1, "piper": 1}


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["--parts", "ladders"], "did you mean 'ladder'"),
        (["--robots", "pipr"], "did you mean 'piper'"),
        (["--robots", "piper", "piper"], "a robot stands twice in piper, piper"),
        (["--tasks", "lift_pott"], "did you mean 'lift_pot'"),
        (["--tasks", "lift_pot", "lift_pot"], "a task stands twice"),
        (["--shots", "1", "5"], "unknown number of shots '5'; known: 1, 2, 3"),
        (["--variants", "loeo_*", "leo_*"], "variants 'leo_\\*' matches none of the parts"),
        (["--variants", "few_shot-piper-3"], "no variant"),
        (["--train-seeds", "0"], "expected at least 1 and 1"),
        (["--machine.workers", "0"], "at least 1"),
    ],
)
def test_what_cannot_be_planned_is_said(overrides: list[str], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        load_study(DEBUG, overrides)


def test_a_key_that_does_not_exist_is_said(tmp_path: Path) -> None:
    (tmp_path / "study.yaml").write_text(DEBUG.read_text().replace("train_seeds:", "train_seed:"))
    with pytest.raises(ConfigError, match="did you mean 'train_seeds'"):
        load_study(tmp_path / "study.yaml")


def test_settings_are_laid_over_one_another() -> None:
    below = {"train": {"steps": 3, "batch": 2}, "split": "fixed"}
    assert merged(below, {"train": {"steps": 0, "epochs": 1}}) == {
        "train": {"steps": 0, "batch": 2, "epochs": 1},
        "split": "fixed",
    }
    assert below["train"] == {"steps": 3, "batch": 2}


def test_trainings_may_be_launched_on_other_machines(study: Study) -> None:
    launched = replace(study, machine=replace(study.machine, train_launcher="srun --nodes=2"))
    cell = plan(launched)["train/fixed-joints-none"]
    assert cell.launcher == ("srun", "--nodes=2") and "--distributed" in cell.command
    assert plan(launched)["rollout/fixed-joints-none"].launcher == plan(study)["train/fixed-joints-none"].launcher == ()


def test_systems_and_remedies_have_their_settings() -> None:
    study = replace(load_study(CONFIGS / "study_small.yaml"), parts=(*PAPER_PARTS, "remedies"))
    assert experiment_of(study, VARIANTS["fixed-ctrl_world"])["model"]["history"] == [-60, -50, -40, -30, -20, -10]
    assert "history" not in experiment_of(study, VARIANTS["fixed-irasim"])["model"]
    assert experiment_of(study, VARIANTS["few_shot-piper-1-lora"])["adapt"]["lora_rank"] == 16
    assert experiment_of(study, VARIANTS["few_shot-piper-1-replay"])["adapt"]["replay"] == 0.25


def test_a_training_does_not_depend_on_where_it_lies_nor_on_rollouts(study: Study) -> None:
    moved = replace(study, out=Path("elsewhere"), settings=merged(study.settings, {"rollout": {"steps": 9}}))
    name = "fixed-optical_flow-nine_views"
    assert plan(moved)[f"train/{name}"].inputs == plan(study)[f"train/{name}"].inputs
    assert plan(moved)["adapt/few_shot-piper-1"].inputs == plan(study)["adapt/few_shot-piper-1"].inputs
    assert plan(moved)[f"rollout/{name}"].inputs != plan(study)[f"rollout/{name}"].inputs
    faster = replace(study, settings=merged(study.settings, {"train": {"learning_rate": 1.0}}))
    assert plan(faster)[f"train/{name}"].inputs != plan(study)[f"train/{name}"].inputs


def test_keys_depend_on_inputs_and_on_what_came_before() -> None:
    cell = Cell("train", "a", ("module",), ("latents/a",), {"steps": 1}, Path("a"))
    keys = {key_of(cell, ["x"]), key_of(cell, ["y"]), key_of(cell, [None]), key_of(replace(cell, inputs={"steps": 2}), ["x"])}
    assert len(keys) == 4
    assert key_of(replace(cell, command=("other",), product=Path("b")), ["x"]) in keys


def test_epochs_are_counted_in_steps() -> None:
    """The paper: 20 passes over 75 episodes of 178 frames; two chunks of 121 cover one, so each is one sample."""
    study = load_study(CONFIGS / "study_paper.yaml")
    variant = VARIANTS["few_shot-piper-3"]
    assert steps_of(study, variant, experiment_of(study, variant)) == round(20 * 75 / 8)


def graph(*edges: tuple[str, str]) -> dict[str, Cell]:
    """Cells of one slot, from (cell, the cells before it)."""
    cells = [Cell("train", name, (), tuple(f"train/{need}" for need in needs), None, Path(name)) for name, needs in edges]
    return {cell.name: cell for cell in cells}


def test_wall_time_by_hand() -> None:
    """a and b side by side, c after both; two more beside: 3 slots need 3 + 4, one slot needs all of it."""
    cells = graph(("a", ""), ("b", ""), ("c", "ab"), ("d", ""), ("e", ""))
    seconds = {"train/a": 3.0, "train/b": 2.0, "train/c": 4.0, "train/d": 1.0, "train/e": 1.0}
    assert longest_ways(cells, seconds)["train/a"] == 7.0
    assert wall_seconds(cells, seconds, (), slots=3) == 7.0
    assert wall_seconds(cells, seconds, (), slots=1) == 11.0
    assert wall_seconds(cells, seconds, ("train/a", "train/b"), slots=1) == 6.0


def test_a_training_that_takes_all_gpus_runs_alone() -> None:
    cells = graph(("a", ""), ("b", ""))
    cells = {name: replace(cell, gpus=8) for name, cell in cells.items()}
    assert wall_seconds(cells, dict.fromkeys(cells, 5.0), (), slots=8) == 10.0


def test_the_estimate_adds_up_and_learns(study: Study, tmp_path: Path) -> None:
    study = replace(study, out=tmp_path / "study")
    cells, rates = plan(study), study.rates
    costs = estimate(study, cells)
    assert costs["generate"].seconds == rates.start_s + 10 * rates.episode_s
    assert costs["rollout/few_shot-piper-1"].amount == 2
    assert costs["train/fixed-joints-none"].amount == study.settings["train"]["steps"]
    ledger = Ledger(study.out)
    before = corrected(costs, cells, ledger)
    assert before == {name: cost.seconds for name, cost in costs.items()}
    table = cost_table(study, cells, costs, before, ledger, slots=2)
    assert table.splitlines()[1].split()[:3] == ["generate", "1", "0"] and rates.measured_on in table


def test_the_estimate_warns_of_a_full_disk(study: Study, tmp_path: Path) -> None:
    study = replace(study, out=tmp_path, rates=replace(study.rates, episode_mb=1e9))
    cells = plan(study)
    costs = estimate(study, cells)
    table = cost_table(study, cells, costs, corrected(costs, cells, Ledger(tmp_path)), Ledger(tmp_path), slots=1)
    assert "WARNING: 10000000" in table


@pytest.mark.parametrize(("seconds", "text"), [(3.2, "3 s"), (600, "10 min"), (12_000, "3 h 20 min")])
def test_durations_are_told_as_people_do(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_the_experiments_are_files_that_the_model_takes(study: Study) -> None:
    for variant in study.planned:
        assert yaml.safe_load(yaml.safe_dump(experiment_of(study, variant))) == experiment_of(study, variant)

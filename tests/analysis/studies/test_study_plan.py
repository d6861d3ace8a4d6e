"""Studies before they start: configs, variants, the graph, keys, costs."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

import xew
from xew.analysis.studies.config import Study, build_experiment, load_study, run_folder
from xew.analysis.studies.cost import (
    correct_by_ledger,
    count_optimizer_steps,
    critical_paths,
    estimate,
    estimate_wall_seconds,
    format_costs,
    format_duration,
    study_rates,
)
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.machines import ThisMachine
from xew.analysis.studies.plan import Step, plan, sort_steps, source_digest, step_key
from xew.analysis.studies.rates import Rate
from xew.analysis.study import main
from xew.analysis.study_analyse import format_coverage
from xew.config import ConfigError, merge_settings
from xew.protocol import PAPER_PARTS, PARTS, SEEN_ROBOTS, VARIANTS, expand_robots

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
    assert wanted <= {variant.name for variant in study.planned_variants}
    steps = plan(study)
    assert len(steps) == 4 + 4 * len(study.planned_variants)
    assert set(study.parts) >= set(PAPER_PARTS)


def test_the_paper_is_planned_at_its_size() -> None:
    study = load_study(CONFIGS / "study_paper.yaml")
    assert sum(study.graded_counts(VARIANTS["fixed-optical_flow-none"]).values()) == 2500
    adapted = VARIANTS["few_shot-piper-3"]
    assert (study.training_count(adapted), study.graded_counts(adapted)) == (75, {"ur5_wsg": 500, "piper": 500})
    settings = build_experiment(study, adapted)
    assert settings["adapt"] == {
        "start_from": "studies/paper/runs/fixed-optical_flow-nine_views",
        "robots": ["piper"],
        "episodes": 3,
    }
    assert (settings["train"]["epochs"], float(settings["train"]["learning_rate"])) == (20, 2e-5)
    assert settings["model"]["embodiment"] == "nine_views"


def test_an_adaptation_waits_for_what_it_starts_from(study: Study) -> None:
    steps = plan(study)
    order = [step.name for step in sort_steps(steps)]
    for step in steps.values():
        assert all(order.index(name) < order.index(step.name) for name in step.predecessors)
    assert "train/fixed-optical_flow-nine_views" in steps["latents/few_shot-piper-1"].needs
    assert "train/fixed-optical_flow-nine_views" in steps["adapt/few_shot-piper-1"].needs
    assert order[0] == "generate" and order[-1] == "analyse"


def test_what_a_step_depends_on_does_not_depend_on_the_variants_of_a_piece(study: Study) -> None:
    """Whichever variant of a split comes first encodes what others share, and pieces with other firsts can be merged."""
    whole, piece = plan(study), plan(replace(study, variants=("fixed-joints-none", "fixed-mask-none")))
    assert whole["latents/fixed-mask-none"].after == ("latents/fixed-optical_flow-none",)
    assert piece["latents/fixed-mask-none"].after == ("latents/fixed-joints-none",)
    for kind in ("latents", "train", "rollout", "evaluate"):
        for name in (f"{kind}/fixed-joints-none", f"{kind}/fixed-mask-none"):
            assert (whole[name].needs, whole[name].inputs) == (piece[name].needs, piece[name].inputs)


def test_baselines_are_graded_once_and_before_there_is_a_model(study: Study) -> None:
    steps = plan(study)
    command = steps["baselines"].command
    assert command[command.index("--baselines-of") + 1] == "test" and command[command.index("--max-frames") + 1] == "5"
    assert command[command.index("--codec") + 1] == "studies/debug/configs/fixed-optical_flow-none.yaml"
    assert steps["baselines"].needs == ("generate", "latents/fixed-optical_flow-none")
    assert "baselines" in steps["analyse"].needs
    assert all("--no-baselines" in step.command for step in steps.values() if step.kind == "evaluate")


def test_a_study_of_own_motion_makes_and_names_it(study: Study) -> None:
    own = replace(study, motion="own")
    assert plan(own)["generate"].command[-2:] == ("--motion", "own") and "--motion" not in plan(study)["generate"].command
    variants = (VARIANTS["fixed-irasim"], VARIANTS["loeo_piper-optical_flow-nine_views"])
    assert [build_experiment(own, variant)["split"] for variant in variants] == ["fixed_own", "loeo_piper_own"]
    assert build_experiment(study, variants[0])["split"] == "fixed"


def test_the_final_study_makes_predicts_and_grades_seeds_that_nobody_has_looked_at(
    study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training seeds stay; steps of other studies keep their digests, since the usual family is in none."""
    usual, final = plan(study), plan(replace(study, test_family="final"))
    generate, rollout, baselines = (final[name].command for name in ("generate", "rollout/fixed-mask-none", "baselines"))
    assert " ".join(generate).endswith("--train-seeds 1 --test-seeds 0 --final-seeds 1")
    assert rollout[rollout.index("--split") + 1] == baselines[baselines.index("--baselines-of") + 1] == "final"
    assert "--test-seeds 1" in " ".join(usual["generate"].command) and "final" not in str(usual)
    assert step_key(final["generate"], []) != step_key(usual["generate"], [])
    monkeypatch.setattr("xew.analysis.study.check_configs", lambda paths: None)
    trial = plan(replace(study, test_family="validation"))["generate"].command
    assert " ".join(trial).endswith("--train-seeds 1 --test-seeds 0 --validation-seeds 1")
    for family, says in (("test", "from 1,000,000"), ("validation", "from 800,000"), ("final", "from 2,100,000")):
        main(["configs/study_debug.yaml", "--dry-run", "--test-family", family, "--out", str(tmp_path / family)])
        assert says in capsys.readouterr().out


def test_coverage_is_told_of_one_variant_and_of_many() -> None:
    def said(names: str, incomplete: str = "") -> str:
        variants = {name: {"expected": {"piper": 2}, "found": {"piper": 1}} for name in names}
        return format_coverage({"variants": variants, "incomplete": list(incomplete)})

    assert said("a") == "the one variant is complete" and said("ab") == "all 2 variants are complete"
    assert said("a", "a") == "INCOMPLETE, the one variant lacks scored episodes:\n  a: piper 1 of 2"
    assert said("ab", "b") == "INCOMPLETE, 1 of 2 variants lack scored episodes:\n  b: piper 1 of 2"


BODIES = CONFIGS / "study_bodies.yaml"


def test_a_study_of_bodies_makes_what_its_variants_ask_for() -> None:
    """Bodies that train have training episodes, bodies that are graded have test episodes, and the five robots both."""
    robots = ["--robots", "ur5_wsg", "piper", "body:0-15", "body:64-65", "body:104-111"]
    study = load_study(BODIES, [*robots, "--variants", "scaling_seen*"])
    names = [variant.name for variant in study.planned_variants]
    assert names == [f"scaling_seen{bodies}-optical_flow-robot_render" for bodies in ("", "_bodies_4", "_bodies_16")]
    assert study.trained_robots == ("ur5_wsg", "piper", *expand_robots(["body:0-15"]))
    assert study.graded_robots == ("ur5_wsg", "piper", *expand_robots(["body:64-65", "body:104-111"]))
    steps = plan(study)
    command = steps["generate"].command
    trained, tested = command[command.index("--robots") + 1 :], command[command.index("--test-robots") + 1 :]
    assert (trained[:18], tested[:12]) == (study.trained_robots, study.graded_robots)
    trial = replace(study, test_family="validation")
    made = plan(trial)["generate"].command
    assert made[made.index("--robots") + 1 :][:28] == trial.trained_robots == study.trained_robots + study.graded_robots[2:]
    assert estimate(trial, plan(trial))["generate"].amount == 6 * (10 * 28 + 2 * 12)
    first, last = study.planned_variants[0], study.planned_variants[-1]
    assert study.graded_counts(first) == dict.fromkeys(study.graded_robots, 12)
    assert study.graded_counts(last) == dict.fromkeys(study.graded_robots[:4], 12), "one model alone is asked for distances"
    assert [study.training_count(variant) for variant in (first, last)] == [60, 17 * 60]
    command = steps["distances"].command
    assert command[command.index("--robot") + 1 :][:8] == study.graded_robots[-8:]
    costs = estimate(study, steps)
    assert costs["generate"].amount == 6 * (10 * 18 + 2 * 12)
    assert costs["distances"].amount == 13 * 12 / 2, "of the five robots and eight bodies"


def test_a_model_of_bodies_is_trained_on_all_of_them_or_not_planned() -> None:
    with pytest.raises(ConfigError, match="no variant of the parts scaling, bodies is left"):
        load_study(BODIES, ["--robots", "ur5_wsg", "body:0-2", "body:64-65", "--variants", "scaling_bodies_4-*"])
    with pytest.raises(ConfigError, match="unknown robot 'body_9999'"):
        load_study(BODIES, ["--robots", "ur5_wsg", "body:9999"])


def test_the_report_is_made_anew_when_the_study_in_the_other_motion_has_scores(study: Study, tmp_path: Path) -> None:
    beside = replace(study, other_motion=tmp_path)
    before = plan(beside)["analyse"].inputs
    assert before == plan(study)["analyse"].inputs, "nothing to compare with yet"
    (tmp_path / "scores.parquet").write_bytes(b"scores")
    assert plan(beside)["analyse"].inputs != before and beside.other_scores == tmp_path / "scores.parquet"


def test_changed_scenes_are_made_once_and_predicted_and_graded_for_both_models() -> None:
    study = load_study(CONFIGS / "study_shifts.yaml", ["--training-seeds", "0", "1"])
    steps = plan(study)
    name, remedy = (variant.name for variant in PARTS["shifts"])
    assert len(study.shifted_runs) == 36 and len(steps) == 3 + 4 * 4 + 1 + 18 + 2 * 36, "of the first training of each"
    lamp, table = (steps[f"generate/data_{change}"].command for change in ("light_2", "height_3"))
    assert lamp[0] == "xew.sim_warp.inspect" and lamp[-4:] == ("--change", "light:2", "--out", "studies/shifts/data_light_2")
    assert table[0] == "xew.sim_warp.generate" and table[12:16] == ("--train-seeds", "0", "--test-seeds", "2")
    for model in (name, remedy):
        rollout, grading = steps[f"rollout/{model}@light_2"], steps[f"evaluate/{model}@light_2"]
        assert rollout.needs == ("generate/data_light_2", f"train/{model}") and grading.name in steps["analyse"].needs
        robots = rollout.command[rollout.command.index("--robots") + 1 : rollout.command.index("--out")]
        assert robots == SEEN_ROBOTS and rollout.command[rollout.command.index("--data") + 1] == "studies/shifts/data_light_2"
        assert str(study.scores_path(f"{model}@light_2")) in grading.command
        assert "studies/shifts/data" in steps[f"rollout/{model}"].command, "unchanged test scenes for both"
    costs = estimate(study, steps)
    assert costs[f"rollout/{name}@light_2"].amount == costs["generate/data_light_2"].amount == 6 * 2 * 3
    few = load_study(CONFIGS / "study_shifts.yaml", ["--changes", "clutter:1"])
    assert list(few.shifted_runs) == [f"{name}@clutter_1", f"{remedy}@clutter_1"] and not load_study(DEBUG).shifted_runs
    with pytest.raises(ConfigError, match="unknown change of scenes 'light:4'"):
        load_study(CONFIGS / "study_shifts.yaml", ["--changes", "light:4"])


def test_the_remedy_trains_on_randomly_changed_scenes_of_its_own() -> None:
    study = load_study(CONFIGS / "study_shifts.yaml")
    steps, (first, remedy) = plan(study), PARTS["shifts"]
    made = steps["generate/data_random"]
    assert made.command[-4:] == ("--change", "random", "--out", "studies/shifts/data_random") and not made.needs
    counted = made.command.index("--robots"), made.command.index("--physics")
    assert made.command[slice(*counted)] == ("--robots", *SEEN_ROBOTS, "--train-seeds", "20", "--test-seeds", "0")
    own, other = (build_experiment(study, variant) for variant in (remedy, first))
    folders = {"data": "studies/shifts/data_random", "cache": "studies/shifts/latents_random"}
    assert own == other | folders | {"out": f"studies/shifts/runs/{remedy.name}"}
    latents = steps[f"latents/{remedy.name}"]
    assert latents.needs == (made.name,) and latents.product == Path(folders["cache"]) and not latents.after
    costs = estimate(study, steps)
    assert costs[made.name].amount == 6 * 20 * 3
    assert costs[latents.name].amount == costs[f"latents/{first.name}"].amount > 0, "nothing is shared"
    alone = plan(replace(study, variants=(first.name,)))
    assert made.name not in alone and len(alone) == 3 + 4 + 3 * 18


def test_a_view_is_rendered_trained_and_graded_in_every_step(study: Study) -> None:
    plain, steps = plan(study), plan(load_study(DEBUG, ["--view", "wrist_left"]))
    variant = study.planned_variants[0].name
    assert steps.keys() == plain.keys()
    for name, option in (("generate", "--cameras"), ("baselines", "--view"), (f"evaluate/{variant}", "--view")):
        command = steps[name].command
        assert command[command.index(option) + 1] == "wrist_left" and option not in plain[name].command
    for name in ("generate", "baselines", f"latents/{variant}", f"train/{variant}"):
        assert steps[name].inputs != plain[name].inputs
    seen = replace(load_study(CONFIGS / "study_shifts.yaml"), view="front")
    shifted = plan(seen)
    assert build_experiment(seen, PARTS["shifts"][1])["view"] == "front" and "view" not in plain[f"train/{variant}"].inputs
    for name in ("generate/data_random", "generate/data_light_1", f"evaluate/{PARTS['shifts'][0].name}@light_1"):
        assert "front" in shifted[name].command


@pytest.mark.parametrize(
    ("config", "view", "message"),
    [
        ("study_debug.yaml", "wrist_lef", "unknown view 'wrist_lef'; did you mean 'wrist_left'"),
        (
            "study_shifts.yaml",
            "wrist_right",
            "the camera wrist_right moves with the robot, and fixed-mask_and_flow.* stands still",
        ),
    ],
)
def test_a_view_that_cannot_be_predicted_is_refused(config: str, view: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_study(CONFIGS / config, ["--view", view])


def test_every_training_seed_is_a_training_of_every_variant(study: Study) -> None:
    study = load_study(DEBUG, ["--training-seeds", "3", "7"])
    steps, once = plan(study), plan(load_study(DEBUG))
    assert len(steps) == 4 + 4 * 2 * len(study.planned_variants) and set(once) < set(steps)
    again = steps["adapt/few_shot-piper-1-seed_7"]
    assert "train/fixed-optical_flow-nine_views-seed_7" in again.needs and "latents/few_shot-piper-1-seed_7" in again.needs
    runs = {run.name: run for run in study.planned_runs}
    settings = {name: build_experiment(study, runs[f"few_shot-piper-1{name}"]) for name in ("", "-seed_7")}
    assert [settings[name]["train"]["seed"] for name in settings] == [3, 7]
    assert settings["-seed_7"]["adapt"]["start_from"] == "studies/debug/runs/fixed-optical_flow-nine_views-seed_7"
    assert (runs["fixed-irasim-seed_7"].of, runs["fixed-irasim"].of) == ("fixed-irasim", "fixed-irasim")
    assert [step.name for step in steps.values() if step.kind == "baselines"] == ["baselines"]
    for name, run in runs.items():
        command = steps[f"evaluate/{name}"].command
        assert command[command.index("--codec") + 1] == str(run_folder(study, run)), "the floor is of its own codec"
    costs = estimate(study, steps)
    assert costs["train/fixed-irasim-seed_7"] == costs["train/fixed-irasim"]
    # One training has the experiment's own seed, as studies had before there were several.
    assert "seed" not in build_experiment(load_study(DEBUG), load_study(DEBUG).planned_runs[0])["train"]


def test_a_subset_keeps_what_it_starts_from(study: Study) -> None:
    names = [variant.name for variant in replace(study, variants=("few_shot-piper-*",)).planned_variants]
    assert names == ["fixed-optical_flow-nine_views", "few_shot-piper-1"]
    without_panda = replace(study, robots=("aloha_agilex", "arx_x5", "ur5_wsg", "piper")).planned_variants
    assert not any("franka" in variant.name for variant in without_panda)
    assert replace(study, robots=("ur5_wsg", "piper")).graded_counts(VARIANTS["fixed-irasim"]) == {"ur5_wsg": 1, "piper": 1}


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["--parts", "ladders"], "did you mean 'ladder'"),
        (["--robots", "pipr"], "did you mean 'piper'"),
        (["--robots", "piper", "piper"], "a robot is named twice in piper, piper"),
        (["--tasks", "lift_pott"], "did you mean 'lift_pot'"),
        (["--tasks", "lift_pot", "lift_pot"], "a task is named twice"),
        (["--training-seeds", "1", "1"], "a training seed is named twice in 1, 1"),
        (["--test-family", "fnal"], "unknown family of test seeds 'fnal'; did you mean 'final'"),
        (["--shots", "1", "5"], "unknown number of shots '5'; known: 1, 2, 3"),
        (["--variants", "loeo_*", "leo_*"], "variants 'leo_\\*' matches none of the parts"),
        (["--variants", "few_shot-piper-3"], "no variant"),
        (["--train-seeds", "0"], "expected at least 1 and 1"),
        (["--machine.workers", "0"], "machine.workers is 0"),
        (["--machine.steps-per-gpu", "0"], "machine.steps_per_gpu is 0; expected at least 1"),
    ],
)
def test_what_cannot_be_planned_is_said(overrides: list[str], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        load_study(DEBUG, overrides)


def test_a_key_that_does_not_exist_is_said(tmp_path: Path) -> None:
    text = DEBUG.read_text().replace("base: study_small.yaml", f"base: {CONFIGS}/study_small.yaml")
    (tmp_path / "study.yaml").write_text(text.replace("train_seeds:", "train_seed:"))
    with pytest.raises(ConfigError, match="did you mean 'train_seeds'"):
        load_study(tmp_path / "study.yaml")


def test_settings_are_laid_over_one_another() -> None:
    below = {"train": {"steps": 3, "batch": 2}, "split": "fixed"}
    assert merge_settings(below, {"train": {"steps": 0, "epochs": 1}}) == {
        "train": {"steps": 0, "batch": 2, "epochs": 1},
        "split": "fixed",
    }
    assert below["train"] == {"steps": 3, "batch": 2}


def test_trainings_may_be_launched_on_other_machines(study: Study) -> None:
    launched = replace(study, machine=replace(study.machine, train_launcher="srun --nodes=2"))
    step = plan(launched)["train/fixed-joints-none"]
    assert step.launcher == ("srun", "--nodes=2") and "--distributed" in step.command
    assert plan(launched)["rollout/fixed-joints-none"].launcher == plan(study)["train/fixed-joints-none"].launcher == ()


def test_steps_of_a_kind_have_an_environment_of_their_own(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = plan(replace(study, step_environment={"train": {"XLA_FLAGS": "--quick"}}))
    assert {step.kind for step in steps.values() if step.environment} == {"train"}
    monkeypatch.setenv("OTHER", "0")
    machine = ThisMachine((), 1, {"OTHER": "1"})
    compares = "import os; raise SystemExit(os.environ['XLA_FLAGS'] + os.environ['OTHER'] != '--quick1')"
    step = replace(steps["train/fixed-joints-none"], launcher=(sys.executable, "-c", compares))
    machine.start(step, (), tmp_path / "step.log")
    assert machine.wait() == [("train/fixed-joints-none", 0)]
    config = tmp_path / "study.yaml"
    text = DEBUG.read_text().replace("base: study_small.yaml", f"base: {CONFIGS}/study_small.yaml")
    config.write_text(text.replace("  train: &quick", "  training: &quick"))
    with pytest.raises(ConfigError, match=r"unknown kind of step in step_environment 'training'; did you mean 'train'"):
        load_study(config)


def test_systems_and_remedies_have_their_settings() -> None:
    study = replace(load_study(CONFIGS / "study_small.yaml"), parts=(*PAPER_PARTS, "remedies"))
    assert build_experiment(study, VARIANTS["fixed-ctrl_world"])["model"]["history"] == [-60, -50, -40, -30, -20, -10]
    assert "history" not in build_experiment(study, VARIANTS["fixed-irasim"])["model"]
    assert build_experiment(study, VARIANTS["few_shot-piper-1-lora"])["adapt"]["lora_rank"] == 16
    assert build_experiment(study, VARIANTS["few_shot-piper-1-replay"])["adapt"]["replay"] == 0.25


def test_a_training_does_not_depend_on_where_it_lies_nor_on_rollouts(study: Study) -> None:
    moved = replace(study, out=Path("elsewhere"), settings=merge_settings(study.settings, {"rollout": {"steps": 9}}))
    name = "fixed-optical_flow-nine_views"
    assert plan(moved)[f"train/{name}"].inputs == plan(study)[f"train/{name}"].inputs
    assert plan(moved)["adapt/few_shot-piper-1"].inputs == plan(study)["adapt/few_shot-piper-1"].inputs
    assert plan(moved)[f"rollout/{name}"].inputs != plan(study)[f"rollout/{name}"].inputs
    faster = replace(study, settings=merge_settings(study.settings, {"train": {"learning_rate": 1.0}}))
    assert plan(faster)[f"train/{name}"].inputs != plan(study)[f"train/{name}"].inputs


def test_keys_depend_on_inputs_and_on_what_came_before() -> None:
    step = Step("train", "a", ("module",), ("latents/a",), {"steps": 1}, Path("a"))
    keys = {
        step_key(step, ["x"]),
        step_key(step, ["y"]),
        step_key(step, [None]),
        step_key(replace(step, inputs={"steps": 2}), ["x"]),
    }
    assert len(keys) == 4
    assert step_key(replace(step, command=("other",), product=Path("b")), ["x"]) in keys


@pytest.mark.parametrize("path", ["analysis/tables/claims.py", "analysis/tables/added.json", "analysis/report.py"])
def test_the_report_is_stale_when_a_file_changes_at_any_depth(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    """A step that is done needs work again when the code in a sub-folder of its room changes."""
    root = tmp_path / "xew"
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(CONFIGS.parent / "xew" / "analysis", root / "analysis", ignore=ignored)
    monkeypatch.setattr(xew, "__path__", [str(root)])

    def plan_report() -> Step:
        source_digest.cache_clear()
        return replace(plan(study)["analyse"], needs=(), product=tmp_path / "index.html")

    step, ledger = plan_report(), Ledger(tmp_path / "study")
    step.product.write_text("report")
    ledger.begin(step)
    assert ledger.finish(step, 0, 1.0) == ""
    (root / "analysis" / "tables" / "__pycache__").mkdir()
    (root / "analysis" / "tables" / "__pycache__" / "claims.pyc").write_bytes(b"compiled")
    assert ledger.find_done(plan_report())
    with (root / path).open("a") as file:
        file.write("# edited")
    assert not ledger.find_done(plan_report())
    source_digest.cache_clear()


def test_grades_are_stale_when_the_protocol_of_grading_is_another(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    """A study's grades outlast edits of the code that change no score; the protocol's version tells when they do."""
    before = plan(study)
    monkeypatch.setattr("xew.analysis.studies.plan.GRADING_PROTOCOL", 999)
    after = plan(study)
    changed = {name for name, step in before.items() if step_key(step, ()) != step_key(after[name], ())}
    assert changed == {"baselines", *(name for name in before if name.startswith("evaluate/"))}


def test_epochs_are_counted_in_steps() -> None:
    """The paper: 20 passes over 75 episodes of 178 frames; two chunks of 121 cover one, so each is one sample."""
    study = load_study(CONFIGS / "study_paper.yaml")
    variant = VARIANTS["few_shot-piper-3"]
    assert count_optimizer_steps(study, variant, build_experiment(study, variant)) == round(20 * 75 / 8)


def graph(*edges: tuple[str, str]) -> dict[str, Step]:
    """Steps of one slot, from (step, the steps before it)."""
    steps = [Step("train", name, (), tuple(f"train/{need}" for need in needs), None, Path(name)) for name, needs in edges]
    return {step.name: step for step in steps}


def test_wall_time_by_hand() -> None:
    """a and b side by side, c after both; two more beside: 3 slots need 3 + 4, one slot needs all of it."""
    steps = graph(("a", ""), ("b", ""), ("c", "ab"), ("d", ""), ("e", ""))
    seconds = {"train/a": 3.0, "train/b": 2.0, "train/c": 4.0, "train/d": 1.0, "train/e": 1.0}
    assert critical_paths(steps, seconds)["train/a"] == 7.0
    assert estimate_wall_seconds(steps, seconds, (), slots=3) == 7.0
    assert estimate_wall_seconds(steps, seconds, (), slots=1) == 11.0
    assert estimate_wall_seconds(steps, seconds, ("train/a", "train/b"), slots=1) == 6.0


def test_wall_time_of_steps_beside_trainings_by_hand() -> None:
    """One GPU trains a, then b, in 3 + 2; a's rollout goes beside b, and only b's comes after. Alone it would be 5 + 2 + 2."""
    steps = graph(("a", ""), ("b", ""))
    for name in "ab":
        steps[f"rollout/{name}"] = Step("rollout", name, (), (f"train/{name}",), None, Path(name))
    seconds = {"train/a": 3.0, "train/b": 2.0, "rollout/a": 2.0, "rollout/b": 2.0}
    assert estimate_wall_seconds(steps, seconds, (), slots=1, steps_per_gpu=2) == 7.0
    assert estimate_wall_seconds(steps, seconds, (), slots=1) == 9.0


def test_a_training_that_takes_all_gpus_runs_alone() -> None:
    steps = graph(("a", ""), ("b", ""))
    steps = {name: replace(step, gpus=8) for name, step in steps.items()}
    assert estimate_wall_seconds(steps, dict.fromkeys(steps, 5.0), (), slots=8) == 10.0


def test_the_estimate_adds_up_and_learns(study: Study, tmp_path: Path) -> None:
    study = replace(study, out=tmp_path / "study")
    steps, rates = plan(study), study_rates(study)
    costs = estimate(study, steps)
    assert costs["generate"].seconds() == rates.kinds["generate"].start_s + 10 * rates.kinds["generate"].item_s
    assert costs["train/fixed-joints-none"].items == 2 * 20, "samples: a batch of two in 20 steps"
    assert costs["rollout/few_shot-piper-1"].amount == 2
    assert costs["train/fixed-joints-none"].amount == study.settings["train"]["steps"]
    ledger = Ledger(study.out)
    before = correct_by_ledger(costs, steps, ledger)
    assert before == {name: cost.seconds() for name, cost in costs.items()}
    table = format_costs(study, steps, costs, before, ledger, slots=2)
    assert table.splitlines()[1].split()[:3] == ["generate", "1", "0"] and rates.text in table


def test_the_estimate_warns_of_a_full_disk(study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = replace(study, out=tmp_path)
    rates = study_rates(study)
    huge = replace(rates, kinds=rates.kinds | {"generate": Rate(4, 2, item_mb=1e9)})
    monkeypatch.setattr("xew.analysis.studies.cost.study_rates", lambda study: huge)
    steps = plan(study)
    costs = estimate(study, steps)
    table = format_costs(study, steps, costs, correct_by_ledger(costs, steps, Ledger(tmp_path)), Ledger(tmp_path), slots=1)
    assert "WARNING: 10000000" in table


@pytest.mark.parametrize(("seconds", "text"), [(3.2, "3 s"), (600, "10 min"), (12_000, "3 h 20 min")])
def test_durations_are_told_as_people_do(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text


def test_the_experiments_are_files_that_the_model_takes(study: Study) -> None:
    for variant in study.planned_variants:
        assert yaml.safe_load(yaml.safe_dump(build_experiment(study, variant))) == build_experiment(study, variant)

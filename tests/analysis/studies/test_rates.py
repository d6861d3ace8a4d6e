"""Rates of studies: measured ones before documented ones, and how many GPUs each step gets."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tests.analysis.studies.chains import ROOT
from xew.analysis.studies import rates as module
from xew.analysis.studies.config import Settings, load_study
from xew.analysis.studies.cost import estimate, estimate_wall_seconds
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.plan import Step, count_gpus, count_sharing, plan
from xew.analysis.studies.rates import DOCUMENTED, Rate, Rates, find_rates, join_rates, read_rates, write_rates
from xew.analysis.studies.runner import StudyRunner
from xew.analysis.study import main
from xew.config import ConfigError, merge_settings

ONE = Rates("one card", "today", 1, {"rollout": Rate(30, 0.8), "train": Rate(60, 0.02)})
FOUR = Rates("four cards", "today", 4, {"rollout": Rate(20, 0.2), "train": Rate(60, 0.01)})


def test_a_rate_is_a_start_and_items_that_gpus_share() -> None:
    joined = join_rates((ONE, FOUR))
    assert joined["rollout"] == pytest.approx(Rate(30, 0.8, scaling=1.0))
    assert joined["rollout"].seconds(100, 4) == pytest.approx(30 + 20)
    assert joined["train"].seconds(100, 4) == pytest.approx(60 + 1)
    assert joined["train"].seconds(100, 2) == pytest.approx(60 + 100 * 0.02 / 2**0.5)
    alone = join_rates((FOUR,))["rollout"]
    assert alone.scaling == module.SCALING and alone.seconds(100, 4) == pytest.approx(20 + 20)
    parts = (replace(ONE, gpus=0), replace(FOUR, gpus=0))
    assert join_rates(parts)["rollout"].item_s == 0.2, "without GPUs the last part is the whole machine"


def test_measured_rates_win_and_the_line_says_whose_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "rates.json"
    monkeypatch.setattr(module, "rates_path", lambda: path)
    assert "one H100 with 16 cores and four H100 with 64 cores (docs/performance.md" in find_rates("small").text
    assert "nothing of size small was measured here, python -m benchmarks.node does it" in find_rates("small").text
    write_rates(path, "small", [FOUR, ONE])
    write_rates(path, "tiny", [ONE])
    found = find_rates("small")
    assert found.kinds["rollout"].item_s == pytest.approx(0.8)
    assert found.kinds["generate"] == join_rates(read_rates(DOCUMENTED)["small"])["generate"]
    assert found.text.startswith("the rates of: one card and four cards (today); analyse, baselines, distances, evaluate")
    assert "nothing of size wan5b" in find_rates("wan5b").text
    assert find_rates("small", path) == found and read_rates(path)["tiny"] == (ONE,)
    write_rates(path, "tiny", [replace(ONE, kinds={"train": Rate(1, 2)})])
    assert read_rates(path)["tiny"][0].kinds == ONE.kinds | {"train": Rate(1, 2)}, "what was not measured again stays"


@pytest.mark.parametrize("text", ["", "[]", '{"small": [{"machine": "x"}]}', '{"small": [{"gpus": "many"}]}'])
def test_a_file_that_holds_no_rates_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "rates.json").write_text(text)
    with pytest.raises(ConfigError, match=r"rates\.json"):
        find_rates("small", tmp_path / "rates.json")


def test_the_dry_run_reads_a_named_file(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    kinds = {kind: Rate(0, 3600) for kind in ("generate", "train")}
    write_rates(tmp_path / "rates.json", "tiny", [Rates("a slow machine", "today", 0, kinds)])
    config, out = str(ROOT / "configs" / "study_debug.yaml"), str(tmp_path / "study")
    main([config, "--dry-run", "--out", out, "--machine.rates", str(tmp_path / "rates.json")])
    said = capsys.readouterr().out
    (line,) = (line for line in said.splitlines() if line.startswith("generate ") and "episodes" in line)
    assert "a slow machine" in said and float(line.split()[5]) == 10, "hours of ten episodes"
    with pytest.raises(SystemExit):
        main([config, "--dry-run", "--out", out, "--machine.rates", str(tmp_path / "none.json")])
    assert "cannot read the rates" in capsys.readouterr().err


def test_every_kind_of_step_has_a_documented_rate() -> None:
    study = load_study(ROOT / "configs" / "study_bodies.yaml")
    assert estimate(study, plan(study)).keys() == plan(study).keys()
    for size in json.loads(DOCUMENTED.read_text()):
        assert join_rates(read_rates(DOCUMENTED)[size]).keys() == {step.kind for step in plan(study).values()} - {"adapt"} | {
            "train"
        }


def training(name: str, needs: tuple[str, ...] = (), **options: int) -> Step:
    return Step("train", name, (), needs, None, Path(name), may_spread=True, **options)


@pytest.mark.parametrize(
    ("left", "gpus"),
    [("a", [8]), ("ab", [4, 4]), ("abc", [2, 2, 4]), ("abcdefgh", [1] * 8), ("abcdefghijk", [1] * 8)],
)
def test_training_runs_share_free_gpus_evenly(left: str, gpus: list[int]) -> None:
    """A batch of eight is divided evenly, so three runs get 2, 2 and 4 of eight GPUs."""
    steps = {f"train/{name}": training(name, batch=8) for name in left}
    waiting, free, given = set(steps), 8, []
    for name, step in steps.items():
        if free:
            given.append(count_gpus(step, 8, free, count_sharing(step, steps, waiting, waiting, ())))
            free -= given[-1]
            waiting.remove(name)
    assert given == gpus


@pytest.mark.parametrize(
    ("settings", "machine", "planned", "alone"),
    [
        ({}, {}, 1, 8),
        ({"train": {"batch": 4}}, {}, 1, 4),
        ({"train": {"batch": 8, "accumulate": 2}}, {}, 1, 4),
        ({"mesh": {"fsdp": 2}}, {}, 2, 8),
        ({"mesh": {"data": 1, "fsdp": 2}}, {}, 2, 2),
        ({}, {"gpus_per_training": 2}, 2, 2),
        ({}, {"train_launcher": "srun"}, 1, 1),
    ],
)
def test_a_run_takes_what_its_mesh_and_batch_allow(settings: Settings, machine: Settings, planned: int, alone: int) -> None:
    """On eight GPUs, alone; the recipe's batch is 16."""
    study = load_study(ROOT / "configs" / "study_small.yaml")
    changed = replace(study, settings=merge_settings(study.settings, settings), machine=replace(study.machine, **machine))
    step = plan(changed)["train/fixed-joints-none"]
    assert (step.gpus_of(8), count_gpus(step, 8, 8, 1)) == (planned, alone)


def test_runs_that_wait_for_a_run_have_no_share_yet() -> None:
    steps = {"train/a": training("a"), "train/b": training("b", ("train/a",)), "train/c": training("c", ("train/a",))}
    assert count_sharing(steps["train/a"], steps, steps, {"train/a"}, ()) == 1
    assert count_sharing(steps["train/b"], steps, {"train/b", "train/c"}, {"train/b"}, {"train/a"}) == 2


def test_other_steps_spread_when_no_training_run_is_left() -> None:
    steps = {"train/a": training("a")} | {
        f"rollout/{name}": Step("rollout", name, (), (), None, Path(name), may_spread=True) for name in "bc"
    }
    ready = {"rollout/b", "rollout/c"}
    assert count_sharing(steps["rollout/b"], steps, steps, ready, ()) == 0
    assert count_gpus(steps["rollout/b"], 4, 4, 0) == 1
    assert count_sharing(steps["rollout/b"], steps, ready, ready, ()) == 2
    assert count_gpus(steps["rollout/b"], 4, 4, 2) == 2
    assert count_gpus(replace(steps["rollout/b"], may_spread=False), 4, 4, 2) == 1


def test_the_wall_time_knows_that_steps_spread() -> None:
    """One run on all four GPUs, then the two that start from it on two each."""
    steps = {"train/a": training("a"), "train/b": training("b", ("train/a",)), "train/c": training("c", ("train/a",))}
    seconds = dict.fromkeys(steps, 8.0)
    assert estimate_wall_seconds(steps, seconds, (), 4, speedup=lambda name, gpus: gpus) == 8 / 4 + 8 / 2
    assert estimate_wall_seconds(steps, seconds, (), 4) == 16.0


class FourGpus:
    """Machines of four GPUs on which steps end at once, one after another; notes what each got."""

    slots = 4

    def __init__(self) -> None:
        self.given: dict[str, int] = {}
        self.running: dict[str, int] = {}

    def has_room_for(self, step: Step) -> bool:
        return 4 - sum(self.running.values()) >= max(1, step.gpus_of(4))

    def start(self, step: Step, command: tuple[str, ...], log: Path, among: int) -> int:
        self.given[step.name] = self.running[step.name] = count_gpus(step, 4, 4 - sum(self.running.values()), among)
        step.product.write_text(step.name)
        return self.given[step.name]

    def wait(self) -> list[tuple[str, int]]:
        name = next(iter(self.running))
        del self.running[name]
        return [(name, 0)]

    def stop(self) -> None:
        """Nothing runs."""


@pytest.mark.usefixtures("cheap_steps")
def test_a_study_divides_its_gpus(tmp_path: Path) -> None:
    study = load_study(ROOT / "configs" / "study_debug.yaml", ["--out", str(tmp_path)])
    steps = {"train/a": training("a", batch=4), "train/b": training("b", ("train/a",)), "train/c": training("c", ("train/a",))}
    steps["rollout/b"] = Step("rollout", "b", (), ("train/b", "train/c"), None, Path("d"), may_spread=True)
    steps = {name: replace(step, product=tmp_path / step.variant) for name, step in steps.items()}
    machines, ledger = FourGpus(), Ledger(tmp_path)
    assert StudyRunner(study, steps, ledger, machines, dict.fromkeys(steps, 1.0)).run() == {}
    assert machines.given == {"train/a": 4, "train/b": 2, "train/c": 2, "rollout/b": 4}
    assert ledger.record(steps["train/a"])["gpus"] == 4

"""The study runner on commands that cost nothing: order, skipping, failing, stopping, killing, what it says."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from tests.analysis.studies.chains import ROOT, STEPS, begun, chain, run
from tests.synthetic import write_synthetic_data
from xew.analysis import study as runner
from xew.analysis.studies.config import Study, load_study
from xew.analysis.studies.cost import critical_paths
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.machines import ThisMachine
from xew.analysis.studies.plan import Step, plan
from xew.analysis.studies.processes import last_lines, start_step
from xew.analysis.studies.runner import Budget, StudyRunner, complete_command
from xew.analysis.studies.status import exit_with_failures
from xew.config import ConfigError, read_yaml
from xew.episode import EpisodeError
from xew.protocol import join_fault

pytestmark = pytest.mark.usefixtures("cheap_steps")


def test_what_is_done_is_not_done_again(study: Study) -> None:
    steps = chain(study.out)
    assert run(study, steps) == {}
    assert run(study, steps) == {}
    assert begun(study.out) == dict.fromkeys(("data", "left", "right", "end"), 1)
    assert (study.out / "end").read_text() == "end"


def test_a_change_is_carried_on_and_no_further(study: Study) -> None:
    """Other inputs of `left` make it and what needs it anew; where its product stays the same, only it."""
    run(study, chain(study.out))
    changed = chain(study.out, left=("--wait", "0.01"))
    run(study, changed)
    assert begun(study.out) == {"data": 1, "left": 2, "right": 1, "end": 1}
    (study.out / "right").write_text("tampered with")
    run(study, changed)
    assert begun(study.out) == {"data": 1, "left": 2, "right": 2, "end": 1}


def test_what_was_removed_is_made_again_where_it_is_needed(study: Study) -> None:
    run(study, chain(study.out))
    for name in ("data", "left"):
        (study.out / name).unlink()
    run(study, chain(study.out))
    assert begun(study.out) == dict.fromkeys(("data", "left", "right", "end"), 1), "all that needs them is done"
    (study.out / "end").write_text("tampered with")
    run(study, chain(study.out))
    assert begun(study.out) == {"data": 2, "left": 2, "right": 1, "end": 2}, "left needs the data, and end needs left"


def test_pieces_come_together(study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One machine makes the left step, another the right one, from the same data; here only the end is left to do."""
    pieces = [study.out / name for name in ("first", "second")]
    for piece, made in zip(pieces, ("left", "right"), strict=True):
        steps = chain(piece)
        steps.pop("train/end")
        steps.pop("train/left" if made == "right" else "train/right")
        run(replace(study, out=piece), steps)
        (piece / "data").unlink()
    home = chain(study.out)
    assert runner.merge_pieces(home, Ledger(study.out), pieces) == {}
    assert [line.split(": ")[1] for line in capsys.readouterr().out.splitlines()[-2:]] == [
        "2 steps taken over",
        "1 steps taken over",
    ]
    assert run(study, home) == {}
    assert begun(study.out) == {"left": 1, "right": 1, "end": 1}, "what lies beside a product comes along"
    assert (study.out / "left").read_text() == "left" and not (study.out / "data").exists()
    assert "left" in (study.out / "logs" / "train" / "left.log").read_text()
    assert runner.merge_pieces(home, Ledger(study.out), pieces[:1]) == {}
    assert capsys.readouterr().out.splitlines()[-1].endswith("0 steps taken over"), "what is done here stays"


def test_scores_that_were_lost_on_the_way_are_made_again(study: Study) -> None:
    """A piece that was fetched while it was written says that a variant is graded, and its scores are not there."""

    def graded(out: Path) -> dict[str, Step]:
        steps = {name: replace(step, kind="evaluate") for name, step in chain(out).items() if name == "train/data"}
        return {step.name: step for step in steps.values()}

    piece = study.out / "piece"
    run(replace(study, out=piece), graded(piece))
    (piece / "data").unlink()
    assert runner.merge_pieces(graded(study.out), ledger := Ledger(study.out), [piece]) == {}
    assert not any(ledger.record(step) for step in graded(study.out).values())
    assert run(study, graded(study.out)) == {} and begun(study.out) == {"data": 1}


def test_scores_of_baselines_by_video_come_along(study: Study) -> None:
    """The next grading finds the truth through the codec there, and does not grade it once more."""

    def baselines(out: Path) -> dict[str, Step]:
        return {"baselines": Step("baselines", "", (STEPS, str(out / "table"), "table"), (), None, out / "table")}

    piece = study.out / "piece"
    run(replace(study, out=piece), baselines(piece))
    (piece / "data-baselines" / "task").mkdir(parents=True)
    (piece / "data-baselines" / "task" / "cell.json").write_text("{}")
    data = {"generate": Step("generate", "", (), (), None, study.out / "data")}
    runner.merge_pieces(baselines(study.out) | data, Ledger(study.out), [piece])
    assert (study.out / "data-baselines" / "task" / "cell.json").is_file()


def test_all_tables_of_the_distances_come_along(study: Study) -> None:
    def distances(out: Path) -> dict[str, Step]:
        table = out / "tables" / "data"
        return {"distances": Step("distances", "", (STEPS, str(table), "data"), (), None, table)}

    piece = study.out / "piece"
    (piece / "tables").mkdir(parents=True)
    run(replace(study, out=piece), distances(piece))
    (piece / "tables" / "robots.csv").write_text("a table beside")
    runner.merge_pieces(distances(study.out), Ledger(study.out), [piece])
    assert (study.out / "tables" / "robots.csv").read_text() == "a table beside"


def test_a_piece_from_other_data_or_with_another_product_is_not_taken(study: Study) -> None:
    run(replace(study, out=study.out / "piece"), chain(study.out / "piece", data=("--wait", "0.01")))
    home, ledger = chain(study.out), Ledger(study.out)
    runner.merge_pieces(home, ledger, [study.out / "piece"])
    assert not any(ledger.record(step) for step in home.values())
    run(replace(study, out=study.out / "second"), chain(study.out / "second"))
    (study.out / "second" / "right").write_text("tampered with")
    with pytest.raises(ConfigError, match=r"second/right is not what the records of .*second say was made"):
        runner.merge_pieces(home, ledger, [study.out / "second"])
    with pytest.raises(ConfigError, match="no folder of a study"):
        runner.merge_pieces(home, ledger, [study.out / "nothing"])


def test_a_budget_begins_only_what_ends_in_time_and_ends_what_is_begun_first(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two variants, each trained and graded: there is time for one of them, and its grades come before the other's training."""
    steps, ledger = chain(study.out), Ledger(study.out)
    monkeypatch.setattr(Budget, "learn", lambda self, ledger: None)
    budget = Budget(study, {}, ledger, 60.0)
    adapted = ("latents/few", "adapt/few")
    budget._order = {name: place for place, name in enumerate((*steps, *adapted, "evaluate/data", "baselines"))}
    budget._seconds = {"train/data": 30.0, "train/left": 61.0, "train/right": 20.0, "train/end": 10.0}
    assert [budget.fits(name) for name in steps] == [True, False, True, True]
    planned = ["evaluate/data", "baselines", *adapted, *steps]
    assert sorted(budget._order, key=budget.rank) == planned, "grades first, then what a checkpoint here is needed for"
    assert StudyRunner(study, steps, ledger, ThisMachine((), 2, {}), dict.fromkeys(steps, 1.0), budget).run() == {}
    assert begun(study.out) == {"data": 1, "right": 1}, "the end needs what there was no time for"
    assert run(study, steps) == {} and begun(study.out)["data"] == 1


def test_only_some_kinds_of_steps_are_run(study: Study) -> None:
    """What makes pictures on one machine, what grades them later; the report waits for all."""
    steps = chain(study.out)
    for kind, variant, needs in (("evaluate", "graded", "train/end"), ("analyse", "", "evaluate/graded")):
        path = study.out / (variant or "report")
        step = Step(kind, variant, (STEPS, str(path), path.name), (needs,), None, path)
        steps[step.name] = step
    machines, ledger, paths = ThisMachine((), 2, {}), Ledger(study.out), dict.fromkeys(steps, 1.0)
    for only, made in ((("evaluate",), 0), (("train",), 4), (("evaluate", "train"), 5), ((), 6)):
        assert StudyRunner(study, steps, ledger, machines, paths, None, only).run() == {}
        assert sum(bool(ledger.outcome(name)) for name in steps) == made
    with pytest.raises(ConfigError, match=r"--only trian is no kind of step; did you mean 'train'\? there are generate, "):
        runner.read_arguments([str(ROOT / "configs" / "study_debug.yaml"), "--only", "train", "trian"])


def test_latents_wait_for_the_first_variant() -> None:
    """Later variants need streams that the first one encodes."""
    given = ["--parts", "ladder", "loeo", "--variants", "fixed-*", "loeo_piper*", "--repeated", "*"]
    steps = plan(load_study(ROOT / "configs" / "study_debug.yaml", given))
    waits = {step.variant: step.after for step in steps.values() if step.kind == "latents"}
    assert len([after for after in waits.values() if not after]) == 1 < len(waits)


def test_what_follows_is_counted_within_a_variant() -> None:
    steps = {
        name: Step(name.partition("/")[0], name.partition("/")[2], (), needs, None, Path(name))
        for name, needs in (
            ("generate", ()), ("train/a", ("generate",)), ("evaluate/a", ("train/a",)), ("adapt/b", ("train/a",)),
        )
    }  # fmt: skip
    paths = critical_paths(steps, dict.fromkeys(steps, 1.0), own=True)
    assert paths == {"generate": 1.0, "train/a": 2.0, "evaluate/a": 1.0, "adapt/b": 1.0}
    assert critical_paths(steps, dict.fromkeys(steps, 1.0))["generate"] == 3.0


def test_a_failing_cell_is_named_and_the_others_go_on(study: Study, capsys: pytest.CaptureFixture[str]) -> None:
    steps, ledger = chain(study.out, left=("--fail",)), Ledger(study.out)
    failed = run(study, steps)
    assert failed == {"train/left": "exit status 1", "train/end": "needs train/left"}
    assert begun(study.out) == {"data": 1, "left": 1, "right": 1}
    with pytest.raises(SystemExit) as stop:
        exit_with_failures(failed, ledger, steps)
    said = capsys.readouterr().err
    assert stop.value.code == 1
    assert f"log: {study.out / 'logs' / 'train' / 'left.log'}" in said and "the disk is made of cheese" in said
    assert "1 steps failed, 1 could not be made for it" in said
    assert run(study, chain(study.out)) == {}
    assert begun(study.out) == {"data": 1, "left": 2, "right": 1, "end": 1}


def test_a_command_that_makes_nothing_has_failed(study: Study) -> None:
    steps = chain(study.out)
    steps = {"train/data": steps["train/data"], "train/left": steps["train/left"]}
    steps["train/left"] = Step("train", "left", (STEPS, str(study.out / "elsewhere"), "x"), (), None, study.out / "left")
    assert run(study, steps) == {"train/left": f"it made no {study.out / 'left'}"}


def test_the_analysis_is_of_whatever_was_graded(study: Study) -> None:
    steps = chain(study.out, left=("--fail",))
    end = steps.pop("train/end")
    for name in ("left", "right"):
        step = steps.pop(f"train/{name}")
        steps[f"evaluate/{name}"] = Step("evaluate", name, step.command, step.needs, None, step.product)
    analyse = Step("analyse", "", end.command, ("evaluate/left", "evaluate/right"), None, end.product)
    assert list(run(study, steps | {"analyse": analyse})) == ["evaluate/left"]
    assert (study.out / "logs" / "analyse.log").read_text().splitlines()[0].endswith(f"{study.out / 'end'} end right")


def write_checkpoint(run: Path) -> None:
    """As much of a checkpoint as tells one from another."""
    folder = run / "checkpoints" / "10"
    folder.mkdir(parents=True)
    (folder / "_CHECKPOINT_METADATA").write_text('{"init_timestamp_nsecs": 7}')


def test_a_training_goes_on_from_its_own_checkpoint_only(study: Study) -> None:
    run = study.out / "run"
    first, second = (Step("train", "a", (), (), inputs, run) for inputs in ("first", "second"))
    ledger = Ledger(study.out)
    assert not ledger.begin(first)
    run.mkdir()
    (run / "config.yaml").write_text("cut o")
    assert not ledger.begin(first) and not run.exists()
    write_checkpoint(run)
    assert ledger.begin(first) and run.exists()
    assert complete_command(first, True, {}) == ("--resume",)
    assert complete_command(first, False, {}) == ()
    assert not ledger.begin(second) and not run.exists()


def test_rollouts_of_another_training_are_removed(study: Study) -> None:
    product = study.out / "rollouts"
    step = Step("rollout", "a", (), (), "first", product)
    ledger = Ledger(study.out)
    ledger.begin(step)
    product.mkdir()
    ledger.begin(step)
    assert product.exists()
    ledger.begin(Step("rollout", "a", (), (), "second", product))
    assert not product.exists()


def test_a_damaged_record_is_no_record(study: Study) -> None:
    steps, ledger = chain(study.out), Ledger(study.out)
    run(study, steps)
    (study.out / "state" / "train" / "data.json").write_text('{"status": "do')
    assert ledger.record(steps["train/data"]) == {}
    assert run(study, steps) == {}
    assert begun(study.out)["data"] == 2


def wait_for(happened: Callable[[], bool], seconds: float = 60.0) -> None:
    """Until it has happened; fails after some time."""
    until = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < until, "it did not happen"
        time.sleep(0.05)


def alive(name: Path) -> bool:
    """Whether a process holds the lock that steps hold."""
    return subprocess.run(["flock", "--nonblock", str(name), "true"]).returncode != 0


SCRIPT = """
import sys
from pathlib import Path
from tests.analysis.studies.chains import ROOT, chain, run
from xew.analysis import study as runner
from xew.analysis.studies import processes
from xew.analysis.studies.config import load_study

if __name__ == "__main__":
    processes.PRELOADED = ()
    study = load_study(ROOT / "configs" / "study_debug.yaml", ["--out", sys.argv[1]])
    with runner.lock_study(study.out), runner.stop_on_sigterm():
        run(study, chain(study.out, data=("--wait", "300")))
"""


@pytest.fixture
def waiting_study(study: Study) -> Iterator[subprocess.Popen[bytes]]:
    """Another process that runs a chain whose first step takes long."""
    (study.out / "script.py").write_text(SCRIPT)
    arguments = [sys.executable, study.out / "script.py", study.out]
    process = subprocess.Popen(arguments, env=os.environ | {"PYTHONPATH": str(ROOT)})
    wait_for((study.out / "data.begun").exists)
    yield process
    process.kill()
    process.wait()


def test_killed_studies_leave_nobody_behind(study: Study, waiting_study: subprocess.Popen[bytes]) -> None:
    lock = study.out / "logs" / "train" / "data.lock"
    assert alive(lock)
    with (
        pytest.raises(EpisodeError, match=rf"is being written by process {waiting_study.pid} on"),
        runner.lock_study(study.out),
    ):
        pass
    waiting_study.kill()
    waiting_study.wait()
    wait_for(lambda: not alive(lock))
    assert json.loads((study.out / "state" / "train" / "data.json").read_text())["status"] == "begun"
    with runner.lock_study(study.out):
        assert run(study, chain(study.out)) == {}


def test_sigterm_stops_a_study_and_its_cells(study: Study, waiting_study: subprocess.Popen[bytes]) -> None:
    waiting_study.send_signal(signal.SIGTERM)
    assert waiting_study.wait(60) != 0
    assert not alive(study.out / "logs" / "train" / "data.lock")


def test_two_of_one_cell_never_run_at_once(study: Study) -> None:
    """The second waits until the first has gone, as after a kill that was not noticed yet."""
    log = study.out / "step.log"
    command = (STEPS, str(study.out / "file"), "text", "--wait", "0.5")
    first = start_step(command, log, {})
    wait_for((study.out / "file.begun").exists)
    second = start_step(command, log, {})
    assert begun(study.out) == {"file": 1}
    first.join()
    second.join()
    assert (first.exitcode, second.exitcode, begun(study.out)) == (0, 0, {"file": 2})
    assert log.read_text().splitlines()[-1].startswith("exit status 0, ")


@pytest.mark.parametrize(("arguments", "code"), [(["--fail"], 1), (["--unknown-number", "x"], 0), (["--wait", "x"], 2)])
def test_exit_statuses_are_those_of_the_command(tmp_path: Path, arguments: list[str], code: int) -> None:
    process = start_step((STEPS, str(tmp_path / "file"), "text", *arguments), tmp_path / "step.log", {})
    process.join()
    assert process.exitcode == code


def test_the_end_of_a_log_has_no_progress_bars(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text(
        "$ python -m x\ntrain:  0%\rtrain: 50%\rtrain: 100%\n\nerror: no\nexit status 2, 0.1 s of CPU\n"
    )
    assert last_lines(tmp_path / "a.log", 2) == "train: 100%\nerror: no"
    assert last_lines(tmp_path / "none.log") == ""


def test_help_lists_what_may_be_overridden(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        runner.main([str(ROOT / "configs" / "study_debug.yaml"), "--help"])
    said = capsys.readouterr().out
    assert stop.value.code == 0
    assert all(option in said for option in ("--dry-run", "--redo", "--train-seeds", "--machine.gpus-per-training"))


def test_overrides_and_options_go_in_any_order() -> None:
    config = str(ROOT / "configs" / "study_debug.yaml")
    args = runner.read_arguments(
        [config, "--parts", "few_shot", "forgetting", "--redo", "a", "b", "--train-seeds", "2", "--dry-run"]
    )
    assert (args.redo, args.dry_run, args.study.parts) == (("a", "b"), True, ("few_shot", "forgetting"))
    assert args.study == load_study(
        ROOT / "configs" / "study_debug.yaml", ["--parts", "few_shot", "forgetting", "--train-seeds", "2"]
    )


def test_redo_names_cells(study: Study) -> None:
    steps = chain(study.out)
    assert [step.name for step in runner.select_steps(steps, ["train/*t"])] == ["train/left", "train/right"]
    with pytest.raises(ConfigError, match="matches no step"):
        runner.select_steps(steps, ["evaluate/*"])


def test_grades_made_anew_do_not_go_on_from_old_ones(study: Study) -> None:
    scores = study.out / "scores"
    (scores / "a.cells").mkdir(parents=True)
    for name in ("a.parquet", "a.curves.parquet", "b.parquet"):
        (scores / name).touch()
    Ledger(study.out).forget(Step("evaluate", "a", (), (), None, scores / "a.parquet"))
    assert [path.name for path in scores.iterdir()] == ["b.parquet"]


def test_data_beyond_the_study_is_an_error(study: Study) -> None:
    """Its models would learn from it, and be graded on it."""
    write_synthetic_data(study.data_folder, tasks=("place_empty_cup", "open_laptop"), seeds=(0, 1, 1_000_000), frames=3)
    only = replace(study, robots=("ur5_wsg", "aloha_agilex", "arx_x5", "piper"))
    said = StudyRunner(only, {}, Ledger(study.out), ThisMachine((), 1, {}), {})._check_data(study.data_folder)
    assert "also holds open_laptop, franka_panda, 1 more train seeds a task" in said
    fitting = replace(study, tasks=("place_empty_cup", "open_laptop"), train_seeds=2)
    fits = StudyRunner(fitting, {}, Ledger(study.out), ThisMachine((), 1, {}), {})
    assert fits._check_data(study.data_folder) == ""
    for base, said in ((0, ""), (1_000_000, "also holds faulty test episodes")):
        for folder in write_synthetic_data(study.data_folder, seeds=(join_fault(3, base),), frames=3):
            header = json.loads((folder / "episode.json").read_text())
            (folder / "episode.json").write_text(json.dumps(header | {"fault": "stop:5", "progress": 1.0}))
        assert said in fits._check_data(study.data_folder) and bool(said) == bool(fits._check_data(study.data_folder))


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="choose another --out"), runner.lock_study(tmp_path / "file" / "study"):
        pass


def test_the_dry_run_shows_everything_and_does_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runner.main([str(ROOT / "configs" / "study_debug.yaml"), "--dry-run", "--out", str(tmp_path / "study")])
    said = capsys.readouterr().out
    assert "few_shot-piper-1" in said and "left to do" in said
    assert not (tmp_path / "study").exists()


def test_experiments_that_the_model_does_not_take_are_said_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "study.yaml"
    content = read_yaml(ROOT / "configs" / "study_debug.yaml")
    content["adaptation"]["train"]["epoch"] = content["adaptation"]["train"].pop("epochs")
    config.write_text(yaml.safe_dump(content))
    with pytest.raises(SystemExit) as stop:
        runner.main([str(config), "--out", str(tmp_path / "study")])
    assert stop.value.code == 2
    assert "unknown key 'epoch'; did you mean 'epochs'" in capsys.readouterr().err
    assert not (tmp_path / "study" / "state").exists()

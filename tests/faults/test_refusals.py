"""Disks that fail, kills at renames, outputs and numbers that mean nothing: one line, and nothing half-written."""

import errno
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from lab.calibration import calibrate
from lab.seeds import yields
from tests import synthetic
from tests.commands import run_command
from xew.analysis.studies.config import load_study
from xew.config import ConfigError, check_finite, read_yaml, user_errors
from xew.episode import EpisodeError, read_record, read_states, read_video, write_episode
from xew.files import write_text
from xew.model import outside
from xew.model.episodes.choice import select_episodes
from xew.model.experiment import load_experiment
from xew.model.runs.folder import claim_run
from xew.sim_warp import generate

REPOSITORY = Path(__file__).parents[2]


def test_both_kinds_of_motion_are_never_mixed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.syspath_prepend(str(REPOSITORY))
    data, out = tmp_path / "data", tmp_path / "out"
    for folder in synthetic.write_synthetic_data(data, seeds=(0, 1), robots=("piper",), frames=2):
        record = read_record(folder)
        motion = "own" if record.seed else "shared"
        videos = [read_video(folder / f"{name}.mkv") for name in ("rgb", "robot")]
        write_episode(data, replace(record, motion=motion), read_states(folder), *videos)
    predicting = ["examples.own_model:freeze", "--data", str(data), "--split", "train", "--out", str(out)]
    for refused in (
        lambda: calibrate.main(calibrate.Args(data=data, out=out)),
        lambda: outside.main(predicting),
        lambda: user_errors(select_episodes)(data, "train"),  # as `rollout` asks
    ):
        with pytest.raises(SystemExit, match="2"):
            refused()
        assert "keep them in separate data sets" in capsys.readouterr().err and not out.exists()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EIO, errno.EDQUOT])
def test_a_disk_that_fails_at_any_rename_is_told_in_one_line(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Also where no command expects it: whatever the system refuses, what was there before is still there."""
    path = tmp_path / "kept.txt"
    write_text(path, "old", within=tmp_path)

    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(SystemExit) as stop:
        user_errors(write_text)(path, "new", within=tmp_path)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and os.strerror(number) in said and said.count("\n") == 1
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_kills_at_every_rename_of_an_episode_and_a_run_lose_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record_property: Any
) -> None:
    """At each rename in turn the process ends; afterwards the old state or the new one stands, and the next write goes on."""
    (folder,) = synthetic.write_synthetic_data(tmp_path / "data", seeds=(0,), robots=("piper",), frames=3)
    record, states = read_record(folder), read_states(folder)
    experiment = load_experiment(REPOSITORY / "configs/debug.yaml")
    run = tmp_path / "run"
    claim_run(run, experiment, load_experiment, resume=False, overwrite=False)
    renames = {"os.rename": os.rename, "os.replace": os.replace}

    class Killed(BaseException):
        """Like SIGKILL, it is caught by nobody."""

    kills = 0
    for after in (False, True):
        for name in renames:
            for at in range(1, 4):
                count = 0

                def rename(*paths: object, name: str = name, at: int = at, after: bool = after) -> None:
                    nonlocal count
                    count += 1
                    if count == at and not after:
                        raise Killed
                    renames[name](*paths)  # type: ignore[operator]
                    if count == at:
                        raise Killed

                monkeypatch.setattr(name, rename)
                for write in (
                    lambda: write_episode(tmp_path / "data", replace(record, instruction="new"), states),
                    lambda: claim_run(run, experiment, load_experiment, resume=True, overwrite=False),
                ):
                    count = 0
                    try:
                        write()
                    except Killed:
                        kills += 1
                monkeypatch.setattr(name, renames[name])
                # A folder is replaced by two renames: between them it is absent, and its cell is made again.
                assert not folder.exists() or read_record(folder).instruction in (record.instruction, "new")
                write_episode(tmp_path / "data", record, states)
                written = {name: getattr(record, name) for name in ("hashes", "files")}
                kept = {name: {key: value for key, value in some.items() if "states" in key} for name, some in written.items()}
                assert read_record(folder) == replace(record, **kept)
                claim_run(run, experiment, load_experiment, resume=True, overwrite=False)
                assert load_experiment(run / "config.yaml") == experiment
    record_property("tried kills at renames", kills)
    assert kills >= 6


@pytest.mark.parametrize("number", [0, -1])
def test_workers_that_are_none_are_refused(number: int, tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match=f"--workers is {number}"):
        generate.generate(generate.Args(tasks=("lift_pot",), robots=("piper",), out=tmp_path / "data", workers=number))
    with pytest.raises(EpisodeError, match=f"--workers is {number}"):
        next(iter(yields.attempt_seeds(yields.Args(tasks=("lift_pot",), robots=("piper",), workers=number))))


@pytest.mark.parametrize(
    "command",
    [
        "lab.robots.bodies --count 1 --out bodies.npz --workers 0",
    ],
)
def test_commands_without_workers_end_in_one_line(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    module, *options = command.split()
    with pytest.raises(AssertionError, match=f"ended with 2:\n.*{options[-2]} is {options[-1]}") as told:
        run_command(module, *options)
    assert "Traceback" not in str(told.value) and not list(tmp_path.iterdir())


def test_a_quote_that_is_not_closed_is_told_with_its_config(tmp_path: Path) -> None:
    content = read_yaml(REPOSITORY / "configs/study_debug.yaml")
    content["machine"] = content.get("machine", {}) | {"train_launcher": "srun --comment='my study"}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError, match=r"mine\.yaml: machine\.train_launcher is .*: No closing quotation"):
        load_study(tmp_path / "mine.yaml")


def test_an_output_that_is_a_file_is_told(tmp_path: Path) -> None:
    experiment = load_experiment(REPOSITORY / "configs/debug.yaml")
    (tmp_path / "run").touch()
    with pytest.raises(ConfigError, match="is a file; choose another --out"):
        claim_run(tmp_path / "run", experiment, load_experiment, resume=False, overwrite=False)


MEANINGLESS = yaml.safe_load((Path(__file__).parent / "inputs/numbers.yaml").read_text())


@pytest.mark.parametrize("change", MEANINGLESS["config"], ids=str)
def test_numbers_of_a_config_that_mean_nothing_are_refused_with_its_name(change: dict[str, object], tmp_path: Path) -> None:
    content = read_yaml(REPOSITORY / "configs/debug.yaml")
    ((name, value),) = change.items()
    *sections, key = name.split(".")
    inner = content
    for section in sections:
        inner = inner.setdefault(section, {})
    inner[key] = value
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError, match=r"mine\.yaml") as error:
        load_experiment(tmp_path / "mine.yaml")
    assert key in str(error.value)


def test_numbers_are_checked_wherever_they_stand() -> None:
    for value in (float("nan"), float("-inf"), 2**70):
        with pytest.raises(ConfigError, match=r"a file: deep\.list is"):
            check_finite({"deep": {"list": [1, value]}}, "a file")
    check_finite({"a": [1.5, True, "x", None, 2**62]}, "a file")


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_a_camera_without_a_focal_length_is_refused(value: float, tmp_path: Path) -> None:
    (folder,) = synthetic.write_synthetic_data(tmp_path, seeds=(0,), robots=("piper",), frames=2)
    states, record = read_states(folder), read_record(folder)
    states.intrinsics[0, 0] = value
    write_episode(tmp_path, record, states)
    with pytest.raises(EpisodeError, match=r"its camera has|intrinsics has NaN"):
        read_states(folder)

"""Calibration of the judge: the rules by which tasks are kept and success is shown, and the tables."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lab.calibration import outcome
from lab.calibration.outcome import (
    CASES,
    INSTANTS,
    Args,
    agreement_table,
    best_threshold,
    change_objects,
    correlation_table,
    instants,
    judge_episode,
    kept_tasks,
    main,
    report,
)
from tests.sim_warp.small import TASK, produce
from xew.dataset import find_accepted
from xew.episode import read_states
from xew.metrics.backends import open_tracker
from xew.metrics.grading.open_graders import PROCESSES
from xew.protocol import join_fault
from xew.sim_warp.production.cells import Job
from xew.sim_warp.rendering.render import Renderer


def rows(judged: dict[str, list[float]], true: list[float]) -> pd.DataFrame:
    key = {"seed": 800_000, "robot": "arx_x5", "case": "truth", "content": "0"}
    return pd.DataFrame(
        [
            key | {"task": task, "frame": i, "true": true[i], "judged": value}
            for task, own in judged.items()
            for i, value in enumerate(own)
        ]
    )


TRUE = [0, 0.2, 0.5, 1, 1]
ROWS = rows({"good": [0, 0.2, 0.6, 0.9, 1], "bad": [0.5, 0.97, 0, 0.5, 0.6], "blind": [0.5] * 5}, TRUE)


def test_tasks_are_kept_by_their_correlation() -> None:
    assert kept_tasks(ROWS) == ["good"], "a judge that always says the same has no correlation"


def test_success_is_shown_from_the_middle_of_the_best_thresholds_on() -> None:
    assert best_threshold(ROWS[ROWS["task"] == "good"]) == 0.75, "0.65 to 0.9 are right about all five"


def test_the_table_counts_right_and_wrong_verdicts() -> None:
    table = agreement_table(ROWS, ["task"])
    assert table.loc["good", ["r", "progress error"]].tolist() == ["0.989", "0.040"]
    counts = ["success, judged so", "success, judged failure", "failure, judged success", "failure, judged so"]
    assert table.loc["good", counts].tolist() == ["1", "0", "0", "0"], "in the last frame"
    assert table.loc["bad", counts].tolist() == ["0", "1", "0", "0"]
    assert agreement_table(ROWS, ["task", "robot"]).index.tolist() == [f"{task} arx_x5" for task in ("bad", "blind", "good")]
    assert correlation_table(ROWS).loc["good"].to_dict() == {"arx_x5": "0.989"}


def test_the_report_names_tasks_without_power() -> None:
    text = report(ROWS)
    assert "Kept are 1 of 3 tasks, whose r is at least 0.9: good." in text
    assert "Left out are: bad (r -0.148), blind (r -)." in text
    assert "(UNJUDGED) is wrong about: bad, blind." in text


def test_an_episode_gives_rows_of_both_cases(tmp_path: Path) -> None:
    produce([Job(TASK, 1, ("piper",))], tmp_path, Renderer("cpu"))
    [episode] = find_accepted(tmp_path)
    table = pd.DataFrame(judge_episode(*episode, open_tracker("opencv"), None))
    assert table["case"].tolist() == ["truth"] * INSTANTS + ["object at rest"] * INSTANTS
    assert table["frame"].tolist() == 2 * instants(12).tolist()
    np.testing.assert_array_equal(table["true"], table["judged"], "success is by the commands alone")


def test_objects_of_faulty_commands_also_move_as_the_expert_s(tmp_path: Path) -> None:
    produce([Job(TASK, 1, ("piper",))], tmp_path, Renderer("cpu"))
    [(folder, record)] = find_accepted(tmp_path)
    expert = read_states(folder)
    faulty = replace(expert, object_pose=expert.object_pose + 0.1)
    [still] = change_objects(folder, record, expert)
    assert (still.object_pose == expert.object_pose[0]).all()
    still, success = change_objects(folder, replace(record, seed=join_fault(3, 1), fault="push:40"), faulty)
    assert (still.object_pose == faulty.object_pose[0]).all()
    np.testing.assert_array_equal(success.object_pose, expert.object_pose)
    np.testing.assert_array_equal(success.joint_pos, faulty.joint_pos)


def test_the_rules_are_about_the_first_two_cases() -> None:
    wrong = ROWS.assign(case=CASES[2], judged=0.0)
    text = report(pd.concat([ROWS, wrong]))
    assert "Kept are 1 of 3 tasks, whose r is at least 0.9: good." in text
    assert text.count(CASES[2]) == 1 and f"| {CASES[2]} | - | 0.540 | 0 | 1 | 0 | 0 |" in text


def test_the_command_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(PROCESSES, "1")
    produce([Job(TASK, seed, ("piper",)) for seed in (1, 2)], tmp_path / "data", Renderer("cpu"))
    args = Args(data=tmp_path / "data", out=tmp_path / "out", tracks="opencv", robots=("piper",))
    main(replace(args, seeds=(1,)))
    judged: list[int] = []
    real = outcome.judge_episode
    monkeypatch.setattr(outcome, "judge_episode", lambda *given: [judged.append(given[1].seed), real(*given)][1])
    main(args)
    assert judged == [2] and "1 of 2 episodes are judged already" in capsys.readouterr().out
    table = pd.read_parquet(args.out / "outcome.parquet")
    assert sorted(set(table["seed"])) == [1, 2] and len(table) == 4 * INSTANTS
    assert (args.out / "outcome.md").read_text("utf-8") == report(table)
    with pytest.raises(SystemExit):
        main(replace(args, robots=()))
    assert "has no robot to choose by; it has piper: --robots." in capsys.readouterr().err

"""Calibration of the judge: the rules by which tasks are kept and success is shown, and the tables."""

from pathlib import Path

import numpy as np
import pandas as pd

from lab.calibration.outcome import INSTANTS, agreement_table, best_threshold, instants, judge_episode, kept_tasks, report
from tests.sim_warp.small import TASK, produce
from xew.dataset import find_accepted
from xew.metrics.backends import open_tracker
from xew.sim_warp.production.cells import Job
from xew.sim_warp.rendering.render import Renderer


def rows(judged: dict[str, list[float]], true: list[float]) -> pd.DataFrame:
    key = {"seed": 800_000, "robot": "arx_x5", "case": "truth"}
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
    table = agreement_table(ROWS, "task")
    assert table.loc["good", ["r", "progress error"]].tolist() == ["0.989", "0.040"]
    counts = ["success, judged so", "success, judged failure", "failure, judged success", "failure, judged so"]
    assert table.loc["good", counts].tolist() == ["1", "1", "0", "3"]
    assert table.loc["bad", counts].tolist() == ["0", "2", "1", "2"]
    assert "Kept are 1 of 3 tasks, whose r is at least 0.9: good." in report(ROWS)


def test_an_episode_gives_rows_of_both_cases(tmp_path: Path) -> None:
    produce([Job(TASK, 1, ("piper",))], tmp_path, Renderer("cpu"))
    [episode] = find_accepted(tmp_path)
    table = pd.DataFrame(judge_episode(*episode, open_tracker("opencv"), None))
    assert table["case"].tolist() == ["truth"] * INSTANTS + ["object at rest"] * INSTANTS
    assert table["frame"].tolist() == 2 * instants(12) and instants(12)[-1] == 11
    np.testing.assert_array_equal(table["true"], table["judged"], "success is by the commands alone")

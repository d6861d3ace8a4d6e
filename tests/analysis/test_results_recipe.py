"""Figures of the page on the recommended recipe that come from its further tables, and its claims in words.

`drift.parquet` has the mean LPIPS of the first and of the last 32 predicted frames of every test episode, `short_runs.parquet`
the scores of shorter runs, and `validation.parquet` the scores by which the recipe was chosen.
"""

import io
import subprocess

import numpy as np
import pandas as pd
import pytest

from tests.analysis.test_results_pages import GROUPS, MAIN, RESULTS, demand, recipe, row_of
from xew.analysis.scores import read_scores
from xew.protocol import BASELINES, HELD_OUT_ROBOTS, PASTED_RENDER, ROBOT_NAMES, SEEN_ROBOTS
from xew.statistics import summarize

COMMIT = "7e04e87"
"""The commit that pages name, which has the scores by frame."""
COLUMNS = ("seen", "piper", "franka")
"""Groups of robots, in the order of the page's columns."""


def verdicts_on_the_recipe() -> pd.DataFrame:
    """Strict metrics of both runs of the recommended recipe against the pasted render, by robot and metric."""
    scores = read_scores(RESULTS / "recipe" / "scores.parquet")
    groups = {"seen": SEEN_ROBOTS, **{robot: (robot,) for robot in ROBOT_NAMES}}
    pairs = summarize(scores.rows, {info.name: info for info in scores.metrics}, groups, scores.codecs).pairs
    strict = [info.name for info in scores.metrics if "strict" in info.suites]
    return pairs[(pairs["other"] == PASTED_RENDER) & ~pairs["model"].isin(BASELINES) & pairs["metric"].isin(strict)]


@pytest.mark.parametrize(
    ("label", "models"),
    [
        ("LPIPS of the last 32 frames over the first 32", ("P0", "P1")),
        ("the same ratio, truth through the codec", ("codec_truth",)),
    ],
)
def test_drift_of_the_recommended_recipe(label: str, models: tuple[str, ...]) -> None:
    rows = pd.read_parquet(RESULTS / "recipe" / "drift.parquet")
    for cell, group in zip(row_of("recipe", label), COLUMNS, strict=True):
        own = rows[rows["model"].isin(models) & rows["robot"].isin(GROUPS[group])]
        first, last = own["first"].mean(), own["last"].mean()
        demand(cell, [last, first, last / first])


def test_the_recommended_recipe_beats_pasting() -> None:
    """On every robot and in both runs, in all strict metrics but flicker and, on unseen robots, the gripper's error."""
    pairs = verdicts_on_the_recipe()
    worse = pairs[pairs["verdict"] == "worse"]
    assert set(worse["metric"]) == {"flicker"} and len(worse) == 2 * (1 + len(ROBOT_NAMES))
    main = pairs[pairs["metric"].isin(MAIN.values())]
    assert (main["verdict"] == "better").all() and len(main) == 2 * (1 + len(ROBOT_NAMES)) * len(MAIN)
    grippers = pairs[(pairs["metric"] == "gripper_error") & pairs["robot"].isin(HELD_OUT_ROBOTS)]
    assert (grippers["verdict"] == "unresolved").all()


def scores_of_runs(table: str, models: str, group: tuple[str, ...], metric: str) -> pd.Series:
    """The mean of each model of `docs/results/recipe/<table>.parquet` whose name matches."""
    rows = pd.read_parquet(RESULTS / "recipe" / f"{table}.parquet")
    rows = rows[rows["model"].str.fullmatch(models) & rows["robot"].isin(group) & (rows["metric"] == metric)]
    return rows.groupby("model")["value"].mean()


@pytest.mark.parametrize(("label", "steps"), [("250 steps, 77 s", 250), ("500 steps, 115 s", 500), ("3,000 steps, 514 s", 0)])
def test_shorter_runs_of_the_recipe(label: str, steps: int) -> None:
    for cell, metric in zip(row_of("recipe", label), ("lpips", "trajectory_error_strict"), strict=True):
        short = (scores_of_runs("short_runs", f"S[01]_{steps}", GROUPS[name], metric).mean() for name in COLUMNS)
        demand(cell, list(short) if steps else [recipe(metric, name)[0] for name in COLUMNS])


VALIDATION_RUNS = {
    "3,000 steps, guess with carried objects": "L[01]_4",
    "the same, 2 sampler steps instead of 4": "L[01]_2",
    "the same, 4 steps, with shadows (kept, this page)": "P[01]_4",
    "the same, a render head for an earlier model": "P[01]h_4",
}
VALIDATION_ROBOTS = (SEEN_ROBOTS, tuple(f"body_{number}" for number in range(96, 100)))


@pytest.mark.parametrize("label", VALIDATION_RUNS)
def test_what_was_tried_for_the_recipe(label: str) -> None:
    for cell, metric in zip(row_of("recipe", label), ("lpips", "trajectory_error_strict"), strict=True):
        demand(
            cell, [scores_of_runs("validation", VALIDATION_RUNS[label], group, metric).mean() for group in VALIDATION_ROBOTS]
        )


def test_what_was_kept_for_the_recipe_by_its_rule() -> None:
    """Lower LPIPS in both seeds on both groups; the other render head is better on one of them only."""
    lpips = {
        name: np.array([scores_of_runs("validation", name, group, "lpips") for group in VALIDATION_ROBOTS])
        for name in VALIDATION_RUNS.values()
    }
    assert (lpips["P[01]_4"] < lpips["L[01]_4"]).all() and (lpips["L[01]_4"] < lpips["L[01]_2"]).all()
    assert ((lpips["P[01]h_4"] < lpips["P[01]_4"]) == [[True, True], [False, False]]).all()


def read_old(place: str) -> pd.DataFrame:
    """A table of another commit."""
    found = subprocess.run(["git", "show", place], capture_output=True, cwd=RESULTS)
    if found.returncode:
        pytest.skip(f"git has no commit {COMMIT} here, as in a shallow clone")
    return pd.read_parquet(io.BytesIO(found.stdout))


def test_the_recipe_before() -> None:
    """Its scores are in the commit that the page names."""
    rows = read_old(f"{COMMIT}:docs/results/small_fine/scores.parquet")
    rows = rows[rows["metric"] == "lpips"]
    own = ~rows["model"].isin(BASELINES)
    for cell, group in zip(row_of("recipe", "LPIPS before, at commit 7e04e87, other test seeds"), COLUMNS, strict=True):
        here = rows["robot"].isin(GROUPS[group])
        demand(cell, [rows[here & each]["value"].mean() for each in (own, rows["model"] == PASTED_RENDER)])

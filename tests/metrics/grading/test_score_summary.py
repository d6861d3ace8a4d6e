"""Means with intervals, differences with a verdict: against scipy, what is known, and what must not be claimed."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from xew.metrics.grading.summary import bootstrap, summarize, to_markdown, verdict

ROBOTS = ("aloha_agilex", "piper")


def table(models: dict[str, dict[str, float]], scenes: int = 20, spread: float = 0.02, seed: int = 0) -> pd.DataFrame:
    """Scores of models whose means are given by metric; what a scene adds is shared by all models, as scenes are."""
    rng = np.random.default_rng(seed)
    shared = rng.normal(0, 5 * spread, scenes)
    rows = [
        {"model": model, "condition": "", "task": f"task{i % 4}", "seed": i // 4, "robot": robot, "metric": metric}
        | {"value": mean + shared[i] + rng.normal(0, spread)}
        for robot in ROBOTS
        for model, means in models.items()
        for metric, mean in means.items()
        for i in range(scenes)
    ]
    return pd.DataFrame(rows)


def test_intervals_are_those_of_scipy_up_to_chance() -> None:
    values = np.random.default_rng(0).gamma(2, size=(40, 3))
    low, high = bootstrap(values, np.arange(40))
    for column in range(3):
        expected = stats.bootstrap(
            (values[:, column],), np.mean, n_resamples=20000, method="percentile", rng=np.random.default_rng(1)
        ).confidence_interval
        width = expected.high - expected.low
        assert low[column] == pytest.approx(expected.low, abs=0.03 * width)
        assert high[column] == pytest.approx(expected.high, abs=0.03 * width)


def test_rows_of_a_unit_are_drawn_together() -> None:
    """Ten copies of each value say no more than one: the interval stays as wide, and is ten times too narrow without units."""
    values = np.random.default_rng(0).normal(size=(12, 1))
    once = np.concatenate(bootstrap(values, np.arange(12)))
    copies = np.repeat(values, 10, axis=0)
    assert np.concatenate(bootstrap(copies, np.repeat(np.arange(12), 10))) == pytest.approx(once, abs=1e-12)
    alone = np.concatenate(bootstrap(copies, np.arange(120)))
    assert np.ptp(alone) < 0.5 * np.ptp(once)


def test_missing_values_are_left_out_and_one_unit_has_no_interval() -> None:
    values = np.array([[1.0, 5.0, np.nan], [2.0, np.nan, np.nan], [3.0, np.nan, np.nan]])
    low, high = bootstrap(values, np.arange(3))
    assert low[0] == 1 and high[0] == 3
    assert np.isnan([low[1], high[1], low[2], high[2]]).all()


def test_a_task_of_its_own_level_widens_the_interval_over_tasks() -> None:
    rows = table({"model": {"ssim": 0.5}}, scenes=40)
    rows["value"] += rows["task"].map({f"task{i}": 0.3 * i for i in range(4)})
    scenes, tasks = (summarize(rows, unit).means for unit in ("scene", "task"))
    width = [float((means["high"] - means["low"]).iloc[0]) for means in (scenes, tasks)]
    assert width[1] > 2 * width[0]


def test_differences_are_paired_and_robots_apart() -> None:
    """Scenes differ ten times more than the models do, which only a paired comparison resolves."""
    rows = table({"a": {"ssim": 0.50}, "b": {"ssim": 0.53}})
    summary = summarize(rows, robots_first=("piper",))
    assert summary.means["robot"].drop_duplicates().tolist() == ["piper", "aloha_agilex"]
    means = summary.means.set_index(["robot", "model"])
    assert means.loc[("piper", "a"), "high"] > means.loc[("piper", "b"), "low"], "the means' intervals overlap"
    for pair in summary.pairs.itertuples():
        assert (pair.model, pair.other, pair.verdict) == ("a", "b", "worse") and pair.low < pair.difference < pair.high < 0
    for robot in ROBOTS:
        own = rows[rows["robot"] == robot].pivot(index=["task", "seed"], columns="model", values="value")
        found = summary.pairs[summary.pairs["robot"] == robot]["difference"].item()
        assert found == pytest.approx(float((own["a"] - own["b"]).mean()), rel=1e-12)


def test_a_difference_within_the_estimators_noise_is_unresolved() -> None:
    """The true video is given 0.9 of 1: 0.05 more or less says nothing of a model, however sure it is."""
    close = {"a": {"mask_iou": 0.70}, "b": {"mask_iou": 0.75}, "ground_truth": {"mask_iou": 0.90}}
    pairs = summarize(table(close, spread=0.001)).pairs.set_index(["model", "other"])
    assert (pairs.loc[[("a", "b")], "verdict"] == "unresolved").all() and (pairs.loc[[("a", "b")], "high"] < 0).all()
    assert pairs.loc[[("a", "b")], "noise"].to_numpy() == pytest.approx(0.10, abs=0.01)
    assert (pairs.loc[[("a", "ground_truth")], "verdict"] == "worse").all()
    near = {"a": {"mask_iou": 0.85}, "ground_truth": {"mask_iou": 0.90}}
    summary = summarize(table(near, spread=0.001))
    assert (summary.means.set_index("model").loc["a", "versus_truth"] == "unresolved").all()
    assert "0.85" in to_markdown(summary) and " ~ |" in to_markdown(summary)


def test_noise_is_of_estimators_alone_and_unknown_without_the_true_video() -> None:
    models = {"a": {"psnr": 20.0, "pck": 0.5, "keypoint_error": 4.0}}
    truth = {"ground_truth": {"psnr": 100.0, "pck": 0.97, "keypoint_error": 0.3}}
    noise = summarize(table(models | truth)).means.set_index(["robot", "model", "metric"])["noise"]
    for robot in ROBOTS:
        assert noise[robot, "a", "psnr"] == 0
        assert noise[robot, "a", "pck"] == pytest.approx(0.03, abs=0.06)
        assert noise[robot, "a", "keypoint_error"] == pytest.approx(0.3, abs=0.06)
    alone = summarize(table(models | {"b": {name: value + 1 for name, value in models["a"].items()}}))
    verdicts = alone.pairs.set_index(["robot", "metric"])["verdict"]
    assert verdicts["piper", "psnr"] == "worse" and verdicts["piper", "pck"] == "unresolved"
    assert "| not graded |" in to_markdown(alone)


@pytest.mark.parametrize(
    ("difference", "low", "high", "noise", "higher", "expected"),
    [
        (1.0, 0.5, 1.5, 0.0, True, "better"),
        (1.0, 0.5, 1.5, 0.0, False, "worse"),
        (-1.0, -1.5, -0.5, 0.5, False, "better"),
        (1.0, -0.1, 2.0, 0.0, True, "unresolved"),
        (1.0, 0.5, 1.5, 1.0, True, "unresolved"),
        (1.0, np.nan, np.nan, 0.0, True, "unresolved"),
        (1.0, 0.5, 1.5, np.nan, True, "unresolved"),
        (0.0, 0.0, 0.0, 0.0, True, "unresolved"),
    ],
)
def test_verdicts(difference: float, low: float, high: float, noise: float, higher: bool, expected: str) -> None:
    assert verdict(difference, low, high, noise, higher) == expected


def test_many_models_leave_the_pairs_to_their_file() -> None:
    few = to_markdown(summarize(table({f"m{i}": {"ssim": 0.1 * i} for i in range(3)}, scenes=4)))
    assert few.count("paired:") == 2 * 3
    many = to_markdown(summarize(table({f"m{i}": {"ssim": 0.1 * i} for i in range(5)}, scenes=4)))
    assert "paired:" not in many and many.count("10 pairs of models") == 2

"""The summary of a score table: means with intervals, differences with a verdict, and what must not be claimed."""

import numpy as np
import pandas as pd
import pytest

from xew.metrics.grading.summary import summarize_robots, to_markdown

ROBOTS = ("aloha_agilex", "piper")


def table(
    models: dict[str, dict[str, float]], scenes: int = 20, spread: float = 0.02, seed: int = 0, tasks: int = 4
) -> pd.DataFrame:
    """Scores of models whose means are given by metric; what a scene adds is shared by all models, as scenes are."""
    rng = np.random.default_rng(seed)
    shared = rng.normal(0, 5 * spread, scenes)
    rows = [
        {"model": model, "condition": "", "task": f"task{i % tasks}", "seed": i // tasks, "robot": robot, "metric": metric}
        | {"value": mean + shared[i] + rng.normal(0, spread)}
        for robot in ROBOTS
        for model, means in models.items()
        for metric, mean in means.items()
        for i in range(scenes)
    ]
    return pd.DataFrame(rows)


def test_a_task_of_its_own_level_widens_the_interval_over_tasks() -> None:
    rows = table({"model": {"ssim": 0.5}}, scenes=40, tasks=8)
    rows["value"] += rows["task"].map({f"task{i}": 0.3 * i for i in range(8)})
    scenes, tasks = (summarize_robots(rows, unit).means for unit in ("scene", "task"))
    width = [float((means["high"] - means["low"]).iloc[0]) for means in (scenes, tasks)]
    assert width[1] > 2 * width[0]
    few = summarize_robots(table({"model": {"ssim": 0.5}}, scenes=40, tasks=5), "task").means
    assert few["low"].isna().all(), "five tasks are too few to draw"


def test_differences_are_paired_and_robots_apart() -> None:
    """Scenes differ ten times more than the models do, which only a paired comparison resolves."""
    rows = table({"a": {"ssim": 0.50}, "b": {"ssim": 0.53}})
    summary = summarize_robots(rows, robots_first=("piper",))
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
    pairs = summarize_robots(table(close, spread=0.001)).pairs.set_index(["model", "other"])
    assert (pairs.loc[[("a", "b")], "verdict"] == "unresolved").all() and (pairs.loc[[("a", "b")], "high"] < 0).all()
    assert pairs.loc[[("a", "b")], "noise"].to_numpy() == pytest.approx(0.10, abs=0.01)
    assert (pairs.loc[[("a", "ground_truth")], "verdict"] == "worse").all()
    near = {"a": {"mask_iou": 0.85}, "ground_truth": {"mask_iou": 0.90}}
    summary = summarize_robots(table(near, spread=0.001))
    assert (summary.means.set_index("model").loc["a", "versus_truth"] == "unresolved").all()
    assert "0.85" in to_markdown(summary) and " ~ |" in to_markdown(summary)


def test_noise_is_of_estimators_alone_and_unknown_without_the_true_video() -> None:
    models = {"a": {"psnr": 20.0, "pck": 0.5, "keypoint_error": 4.0}}
    truth = {"ground_truth": {"psnr": 100.0, "pck": 0.97, "keypoint_error": 0.3}}
    noise = summarize_robots(table(models | truth)).means.set_index(["robot", "model", "metric"])["noise"]
    for robot in ROBOTS:
        assert noise[robot, "a", "psnr"] == 0
        assert noise[robot, "a", "pck"] == pytest.approx(0.03, abs=0.06)
        assert noise[robot, "a", "keypoint_error"] == pytest.approx(0.3, abs=0.06)
    alone = summarize_robots(table(models | {"b": {name: value + 1 for name, value in models["a"].items()}}))
    verdicts = alone.pairs.set_index(["robot", "metric"])["verdict"]
    assert verdicts["piper", "psnr"] == "worse" and verdicts["piper", "pck"] == "unresolved"
    assert "| not graded |" in to_markdown(alone)


def test_many_models_leave_the_pairs_to_their_file() -> None:
    few = to_markdown(summarize_robots(table({f"m{i}": {"ssim": 0.1 * i} for i in range(3)}, scenes=4)))
    assert few.count("paired:") == 2 * 3
    many = to_markdown(summarize_robots(table({f"m{i}": {"ssim": 0.1 * i} for i in range(5)}, scenes=4)))
    assert "paired:" not in many and many.count("10 pairs of models") == 2

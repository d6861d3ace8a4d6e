"""Means, intervals and verdicts on numbers whose answer is known."""

import numpy as np
import pandas as pd
import pytest

from xew.analysis.reports.run_tables import Interval, RobotTable, Row, finding, progress
from xew.analysis.scores import MetricInfo
from xew.analysis.tables.table import format_number
from xew.statistics import summarize

rng = np.random.default_rng(0)


def episodes(values: object, robots: tuple[str, ...] = ("piper",)) -> pd.Series:
    """Scores of scenes and robots, scene by scene."""
    values = np.atleast_1d(np.asarray(values, float))
    scenes = [("lift_pot", seed) for seed in range(len(values) // len(robots))]
    index = pd.MultiIndex.from_tuples([(*s, r) for s in scenes for r in robots], names=["task", "seed", "robot"])
    return pd.Series(values, index)


def mean_interval(scores: pd.Series) -> Interval:
    """Mean and interval of one model's scores in a summary."""
    rows = scores.rename("value").reset_index().assign(model="m", condition="", metric="x")
    mean = summarize(rows, {"x": info("x")}, {"all": list(rows["robot"].unique())}, {}).means.iloc[0]
    return Interval(mean["mean"], mean["low"], mean["high"], mean["episodes"])


def verdict_on(model: pd.Series, copy: pd.Series, higher: bool, floor: float = 0.0) -> str:
    """Verdict of a summary on a model against the frozen first frame; the true video misses the best of 1 by the floor."""
    tables = {"m": model, "copy_first_frame": copy, "ground_truth": model * 0 + 1 - floor}
    rows = [
        scores.rename("value").reset_index().assign(model=name, condition="", metric="x") for name, scores in tables.items()
    ]
    metric = MetricInfo("x", "visual", "", higher, 1.0 if not higher else None, 1.0, "", "X", estimated=floor > 0)
    pairs = summarize(pd.concat(rows), {"x": metric}, {"all": list(rows[0]["robot"].unique())}, {}).pairs
    return str(pairs[(pairs["model"] == "m") & (pairs["other"] == "copy_first_frame")]["verdict"].item())


def info(name: str, unit: str = "", higher: bool = False) -> MetricInfo:
    return MetricInfo(name, "visual", unit, higher, None, None, "", name.upper())


def test_the_interval_is_close_to_the_normal_one_for_many_values() -> None:
    values = rng.normal(3, 2, 400)
    interval = mean_interval(episodes(values))
    half = 1.96 * values.std() / np.sqrt(len(values))
    assert interval.mean == pytest.approx(values.mean())
    assert (interval.low, interval.high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.1 * half)
    assert interval == mean_interval(episodes(values))


def test_one_value_has_no_interval_and_equal_values_a_point() -> None:
    assert np.isnan(mean_interval(episodes(2.0)).low)
    assert mean_interval(episodes([2.0] * 6)) == Interval(2, 2, 2, 6)


@pytest.mark.parametrize(("shift", "higher", "expected"), [(1, True, "better"), (1, False, "worse"), (0, True, "unresolved")])
def test_verdicts_are_paired(shift: float, higher: bool, expected: str) -> None:
    """Episodes differ by far more than the models do, so that only pairing can tell them apart."""
    copy = episodes(rng.normal(0, 50, 20))
    model = copy + shift + np.tile([-0.5, 0.5], 10)
    assert verdict_on(model.sample(frac=1, random_state=1), copy, higher) == expected


def test_fewer_than_six_scenes_resolve_nothing() -> None:
    """Of five all differences have one sign by chance in 6 % of cases; a study's tables ask for as many."""
    high, low, pooled = [9.0, 8.0, 9.5, 8.5, 9.1, 8.9], [1.0, 2.0, 1.5, 1.2, 1.8, 1.1], ("aloha_agilex", "arx_x5", "ur5_wsg")
    assert verdict_on(episodes(high), episodes(low), True) == "better"
    assert verdict_on(episodes(high[:5]), episodes(low[:5]), True) == "unresolved"
    assert verdict_on(episodes(high), episodes(low).iloc[1:], True) == "unresolved"
    assert verdict_on(episodes(high, pooled), episodes(low, pooled), True) == "unresolved"  # three robots in two scenes
    assert np.isnan(mean_interval(episodes(high[:5])).low) and mean_interval(episodes(high)).low < 8.9


def test_robots_in_one_scene_are_resampled_together() -> None:
    """Three robots that score alike in every scene tell no more than one of them."""
    scenes, pooled = rng.normal(3, 2, 30), ("aloha_agilex", "arx_x5", "ur5_wsg")
    one, three = mean_interval(episodes(scenes)), mean_interval(episodes(np.repeat(scenes, 3), pooled))
    assert (three.low, three.high) == pytest.approx((one.low, one.high)) and (one.count, three.count) == (30, 90)


def test_a_difference_inside_the_noise_floor_is_not_resolved() -> None:
    model, copy = episodes(0.53 + 0.001 * np.arange(8)), episodes(0.5 + 0.001 * np.arange(8))
    assert verdict_on(model, copy, True, floor=0.02) == "better" and verdict_on(model, copy, True, floor=0.04) == "unresolved"
    assert verdict_on(copy, model, True, floor=0.02) == "worse" and verdict_on(copy, model, True, floor=0.04) == "unresolved"


def table(title: str, model: float, copy: float = 0.4) -> RobotTable:
    point = lambda value: {"lpips": Interval(value, value, value, 4)}  # noqa: E731
    rows = (
        Row("m", "c", point(model), {"lpips": "better" if model < copy else "worse"}),
        Row("copy_first_frame", "", point(copy), {}),
        Row("ground_truth", "", point(0.0), {}),
    )
    return RobotTable(title, (title,), rows, 4)


def test_progress_is_the_share_of_the_way_from_frozen_to_true() -> None:
    for model, share in ((0.4, 0), (0.1, 0.75), (0, 1), (0.5, -0.25)):
        made = table("x", model)
        assert progress(made, made.rows[0], "lpips") == pytest.approx(share)


def test_the_finding_says_better_worse_and_how_far() -> None:
    said = finding([table("Panda", 0.1), table("Piper", 0.5)], [table("Seen", 0.2)], [info("lpips")])
    assert said == [
        "Panda (4 episodes): m · c is better than the frozen first frame on LPIPS. "
        "Its LPIPS error is 25\u00a0% of the frozen first frame's (50\u00a0% on seen robots).",
        "Piper (4 episodes): m · c is worse than the frozen first frame on LPIPS. "
        "Its LPIPS error is 125\u00a0% of the frozen first frame's (50\u00a0% on seen robots).",
    ]
    assert "--no-baselines" in finding([], [], [info("lpips")])[0]
    few = Row("m", "c", {"lpips": Interval(0.1, np.nan, np.nan, 4)}, {"lpips": "unresolved"})
    said = finding([RobotTable("Panda", ("Panda",), (few,), 4)], [], [info("lpips")])
    assert said == [
        "Panda (4 episodes): m · c cannot be compared with the frozen first frame: fewer than 6 scenes were graded."
    ]


def test_numbers_have_the_digits_that_mean_something() -> None:
    assert format_number(21.23456, info("psnr", "dB")) == "21.23"
    assert format_number(3.14159, info("keypoint_error", "px")) == "3.1"
    assert format_number(0.123456, info("lpips")) == "0.123"

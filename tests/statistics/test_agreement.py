"""`evaluate` and `report` say the same of the same scores: means, intervals and verdicts, to the last digit.

A study's intervals carry a spread between runs besides, which is 0 here.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.analysis.synthetic_study import paper_axes
from xew.analysis.paper import read_paper
from xew.analysis.report import run_table
from xew.analysis.reports.run_tables import finding, flat_summary, robot_table
from xew.analysis.scores import COPY, TRUTH, Scores, read_scores
from xew.analysis.statistics.grades import StudyGrades
from xew.analysis.tables.builder import Builder, paired_verdict
from xew.metrics import METRICS
from xew.metrics.grading.scores import describe
from xew.metrics.grading.summary import summarize_robots, to_markdown
from xew.protocol import CODEC_TRUTH, PASTED_RENDER, ROBOT_NAMES, SEEN_ROBOTS, reference
from xew.statistics import Summary

ROBOTS = ("ur5_wsg", "piper")
JOINTS, FLOW = (reference(action=action).name for action in ("joints", "optical_flow"))
KEY = "codec 0123abcd"
"""Condition of the truth through the codec of the second model; the first has none."""
BASE = {
    "psnr": 20.0,
    "ssim": 0.8,
    "mask_iou": 0.6,
    "keypoint_error": 6.0,
    "keypoint_error_strict": 8.0,
    "trajectory_error": 9.0,
}
"""Mean score of the worse model by metric; all but the first two are estimated."""
BESIDE = {"keypoint_error"}
"""Metrics of the suite paper beside which one of the suite strict decides."""


def write_scores(path: Path, scenes: int, truth: bool, spread: float, missing: float) -> Scores:
    """Two models and the baselines on scenes of four tasks; scores are rounded, so that some are tied."""
    rng = np.random.default_rng(scenes)
    gains = {JOINTS: 0.0, FLOW: 0.08, COPY: -0.02, PASTED_RENDER: 0.04} | ({TRUTH: 0.6, CODEC_TRUTH: 0.5} if truth else {})
    rows = [
        {
            "model": model,
            "condition": KEY * (model == CODEC_TRUTH),
            "task": f"task{i % 4}",
            "seed": 1_000_000 + i // 4,
            "robot": robot,
            "metric": metric,
        }
        | {"value": _score(metric, base, gain + 0.05 * shared + spread * rng.normal())}
        for i, shared in enumerate(rng.normal(size=scenes))
        for robot in ROBOTS
        for model, gain in gains.items()
        for metric, base in BASE.items()
        if rng.random() >= missing
    ]
    table = pd.DataFrame(rows).assign(frames=5, exact_frames=0)
    table.attrs = describe({"protocol": 3, "estimators": {}, "frame_zero": "given", "allowed": []}, tuple(BASE))
    table.attrs["codecs"] = {FLOW: [KEY]}
    table.to_parquet(path)
    table.assign(frame=0).to_parquet(path.with_suffix(".curves.parquet"))
    return read_scores(path)


def _score(metric: str, base: float, gain: float) -> float:
    low, high = METRICS[metric].range
    value = base * (1 + gain if METRICS[metric].higher_is_better else 1 - gain)
    return float(np.clip(np.round(value, 2 if high == 1 else 1), low, high))


@pytest.fixture(params=[(3, True), (6, True), (12, True), (12, False)], ids=lambda p: f"{p[0]}-{'truth' if p[1] else 'none'}")
def size(request: pytest.FixtureRequest) -> tuple[int, bool]:
    return request.param


@pytest.fixture(params=[(0.01, 0.0), (0.06, 0.15), (0.0, 0.0)], ids=["clear", "gaps", "ties"])
def scores(request: pytest.FixtureRequest, size: tuple[int, bool], tmp_path: Path) -> Scores:
    return write_scores(tmp_path / "scores.parquet", *size, *request.param)


def pairs_of(summary: Summary, model: str, other: str) -> Iterator[tuple[tuple[str, str], str]]:
    pairs = summary.pairs[(summary.pairs["model"] == model) & (summary.pairs["other"] == other)]
    for pair in pairs.itertuples():
        yield (str(pair.robot), str(pair.metric)), str(pair.verdict)


def test_a_run_is_the_same_in_both(scores: Scores) -> None:
    summary = summarize_robots(scores.rows)
    means = summary.means.set_index(["robot", "model", "metric"])
    reported = {robot: robot_table(scores, robot, [robot], None) for robot in ROBOTS}
    compared = 0
    for robot, table in reported.items():
        for row in table.rows:
            for metric, score in row.scores.items():
                found = means.loc[(robot, row.model, metric)]
                np.testing.assert_array_equal(found[["mean", "low", "high"]].astype(float), [score.mean, score.low, score.high])
                assert found["episodes"] == score.count
                compared += 1
    assert compared == len(summary.means)
    for model in (JOINTS, FLOW):
        rows = {robot: next(row for row in table.rows if row.model == model) for robot, table in reported.items()}
        for other, verdicts in ((COPY, "verdicts"), (PASTED_RENDER, "over_pasting")):
            own = {(robot, name): word for robot, row in rows.items() for name, word in getattr(row, verdicts).items()}
            assert dict(pairs_of(summary, model, other)) == own and len(own) == len(ROBOTS) * len(BASE)


def test_which_suite_decides_and_where_they_part_is_the_same_in_both(tmp_path: Path) -> None:
    """By the paper's metric the first model is worse than a frozen frame, and by that of the suite strict it is better."""
    scores = write_scores(tmp_path / "scores.parquet", 12, True, 0.01, 0.0)
    worse = (scores.rows["metric"] == "keypoint_error") & (scores.rows["model"] == JOINTS)
    better = (scores.rows["metric"] == "keypoint_error_strict") & (scores.rows["model"] == JOINTS)
    value = scores.rows["value"].where(~worse, 29.0).where(~better, 0.1)
    rows = scores.rows.assign(value=value)
    rows.attrs = scores.rows.attrs
    summary = summarize_robots(rows)
    tables = [robot_table(replace(scores, rows=rows), robot, [robot], None) for robot in ROBOTS]
    assert set(summary.pairs.loc[~summary.pairs["decides"], "metric"]) == BESIDE
    flat = flat_summary(tables, scores.metrics)
    assert set(flat.loc[~flat["decides"], "metric"]) == BESIDE
    text = "The suites disagree on {} (better) and {} (worse); strict decides."
    assert text.format("keypoint_error_strict", "keypoint_error") in to_markdown(replace(summary, pairs=two_models(summary)))
    sentences = finding(tables, [], scores.metrics)
    joints = [sentence for sentence in sentences if f": {JOINTS} " in sentence]
    assert len(joints) == len(ROBOTS)
    for sentence in joints:
        assert sentence.endswith(text.format("Strict keypoint error", "Keypoint error"))
        decided = sentence[: sentence.index(" The suites disagree")]
        assert "Strict keypoint error" in decided and "Keypoint error" not in decided
        assert "the paste baseline" in decided
    # A mark stands at the metric that decides.
    (section,) = run_table(tables[0], scores.metrics).sections
    row = next(row for row in section.rows if row.labels == (JOINTS,))
    marks = dict(zip(tables[0].rows[0].scores, (cell.verdict for cell in row.cells), strict=True))
    assert marks["keypoint_error_strict"] == "better" and marks["keypoint_error"] == ""


def test_tasks_without_power_leave_the_means_of_the_suite_strict_in_both(tmp_path: Path) -> None:
    """In one of four tasks the frozen first frame is hardly worse than the truth in one metric of each suite."""
    scores = write_scores(tmp_path / "scores.parquet", 12, True, 0.01, 0.0)
    at_rest = (scores.rows["task"] == "task2") & (scores.rows["model"] == COPY)
    at_rest &= scores.rows["metric"].isin(["keypoint_error", "keypoint_error_strict"])
    rows = scores.rows.assign(value=scores.rows["value"].where(~at_rest, 1.0))
    rows.attrs = scores.rows.attrs
    summary = summarize_robots(rows)
    power = summary.power.set_index(["metric", "task"])
    assert set(power.index.get_level_values("metric")) == {"mask_iou", "keypoint_error_strict"}, "estimated, and strict"
    assert not power.loc[("keypoint_error_strict", "task2"), "kept"] and power["kept"].sum() == 2 * 4 - 1
    truth = rows[(rows["model"] == TRUTH) & (rows["metric"] == "keypoint_error_strict") & (rows["task"] == "task2")][
        "value"
    ].mean()
    assert power.loc[("keypoint_error_strict", "task2"), "power"] == pytest.approx(1 / truth)
    variants = rows["model"].where(rows["model"].isin([JOINTS, FLOW]), "")
    grades = StudyGrades(
        rows.assign(variant=variants), scores.metrics, paper_axes(read_paper()), codecs=scores.codecs, assumed_spread=0
    )
    changed = replace(scores, rows=rows)
    means = summary.means.set_index(["robot", "model", "metric"])
    for robot in ROBOTS:
        table = robot_table(changed, robot, [robot], None)
        row = next(row for row in table.rows if row.model == JOINTS)
        for metric, count in (("keypoint_error_strict", 9), ("keypoint_error", 12), ("psnr", 12)):
            own = rows[(rows["robot"] == robot) & (rows["model"] == JOINTS) & (rows["metric"] == metric)]
            own = own[own["task"] != "task2"] if count == 9 else own
            study = grades.variant_mean(JOINTS, (robot,), metric)
            found = means.loc[(robot, JOINTS, metric)]
            assert study and study.count == found["episodes"] == row.scores[metric].count == len(own) == count
            assert found["mean"] == row.scores[metric].mean == study.value == pytest.approx(own["value"].mean())
            assert study.interval() == (row.scores[metric].low, row.scores[metric].high) == (found["low"], found["high"])
        assert "(Strict keypoint error: task2)." in table.notes
        assert table.notes in run_table(table, scores.metrics).caption
    assert "(keypoint_error_strict: task2)." in to_markdown(summary)
    assert "(Strict keypoint error: task2)." in grades.notes
    alone = rows[rows["model"] != COPY]
    assert summarize_robots(alone).power.empty, "without the baseline nothing is known, and all tasks stay"


def two_models(summary: Summary) -> pd.DataFrame:
    """The pairs of the first model and the frozen frame, few enough to be printed."""
    return summary.pairs[(summary.pairs["model"] == JOINTS) & (summary.pairs["other"] == COPY)]


def test_a_study_is_the_same_in_both(scores: Scores) -> None:
    summary = summarize_robots(scores.rows)
    means = summary.means.set_index(["robot", "model", "metric"])
    variants = scores.rows["model"].where(scores.rows["model"].isin([JOINTS, FLOW]), "")
    rows = scores.rows.assign(variant=variants)
    grades = StudyGrades(rows, scores.metrics, paper_axes(read_paper()), codecs=scores.codecs, assumed_spread=0)
    builder = Builder(grades, None)
    found = dict(pairs_of(summary, JOINTS, FLOW))
    words = set()
    for robot in ROBOTS:
        for metric in BASE:
            for row, model in (("joints", JOINTS), ("optical_flow", FLOW)):
                cell, mean = builder.cell("actions", row, robot, metric), means.loc[(robot, model, metric)]
                np.testing.assert_array_equal([cell.value, cell.low, cell.high], mean[["mean", "low", "high"]].astype(float))
            assert paired_verdict(grades, "actions", "joints", "optical_flow", robot, metric) == found[robot, metric]
            for row, model in (("joints", JOINTS), ("optical_flow", FLOW)):
                noise = means.loc[(robot, model, metric), "noise"]
                assert grades.floor(robot, metric, ("actions", row)) == pytest.approx(noise, abs=0, nan_ok=True)
            mark = builder.cell("actions", "joints", robot, metric, "optical_flow").verdict
            assert mark == ("" if metric in BESIDE else found[robot, metric]), "the suite strict decides"
            words.add(found[robot, metric])
    if len(scores.rows["seed"].unique()) < 2:
        assert words == {"unresolved"}, "three scenes resolve nothing, in neither"


def test_what_the_two_once_disagreed_on(tmp_path: Path) -> None:
    """Three scenes are too few in both, and what is estimated has no floor without the true video, in both."""
    for scenes, truth, resolved in ((3, True, set()), (12, True, set(BASE)), (12, False, {"psnr", "ssim"})):
        scores = write_scores(tmp_path / "scores.parquet", scenes, truth, 0.01, 0.0)
        tables = [robot_table(scores, robot, [robot], None) for robot in ROBOTS]
        reported = [row.verdicts for table in tables for row in table.rows if row.model == FLOW]
        graded = dict(pairs_of(summarize_robots(scores.rows), FLOW, COPY))
        for words in (*reported, {metric: word for (_, metric), word in graded.items()}):
            found = {metric for metric, word in words.items() if word == "better"}
            assert found <= resolved and (found & {"psnr", "ssim"}) == (resolved & {"psnr", "ssim"})


def test_robots_that_are_pooled_are_the_same_in_a_run_and_a_study(tmp_path: Path) -> None:
    scores = write_scores(tmp_path / "scores.parquet", 12, True, 0.05, 0.1)
    rows = pd.concat([scores.rows.assign(robot=robot) for robot in ROBOT_NAMES])
    rows["value"] *= 1 - 0.001 * rows.groupby(["model", "task", "seed", "metric"]).cumcount()
    rows = rows.drop_duplicates(["model", "task", "seed", "robot", "metric"])
    variants = rows["model"].where(rows["model"].isin([JOINTS, FLOW]), "")
    grades = StudyGrades(rows.assign(variant=variants), scores.metrics, paper_axes(read_paper()), assumed_spread=0)
    table = robot_table(Scores(rows, scores.curves, scores.metrics, {}), "seen", SEEN_ROBOTS, None)
    for row in table.rows:
        for metric, score in row.scores.items():
            name = " ".join(filter(None, (row.model, row.condition)))
            mean = grades.variant_mean(name, SEEN_ROBOTS, metric)
            assert mean and (mean.value, *mean.interval(), mean.count) == (score.mean, score.low, score.high, score.count)

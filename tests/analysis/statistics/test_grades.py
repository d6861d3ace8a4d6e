"""Means by address, and what they vary over."""

import numpy as np
import pandas as pd
import pytest

from tests.analysis.synthetic_study import TASKS, paper_axes, write_study
from xew.analysis.paper import read_paper
from xew.analysis.scores import Scores, read_scores
from xew.analysis.statistics.grades import SEEN, PaperGrades, StudyGrades, find_variant, relative_gain, row_keys
from xew.protocol import PAPER_PARTS, PARTS, ROBOT_NAMES, SEEN_ROBOTS
from xew.statistics import bootstrap_means, combine


@pytest.fixture(scope="module")
def scores(tmp_path_factory: pytest.TempPathFactory) -> Scores:
    return read_scores(write_study(tmp_path_factory.mktemp("grades") / "scores.parquet"))


@pytest.fixture(scope="module")
def grades(scores: Scores) -> StudyGrades:
    return StudyGrades(scores.rows, scores.metrics, paper_axes(read_paper()))


def test_every_row_of_the_paper_is_a_variant_of_the_protocol_and_the_other_way_round() -> None:
    paper = read_paper()
    for part, printed in paper.parts.items():
        keys = {key for variant in PARTS[part] for key in row_keys(part, variant)}
        assert set(printed.rows) == keys - {"robot_render"} or (part == "ladder" and set(printed.rows) == keys)
        for key in printed.rows:
            assert find_variant(part, key) in PARTS[part]
    assert set(paper.parts) | {"fixed"} == set(PAPER_PARTS)
    with pytest.raises(KeyError, match="wings"):
        find_variant("actions", "wings")


def test_a_mean_is_over_episodes_and_seen_robots_are_pooled(grades: StudyGrades, scores: Scores) -> None:
    rows = scores.rows[(scores.rows["variant"] == "fixed-optical_flow-none") & (scores.rows["metric"] == "lpips")]
    for robots, names in ((SEEN, SEEN_ROBOTS), ("piper", ("piper",))):
        mean, chosen = grades.mean("fixed", "fixed", robots, "lpips"), rows[rows["robot"].isin(names)]
        assert mean is not None and mean.value == pytest.approx(chosen["value"].mean())
        assert mean.count == len(chosen) and mean.scenes == 12
    fold = grades.mean("loeo", "loeo_piper", SEEN, "lpips")
    assert fold is not None and fold.count == 4 * 12


def test_intervals_are_those_of_resampled_scenes(grades: StudyGrades, scores: Scores) -> None:
    """Episodes of one scene are alike, so the interval of three pooled robots is far wider than that of as many scenes."""
    mean = grades.mean("fixed", "fixed", SEEN, "lpips")
    rows = scores.rows[(scores.rows["variant"] == "fixed-optical_flow-none") & (scores.rows["metric"] == "lpips")]
    by_scene = rows[rows["robot"].isin(SEEN_ROBOTS)].groupby(["task", "seed"])["value"].mean()
    assert mean is not None
    within = by_scene.groupby("task").var(ddof=1).mean()  # scenes are drawn within tasks
    assert mean.values[1:].std() == pytest.approx(np.sqrt(within / 12), rel=0.06) and mean.freedom == 12 - 4
    low, high = mean.interval()
    assert low < mean.value < high


@pytest.mark.parametrize("scenes", [6, 20, 100])
def test_chance_resolves_as_often_as_is_said(scenes: int) -> None:
    differences = np.random.default_rng(1).normal(size=(1500, scenes))
    ends = np.array([mean.interval() for mean in bootstrap_means(differences.T, np.arange(scenes), (0,) * scenes) if mean])
    assert np.mean((ends[:, 0] > 0) | (ends[:, 1] < 0)) == pytest.approx(0.05, abs=0.02)


def test_differences_are_paired_by_scene(grades: StudyGrades) -> None:
    """Scenes differ by 15 %, the two rows by 3 % within a scene: only pairing can tell them apart so well."""
    after, before = (grades.mean("actions", row, "piper", "lpips") for row in ("optical_flow", "joints"))
    assert after is not None and before is not None
    gain = relative_gain(after, before, grades.metrics["lpips"])
    assert gain.value == pytest.approx((before.value - after.value) / before.value)
    unpaired = before.values[1:] - np.random.default_rng(0).permutation(after.values[1:])
    assert np.ptp(gain.interval()) * before.value < 0.5 * np.ptp(np.quantile(unpaired, [0.025, 0.975]))


def test_the_floor_is_what_the_estimators_miss_on_the_truth(grades: StudyGrades) -> None:
    assert grades.floor("piper", "mask_iou") == pytest.approx(0.03)
    assert grades.floor(SEEN, "keypoint_error") == pytest.approx(1.2)
    assert grades.floor("piper", "psnr") == grades.floor("piper", "lpips") == 0


def test_what_was_not_graded_is_none(scores: Scores) -> None:
    rows = scores.rows[(scores.rows["variant"] != "fixed-mask-none") & (scores.rows["robot"] != "piper")]
    some = StudyGrades(rows, scores.metrics, paper_axes(read_paper()))
    assert some.mean("actions", "mask", "franka_panda", "lpips") is None
    assert some.mean("actions", "joints", "piper", "lpips") is None and not some.has("fixed-mask-none")
    assert np.isnan(some.floor("piper", "mask_iou")) and some.floor("piper", "lpips") == 0


def test_shared_cells_are_those_that_all_rows_of_a_part_have(scores: Scores) -> None:
    lacks = (scores.rows["variant"] == "fixed-mask-none") & (scores.rows["task"] == TASKS[0])
    some = StudyGrades(scores.rows[~lacks], scores.metrics, paper_axes(read_paper()))
    counts = {}
    for shared in (False, True):
        means = {row: some.mean("actions", row, "piper", "lpips", shared) for row in ("joints", "mask")}
        counts[shared] = [mean.count for mean in means.values() if mean]
    assert counts == {False: [12, 9], True: [9, 9]}


def test_an_adapted_model_takes_no_seen_robot_from_the_one_that_it_starts_from(grades: StudyGrades) -> None:
    """It is graded on UR5 alone of the seen ones; the pool stays whole."""
    pool, alone = (grades.mean("few_shot", "reference", robots, "lpips", shared=True) for robots in (SEEN, "ur5_wsg"))
    assert pool is not None and alone is not None and (pool.count, alone.count) == (36, 12)


def train_thrice(rows: pd.DataFrame, variant: str, spread: float) -> pd.DataFrame:
    """The same scores with the column `training`, and two more trainings of a variant, worse and better by a share."""
    rows = rows.assign(training=0)
    own = rows[rows["variant"] == variant]
    more = [own.assign(training=seed, value=own["value"] * (1 + sign * spread)) for seed, sign in ((1, 1), (2, -1))]
    return pd.concat([rows, *more], ignore_index=True)


def test_a_variant_of_several_trainings_is_their_mean_and_has_their_spread(grades: StudyGrades, scores: Scores) -> None:
    flow = "fixed-optical_flow-none"
    more = StudyGrades(train_thrice(scores.rows, flow, 0.2), scores.metrics, paper_axes(read_paper()))
    assert more.trainings(flow) == 3 and more.trainings("fixed-joints-none") == 1
    one, three = (one.mean("actions", "optical_flow", "piper", "lpips") for one in (grades, more))
    assert one and three and (one.trainings, three.trainings) == (1, 3)
    assert three.value == pytest.approx(one.value) and (three.count, three.scenes) == (one.count, one.scenes)
    between = np.sqrt(2 / 3) * 0.2 * one.value / np.sqrt(2)  # sd of (0, 0.2, -0.2) over the root of three
    assert three.values[1:-3].std() == pytest.approx(np.hypot(one.values[1:].std(), between), rel=0.1)
    assert np.ptp(three.interval()) > 3 * np.ptp(one.interval())
    same = [one.mean("actions", "joints", "piper", "lpips") for one in (grades, more)]
    assert same[0] and same[1] and same[0].interval() == same[1].interval() and same[1].trainings == 1
    gap = [one.difference("actions", "optical_flow", "joints", "piper", "lpips") for one in (grades, more)]
    assert gap[0] and gap[1] and gap[1].value == pytest.approx(gap[0].value) and gap[1].trainings == 1
    assert np.ptp(gap[1].interval()) > np.ptp(gap[0].interval())


def test_an_adapted_model_is_compared_with_the_training_that_it_started_from(grades: StudyGrades, scores: Scores) -> None:
    views = "fixed-optical_flow-nine_views"
    rows = train_thrice(scores.rows, views, 0.2)
    rows.loc[(rows["variant"] == views) & (rows["training"] == 2), "value"] *= 0.5
    more = StudyGrades(rows, scores.metrics, paper_axes(read_paper()))
    assert more.trainings(views) == 3 and more.variants == grades.variants
    for part, row, robot in (("few_shot", "piper-0", "piper"), ("forgetting", "none", "ur5_wsg")):
        one, own = (each.mean(part, row, robot, "lpips") for each in (grades, more))
        assert one and own and own.value == one.value and own.trainings == 1
    gains = [each.difference("few_shot", "piper-1", "piper-0", "piper", "lpips") for each in (grades, more)]
    assert gains[0] and gains[1] and gains[1].value == gains[0].value and gains[1].interval() == gains[0].interval()
    means = [each.mean("ladder", "nine_views", "piper", "lpips") for each in (grades, more)]
    assert means[0] and means[1] and means[1].value < means[0].value, "elsewhere all trainings count"


def test_an_adaptation_is_drawn_with_the_training_that_it_started_from(grades: StudyGrades, scores: Scores) -> None:
    """What one training of the start has of luck, the adaptation of it has too, and is in no comparison of the two."""
    rows = train_thrice(scores.rows, "fixed-optical_flow-nine_views", 0.2)
    rows = pd.concat([rows, train_thrice(scores.rows, "few_shot-piper-1", 0.2).query("training > 0")], ignore_index=True)
    more = StudyGrades(rows, scores.metrics, paper_axes(read_paper()))
    ratios = []
    for each in (grades, more):
        after, before = (each.mean("few_shot", row, "piper", "lpips") for row in ("piper-1", "piper-0"))
        assert after and before
        ratios.append(combine(np.divide, after, before))
    assert [ratio.trainings for ratio in ratios] == [1, 3]
    assert ratios[1].value == pytest.approx(ratios[0].value) and ratios[1].interval() == pytest.approx(ratios[0].interval())
    after, joints = (more.mean(*address, "piper", "lpips") for address in (("few_shot", "piper-1"), ("actions", "joints")))
    assert after and joints
    assert np.ptp(combine(np.divide, after, joints).interval()) > 2 * np.ptp(ratios[1].interval()), "others are not its start"


def test_episodes_that_one_training_lacks_count_for_none(scores: Scores) -> None:
    flow = "fixed-optical_flow-none"
    rows = train_thrice(scores.rows, flow, 0.2)
    lost = (rows["training"] == 2) & (rows["task"] == TASKS[0])
    mean = StudyGrades(rows[~lost], scores.metrics, {}).mean("actions", "optical_flow", "piper", "lpips")
    kept = scores.rows[(scores.rows["variant"] == flow) & (scores.rows["task"] != TASKS[0])]
    expected = kept[(kept["robot"] == "piper") & (kept["metric"] == "lpips")]["value"].mean()
    assert mean and mean.count == 9 and mean.value == pytest.approx(expected)


def test_the_papers_means_vary_by_what_prints_the_same() -> None:
    paper = read_paper()
    grades = PaperGrades(paper, paper.infos)
    mean = grades.mean("baselines", "irasim", "piper", "trajectory_error")
    assert mean is not None and set(np.round(mean.values, 6)) == {18.4, 18.35, 18.45}
    assert grades.print("baselines", "irasim", "piper", "trajectory_error") == "18.4"
    assert (
        grades.print("fixed", "fixed", "piper", "psnr") == "24.245"
        and grades.print("actions", "joints", "arx_x5", "psnr") == ""
    )
    looks, reach = (grades.axis(axis) for axis in ("appearance", "kinematic"))
    assert looks[0].tolist() == [paper.robots[robot].appearance for robot in ROBOT_NAMES]
    up = (looks[1:] > looks[0]).ravel(), (reach[1:] > reach[0]).ravel()
    assert abs(np.corrcoef(*up)[0, 1]) < 0.05  # else half of what prints the same is never tried


def test_no_two_variants_of_a_part_fill_one_row() -> None:
    for part, variants in PARTS.items():
        keys = [key for variant in variants for key in row_keys(part, variant)]
        assert len(keys) == len(set(keys)), part

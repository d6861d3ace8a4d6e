"""Means by address, and what they vary over."""

import numpy as np
import pandas as pd
import pytest

from tests.analysis.synthetic_study import TASKS, paper_axes, write_study
from xew.analysis.paper import read_paper
from xew.analysis.scores import Scores, read_scores
from xew.analysis.statistics.grades import SEEN, PaperGrades, StudyGrades, find_variant, relative_gain, relative_loss, row_keys
from xew.protocol import PAPER_PARTS, PARTS, ROBOT_NAMES, SEEN_ROBOTS, join_fault
from xew.statistics import ASSUMED_SPREAD, Mean, bootstrap_means, combine, fixed_mean


@pytest.fixture(scope="module")
def scores(tmp_path_factory: pytest.TempPathFactory) -> Scores:
    return read_scores(write_study(tmp_path_factory.mktemp("grades") / "scores.parquet"))


@pytest.fixture(scope="module")
def grades(scores: Scores) -> StudyGrades:
    return StudyGrades(scores.rows, scores.metrics, paper_axes(read_paper()), assumed_spread=0)


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


def test_all_commands_in_a_scene_are_one_scene(grades: StudyGrades, scores: Scores) -> None:
    """Faulty episodes that score as the expert's say no more: the interval stays as wide."""
    rows = pd.concat([scores.rows.assign(seed=join_fault(fault, scores.rows["seed"])) for fault in range(3)])
    faulty = StudyGrades(rows, scores.metrics, paper_axes(read_paper()), assumed_spread=0)
    assert faulty.scenes == grades.scenes == 12
    for robots, metric in ((SEEN, "lpips"), ("piper", "trajectory_error")):
        mean, expert = (each.mean("fixed", "fixed", robots, metric) for each in (faulty, grades))
        assert mean is not None and expert is not None
        assert (mean.count, mean.scenes, mean.freedom) == (3 * expert.count, 12, expert.freedom)
        assert mean.interval() == pytest.approx(expert.interval())


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


def test_no_more_than_all_of_a_score_is_lost_and_no_more_than_all_of_an_error_is_gained(grades: StudyGrades) -> None:
    noisy = fixed_mean(np.r_[0.01, np.random.default_rng(0).normal(0.01, 0.03, 999)], 36, 36)
    sure = fixed_mean(np.full(1000, 0.02), 36, 36)
    for metric, place, bound in (("mask_iou", 0, -1), ("lpips", 1, 1)):
        gain, loss = (number(noisy, sure, grades.metrics[metric]).interval() for number in (relative_gain, relative_loss))
        assert gain[place] == bound == -loss[1 - place]
        assert -loss[place] == pytest.approx(gain[1 - place]) and abs(loss[place]) > 1.5


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
    rows = rows.assign(training=0) if "training" not in rows else rows
    own = rows[rows["variant"] == variant]
    more = [own.assign(training=seed, value=own["value"] * (1 + sign * spread)) for seed, sign in ((1, 1), (2, -1))]
    return pd.concat([rows, *more], ignore_index=True)


FLOW, VIEWS, JOINTS = (f"fixed-{name}" for name in ("optical_flow-none", "optical_flow-nine_views", "joints-none"))


def lpips_of(rows: pd.DataFrame, scores: Scores, *addresses: tuple[str, str], **options: float) -> list[Mean]:
    """Means of LPIPS on Piper at some parts and rows."""
    grades = StudyGrades(rows, scores.metrics, paper_axes(read_paper()), **options)
    means = [grades.mean(*address, "piper", "lpips", shared=True) for address in addresses]
    return [mean for mean in means if mean is not None]


def test_a_variant_of_several_trainings_is_their_mean_and_has_their_spread(scores: Scores) -> None:
    flow, joints = ("actions", "optical_flow"), ("actions", "joints")
    [one] = lpips_of(scores.rows, scores, flow, assumed_spread=0)
    three, single = lpips_of(train_thrice(scores.rows, FLOW, 0.2), scores, flow, joints)
    assert (one.trainings, three.trainings, single.trainings) == (1, 3, 1)
    assert three.value == pytest.approx(one.value) and (three.count, three.scenes) == (one.count, one.scenes)
    between = np.sqrt(2 / 3) * 0.2 * one.value / np.sqrt(2)  # sd of (0, 0.2, -0.2) over the root of three
    assert three.values[1:].std() == pytest.approx(np.hypot(one.values[1:].std(), between), rel=0.1)
    assert np.ptp(three.interval()) > 3 * np.ptp(one.interval())


def test_a_variant_of_one_training_carries_the_spread_of_the_others(scores: Scores) -> None:
    joints = ("actions", "joints")
    [alone], [assumed] = (lpips_of(scores.rows, scores, joints, **options) for options in ({"assumed_spread": 0}, {}))
    [carried] = lpips_of(train_thrice(scores.rows, FLOW, 0.2), scores, joints)
    for mean, share in ((assumed, ASSUMED_SPREAD), (carried, 0.2)):
        assert mean.value == alone.value
        assert mean.values[1:].std() == pytest.approx(np.hypot(alone.values[1:].std(), share * alone.value), rel=0.05)
    assert np.ptp(carried.interval()) > 3 * np.ptp(alone.interval())


def test_differences_are_taken_within_a_training_seed(scores: Scores) -> None:
    """Two runs of the luckier sort are in one mean and not in the other, and in no difference."""
    rows = train_thrice(scores.rows, FLOW, 0.2)
    rows.loc[(rows["variant"] == FLOW) & (rows["training"] > 0), "value"] *= 0.5
    pair = (("actions", "optical_flow"), ("actions", "joints"))
    differences = [combine(np.subtract, *lpips_of(each, scores, *pair)) for each in (scores.rows, rows)]
    assert differences[0].value == differences[1].value and differences[1].seeds == ((0,), (0,))
    flow, joints = lpips_of(rows, scores, *pair)
    assert flow.value - joints.value < differences[1].value


def test_what_a_seed_does_to_all_is_in_no_difference(scores: Scores) -> None:
    """Adaptations start from the run of their seed; any two variants with the same seeds are drawn together."""
    rows = scores.rows
    for variant in (FLOW, VIEWS, "few_shot-piper-1"):
        rows = train_thrice(rows, variant, 0.2)
    pair = (("few_shot", "piper-1"), ("few_shot", "piper-0"))
    one, three = (combine(np.divide, *lpips_of(each, scores, *pair, assumed_spread=0)) for each in (scores.rows, rows))
    assert (one.trainings, three.trainings) == (1, 3)
    assert three.value == pytest.approx(one.value) and three.interval() == pytest.approx(one.interval())


def test_a_seed_that_all_anchors_share_cancels_in_single_runs(scores: Scores) -> None:
    """Both anchors move alike from seed to seed, so nothing is left between two variants of the same seed."""
    rows = train_thrice(train_thrice(scores.rows, FLOW, 0.2), VIEWS, 0.2)
    pair = (("actions", "mask"), ("actions", "joints"))
    alone, carried = (lpips_of(each, scores, *pair, assumed_spread=0) for each in (scores.rows, rows))
    assert np.ptp(carried[0].interval()) > 2 * np.ptp(alone[0].interval())
    ratios = [combine(np.divide, *means).interval() for means in (alone, carried)]
    assert ratios[1] == pytest.approx(ratios[0], rel=1e-3)


def test_intervals_stay_in_the_range_of_their_metric(scores: Scores) -> None:
    grades = StudyGrades(train_thrice(scores.rows, FLOW, 0.6), scores.metrics, paper_axes(read_paper()))
    for metric in ("mask_iou", "trajectory_error"):
        mean = grades.mean("actions", "joints", "piper", metric)
        assert mean
        low, high = mean.interval()
        info = grades.metrics[metric]
        assert info.range[0] <= low < mean.value < high <= info.range[1] and (low == 0 or high == 1)


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

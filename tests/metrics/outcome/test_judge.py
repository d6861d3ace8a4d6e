"""The judge on an episode of the simulation: a block on a table, and hands that close."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.sim_warp.small import TASK
from xew.dataset import holds_faults
from xew.episode import episode_folder, read_pixels, read_record
from xew.metrics import METRICS
from xew.metrics.backends import open_masker, open_tracker
from xew.metrics.episode_cache import EpisodeCache
from xew.metrics.grade import Comparison, Grades, grade
from xew.metrics.grading.settings import WITHOUT_OUTCOME, Args, resolve
from xew.metrics.truth import Truth, read_truth
from xew.protocol import OUTCOME, join_fault

NAMES = tuple(name for name, metric in METRICS.items() if metric.dimension == OUTCOME)


def judge(folder: Path, video: np.ndarray | None = None) -> Grades:
    truth = read_truth(folder, read_record(folder).frame_count, ("outcome", "variants", "variant_videos"))
    prediction = truth.rgb if video is None else video
    return grade(Comparison(prediction, EpisodeCache(truth), open_masker("opencv"), open_tracker("opencv")), NAMES)


def test_the_true_video_has_the_true_outcome_and_is_retrieved(data: Path) -> None:
    expert = episode_folder(data, TASK, 1, "piper")
    values = judge(expert).values
    assert np.isnan(values.pop("hallucinated_success")), "it is no failure"
    assert values == {"outcome_accuracy": 1, "progress_error": 0, "retrieval": 1, "retrieval_lpips": 1}


def test_a_block_that_should_have_moved_is_not_retrieved(data: Path) -> None:
    expert, faulty = (episode_folder(data, TASK, seed, "piper") for seed in (1, join_fault(3, 1)))
    for name in ("retrieval", "retrieval_lpips"):
        assert judge(faulty).values[name] == 1
        assert judge(faulty, read_pixels(expert, "rgb")).values[name] == 0
        assert judge(expert, read_pixels(faulty, "rgb")).values[name] == 0


WAY = 0.04
"""Way of the block to the right [m] that is a success."""


def read_pushing(folder: Path) -> Truth:
    """An episode whose task is to push the block."""
    truth = read_truth(folder, read_record(folder).frame_count, ("outcome",))
    assert truth.outcome is not None
    pushed = replace(truth.outcome.task, success=lambda scene, now: now.object_pose[0, 0] > scene.objects[0].pose[0] + WAY)
    return replace(truth, outcome=replace(truth.outcome, task=pushed))


def test_success_is_what_the_video_shows_whatever_the_commands_cause(data: Path) -> None:
    still, pushed = (read_pushing(episode_folder(data, TASK, seed, "piper")) for seed in (1, join_fault(3, 1)))
    names = ("outcome_accuracy", "hallucinated_success")
    for truth, video, expected in (
        (still, still.rgb, [1, 0]),
        (still, pushed.rgb, [0, 1]),
        (pushed, pushed.rgb, [1, np.nan]),
        (pushed, still.rgb, [0, np.nan]),
    ):
        obedient = Comparison(video, EpisodeCache(truth), open_masker("opencv"), lambda seen, true, points, visible: points)
        np.testing.assert_array_equal([grade(obedient, names).values[name] for name in names], expected)


def test_a_scene_with_one_command_is_judged_by_tracking(data: Path) -> None:
    still, pushed = (read_pushing(episode_folder(data, TASK, seed, "piper")) for seed in (1, join_fault(3, 1)))
    assert still.outcome is not None
    alone = EpisodeCache(replace(still, outcome=replace(still.outcome, variants=None)))
    comparison = Comparison(pushed.rgb, alone, open_masker("opencv"), lambda seen, true, points, visible: points)
    assert comparison.judged_poses is comparison.tracked_poses


@pytest.mark.parametrize("seed", [1, join_fault(3, 1)], ids=["at rest", "pushed"])
def test_a_video_without_the_block_shows_no_end(data: Path, seed: int) -> None:
    truth = read_pushing(episode_folder(data, TASK, seed, "piper"))
    assert truth.outcome is not None and truth.outcome.variants is not None
    table = np.median(truth.rgb[truth.labels == 0], axis=0).astype(np.uint8)
    erased = np.where(truth.labels[..., None] > 0, table, truth.rgb)
    assert truth.outcome.variants.find_shown(truth.rgb) is truth.outcome.variants.variants[truth.outcome.own]
    assert truth.outcome.variants.find_shown(erased) is None


def test_poses_of_objects_are_those_of_the_simulator(data: Path) -> None:
    folder = episode_folder(data, TASK, 1, "piper")
    truth = read_truth(folder, 12, ("outcome",))
    outcome = truth.outcome
    assert outcome is not None and truth.surfaces is not None and truth.surfaces.resting is not None
    poses = outcome.poses(truth.surfaces.resting.pixels, truth.surfaces.resting.visible)
    np.testing.assert_allclose(poses, outcome.true_poses(12), atol=2e-3)
    place, joint = outcome.place(poses[-1])
    np.testing.assert_allclose(place[0], outcome.states.object_pose[-1, 0], atol=2e-3)
    assert joint.shape == (1,) and outcome.true_progress(0) == 0 and outcome.true_progress(11) == 1


def test_outcomes_are_graded_by_default_where_commands_fail(data: Path, tmp_path: Path) -> None:
    assert holds_faults(data) and resolve(Args(data=data)).metrics == tuple(METRICS)
    assert not holds_faults(tmp_path) and resolve(Args(data=tmp_path)).metrics == WITHOUT_OUTCOME
    assert resolve(Args(data=tmp_path, metrics=("progress_error",))).metrics == ("progress_error",)

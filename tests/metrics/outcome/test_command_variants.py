"""Command variants of a scene: they are read once, and their moving regions are compared by LPIPS."""

import json
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.metrics.outcome.conftest import FAULTS
from tests.sim_warp.small import TASK
from xew import episode
from xew.episode import episode_folder, read_pixels, read_record
from xew.metrics import evaluate, lpips_embedding, truth
from xew.metrics.grading.grade_episodes import group_jobs
from xew.metrics.grading.settings import Args, resolve
from xew.metrics.outcome import variants
from xew.metrics.outcome.variants import CommandVariants, find_variants, instants
from xew.protocol import COPY_FIRST_FRAME, GROUND_TRUTH, join_fault
from xew.sim_warp.production import surfaces

SEEDS = (1, *(join_fault(number, 1) for number in FAULTS))


def find(data: Path, seed: int) -> tuple[CommandVariants, int]:
    folder = episode_folder(data, TASK, seed, "piper")
    found, own = find_variants(folder, read_record(folder), 12, None)
    assert found is not None
    return found, own


def test_states_of_a_scene_are_read_twice_however_many_videos_are_graded(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    variants._open_variants.cache_clear()
    reads: Counter[str] = Counter()

    def counted(module: object, name: str) -> None:
        read = getattr(episode, name)
        monkeypatch.setattr(module, name, lambda *args, **options: [reads.update([name]), read(*args, **options)][1])

    for module in (truth, variants, surfaces):
        counted(module, "read_states")
    counted(variants, "read_pixels")
    names = ("retrieval", "retrieval_lpips")
    out = tmp_path / "scores.parquet"
    evaluate.grade_tables(Args(data=data, out=out, metrics=names, baselines_of="train", tracks="opencv"))
    assert reads == {"read_states": 2 * len(SEEDS), "read_pixels": len(SEEDS)}, "as an episode, and as a variant of all"
    rows = pd.read_parquet(out)
    assert len(rows[rows["metric"] == "retrieval_lpips"]) == 3 * len(SEEDS), "three baselines of each"
    means = rows.groupby(["metric", "model"])["value"].mean()
    for name in names:
        assert means[name, GROUND_TRUTH] == 1
        assert means[name, COPY_FIRST_FRAME] == pytest.approx(1 / len(SEEDS)), "it always looks like the same variant"


def test_a_command_that_another_robot_refused_is_no_variant(data: Path, tmp_path: Path) -> None:
    """Such a cell has a record without hashes, and no states."""
    copied = Path(shutil.copytree(data, tmp_path / "data"))
    refused = episode_folder(copied, TASK, SEEDS[-1], "piper")
    header = json.loads((refused / "episode.json").read_text("utf-8")) | {"files": {}, "hashes": {}}
    shutil.rmtree(refused)
    refused.mkdir()
    (refused / "episode.json").write_text(json.dumps(header), "utf-8")
    found, _ = find(copied, 1)
    assert found.folders == tuple(episode_folder(copied, TASK, seed, "piper") for seed in SEEDS[:-1])


def test_variants_of_a_scene_are_graded_after_one_another(data: Path) -> None:
    settings = resolve(Args(data=data, baselines_of="train"))
    [group] = group_jobs(settings, evaluate.list_jobs(settings).jobs[::-1])
    episodes = [job.cell.seed for job, _ in group]
    assert sorted(set(episodes)) == sorted(SEEDS) and episodes == sorted(episodes, key=episodes.index)


def test_regions_are_of_objects_that_move_under_any_variant(data: Path) -> None:
    found, own = find(data, SEEDS[1])
    assert found is find(data, SEEDS[0])[0] and (len(found), own) == (3, 1)
    places = [np.argwhere(found.moving[n])[:, 1] for n in (0, -1)]
    assert np.ptp(places[1]) > 1.5 * np.ptp(places[0]), "the block has gone to both sides, and to none at first"


def test_distances_are_lpips_of_the_regions_alone(data: Path) -> None:
    found, _ = find(data, SEEDS[0])
    truths = [read_pixels(episode_folder(data, TASK, seed, "piper"), "rgb") for seed in SEEDS]
    regions = [np.where(found.moving[..., None], video[instants(12)], truths[0][0]) for video in truths]
    features = [np.asarray(lpips_embedding(video, found.moving)) for video in regions]
    expected = [np.square(features[1] - other).sum(axis=1).mean() for other in features]  # as tests/metrics/test_perceptual.py
    elsewhere = truths[1].copy()
    elsewhere[instants(12)] = np.where(found.moving[..., None], elsewhere[instants(12)], 0)
    for video in (truths[1], elsewhere):
        np.testing.assert_allclose(found.perceptual_distances(video), expected, rtol=1e-5, atol=1e-7)
    assert (found.perceptual_distances(np.zeros_like(elsewhere)) > 0.1).all()


@pytest.mark.parametrize(("frames", "expected"), [(9, [1, 2, 3, 4, 5, 6, 7, 8]), (81, [10, 20, 30, 40, 50, 60, 70, 80])])
def test_instants_are_equally_far_apart(frames: int, expected: list[int]) -> None:
    assert instants(frames).tolist() == expected

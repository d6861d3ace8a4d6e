"""Training the render head: groups are cut where they should be, and a step improves what it is shown."""

from pathlib import Path

import numpy as np
import pytest

from lab.codec import head
from lab.codec.head import Packed, Train, draw_batches, list_starts, open_pack
from tests import synthetic
from xew.episode import episode_folder, read_record, read_video
from xew.model.codecs.render_head import HeadSize, load_head
from xew.model.episodes.commands import episode_command
from xew.rollout import write_rollout


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("head") / "data"
    synthetic.write_synthetic_data(root, seeds=(0, 1, 1_000_000), robots=("ur5_wsg", "piper"))
    return root


@pytest.mark.parametrize(("seed", "expected"), [(0, [1, 13]), (1, [5, 17]), (2, [9])])
def test_groups_lie_behind_the_first_frame_and_seeds_take_different_ones(seed: int, expected: list[int]) -> None:
    assert list(list_starts(21, seed, every=3)) == expected


def test_a_pack_holds_the_groups_of_training_seeds_of_the_named_robots(data: Path, tmp_path: Path) -> None:
    words = ["--robots", "ur5_wsg", "--every", "2", "--carried"]
    head.main(["pack", "--data", str(data), "--out", str(tmp_path / "pack"), *words])
    arrays = open_pack(tmp_path / "pack").arrays
    folder = episode_folder(data, "place_empty_cup", 1, "ur5_wsg")
    truth, render = read_video(folder / "rgb.mkv"), read_video(folder / "robot.mkv")
    starts, scene = list_starts(len(truth), 1, 2), episode_command(folder, read_record(folder)).carried_scene
    assert arrays["episode"].max() == 1, "the test seed is not among them"
    rows = np.flatnonzero(arrays["episode"] == 1)
    assert len(rows) == len(starts)
    for row, start in zip(rows, starts, strict=True):
        np.testing.assert_array_equal(arrays["truth"][row], truth[start : start + 4])
        np.testing.assert_array_equal(arrays["render"][row, 1:5], render[start : start + 4])
        np.testing.assert_array_equal(arrays["scene"][row], scene[start : start + 4])
    np.testing.assert_array_equal(arrays["first"][1], truth[:1])


def test_a_pack_of_rollouts_holds_the_predictions_that_there_are(data: Path, tmp_path: Path) -> None:
    folder = episode_folder(data, "place_empty_cup", 0, "piper")
    video = 255 - read_video(folder / "rgb.mkv")
    write_rollout(tmp_path / "rollouts", "place_empty_cup", 0, "piper", video, {"model": "m", "condition": "c"})
    words = ["--data", str(data), "--rollouts", str(tmp_path / "rollouts"), "--robots", "piper", "ur5_wsg"]
    head.main(["pack", *words, "--out", str(tmp_path / "pack"), "--every", "1"])
    arrays = open_pack(tmp_path / "pack").arrays
    np.testing.assert_array_equal(arrays["predicted"], 255 - arrays["truth"])
    assert len(arrays["truth"]) == len(list_starts(len(video), 0, 1))


@pytest.mark.parametrize(("share", "expected"), [(1.0, {True}), (0.0, {False}), (0.5, {True, False})])
def test_batches_are_drawn_from_both_kinds_of_packs(share: float, expected: set[bool]) -> None:
    true, predicted = ({"truth": np.zeros(size), "episode": np.zeros(size, int)} for size in (5, 7))
    packs = [Packed(true), Packed(predicted | {"predicted": np.zeros(7)})]
    args = Train(packs=(), out=Path("unused"), predicted=share)
    drawn = [pair for pair, _ in zip(draw_batches(args, packs), range(40), strict=False)]
    assert {"predicted" in packed.arrays for packed, _ in drawn} == expected
    assert all(rows.max() < len(packed.arrays["truth"]) for packed, rows in drawn)


@pytest.mark.parametrize("carried", [[], ["--carried"]])
def test_a_head_is_trained_and_written(data: Path, tmp_path: Path, carried: list[str]) -> None:
    words = ["--robots", "ur5_wsg", "--every", "1", *carried]
    head.main(["pack", "--data", str(data), "--out", str(tmp_path / "pack"), *words])
    words = ["--packs", str(tmp_path / "pack"), "--out", str(tmp_path / "head.safetensors"), "--batch", "1", "--lpips", "0"]
    head.main(["train", *words, "--seconds", "2", "--size.widths", "8", "8", "--size.blocks", "1", "1"])
    trained = load_head(tmp_path / "head.safetensors")
    assert trained.size == HeadSize((8, 8), (1, 1))
    assert np.abs(np.asarray(trained.conv_out.kernel[...])).max() > 0, "it is no longer the identity"

"""The index of a data set: one reading of each header a command, and what changes on disk is seen."""

import json
import os
import shutil
import time
from collections import Counter
from pathlib import Path

import pytest

from tests import synthetic
from xew.dataset import find_accepted, read_dataset
from xew.episode import EpisodeError, Record, read_record, write_episode
from xew.model import latents

CONFIG = """
clip: {frames: 5, height: 32, width: 64}
model: {size: tiny,
  history: [], reference: frame, visibility: joint, prediction: velocity, dtype: float32, remat: none,
  action: none, embodiment: none}
train: {steps: 1, batch: 1,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, ema: 0, motion_loss_weight: 0}
"""


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data set of two robots whose headers are old enough to be kept."""
    synthetic.write_synthetic_data(tmp_path / "data", seeds=(0, 1_000_000), robots=("piper", "ur5_wsg"), frames=5)
    settle()
    return tmp_path / "data"


def settle() -> None:
    """Wait until no header is so young that it would be read again."""
    time.sleep(0.15)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Counter[Path]:
    """How often each header is opened."""
    counted: Counter[Path] = Counter()
    read_text = Path.read_text

    def count(path: Path, *args: object, **kwargs: object) -> str:
        if path.name == "episode.json":
            counted[path] += 1
        return read_text(path, *args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(Path, "read_text", count)
    return counted


def test_a_command_reads_each_header_once(data: Path, reads: Counter[Path]) -> None:
    config = data.parent / "config.yaml"
    config.write_text(f"data: {data}\nout: {data.parent / 'run'}\n{CONFIG}")
    latents.main([str(config)])
    assert len(reads) == 4 and set(reads.values()) == {1}
    latents.main([str(config)])
    assert set(reads.values()) == {1}


def test_what_changes_on_disk_is_seen(data: Path, reads: Counter[Path]) -> None:
    first = read_dataset(data)
    assert len(first.cells) == 4 and len(reads) == 4
    folder, record = first.cells[0]
    path = folder / "episode.json"
    before = path.stat()
    path.write_text(
        json.dumps(json.loads(path.read_text()) | {"scene_hash": record.scene_hash[::-1]}, indent=1) + "\n"
    )  # as many bytes
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert read_dataset(data).cells[0][1].scene_hash == record.scene_hash[::-1] != record.scene_hash
    shutil.rmtree(folder)
    assert [cell for cell, _ in read_dataset(data).cells] == [cell for cell, _ in first.cells[1:]]
    write_episode(data, Record(record.task, 7, "piper", False, "grasp"))
    assert {found.seed for _, found in read_dataset(data).cells} == {0, 7, 1_000_000}
    unchanged = [cell / "episode.json" for cell, _ in first.cells[1:]]
    assert [reads[path] for path in unchanged] == [1] * 3


def test_a_header_that_was_just_written_is_read_again(tmp_path: Path) -> None:
    for seed in range(20):
        record = Record("grab_roller", 3, "piper", False, "grasp", failure_detail=f"{seed:02d}")
        folder = write_episode(tmp_path, record)
        assert read_dataset(tmp_path).cells == ((folder, record),)


def test_episodes_are_selected(data: Path) -> None:
    dataset = read_dataset(data)
    assert [record.robot for _, record in dataset.select(split="test")] == ["piper", "ur5_wsg"]
    assert [record.seed for _, record in dataset.select(robots=["piper"])] == [0, 1_000_000]
    assert dataset.select(tasks=["lift_pot"]) == [] and dataset.robots == ["piper", "ur5_wsg"]
    assert find_accepted(data) == list(dataset.accepted) == dataset.select()


def test_damaged_headers_are_told_or_gathered(data: Path) -> None:
    folder = read_dataset(data).cells[0][0]
    (folder / "episode.json").write_text("{")
    with pytest.raises(EpisodeError, match="is damaged"):
        read_dataset(data)
    problems: list[str] = []
    assert len(read_dataset(data, problems).cells) == 3
    assert len(problems) == 1 and str(folder) in problems[0]


def test_a_data_set_of_failures_has_nothing_to_learn_from(tmp_path: Path) -> None:
    folder = write_episode(tmp_path, Record("grab_roller", 3, "piper", False, "grasp"))
    assert read_dataset(tmp_path).cells == ((folder, read_record(folder)),)
    with pytest.raises(EpisodeError, match="no accepted episode under"):
        _ = read_dataset(tmp_path).accepted

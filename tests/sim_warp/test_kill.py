"""A run that is killed and taken up again gives the same bytes, and nobody ever reads half an episode.

The same with twenty kills: python -m tests.sim_warp.kill
"""

import random
import threading
from pathlib import Path

import pytest

from tests.sim_warp.kill import complete, contents, kill_at_random, make_undisturbed, read_beside
from xew.dataset import find_records
from xew.episode import Record, complete_folder, episode_folder, write_episode


@pytest.mark.lab
def test_kills_change_no_byte(tmp_path: Path) -> None:
    expected, out, rng = make_undisturbed(tmp_path / "undisturbed"), tmp_path / "killed", random.Random(0)
    with read_beside(out) as reader:
        told = [kill_at_random(out, len(expected), rng, workers) for workers in (2, 1)]
        complete(out)
    assert any(told), "both runs ended before they were killed"
    assert not reader.wrong and reader.episodes, reader.wrong
    assert contents(out) == expected


def test_a_cell_that_is_replaced_is_read_whole_or_not_at_all(tmp_path: Path) -> None:
    record = Record("task", 0, "robot", False, "plan")
    write_episode(tmp_path, record)
    writer = threading.Thread(target=lambda: [write_episode(tmp_path, record) for _ in range(300)])
    writer.start()
    seen = 0
    while writer.is_alive():
        for _, found in find_records(tmp_path):
            assert found == record
            seen += 1
    assert seen and list(episode_folder(tmp_path, "task", 0, "robot").parent.iterdir()), "read while it was being replaced"


def test_what_fails_leaves_what_was_there(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    with complete_folder(folder) as temporary:
        (temporary / "file").write_text("old")
    try:
        with complete_folder(folder, held=["file"]) as temporary:
            (temporary / "file").write_text("new")
            raise OSError("full")
    except OSError:
        pass
    assert (folder / "file").read_text() == "old" and list(folder.parent.iterdir()) == [folder]

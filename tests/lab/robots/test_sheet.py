"""Pictures and reference renders of robots as files."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.robots.sheet import main, write_references, write_sheets
from xew.episode import read_video
from xew.sim_warp.rendering.streams import articulation_clip, nine_views, reference_image
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.robots.adopt import view_sheet

PIPER = ROBOTS["piper"]


def read(path: Path) -> np.ndarray:
    return cv2.imread(str(path))[..., ::-1]


def test_reference_renders_are_written_as_they_are(tmp_path: Path) -> None:
    own = write_references(PIPER, tmp_path)
    views = [f"view_{azimuth:03d}.png" for azimuth in range(0, 360, 40)]
    assert own == tmp_path / "piper"
    assert {path.name for path in own.iterdir()} == {"front.png", "clip.mkv", "clip.png", "ray_map.png", *views}
    assert np.array_equal(read(own / "front.png"), reference_image(PIPER))
    assert np.array_equal(np.stack([read(own / view) for view in views]), nine_views(PIPER))
    assert np.array_equal(read_video(own / "clip.mkv"), articulation_clip(PIPER))
    assert read(own / "clip.png").shape == (240, 17 * 320, 3)


def test_sheets_are_written_for_each_robot_and_for_all(tmp_path: Path) -> None:
    one, together = write_sheets([ROBOTS["ur5_wsg"]], tmp_path)
    assert np.array_equal(read(one), view_sheet(nine_views(ROBOTS["ur5_wsg"])))
    assert read(together).shape == (120, 6 * 160, 3)


@pytest.mark.parametrize("option", ["--references", "--out"])
def test_a_folder_that_cannot_be_made_is_refused(option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(sys, "argv", ["sheet", "--robots", "piper", option, str(tmp_path / "file")])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2 and "choose another path" in capsys.readouterr().err


def test_an_unknown_robot_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["sheet", "--robots", "pipper", "--references", str(tmp_path)])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2 and "piper" in capsys.readouterr().err

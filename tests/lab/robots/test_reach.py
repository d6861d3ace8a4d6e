"""The maps of reach as a command."""

import sys

import pytest

from lab.robots.reach import main as reach


def test_the_reach_of_an_unknown_robot_is_refused_in_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(sys, "argv", ["reach", "--robots", "pipper"])
    with pytest.raises(SystemExit) as left:
        reach()
    assert left.value.code == 2 and "did you mean 'piper'" in capsys.readouterr().err

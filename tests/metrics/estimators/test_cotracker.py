"""CoTracker3's adapter: checkpoint, queries, directions and what counts as lost.

The package is not on PyPI and its license keeps it out of here, so a stand-in with the published signature is called: it reads
a state dict and follows colors. `test_the_real_network` runs where somebody has installed the package.
"""

import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.metrics.estimators.colored_squares import squares
from xew.config import ConfigError
from xew.metrics.backends import open_tracker
from xew.metrics.estimators.adapters import query_frames
from xew.metrics.estimators.cotracker import open_cotracker

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.lab


class StandIn(torch.nn.Module):
    """Follows the color under each query; what it has not been asked for it answers with nonsense."""

    opened: dict[str, Any]

    def __init__(self, checkpoint: str, offline: bool = True, v2: bool = False, window_len: int = 60) -> None:
        super().__init__()
        StandIn.opened = {"offline": offline, "v2": v2, "window_len": window_len}
        self.register_buffer("time_emb", torch.zeros(1, window_len, 8))
        self.corr_mlp = torch.nn.Linear(1, 1)
        self.load_state_dict(torch.load(checkpoint, map_location="cpu")["model"])

    def forward(self, video: Any, queries: Any, backward_tracking: bool = False) -> tuple[Any, Any]:
        assert video.shape[0] == 1 and video.shape[2] == 3 and video.dtype == torch.float32 and video.max() > 1
        tracks = torch.full((1, video.shape[1], queries.shape[1], 2), -1000.0)
        seen = torch.zeros(tracks.shape[:3], dtype=bool)
        for point, (start, x, y) in enumerate(queries[0]):
            color = video[0, int(start), :, int(y.round()), int(x.round())]
            for frame in range(0 if backward_tracking else int(start), video.shape[1]):
                same = ((video[0, frame] - color[:, None, None]).abs().amax(0) < 8).nonzero().float()
                if len(same):
                    tracks[0, frame, point], seen[0, frame, point] = same.mean(0).flip(0), True
        return tracks, seen


def save(path: Path, frames: int = 60, **more: Any) -> Path:
    """A checkpoint as published: a state dict, under `model` or bare."""
    state = {"time_emb": torch.zeros(1, frames, 8), "corr_mlp.weight": torch.zeros(1, 1), "corr_mlp.bias": torch.zeros(1)}
    torch.save({"model": state | more}, path)
    return path


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> None:
    """`cotracker.predictor` as somebody would have installed it."""
    predictor = types.ModuleType("cotracker.predictor")
    predictor.CoTrackerPredictor = StandIn
    monkeypatch.setitem(sys.modules, "cotracker", types.ModuleType("cotracker"))
    monkeypatch.setitem(sys.modules, "cotracker.predictor", predictor)


@pytest.mark.usefixtures("package")
def test_points_are_followed_both_ways_from_where_most_are_seen(tmp_path: Path) -> None:
    video, points, visible = squares()
    found = open_tracker("cotracker3", save(tmp_path / "scaled_offline.pth"))(video, np.zeros_like(video), points, visible)
    assert found.shape == points.shape and found.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(found).any(-1), ~visible)
    np.testing.assert_allclose(found[visible], points[visible], atol=1e-4)
    assert StandIn.opened == {"offline": True, "v2": False, "window_len": 60}


@pytest.mark.usefixtures("package")
def test_its_license_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    open_cotracker(save(tmp_path / "scaled_offline.pth"))
    assert "CC-BY-NC 4.0" in capsys.readouterr().err


@pytest.mark.usefixtures("package")
def test_where_no_point_is_ever_seen_all_are_lost(tmp_path: Path) -> None:
    video, points, visible = squares()
    found = open_cotracker(save(tmp_path / "c.pth"))(video, video, points, np.zeros_like(visible))
    assert found.shape == points.shape and np.isnan(found).all()


@pytest.mark.usefixtures("package")
def test_it_says_what_it_takes(tmp_path: Path) -> None:
    video, points, visible = squares()
    tracker = open_cotracker(save(tmp_path / "c.pth"))
    for wrong in ((video / 255, video, points, visible), (video, video, points[:3], visible), (video, video, points, points)):
        with pytest.raises(ValueError, match="expected"):
            tracker(*wrong)


@pytest.mark.usefixtures("package")
def test_other_checkpoints_are_refused(tmp_path: Path) -> None:
    online, older, more = (tmp_path / name for name in ("scaled_online.pth", "cotracker2.pth", "more.pth"))
    save(online, frames=16)
    torch.save({"model": {"time_emb": torch.zeros(1, 8, 8)}}, older)
    save(more, unknown=torch.zeros(1))
    for path, reason in ((online, "CoTracker3 online"), (older, "no checkpoint of CoTracker3;"), (more, "Unexpected key")):
        with pytest.raises(ConfigError, match=reason) as caught:
            open_cotracker(path)
        assert path.name in str(caught.value)


def test_without_the_package_one_is_told_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cotracker", None)
    with pytest.raises(ConfigError, match=r"CoTracker3 needs the package cotracker .* github\.com/facebookresearch/co-tracker"):
        open_cotracker(save(tmp_path / "c.pth"))


def test_query_frames_are_the_papers_where_the_paper_has_one() -> None:
    """All points that are visible in the fullest frame start there; the others in the fullest of their own frames."""
    _, _, visible = squares()
    assert visible.sum(1).tolist() == [2, 2, 2, 2, 1]
    assert query_frames(visible).tolist() == [0, 1, 0, -1]
    visible[2, 2] = True
    assert query_frames(visible).tolist() == [2, 2, 2, -1]


@pytest.mark.needs("cotracker")
def test_the_real_network(tmp_path: Path) -> None:
    """Random weights of the published architecture, saved as published."""
    from cotracker.models import build_cotracker as build

    torch.manual_seed(0)
    torch.save(build.build_cotracker(None, offline=True, v2=False, window_len=60).state_dict(), tmp_path / "scaled_offline.pth")
    video, points, visible = squares()
    found = open_cotracker(tmp_path / "scaled_offline.pth")(video, video, points, visible)
    assert found.shape == points.shape and np.isnan(found[:, 3]).all()
    starts = query_frames(visible)[:3]
    np.testing.assert_allclose(found[starts, range(3)], points[starts, range(3)], atol=1e-3)

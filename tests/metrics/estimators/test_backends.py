"""The registries of estimators: names, what is missing, and what a score table says of them."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from xew.config import ConfigError
from xew.files import digest_tree
from xew.metrics import backends
from xew.metrics.backends import FLOWS, MASKERS, TRACKERS, Backend, identity, open_flow, open_masker, open_tracker
from xew.metrics.estimators.masks import Episode, estimate_masks
from xew.metrics.estimators.tracks import estimate_tracks

REGISTRIES = {"masker": (MASKERS, open_masker), "tracker": (TRACKERS, open_tracker), "optical flow": (FLOWS, open_flow)}
NEEDY = [(open_, name) for registry, open_ in REGISTRIES.values() for name, backend in registry.items() if backend.needs]
MINE: Backend = Backend(lambda: lambda prediction, target, mask: mask, None, "gives the truth back")


def test_the_registries_hold_what_the_documents_name() -> None:
    assert list(MASKERS) == ["default", "opencv", "sam2"] and list(FLOWS) == ["dis", "raft"]
    assert list(TRACKERS) == ["default", "opencv", "cotracker3", "tapir"]
    assert {name for _, name in NEEDY} == {"sam2", "cotracker3", "tapir", "raft"}
    for registry, _ in REGISTRIES.values():
        for backend in registry.values():
            assert backend.summary and (backend.needs is None or "licen" in backend.needs or "; " in backend.needs)


@pytest.mark.parametrize(("open_", "name"), NEEDY, ids=[name for _, name in NEEDY])
def test_a_missing_checkpoint_is_named_with_its_source_license_and_option(
    open_: Callable[..., object], name: str, tmp_path: Path
) -> None:
    for checkpoint in (None, tmp_path / "absent.pt"):
        with pytest.raises(ConfigError) as caught:
            open_(name, checkpoint, option="--the-option")
        message = str(caught.value)
        assert "\n" not in message and "--the-option" in message
        assert any(license in message for license in ("Apache-2.0", "CC-BY-NC 4.0", "BSD-3-Clause"))
        assert any(source in message for source in ("github.com", "Hugging Face", "torchvision"))
        assert checkpoint is None or str(checkpoint) in message


def test_a_checkpoint_for_none_is_an_error() -> None:
    with pytest.raises(ConfigError, match=r"default has no checkpoint, --masks-checkpoint names x\.pt; leave it out"):
        open_masker("default", Path("x.pt"))


@pytest.mark.parametrize("kind", REGISTRIES)
def test_an_unknown_name_is_an_error_with_a_suggestion(kind: str) -> None:
    registry, open_ = REGISTRIES[kind]
    name = list(registry)[-1]
    with pytest.raises(ConfigError, match=f"unknown {kind} '{name}x'; did you mean '{name}'"):
        open_(name + "x")


def test_anybodys_masker_serves() -> None:
    mask = np.ones((1, 4, 4), bool)
    assert open_masker("tests.metrics.estimators.test_backends:MINE")(mask, mask, mask) is mask


def test_a_score_table_tells_checkpoints_apart_by_content_and_not_by_place(tmp_path: Path) -> None:
    here, there = tmp_path / "a" / "net.pt", tmp_path / "b" / "net.pt"
    for path in (here, there):
        path.parent.mkdir()
        path.write_bytes(b"weights")
    assert identity("default") == "default"
    assert identity("sam2", here) == identity("sam2", there)
    assert identity("sam2", here).startswith("sam2 net.pt sha256:")
    assert digest_tree(tmp_path / "a") == digest_tree(tmp_path / "b")
    there.write_bytes(b"other weights")
    assert identity("sam2", here) != identity("sam2", there)
    assert digest_tree(tmp_path / "a") != digest_tree(tmp_path / "b")


def test_the_default_masker_learns_an_episode_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    target, other = rng.integers(0, 255, (2, 3, 40, 50, 3), dtype=np.uint8)
    mask = np.zeros((3, 40, 50), bool)
    mask[:, 10:30, 10:30] = True
    learnt = []
    monkeypatch.setattr(backends, "Episode", lambda *episode: learnt.append(1) or Episode(*episode))
    masker = open_masker("default")
    for prediction in (target, other, target):
        np.testing.assert_array_equal(masker(prediction, target, mask), estimate_masks(prediction, target, mask))
    assert len(learnt) == 1
    np.testing.assert_array_equal(masker(target, other, mask), estimate_masks(target, other, mask))
    assert len(learnt) == 2


def test_the_default_tracker_gives_the_same_whatever_it_was_asked_before() -> None:
    rng = np.random.default_rng(0)
    videos = rng.integers(0, 255, (3, 4, 40, 50, 3), dtype=np.uint8)
    points, visible = rng.uniform(8, 32, (2, 4, 3, 2)).astype(np.float32), np.ones((4, 3), bool)
    tracker = open_tracker("default")
    for prediction, target, kind in ((0, 1, 0), (0, 1, 1), (2, 1, 0), (2, 2, 0), (0, 0, 1), (0, 1, 0)):
        asked = videos[prediction], videos[target], points[kind], visible
        np.testing.assert_array_equal(tracker(*asked), estimate_tracks(*asked))


def test_nobody_needs_pytorch_for_the_defaults() -> None:
    """In a process of its own; the adapters are imported too, which ask for their packages only when they are opened."""
    program = (
        "import sys; from xew.metrics import backends; from xew.metrics.estimators import cotracker, flow, sam2, tapir; "
        "backends.open_masker('default'); "
        "backends.open_tracker('default'); backends.open_flow('dis'); "
        "print([name for name in ('torch', 'torchvision', 'transformers', 'haiku', 'tapnet') if name in sys.modules])"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert ran.stdout.strip() == "[]"

"""The scene and the rollouts that the tests of the command grade."""

from pathlib import Path

import pytest

from tests.metrics.grading.graded import ASKED, FRAMES, ROBOTS, SEED, TASK, late, truth
from tests.synthetic import write_synthetic_data
from xew.rollout import write_rollout


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    write_synthetic_data(root, tasks=(TASK,), seeds=(SEED,), robots=ROBOTS, frames=FRAMES)
    return root


@pytest.fixture
def rollouts(data: Path, tmp_path: Path) -> Path:
    """A model that is a frame late, asked for ASKED frames."""
    root = tmp_path / "rollouts"
    for robot in ROBOTS:
        header = {"model": "late", "condition": "none"}
        write_rollout(root, TASK, SEED, robot, late(truth(data, robot))[:ASKED], header)
    return root

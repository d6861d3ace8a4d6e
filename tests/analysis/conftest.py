"""A small study for the analysis: synthetic episodes, a model that is late, and its scores, graded by the real command."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.metrics.quick import QUICK, mean_change
from tests.synthetic import write_synthetic_data
from xew.analysis.reports import charts, pictures
from xew.dataset import find_accepted
from xew.episode import read_video
from xew.metrics.evaluate import Args, main
from xew.metrics.perceptual import SharedFeatures
from xew.protocol import seed_split
from xew.rollout import write_rollout

TASKS, SEEDS, FRAMES = ("place_empty_cup", "open_laptop"), (0, 1_000_000, 1_000_001, 1_000_002), 6
ROBOTS = ("aloha_agilex", "franka_panda", "piper")


@dataclass(frozen=True)
class Study:
    data: Path
    rollouts: Path
    scores: Path


@pytest.fixture(scope="session", autouse=True)
def quick_files() -> Iterator[None]:
    """Cutting fonts down to the glyphs used is a third of a report's time, and outlines of glyphs look the same in a PDF;
    compressing pictures as far as can be is a tenth."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(charts.STYLE, "pdf.fonttype", 3)
        patch.setattr(pictures, "PNG_COMPRESSION", 1)
        yield


@pytest.fixture(scope="session")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    root = tmp_path_factory.mktemp("study")
    made = Study(root / "data", root / "rollouts", root / "scores.parquet")
    write_synthetic_data(made.data, tasks=TASKS, seeds=SEEDS, robots=ROBOTS, frames=FRAMES)
    for folder, record in find_accepted(made.data):
        if seed_split(record.seed) == "test":
            late = read_video(folder / "rgb.mkv")[np.maximum(np.arange(FRAMES) - 1, 0)]
            header = {"model": "late", "condition": "by one <frame>"}
            write_rollout(made.rollouts, record.task, record.seed, record.robot, late, header)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SharedFeatures, "distances", mean_change)  # LPIPS takes half a minute; what it finds, nothing here asks
        main(Args((made.rollouts,), made.data, made.scores, ("psnr", "lpips", "mask_iou"), masks=QUICK))
    return made

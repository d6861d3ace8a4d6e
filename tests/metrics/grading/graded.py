"""What the tests of the command share: one scene of two robots, a model that is a frame late, and the command itself."""

from pathlib import Path

import numpy as np
import pandas as pd

from xew.episode import episode_folder, read_video
from xew.metrics.evaluate import Args, main

TASK, SEED, ROBOTS = "place_empty_cup", 1_000_000, ("franka_panda", "piper")
FRAMES, ASKED = 9, 7
CHEAP = ("psnr", "ssim", "mask_iou")


def truth(data: Path, robot: str) -> np.ndarray:
    return read_video(episode_folder(data, TASK, SEED, robot) / "rgb.mkv")


def late(video: np.ndarray) -> np.ndarray:
    return video[np.maximum(np.arange(len(video)) - 1, 0)]


def grade(rollouts: Path, data: Path, **settings: object) -> pd.DataFrame:
    out = settings.pop("out", rollouts.parent / "scores.parquet")
    main(Args((rollouts,), data, out, **{"metrics": CHEAP, "baselines": False} | settings))
    return pd.read_parquet(out)


def value(scores: pd.DataFrame, model: str, robot: str, metric: str) -> float:
    found = scores[(scores["model"] == model) & (scores["robot"] == robot) & (scores["metric"] == metric)]
    assert len(found) == 1
    return float(found["value"].iloc[0])

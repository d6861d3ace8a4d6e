"""Sample videos in training: one clip of test seeds, predicted beside the ground truth, on seen and on unseen robots."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from xew.config import ConfigError
from xew.dataset import Episode
from xew.episode import read_video
from xew.model.sampling.predict import Predictor
from xew.model.training.tensorboard import RunLog
from xew.model.video.frames import to_model_size

STRIP_FRAMES = 5
"""Number of frames in a strip."""


def check_samples(episodes: Mapping[str, Episode], data: Path) -> None:
    """Raise ConfigError where the episodes to draw sample videos of have no videos themselves."""
    bare = [folder for folder, record in episodes.values() if not record.videos]
    if bare:
        raise ConfigError(
            f"{bare[0]} was made with --states-only and has no video to begin a sample with; draw none with "
            f"--train.sample-every 0, or make videos: python -m xew.sim_warp.inspect {data} --render"
        )


def log_samples(log: RunLog | None, predictor: Predictor, episodes: Mapping[str, Episode], step: int) -> None:
    """Predict one clip of each sample episode, by name; log PSNR, a strip (ground truth above prediction) and a video.

    Every process predicts, for each has a part of the parameters; the one with a log writes.
    """
    clip = predictor.inputs.clip
    predicted = predictor.predict(list(episodes.values()), clip.frames)
    if log is None:
        return
    scores = {}
    for (name, (folder, _)), video in zip(episodes.items(), predicted, strict=True):
        truth = to_model_size(read_video(folder / "rgb.mkv")[: clip.frames], clip.height, clip.width)
        video = video[: len(truth)]
        scores[f"sample/psnr/{name}"] = psnr(video[1:], truth[1:])
        scores[f"sample/psnr_of_first_frame/{name}"] = psnr(np.broadcast_to(truth[:1], truth[1:].shape), truth[1:])
        log.image(step, f"sample/{name}", strip(truth, video))
        log.video(step, f"sample_video/{name}", np.concatenate([truth, video], axis=2))
    log.scalars(step, scores)


def strip(truth: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Put a few frames of two videos [t h w 3] uint8 side by side, ground truth above prediction: [2h kw 3] uint8."""
    chosen = np.linspace(0, len(truth) - 1, min(STRIP_FRAMES, len(truth))).astype(int)
    return np.concatenate([np.concatenate(list(video[chosen]), axis=1) for video in (truth, predicted)], axis=0)


def psnr(predicted: np.ndarray, truth: np.ndarray) -> float:
    """Mean PSNR [dB] over frames of two videos [t h w 3] uint8, for watching training only; the study's is in xew.metrics."""
    error = np.square(predicted.astype(np.float32) - truth).mean(axis=(1, 2, 3))
    return float((10 * np.log10(255**2 / np.maximum(error, 1e-6))).mean())

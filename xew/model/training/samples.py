"""Sample videos in training: one clip of test seeds, predicted beside the truth, on seen and on unseen robots."""

import numpy as np

from xew.config import ConfigError
from xew.episode import read_video
from xew.model.experiment import Experiment
from xew.model.latents import Episode, test_episodes, training_episodes
from xew.model.sampling.predict import Predictor
from xew.model.training.tensorboard import RunLog
from xew.model.video.frames import to_model_size

STRIP_FRAMES = 5


def check_samples(experiment: Experiment) -> None:
    """Raise ConfigError where sample videos are asked for and the episodes to draw them of have no videos themselves."""
    bare = [folder for folder, record in sample_episodes(experiment).values() if not record.videos]
    if experiment.train.sample_every and bare:
        raise ConfigError(
            f"{bare[0]} was made with --states-only and has no video to begin a sample with; draw none with "
            f"--train.sample-every 0, or make videos: python -m xew.sim_warp.inspect {experiment.data} --render"
        )


def sample_episodes(experiment: Experiment) -> dict[str, Episode]:
    """An episode of each robot of the split by role and robot, of test seeds where there are any.

    In an adapted run the robots adapted to are the target, and seen are those of the run that it started from.
    """
    robots, targets = experiment.robots, experiment.adapt.robots
    roles = dict.fromkeys(robots.train_robots, "seen") | dict.fromkeys(robots.held_out_robots, "unseen")
    roles |= dict.fromkeys(targets, "target")
    found = test_episodes(experiment.data, tuple(roles)) or training_episodes(experiment)
    first = {record.robot: (folder, record) for folder, record in reversed(found)}
    return {f"{roles[robot]}/{robot}": first[robot] for robot in roles if robot in first}


def log_samples(log: RunLog | None, predictor: Predictor, step: int) -> None:
    """Predict one clip of each sample episode; log PSNR, a strip (truth above prediction) and a video.

    Every process predicts, for each has a part of the parameters; the one with a log writes.
    """
    named = sample_episodes(predictor.experiment)
    clip = predictor.experiment.clip
    predicted = predictor.predict(list(named.values()), clip.frames)
    if log is None:
        return
    scores = {}
    for (name, (folder, _)), video in zip(named.items(), predicted, strict=True):
        truth = to_model_size(read_video(folder / "rgb.mkv")[: clip.frames], clip.height, clip.width)
        video = video[: len(truth)]
        scores[f"sample/psnr/{name}"] = psnr(video[1:], truth[1:])
        scores[f"sample/psnr_of_first_frame/{name}"] = psnr(np.broadcast_to(truth[:1], truth[1:].shape), truth[1:])
        log.image(step, f"sample/{name}", strip(truth, video))
        log.video(step, f"sample_video/{name}", np.concatenate([truth, video], axis=2))
    log.scalars(step, scores)


def strip(truth: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """A few frames [t h w 3] side by side, truth above prediction: [2h kw 3]."""
    chosen = np.linspace(0, len(truth) - 1, min(STRIP_FRAMES, len(truth))).astype(int)
    return np.concatenate([np.concatenate(list(video[chosen]), axis=1) for video in (truth, predicted)], axis=0)


def psnr(predicted: np.ndarray, truth: np.ndarray) -> float:
    """Mean over frames [dB] at the model's size, for watching training only; the study's PSNR is in xew.metrics."""
    error = np.square(predicted.astype(np.float32) - truth).mean(axis=(1, 2, 3))
    return float((10 * np.log10(255**2 / np.maximum(error, 1e-6))).mean())

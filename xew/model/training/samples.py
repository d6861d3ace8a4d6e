"""Sample rollouts in training: fixed validation episodes, graded next to the pasted render, the no-learning baseline.

Reads  the sample episodes (`xew.model.episodes.choice.sample_episodes`)
Writes scores (validation/…), strips and videos to the run's log
"""

from collections import defaultdict
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from xew.concurrency import usable_cores
from xew.dataset import Episode
from xew.episode import Record
from xew.model.cache.scales import Scale
from xew.model.codecs.contract import Codec
from xew.model.conditions import pasted_render
from xew.model.episodes.commands import episode_command
from xew.model.experiment import Experiment
from xew.model.runs.log import RunLog
from xew.model.sampling.predict import make_predictor
from xew.model.settings.settings import TrainSettings
from xew.model.video.comparison import strip
from xew.model.video.frames import picture_size, to_camera_size
from xew.protocol import PASTED_RENDER

CHUNKS = 2
"""Number of chunks of a sample rollout: the second starts from a predicted frame."""
SCORES = {
    "lpips": "video",
    "psnr": "video",
    "mask_iou": "mask",
    "trajectory_error": "objects",
    "object_coverage": "objects",
}
"""Metrics of samples, with the kind of arrays that each compares, a key of `xew.metrics.truth.NEEDS`."""


def sample_steps(settings: TrainSettings) -> frozenset[int]:
    """Steps of a run after which samples are rolled out, evenly spaced up to the last."""
    return frozenset(settings.steps * number // settings.samples for number in range(1, settings.samples + 1)) - {0}


@dataclass(frozen=True)
class SampleRollouts:
    """Rollouts of the sample episodes with any parameters of an experiment's network."""

    experiment: Experiment
    codec: Codec
    scales: Mapping[str, Scale]
    episodes: Mapping[str, Episode]
    """Episodes by role and robot, such as seen/ur5_wsg."""

    @property
    def frames(self) -> int:
        """Number of frames of a rollout."""
        return CHUNKS * (self.experiment.clip.frames - 1) + 1

    @cached_property
    def truths(self) -> dict[str, Any]:
        """The episodes as graders read them (`EpisodeCache`): true videos, and robots and objects if they are known."""
        from xew.metrics.episode_cache import EpisodeCache
        from xew.metrics.truth import read_truth

        return {
            name: EpisodeCache(read_truth(folder, self.frames, {SCORES[metric] for metric in known_scores(record)}))
            for name, (folder, record) in self.episodes.items()
        }

    @cached_property
    def pasted(self) -> dict[str, np.ndarray]:
        """Pasted renders [t h w 3] uint8 of the episodes."""
        return {name: pasted_render(episode_command(*episode))[: self.frames] for name, episode in self.episodes.items()}

    @cached_property
    def pasted_scores(self) -> dict[str, float]:
        """Scores of the pasted renders."""
        return self._mean_scores(self.pasted, f"_of_{PASTED_RENDER}")

    def log(self, log: RunLog | None, params: Any, step: int) -> None:
        """Roll out the episodes; log scores by role and, of each episode, a video and a strip.

        A strip shows truth, prediction and pasted render. Every process predicts, because parameters are sharded; the one
        with a log grades and writes.
        """
        if not self.episodes:
            return
        predictor = make_predictor(self.experiment, self.codec, params, self.scales)
        predicted = predictor.predict(list(self.episodes.values()), self.frames)
        if log is None:
            return
        videos = {
            name: to_camera_size(video, picture_size(self.truths[name].truth.rgb))[: len(self.truths[name].truth.rgb)]
            for name, video in zip(self.episodes, predicted, strict=True)
        }
        log.scalars(step, self._mean_scores(videos) | self.pasted_scores)
        for name, video in videos.items():
            truth = self.truths[name].truth.rgb
            log.image(step, f"validation/{name}", strip(truth, video, self.pasted[name]))
            rate = self.episodes[name][1].frame_rate
            log.video(step, f"validation_video/{name}", np.concatenate([truth, video], axis=2), rate)

    def _mean_scores(self, videos: Mapping[str, np.ndarray], suffix: str = "") -> dict[str, float]:
        """Mean scores of videos [t h w 3] uint8 by metric and role, as validation/lpips/seen; NaN is left out."""
        from xew.metrics.estimators.masks import estimate_masks
        from xew.metrics.estimators.tracks import ReferenceTracker
        from xew.metrics.grade import Comparison, grade

        def grade_one(name: str) -> dict[str, float]:
            comparison = Comparison(videos[name], self.truths[name], estimate_masks, ReferenceTracker())
            return grade(comparison, known_scores(self.episodes[name][1])).values

        values = defaultdict(list)
        with ThreadPoolExecutor(usable_cores()) as pool:
            for name, grades in zip(videos, pool.map(grade_one, videos), strict=True):
                for metric, value in grades.items():
                    values[f"validation/{metric}{suffix}/{name.partition('/')[0]}"].append(value)
        means = {name: float(np.nanmean(found)) for name, found in values.items() if not np.isnan(found).all()}
        return dict(sorted(means.items()))


def known_scores(record: Record) -> list[str]:
    """The metrics of samples whose truth an episode knows; an imported one may know no robot mask and no objects."""
    from xew.metrics.truth import NEEDS

    return [metric for metric, kind in SCORES.items() if not set(NEEDS[kind]) & set(record.unknown)]

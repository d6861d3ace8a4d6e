"""What there is to grade: rollouts, the episodes that they predict, and the baselines on these episodes."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from xew.concurrency import map_in_order
from xew.config import ConfigError
from xew.dataset import Episode
from xew.episode import EpisodeError, Record, episode_folder, read_record
from xew.files import digest_files
from xew.metrics.grading.baselines import BASELINES
from xew.metrics.grading.codecs import ModelCodec
from xew.metrics.grading.scores import Cell
from xew.metrics.truth import Truth
from xew.protocol import BASELINES as TITLES
from xew.protocol import CODEC_TRUTH, GROUND_TRUTH
from xew.rollout import Rollout, RolloutError, find_rollouts, read_rollout_video, resize_video

SOFTNESS = 0.8
"""Standard deviation [pixels] of the blur through which estimators see the true video. Reference-aligned ones hardly err on the
very video that they compare with; no prediction is ever that, and this is about as soft as a good codec leaves a video."""


@dataclass(frozen=True)
class Job:
    """One video to grade: a rollout, or a baseline on a rollout's episode and frames."""

    cell: Cell
    rollout: Rollout | None
    """None: the baseline that the cell names as its model."""
    episode: Path
    frame_rate: float
    """The episode's."""

    @property
    def place(self) -> Path:
        return self.rollout.folder if self.rollout else self.episode


def list_jobs(
    rollouts: Sequence[Path],
    data: Path,
    settings: str,
    baselines: Collection[str],
    workers: int,
    problems: list[str] | None = None,
    codecs: Mapping[str, ModelCodec] | None = None,
) -> list[Job]:
    """All that is to be graded, each once, jobs of one episode together.

    Args:
        rollouts: roots of their trees.
        data: the data set.
        settings: what else the scores depend on, as text.
        baselines: keys of BASELINES to grade too.
        workers: threads that read.
        problems: where given, rollouts that cannot be graded are told here and left out.
        codecs: by the model that each is of; the truth goes through them on the episodes that the model has predicted.

    Raises:
        EpisodeError: a rollout cannot be graded. ConfigError: none is named.
    """
    if not rollouts:
        raise ConfigError(
            "no rollouts named; give their folder: python -m xew.metrics.evaluate ROLLOUTS --data DATA, or grade the baselines "
            "alone: --baselines-of test"
        )

    def try_jobs(rollout: Rollout) -> list[Job] | EpisodeError:
        try:
            return list(_jobs(rollout, data, settings, baselines, (codecs or {}).get(rollout.model)))
        except EpisodeError as error:
            return error

    found = _unique(rollouts, problems)
    jobs: dict[Cell, Job] = {}
    results = tqdm(
        map_in_order(try_jobs, found, workers), total=len(found), desc="read", unit="video", disable=None, leave=False
    )
    for result in results:
        if isinstance(result, EpisodeError):
            _raise_or_note(problems, str(result))
        else:
            jobs |= {job.cell: job for job in result}
    _check_horizons(jobs.values())
    return sorted(jobs.values(), key=lambda job: (job.episode, job.rollout is None, job.cell.key))


def _jobs(rollout: Rollout, data: Path, settings: str, baselines: Collection[str], codec: ModelCodec | None) -> Iterator[Job]:
    """The rollout's own job, then its baselines'."""
    episode = episode_folder(data, rollout.task, rollout.seed, rollout.robot)
    record = _find_record(rollout, episode, data)
    frames = rollout.frame_count or record.frame_count
    if not 1 < frames <= record.frame_count:
        raise RolloutError(
            f"{rollout.folder}: asks for {frames} frames, its episode has {record.frame_count}; at least 2 are needed and no "
            "more than there are."
        )
    try:
        digest = digest_files(rollout.video)
    except OSError as error:
        raise RolloutError(f"{rollout.folder} cannot be read: {error}.") from error
    rgb, states = (record.hashes.get(name, "") for name in ("rgb", "states"))
    key = (rollout.model, rollout.condition, rollout.task, rollout.seed, rollout.robot)
    cell = Cell(*key, frames, digest, rgb, states, settings)
    yield Job(cell, rollout, episode, record.frame_rate)
    yield from _baseline_jobs(cell, (episode, record), baselines, () if codec is None else (codec,))


def _baseline_jobs(cell: Cell, episode: Episode, baselines: Collection[str], codecs: Iterable[ModelCodec]) -> Iterator[Job]:
    """Jobs of baselines, and of the truth through codecs, on the episode and frames of a cell."""
    folder, record = episode
    for name in baselines:
        source = BASELINES[name].source(folder, record)
        if source is not None:
            yield Job(replace(cell, model=name, condition="", prediction=source), None, folder, record.frame_rate)
    for codec in codecs:
        through = replace(cell, model=CODEC_TRUTH, condition=codec.key, prediction=codec.digest)
        yield Job(through, None, folder, record.frame_rate)


def list_baseline_jobs(
    episodes: Sequence[Episode],
    settings: str,
    baselines: Collection[str],
    codecs: Mapping[str, ModelCodec],
    max_frames: int = 0,
) -> list[Job]:
    """The baselines on episodes that no model has predicted yet, jobs of one episode together.

    Args:
        episodes: folders and headers.
        settings: what else the scores depend on, as text.
        baselines: keys of BASELINES.
        codecs: what the truth goes through.
        max_frames: number of frames that are graded; 0 for whole episodes.

    Raises ConfigError where there is no episode or the number of frames is one that cannot be graded.
    """
    if not episodes:
        raise ConfigError("the data set holds no episode of these seeds; generate some, or name others: --baselines-of.")
    if max_frames < 0 or max_frames == 1:
        raise ConfigError(f"--max-frames is {max_frames}; expected at least 2 frames, or 0 for whole episodes.")
    jobs: list[Job] = []
    for folder, record in episodes:
        rgb, states = (record.hashes.get(name, "") for name in ("rgb", "states"))
        frames = min(record.frame_count, max_frames or record.frame_count)
        cell = Cell("", "", record.task, record.seed, record.robot, frames, "", rgb, states, settings)
        jobs += _baseline_jobs(cell, (folder, record), baselines, codecs.values())
    return sorted(jobs, key=lambda job: (job.episode, job.cell.key))


def _check_horizons(jobs: Iterable[Job]) -> None:
    """Raise RolloutError where models are graded over different numbers of frames of one episode: they do not compare."""
    first: dict[Path, Job] = {}
    for job in jobs:
        other = first.setdefault(job.episode, job)
        if other.cell.frames != job.cell.frames:
            raise RolloutError(
                f"{job.episode}: {other.cell.model} has {other.cell.frames} frames and {job.cell.model} {job.cell.frames}; "
                "scores over different horizons do not compare, grade them into separate tables (--out)."
            )


def _find_record(rollout: Rollout, folder: Path, data: Path) -> Record:
    if not folder.is_dir():
        raise RolloutError(
            f"{rollout.folder} predicts {rollout.task}, seed {rollout.seed}, {rollout.robot}, which {data} does not hold; name "
            "the data set that the rollout was made from: --data."
        )
    record = read_record(folder)
    if not record.success:
        raise RolloutError(f"{rollout.folder} predicts an episode that was rejected ({record.failure}); delete this rollout.")
    source = rollout.header.get("source_hash")
    if source is not None and source != record.hashes.get("rgb"):
        raise RolloutError(f"{rollout.folder} was made from another video than {folder} now holds; make this rollout again.")
    return record


def _unique(roots: Sequence[Path], problems: list[str] | None) -> list[Rollout]:
    """Rollouts of all trees. Raises RolloutError, or tells, when two claim to be the same model's video of one episode."""
    seen: dict[tuple[str, str, str, int, str], Rollout] = {}
    for rollout in (rollout for root in roots for rollout in find_rollouts(root, problems)):
        first = seen.setdefault((rollout.model, rollout.condition, rollout.task, rollout.seed, rollout.robot), rollout)
        if rollout.model in TITLES:
            _raise_or_note(problems, f"{rollout.folder}: the name {rollout.model} is a baseline's; give the model another.")
        elif first is not rollout:
            _raise_or_note(
                problems,
                f"{first.folder} and {rollout.folder} are both model {rollout.model!r}, condition {rollout.condition!r}; "
                "give them different names in rollout.json.",
            )
    return [rollout for rollout in seen.values() if rollout.model not in TITLES]


def _raise_or_note(problems: list[str] | None, message: str) -> None:
    """Raise RolloutError, or add to the problems where there is a list of them."""
    if problems is None:
        raise RolloutError(message)
    problems.append(message)


def read_prediction(
    job: Job, truth: Truth, codecs: Mapping[str, ModelCodec], allow: Collection[str] = (), frame_zero: str = "given"
) -> np.ndarray:
    """The video to grade [t h w 3] uint8, of the truth's shape.

    Args:
        job: of a rollout or a baseline.
        truth: of its episode.
        codecs: by the conditions of the baseline CODEC_TRUTH that name them.
        allow: what else is an error: "resize", "trim", "rate".
        frame_zero: "absent" where the rollout begins with frame 1.

    Raises:
        RolloutError: the video cannot be read, or is not of the truth's shape, and that is not allowed.
    """
    if job.rollout is None and job.cell.model == CODEC_TRUTH:
        return codecs[job.cell.condition].reconstruct(truth.rgb)
    if job.rollout is None:
        return BASELINES[job.cell.model].make(job.episode, truth)
    video = read_rollout_video(job.rollout, None if "rate" in allow else job.frame_rate)
    if "resize" in allow:
        video = resize_video(video, truth.rgb.shape[1:3])
    if frame_zero == "absent" and video.shape[1:] == truth.rgb.shape[1:]:
        video = np.concatenate([truth.rgb[:1], video])
    if "trim" in allow:
        video = video[: len(truth.rgb)]
    if video.shape != truth.rgb.shape:
        raise RolloutError(
            f"{job.rollout.video[0]} is {_size(video)}, expected {_size(truth.rgb)} as in the episode; say in rollout.json how "
            'many frames were asked for ({"frame_count": n}), or allow what may be changed: --allow resize trim; a video '
            "without the given frame: --frame-zero absent."
        )
    return video


def estimator_view(job: Job, truth: Truth) -> np.ndarray | None:
    """The video [t h w 3] uint8 that estimators see in place of a job's own; None where they see the job's.

    For the ground truth it is the true video softened, whose masks and points are still known.
    """
    if job.rollout is not None or job.cell.model != GROUND_TRUTH:
        return None
    return np.stack([cv2.GaussianBlur(frame, (0, 0), SOFTNESS) for frame in truth.rgb])


def _size(video: np.ndarray) -> str:
    return f"{len(video)} frames of {video.shape[2]}x{video.shape[1]}"

"""Third step of `evaluate`: read and grade the videos of one episode after another. Groups and results can be sent to other
processes.
"""

import itertools
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from xew.episode import EpisodeError, read_record
from xew.metrics.backends import Masker, Tracker
from xew.metrics.episode_cache import EpisodeCache
from xew.metrics.grade import JUDGED, ON_SURFACES, Comparison, Grades, grade, input_kind
from xew.metrics.grading.baselines import BASELINES
from xew.metrics.grading.codecs import ModelCodec
from xew.metrics.grading.list_jobs import Job
from xew.metrics.grading.settings import Args, GradingSettings
from xew.metrics.truth import Truth, read_truth
from xew.protocol import CODEC_TRUTH, GROUND_TRUTH, split_fault
from xew.rollout import Rollout, RolloutError, read_rollout_video, resize_frame

SOFTNESS = 0.8
"""Standard deviation [pixels] of the blur through which estimators see the true video. Reference-aligned ones hardly err on the
very video that they compare with; no prediction is ever that, and this is about as soft as a good codec leaves a video."""
OTHER_FRAME = 255**2 / 100
"""Mean squared error from which on frame 0 is not the given frame: a PSNR of 20 dB."""
OTHER_ASPECT = (
    "these aspect ratios differ, so crop or pad the picture in your file, or, if all of it was stretched to its size, pass "
    "--allow stretch"
)
"""Remedy for a video of another aspect ratio, in words."""

PARTS_OF_PROCESS = 3
"""Number of parts for each process from which on episodes are not divided."""
FEWEST_OF_PART = 4
"""Number of videos for which an episode is worth being read again."""

Group = list[tuple[Job, tuple[str, ...]]]
"""Jobs of one scene and robot, those of an episode together, each with the names of the metrics that are still to be graded."""


@dataclass
class GroupResult:
    """What came of grading a group, besides the scores in the store."""

    episodes: list[Path] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    notes: list[tuple[str, Path]] = field(default_factory=list)
    """Remarks on graded videos, each with the video's file."""
    without_shapes: list[Path] = field(default_factory=list)
    """The episodes whose bodies have unknown shapes, where these were needed."""


class ThreadResources(threading.local):
    """The estimators of one thread. Those without weights remember an episode, so each thread has its own."""

    def __init__(self, open_masker: Callable[[], Masker], open_tracker: Callable[[], Tracker]) -> None:
        self.masker, self.tracker = open_masker(), open_tracker()


@dataclass(frozen=True)
class Grader:
    """What the threads of a process grade videos with."""

    settings: GradingSettings
    resources: ThreadResources
    codecs: Mapping[str, ModelCodec]
    stop: threading.Event
    """Signal that no further video is to be begun."""
    done: Callable[[], object]
    """Called after each video."""

    def __call__(self, group: Group) -> GroupResult:
        """Grade jobs of one scene and robot, each episode of which is read once, and enter the scores.

        Raises:
            RolloutError: a video cannot be graded, unless the settings say to keep going.
        """
        result = GroupResult()
        for _, jobs in itertools.groupby(group, key=lambda pair: pair[0].episode):
            self._grade_episode(list(jobs), result)
        return result

    def _grade_episode(self, group: Group, result: GroupResult) -> None:
        """Grade jobs of one episode, enter the scores, and add to the result."""
        episode: EpisodeCache | None = None
        for job, metrics in group:
            if self.stop.is_set():
                break
            try:
                episode = episode or self.read_episode(group)
                self.settings.store.write(job.cell, self.grade(job, episode, metrics, result.notes))
            except (EpisodeError, ValueError) as error:
                message = str(error) if str(job.folder) in str(error) else f"{job.folder}: {error}"
                if not self.settings.args.keep_going:
                    raise RolloutError(message) from error
                result.errors.append(message)
            self.done()
        surfaces = episode.truth.surfaces if episode else None
        on_surfaces = any(input_kind(name) in (*ON_SURFACES, *JUDGED) for _, names in group for name in names)
        result.episodes.append(group[0][0].episode)
        if on_surfaces and surfaces is not None and not surfaces.known:
            result.without_shapes.append(group[0][0].episode)

    def read_episode(self, group: Group) -> EpisodeCache:
        """The episode of a group's jobs, as far as their metrics need it. Raises EpisodeError as `read_truth`."""
        job, _ = group[0]
        needed = {input_kind(name) for _, names in group for name in names}
        truth = read_truth(job.episode, job.cell.frames, needed, self.settings.surfaces, job.record)
        return EpisodeCache(truth, self.settings.first_frame)

    def grade(
        self, job: Job, episode: EpisodeCache, metrics: Sequence[str], notes: list[tuple[str, Path]] | None = None
    ) -> Grades:
        """Scores of one video; what users must know of it is added to `notes`.

        Raises RolloutError, EpisodeError or ValueError where it cannot be graded.
        """
        if job.rollout is None:
            prediction = make_baseline(job, episode.truth, self.codecs)
        else:
            prediction, remarks = read_prediction(job, job.rollout, episode.truth, self.settings.args)
            if notes is not None:
                notes += [(remark, job.rollout.video[0]) for remark in remarks]
        estimator_video = soften_truth(job, episode.truth)
        return grade(Comparison(prediction, episode, self.resources.masker, self.resources.tracker, estimator_video), metrics)


def make_baseline(job: Job, truth: Truth, codecs: Mapping[str, ModelCodec]) -> np.ndarray:
    """The video of a baseline [t h w 3] uint8; `codecs` by the conditions of CODEC_TRUTH.

    Raises RolloutError if the episode was replaced since it was listed.
    """
    if job.cell.model == CODEC_TRUTH:
        return codecs[job.cell.condition].reconstruct(job.episode, truth.rgb)
    baseline = BASELINES[job.cell.model]
    video = baseline.make(job.episode, truth)
    if baseline.source(job.episode, read_record(job.episode)) != job.cell.prediction:
        raise RolloutError(f"{job.episode} was replaced while this command ran; run it again.")
    return video


def read_prediction(job: Job, rollout: Rollout, truth: Truth, args: Args) -> tuple[np.ndarray, list[str]]:
    """The video of a rollout [t h w 3] uint8, of the truth's shape, and what users must know of it.

    Raises:
        RolloutError: the video cannot be read, or it has another shape and the options do not allow that.
    """
    path, size = rollout.video[0], truth.rgb.shape[1:3]
    frames = len(truth.rgb) - (args.frame_zero == "absent")
    fit = EpisodeSize(path, size, "stretch" in args.allow) if {"resize", "stretch"} & set(args.allow) else None
    rate = None if "rate" in args.allow else job.record.frame_rate
    most = frames if "trim" in args.allow else frames + 1
    video = read_rollout_video(rollout, rate, job.cell.prediction, most, fit)
    if video.shape[:3] != (frames, *size):
        raise RolloutError(_explain_shape(path, video.shape, (frames, *size), args))
    remarks = [fit.remark] if fit and fit.remark else []
    if args.frame_zero == "given":
        remarks += _compare_given_frame(video, truth)
    return np.concatenate([truth.rgb[:1], video]) if args.frame_zero == "absent" else video, remarks


class EpisodeSize:
    """Function of a frame of a video to the same frame at the size of its episode.

    Args:
        path: of the video, for messages.
        size: height and width of the episode [pixels].
        stretch: whether frames of another aspect ratio are stretched instead of refused.
    """

    def __init__(self, path: Path, size: tuple[int, ...], stretch: bool) -> None:
        self.path, self.size, self.stretch = path, size, stretch
        self.remark = ""
        """What was done, in words."""

    def __call__(self, frame: np.ndarray) -> np.ndarray:
        """The frame [h w 3] uint8, resized. Raises RolloutError if it has another aspect ratio that is not to be stretched."""
        if frame.shape[:2] == self.size:
            return frame
        same = _have_same_aspect(frame.shape, self.size)
        if not same and not self.stretch:
            raise RolloutError(f"{self.path} is {_size(frame.shape)}, its episode {_size(self.size)}; {OTHER_ASPECT}.")
        self.remark = f"were {'resized' if same else 'stretched'} from {_size(frame.shape)} to {_size(self.size)}"
        return resize_frame(frame, self.size)


def _have_same_aspect(shape: tuple[int, ...], size: tuple[int, ...]) -> bool:
    """Would a frame [h w 3] that is resized to a height be less than a pixel off its width?"""
    return abs(shape[1] * size[0] / shape[0] - size[1]) < 1


def _explain_shape(path: Path, found: tuple[int, ...], expected: tuple[int, ...], args: Args) -> str:
    """Message about a video [t h w 3] that has not the expected number and size of frames [t h w], with what helps."""
    frames, more = expected[0], found[0] > expected[0]
    ways = []
    if found[1:3] != expected[1:]:
        ways.append("pass --allow resize" if _have_same_aspect(found[1:], expected[1:]) else OTHER_ASPECT)
    if found[0] != frames:
        ways.append('say in rollout.json how many frames were asked for, with the given one ({"frame_count": n})')
    if more:
        ways.append("cut longer videos by --allow trim")
    if found[0] == frames - 1 and args.frame_zero == "given":
        ways.append("of videos without the given frame say --frame-zero absent")
    return (
        f"{path} is {'at least ' if more else ''}{found[0]} frames of {_size(found[1:])}, expected {frames} frames of "
        f"{_size(expected[1:])}{' after the given one' if args.frame_zero == 'absent' else ''} as in the episode; "
        f"{', or '.join(ways)}."
    )


def _size(shape: Sequence[int]) -> str:
    return f"{shape[1]}x{shape[0]}"


def _compare_given_frame(video: np.ndarray, truth: Truth) -> list[str]:
    """What is wrong with the first frame of a video [t h w 3], which should be the given one."""
    first, second = (frame.astype(np.float32) for frame in truth.rgb[:2])
    errors = [np.square(video[0] - frame).mean() for frame in (first, second)]
    if errors[0] - errors[1] > np.square(first - second).mean() / 2:  # half, for a codec's errors in the given frame
        return [
            "begin with a picture that is nearer to frame 1 than to frame 0; if they lack frame 0, pass --frame-zero absent"
        ]
    if errors[0] > OTHER_FRAME:
        return ["begin with a picture unlike the given frame 0 (PSNR under 20 dB)"]
    return []


def soften_truth(job: Job, truth: Truth) -> np.ndarray | None:
    """Blurred true video [t h w 3] uint8, which estimators see instead of the ground truth; None for other jobs."""
    if job.rollout is not None or job.cell.model != GROUND_TRUTH:
        return None
    return np.stack([cv2.GaussianBlur(frame, (0, 0), SOFTNESS) for frame in truth.rgb])


def group_jobs(settings: GradingSettings, jobs: Sequence[Job]) -> list[Group]:
    """Jobs that are not graded yet, grouped by scene and robot; the largest groups come first, so none starts last.

    Jobs of one episode stand together in `jobs`, and do so in their group.
    """
    overwrite, store = settings.args.overwrite, settings.store
    wanted = [(job, settings.metrics if overwrite else store.missing(job.cell, settings.metrics)) for job in jobs]
    todo = [(job, names) for job, names in wanted if names]
    if len(todo) < len(jobs):
        print(f"{len(jobs) - len(todo)} of {len(jobs)} are graded already in {store.folder}")
    groups = [list(group) for _, group in itertools.groupby(sorted(todo, key=_scene), key=_scene)]
    return sorted(groups, key=lambda group: len(group) * group[0][0].cell.frames, reverse=True)


def _scene(pair: tuple[Job, tuple[str, ...]]) -> tuple[str, int, str, int]:
    """Task, base seed and robot of a job, and its number of frames: what retrieval compares has them in common."""
    cell = pair[0].cell
    return cell.task, split_fault(cell.seed)[1], cell.robot, cell.frames


def split_groups(groups: Sequence[Group], processes: int) -> list[Group]:
    """The groups, divided where few episodes have so many videos that processes would wait for the last one."""
    most = max(FEWEST_OF_PART, -(-sum(map(len, groups)) // (PARTS_OF_PROCESS * processes)))
    return [group[start : start + most] for group in groups for start in range(0, len(group), most)]


def describe_results(results: Sequence[GroupResult], total: int) -> str:
    """What users must know of graded videos, in lines; `total` is the number of all videos, with those graded before."""
    noted: dict[str, list[Path]] = {}
    for note, path in (noted_video for result in results for noted_video in result.notes):
        noted.setdefault(note, []).append(path)
    lines = [f"{len(paths)} of {total} videos {note} (such as {min(paths)})" for note, paths in sorted(noted.items())]
    episodes, without_shapes = (
        {episode for result in results for episode in getattr(result, name)} for name in ("episodes", "without_shapes")
    )
    if without_shapes:
        lines.append(
            f"the shapes of {len(without_shapes)} of {len(episodes)} episodes are not known "
            f"(imported, or of another version of their task, such as {min(without_shapes)}): their strict metrics of points "
            "are of links' and objects' origins"
        )
    return "\n".join(lines)

"""First step of `evaluate`: list the rollouts, the episodes that they predict, and the baselines on these episodes."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tqdm import tqdm

from xew.concurrency import map_in_order
from xew.config import ConfigError
from xew.dataset import Episode, demand_one_change, demand_one_motion, find_accepted
from xew.episode import EpisodeError, Record, episode_folder, read_record
from xew.files import digest_files
from xew.metrics.grading.baselines import BASELINES
from xew.metrics.grading.codecs import ModelCodec, match_codecs, open_codecs
from xew.metrics.grading.scores import Cell
from xew.metrics.grading.settings import GradingSettings
from xew.protocol import BASELINES as TITLES
from xew.protocol import CODEC_TRUTH, seed_split
from xew.rollout import Rollout, RolloutError, find_rollouts

WITHOUT_PREDICTION = {"frame_zero": "given", "allowed": []}
"""Choices about videos of models, as they are without any. Baselines do not depend on them: all models share their scores."""


@dataclass(frozen=True)
class Job:
    """One video to grade: a rollout, or a baseline on a rollout's episode and frames."""

    cell: Cell
    rollout: Rollout | None
    """None: the baseline that the cell names as its model."""
    episode: Path
    record: Record

    @property
    def folder(self) -> Path:
        """Folder that messages name."""
        return self.rollout.folder if self.rollout else self.episode


@dataclass(frozen=True)
class Listing:
    """All videos to grade, and what was opened and refused while they were listed."""

    jobs: Sequence[Job]
    """Each video once, those of one episode together."""
    codecs: Mapping[str, ModelCodec]
    """The codecs of graded models, or, without rollouts, of runs; by the model's name."""
    motion: str
    errors: Sequence[str]
    """Messages about rollouts that cannot be graded and are left out."""
    change: str
    """The change of all scenes, see `dataset.demand_one_change`."""


def list_jobs(settings: GradingSettings, baselines: Collection[str] | None = None) -> Listing:
    """List all videos to grade, and open the codecs.

    Args:
        settings: of the grading.
        baselines: keys of BASELINES; as the settings say if None.

    Raises:
        EpisodeError: a rollout cannot be graded, unless the settings say to keep going.
        ConfigError: options contradict each other, no rollout is named, or a codec cannot be opened.
    """
    args = settings.args
    if baselines is None:
        baselines = tuple(BASELINES) if args.baselines else ()
    if args.baselines_of and (args.rollouts or not baselines):
        raise ConfigError("--baselines-of grades baselines alone: leave out the rollouts, and --no-baselines.")
    if args.frame_zero == "predicted" and (baselines or args.codec):
        raise ConfigError(
            "frame 0 of the frozen first frame is the truth: with --frame-zero predicted say --no-baselines, and no --codec."
        )
    errors: list[str] = []
    problems = errors if args.keep_going else None
    rollouts = None if args.baselines_of else _find_unique(args.rollouts, problems)
    codecs = open_codecs(args.codec)
    if rollouts is None:
        jobs = _list_baseline_jobs(settings, baselines, codecs)
    else:
        codecs = match_codecs(codecs, rollouts)
        jobs = _list_rollout_jobs(rollouts, settings, baselines, codecs, problems)
    records = {job.episode: job.record for job in jobs}.values()
    return Listing(jobs, codecs, demand_one_motion(args.data, records), errors, demand_one_change(args.data, records))


def _list_rollout_jobs(
    rollouts: Sequence[Rollout],
    settings: GradingSettings,
    baselines: Collection[str],
    codecs: Mapping[str, ModelCodec],
    problems: list[str] | None,
) -> list[Job]:
    def try_jobs(rollout: Rollout) -> list[Job] | EpisodeError:
        try:
            return list(_jobs(rollout, settings, baselines, codecs.get(rollout.model)))
        except EpisodeError as error:
            return error

    unbound = sum(rollout.header.get("source_hash") is None for rollout in rollouts)
    if unbound:
        print(
            f"{unbound} of {len(rollouts)} rollouts do not say which video they predict (source_hash in rollout.json): they "
            "are graded against the episodes that their folders name"
        )
    jobs: dict[Cell, Job] = {}
    results = tqdm(map_in_order(try_jobs, rollouts), total=len(rollouts), desc="read", unit="video", disable=None, leave=False)
    for result in results:
        if isinstance(result, EpisodeError):
            _raise_or_note(problems, str(result))
        else:
            jobs |= {job.cell: job for job in result}
    _check_horizons(jobs.values())
    return sorted(jobs.values(), key=lambda job: (job.episode, job.rollout is None, job.cell.key))


def _jobs(rollout: Rollout, settings: GradingSettings, baselines: Collection[str], codec: ModelCodec | None) -> Iterator[Job]:
    episode, record = _find_episode(rollout, settings.args.data)
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
    cell = Cell(*key, frames, digest, rgb, states, str(settings.choices))
    yield Job(cell, rollout, episode, record)
    yield from _baseline_jobs(cell, (episode, record), settings, baselines, () if codec is None else (codec,))


def _baseline_jobs(
    cell: Cell, episode: Episode, settings: GradingSettings, baselines: Collection[str], codecs: Iterable[ModelCodec]
) -> Iterator[Job]:
    folder, record = episode
    cell = replace(cell, settings=str(settings.choices | WITHOUT_PREDICTION))
    for name in baselines:
        source = BASELINES[name].source(folder, record)
        if source is not None:
            yield Job(replace(cell, model=name, condition="", prediction=source), None, folder, record)
    for codec in codecs:
        through = replace(cell, model=CODEC_TRUTH, condition=codec.key, prediction=codec.digest)
        yield Job(through, None, folder, record)


def _list_baseline_jobs(settings: GradingSettings, baselines: Collection[str], codecs: Mapping[str, ModelCodec]) -> list[Job]:
    """The baselines on episodes that no model has predicted yet.

    Raises ConfigError where there is no episode or the number of frames is one that cannot be graded.
    """
    args = settings.args
    episodes = [episode for episode in find_accepted(args.data) if seed_split(episode[1].seed) == args.baselines_of]
    if not episodes:
        raise ConfigError("the data set holds no episode of these seeds; generate some, or name others: --baselines-of.")
    if args.max_frames < 0 or args.max_frames == 1:
        raise ConfigError(f"--max-frames is {args.max_frames}; expected at least 2 frames, or 0 for whole episodes.")
    jobs: list[Job] = []
    for folder, record in episodes:
        rgb, states = (record.hashes.get(name, "") for name in ("rgb", "states"))
        frames = min(record.frame_count, args.max_frames or record.frame_count)
        cell = Cell("", "", record.task, record.seed, record.robot, frames, "", rgb, states, str(settings.choices))
        jobs += _baseline_jobs(cell, (folder, record), settings, baselines, dict.fromkeys(codecs.values()))
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


def _find_episode(rollout: Rollout, data: Path) -> Episode:
    folder = episode_folder(data, rollout.task, rollout.seed, rollout.robot)
    if not folder.is_dir():
        raise RolloutError(
            f"{rollout.folder} predicts {rollout.task}, seed {rollout.seed}, {rollout.robot}, which {data} does not hold; name "
            "the data set that the rollout was made from: --data."
        )
    record = read_record(folder)
    if not record.is_kept:
        raise RolloutError(f"{rollout.folder} predicts an episode that was rejected ({record.failure}); delete this rollout.")
    source = rollout.header.get("source_hash")
    if source is not None and source != record.hashes.get("rgb"):
        raise RolloutError(f"{rollout.folder} was made from another video than {folder} now holds; make this rollout again.")
    return folder, record


def _find_unique(roots: Sequence[Path], problems: list[str] | None) -> list[Rollout]:
    """Rollouts of all trees, without those that claim to be the same model's video of one episode or a baseline's."""
    if not roots:
        raise ConfigError(
            "no rollouts named; give their folder: python -m xew.metrics.evaluate ROLLOUTS --data DATA, or grade the baselines "
            "alone: --baselines-of test"
        )
    unique: dict[tuple[str, str, str, int, str], Rollout] = {}
    for rollout in (rollout for root in roots for rollout in find_rollouts(root, problems)):
        if rollout.model in TITLES:
            _raise_or_note(problems, f"{rollout.folder}: the name {rollout.model} is a baseline's; give the model another.")
            continue
        first = unique.setdefault((rollout.model, rollout.condition, rollout.task, rollout.seed, rollout.robot), rollout)
        if first is not rollout:
            _raise_or_note(
                problems,
                f"{first.folder} and {rollout.folder} are both model {rollout.model!r}, condition {rollout.condition!r}; "
                "give them different names in rollout.json.",
            )
    return list(unique.values())


def _raise_or_note(problems: list[str] | None, message: str) -> None:
    if problems is None:
        raise RolloutError(message)
    problems.append(message)

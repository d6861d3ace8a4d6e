"""Choosing the episodes of a data set that a training run, its samples or a rollout read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from xew.config import ConfigError, suggestion
from xew.dataset import Dataset, Episode, demand_one_motion, read_dataset
from xew.episode import EpisodeError
from xew.model.settings.parts import EpisodeChoice
from xew.protocol import expand_robots


@dataclass(frozen=True)
class TrainingEpisodes:
    """The episodes that a training run reads."""

    fresh: list[Episode]
    """Those to learn from."""
    replay: list[Episode]
    """Those of the run that an adaptation starts from, of which every batch has a part."""
    samples: dict[str, Episode]
    """Those that sample videos are drawn of, by role and robot."""


def choose_episodes(dataset: Dataset, choice: EpisodeChoice) -> TrainingEpisodes:
    """Choose all episodes that a training run reads.

    Raises:
        ConfigError, EpisodeError: there are none to learn from, too few to adapt to, or no videos to draw samples of.
    """
    samples = sample_episodes(dataset, choice.samples, choice.motion)
    bare = [folder for folder, record in samples.values() if not record.videos]
    if bare:
        raise ConfigError(
            f"{bare[0]} was made with --states-only and has no video to begin a sample with; draw none with "
            f"--train.sample-every 0, or make videos: python -m xew.sim_warp.inspect {dataset.root} --render"
        )
    return TrainingEpisodes(training_episodes(dataset, choice), replay_episodes(dataset, choice), samples)


def training_episodes(dataset: Dataset, choice: EpisodeChoice) -> list[Episode]:
    """Episodes to learn from, of training seeds: all of the training robots, or a few of the robots to adapt to.

    Raises:
        ConfigError, EpisodeError: there are none, or too few to adapt to.
    """
    return _select_training(dataset, choice.robots, choice.motion, shots=choice.shots, need_all=choice.shots > 0)


def replay_episodes(dataset: Dataset, choice: EpisodeChoice) -> list[Episode]:
    """In an adaptation with replay, what the run that it starts from was trained on; else none."""
    return _select_training(dataset, choice.replay, choice.motion, need_all=True) if choice.replay else []


def _select_training(dataset: Dataset, robots: Sequence[str], motion: str, *, shots: int = 0, need_all: bool) -> list[Episode]:
    """Episodes of training seeds of some robots, all or the first few of each task and robot.

    Raises:
        ConfigError: a robot has none (one of all, unless all are needed), or fewer than those few.
        EpisodeError: some are of another kind of motion.
    """
    chosen = dataset.select(robots=robots, split="train", motion=motion)
    if shots:
        chosen = first_of_each(chosen, shots)
    missing = [robot for robot in robots if robot not in {record.robot for _, record in chosen}]
    if missing and (need_all or not chosen):
        raise explain_missing_robots(dataset, missing, "training episode")
    return chosen


def first_of_each(episodes: Sequence[Episode], count: int) -> list[Episode]:
    """The first `count` seeds of every task and robot. Raises ConfigError where there are fewer."""
    groups: dict[tuple[str, str], list[Episode]] = {}
    for episode in sorted(episodes, key=lambda episode: episode[1].seed):
        groups.setdefault((episode[1].task, episode[1].robot), []).append(episode)
    for (task, robot), group in groups.items():
        if len(group) < count:
            raise ConfigError(
                f"adapt.episodes is {count}, there are only {len(group)} training episodes of {robot} in {task}; lower it, or "
                "make more with `python -m xew.sim_warp.generate`."
            )
    return [episode for _, group in sorted(groups.items()) for episode in group[:count]]


def sample_episodes(dataset: Dataset, roles: Mapping[str, str], motion: str | None = None) -> dict[str, Episode]:
    """An episode of each of these robots that the data has, by role and robot, never of a test seed.

    It is of a validation seed where there is one of that robot, else of a training seed, which a model of the robot has seen.
    """
    robots = tuple(roles)
    candidates = [e for family in ("validation", "train") for e in dataset.select(robots=robots, split=family, motion=motion)]
    first = {record.robot: (folder, record) for folder, record in reversed(candidates)}
    return {f"{roles[robot]}/{robot}": first[robot] for robot in roles if robot in first}


def select_episodes(data: Path, split: str, robots: Sequence[str] | None = None) -> list[Episode]:
    """Accepted episodes of a seed family and of the given robots, or of all.

    Raises:
        ConfigError, EpisodeError: there is none, or they are of both kinds of motion.
    """
    dataset = read_dataset(data)
    robots = expand_robots(robots or ()) or None
    missing = [robot for robot in robots or () if robot not in dataset.robots]
    if missing:
        raise explain_missing_robots(dataset, missing)
    chosen = dataset.select(robots=robots, split=split)
    if not chosen:
        asked = f"{split} episode of {', '.join(robots)}" if robots else f"{split} episode"
        seeds = " --validation-seeds 4" if split == "validation" else ""
        raise EpisodeError(f"{data} has no {asked}; run python -m xew.sim_warp.generate --out {data}{seeds}")
    demand_one_motion(data, (record for _, record in chosen))
    return chosen


def explain_missing_robots(dataset: Dataset, robots: Sequence[str], what: str = "episode") -> ConfigError:
    """The error for robots of which there is no such episode: it says which robots there are, and how to make some."""
    known, asked = sorted({record.robot for _, record in dataset.cells}), ", ".join(robots[:6])
    return ConfigError(
        f"{dataset.root} has no {what} of {asked}{' …' if len(robots) > 6 else ''};{suggestion(robots[0], known)} it has "
        f"{', '.join(known) or 'nothing'}. Make some: python -m xew.sim_warp.generate --robots {' '.join(robots[:6])} "
        f"--out {dataset.root}"
    )

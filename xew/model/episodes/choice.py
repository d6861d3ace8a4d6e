"""Selection of the episodes of a training run, its sample videos and rollouts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from xew.config import ConfigError, suggestion
from xew.dataset import Dataset, Episode, demand_one_motion, demand_one_rate, read_dataset
from xew.episode import EpisodeError
from xew.model.settings.parts import EpisodeChoice
from xew.protocol import expand_robots

SAMPLE_ROBOTS = 8
"""Largest number of robots of a role in sample videos, which take seconds each to grade; there may be 128 bodies."""


@dataclass(frozen=True)
class TrainingEpisodes:
    """The episodes of a training run."""

    fresh: list[Episode]
    """Training episodes."""
    replayed: list[Episode]
    """Training episodes that a part of every batch is drawn from (`replayed_episodes`)."""
    samples: dict[str, Episode]
    """Episodes of sample videos, by role and robot."""


def choose_episodes(dataset: Dataset, choice: EpisodeChoice) -> TrainingEpisodes:
    """Choose all episodes of a training run.

    Raises:
        ConfigError, EpisodeError: there are no or too few training episodes, or they have several frame rates.
    """
    samples = sample_episodes(dataset, choice.samples, choice.motion)
    fresh, replayed = training_episodes(dataset, choice), replayed_episodes(dataset, choice)
    demand_one_rate(dataset.root, (record for _, record in (*fresh, *replayed)))
    return TrainingEpisodes(fresh, replayed, samples)


def training_episodes(dataset: Dataset, choice: EpisodeChoice) -> list[Episode]:
    """The expert's training episodes of the training robots, or the first few (`shots`) of the robots to adapt to.

    Raises:
        ConfigError: there are none or, in an adaptation, too few of a robot.
        EpisodeError: some have another kind of motion.
    """
    return _select_training(dataset, choice.robots, choice.motion, shots=choice.shots, need_all=choice.shots > 0)


def replayed_episodes(dataset: Dataset, choice: EpisodeChoice) -> list[Episode]:
    """Episodes that an adaptation replays, training episodes of the run that it starts from. Raises as `training_episodes`."""
    return _select_training(dataset, choice.replay, choice.motion, need_all=True) if choice.replay else []


def _select_training(dataset: Dataset, robots: Sequence[str], motion: str, *, shots: int = 0, need_all: bool) -> list[Episode]:
    chosen = dataset.select(robots=robots, split="train", motion=motion, faults=False)
    if shots:
        chosen = first_of_each(chosen, shots)
    missing = [robot for robot in robots if robot not in {record.robot for _, record in chosen}]
    if missing and (need_all or not chosen):
        raise explain_missing_robots(dataset, missing, "training episode")
    return chosen


def first_of_each(episodes: Sequence[Episode], count: int) -> list[Episode]:
    """The first `count` seeds of every task and robot. Raises ConfigError if there are fewer."""
    groups: dict[tuple[str, str], list[Episode]] = {}
    for episode in sorted(episodes, key=lambda episode: episode[1].seed):
        groups.setdefault((episode[1].task, episode[1].robot), []).append(episode)
    for (task, robot), group in groups.items():
        if len(group) < count:
            raise ConfigError(
                f"adapt.episodes is {count}, there are only {len(group)} training episodes of {robot} in {task}; lower it, or "
                "make more episodes with `python -m xew.sim_warp.generate`."
            )
    return [episode for _, group in sorted(groups.items()) for episode in group[:count]]


def sample_episodes(dataset: Dataset, roles: Mapping[str, str], motion: str | None = None) -> dict[str, Episode]:
    """The expert's episode with videos of these robots, by role and robot: of a validation, else a training seed.

    Of each role, the first SAMPLE_ROBOTS robots that have one.
    """
    candidates = [
        episode
        for family in ("validation", "train")
        for episode in dataset.select(robots=tuple(roles), split=family, motion=motion, faults=False)
    ]
    first = {record.robot: (folder, record) for folder, record in reversed(candidates) if record.videos}
    by_role: dict[str, list[str]] = {}
    for robot, role in roles.items():
        if robot in first:
            by_role.setdefault(role, []).append(robot)
    return {f"{role}/{robot}": first[robot] for role, robots in by_role.items() for robot in robots[:SAMPLE_ROBOTS]}


def select_episodes(data: Path, split: str, robots: Sequence[str] | None = None, faults: bool = True) -> list[Episode]:
    """Accepted episodes of a seed family and of the given robots, by default all; without `faults` the experts' alone.

    Raises:
        ConfigError, EpisodeError: there are none, or they have both kinds of motion.
    """
    dataset = read_dataset(data)
    robots = expand_robots(robots or ()) or None
    missing = [robot for robot in robots or () if robot not in dataset.robots]
    if missing:
        raise explain_missing_robots(dataset, missing)
    chosen = dataset.select(robots=robots, split=split, faults=faults)
    if not chosen:
        asked = f"{split} episode of {', '.join(robots)}" if robots else f"{split} episode"
        seeds = " --validation-seeds 4" if split == "validation" else ""
        raise EpisodeError(f"{data} has no {asked}; run python -m xew.sim_warp.generate --out {data}{seeds}")
    demand_one_motion(data, (record for _, record in chosen))
    return chosen


def explain_missing_robots(dataset: Dataset, robots: Sequence[str], what: str = "episode") -> ConfigError:
    """The error for robots without such an episode, with the robots of the data and the command that makes episodes."""
    known, missing = sorted({record.robot for _, record in dataset.cells}), ", ".join(robots[:6])
    return ConfigError(
        f"{dataset.root} has no {what} of {missing}{' …' if len(robots) > 6 else ''};{suggestion(robots[0], known)} it has "
        f"{', '.join(known) or 'nothing'}. Make some: python -m xew.sim_warp.generate --robots {' '.join(robots[:6])} "
        f"--out {dataset.root}"
    )

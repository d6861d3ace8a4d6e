"""Selection of episodes to train or measure an autoencoder, without pairing over robots."""

from collections.abc import Collection, Sequence
from typing import Literal

from xew.dataset import Dataset, Episode, demand_motion
from xew.model.episodes.choice import explain_missing_robots
from xew.protocol import seed_split

Seeds = Literal["train", "test"]
"""Seed family."""


def select_unpaired(dataset: Dataset, robots: Collection[str], seeds: Seeds) -> list[Episode]:
    """Sorted experts' episodes with videos of some robots and a seed family, including seeds at which another robot failed."""
    return [
        (folder, record)
        for folder, record in dataset.cells
        if record.is_kept and not record.fault and record.videos and record.robot in robots and seed_split(record.seed) == seeds
    ]


def unpaired_training_episodes(dataset: Dataset, robots: Sequence[str], motion: str) -> list[Episode]:
    """Episodes with videos of training seeds of some robots.

    Raises:
        ConfigError: there are none.
        EpisodeError: some have another kind of motion.
    """
    episodes = select_unpaired(dataset, robots, "train")
    if not episodes:
        raise explain_missing_robots(dataset, robots, "training episode with videos")
    demand_motion(dataset.root, (record for _, record in episodes), motion)
    return episodes

"""Choosing the episodes of a data set that an autoencoder is trained or measured on, which needs no pairs of robots."""

from collections.abc import Collection, Sequence
from typing import Literal

from xew.dataset import Dataset, Episode, demand_motion
from xew.model.episodes.choice import explain_missing_robots
from xew.protocol import seed_split

Seeds = Literal["train", "test"]
"""A family of seeds that a codec is trained or measured on."""


def select_unpaired(dataset: Dataset, robots: Collection[str], seeds: Seeds) -> list[Episode]:
    """Episodes with pictures of some robots and a family of seeds, sorted; possibly none.

    Seeds at which another robot has failed count too where this one's pictures are there.
    """
    return [
        (folder, record)
        for folder, record in dataset.cells
        if record.success and record.videos and record.robot in robots and seed_split(record.seed) == seeds
    ]


def unpaired_training_episodes(dataset: Dataset, robots: Sequence[str], motion: str) -> list[Episode]:
    """Episodes with pictures of training seeds of some robots.

    Raises:
        ConfigError: there is none at all.
        EpisodeError: some are of another kind of motion.
    """
    episodes = select_unpaired(dataset, robots, "train")
    if not episodes:
        raise explain_missing_robots(dataset, robots, "training episode with videos")
    demand_motion(dataset.root, (record for _, record in episodes), motion)
    return episodes

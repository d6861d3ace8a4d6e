"""The commands of an episode, from which conditions are made before anything of it has happened."""

from pathlib import Path

import numpy as np

from xew.episode import Record, read_states
from xew.model.conditions import Command, make_command


def episode_command(
    folder: Path, record: Record, rendered: np.ndarray | None = None, scene: np.ndarray | None = None
) -> Command:
    """Read what conditions may be made from, of an episode of a data set.

    Args:
        rendered: [t 240 320 3] uint8, the robot alone, where it is in memory; else its video is read when it is needed.
        scene: [t 240 320 3] uint8, the episode's video, where it is in memory; conditions see its first frame alone.
    """
    return make_command(folder, record, read_states(folder), rendered, scene)

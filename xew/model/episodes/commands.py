"""Reading the commands of an episode, the input of conditions."""

from pathlib import Path

import numpy as np

from xew.episode import Record, read_states
from xew.model.conditions import Command, make_command


def episode_command(
    folder: Path, record: Record, rendered: np.ndarray | None = None, scene: np.ndarray | None = None
) -> Command:
    """Read the command of an episode.

    Args:
        folder: of the episode.
        record: of the episode.
        rendered: [t 240 320 3] uint8, the robot alone, if in memory; otherwise its video is read when needed.
        scene: [n 240 320 3] uint8, the first frames of the episode's video, if in memory; conditions see one alone.
    """
    return make_command(folder, record, read_states(folder, record), rendered, scene)

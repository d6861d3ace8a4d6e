"""Video through a run's codec and back: what is left of true frames, for whoever measures it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from xew.config import ConfigError
from xew.model.runs.folder import load_run
from xew.model.video.frames import to_camera_size, to_model_size


def open_roundtrip(run: Path) -> Callable[[np.ndarray], np.ndarray]:
    """A function of video [t h w 3] uint8 to what the codec of a run leaves of it, [t h w 3] uint8.

    Raises:
        ConfigError: there is no such run.
    """
    try:
        experiment, codec = load_run(run)
    except FileNotFoundError as error:
        raise ConfigError(
            f"{run} is no run with a codec ({error.filename}); name a folder that xew.model.train wrote."
        ) from error

    def reconstruct(video: np.ndarray) -> np.ndarray:
        filled = np.concatenate([video, np.repeat(video[-1:], -(len(video) - 1) % 4, axis=0)])  # it takes 4 k + 1 frames
        small = to_model_size(filled, experiment.clip.height, experiment.clip.width)
        return to_camera_size(codec.decode(codec.encode(small)))[: len(video)]

    return reconstruct

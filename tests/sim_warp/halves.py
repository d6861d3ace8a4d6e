"""A job for worker processes, which import its module: one without the simulator, for a quick start."""

import os
import signal

from xew.config import ConfigError


def half(number: int) -> int:
    """Half of a number; 13 is an error, and 17 kills the worker."""
    if number == 13:
        raise ConfigError("thirteen")
    if number == 17:
        os.kill(os.getpid(), signal.SIGKILL)
    return number // 2
